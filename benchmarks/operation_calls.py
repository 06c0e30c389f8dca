"""Bad calls, each in a forked child with a clock and a limit of memory: `operation.py --only calls`.

The cases are lists CASES of tuples (code, expected, words) in modules of their own, one for each half of the
package. The code's last line is the call, its value goes into the note; the names of `names()` are at hand.
What is expected: "bad": an error of the package with one of the words, or one that the code's own function
raises; "ok": an answer; "either" of both.
"""

import contextlib
import importlib.util
import json
import os
import random
import resource
import signal
import tempfile
import traceback
import warnings

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import mesh
from operation_cases import Case

import polarmpm as pm

HALVES = {"calls: bodies": "operation_calls_bodies", "calls: problems": "operation_calls_problems"}
_SECONDS = 40
_BYTES = 10 << 30
_QUICK = 12  # cases of each half


def cases(quick, seed):
    """Cases of both halves of the package, one after the other."""
    scene = names()
    with tempfile.TemporaryDirectory() as folder:
        scene["OUT"] = folder
        for group, module in HALVES.items():
            if importlib.util.find_spec(module) is None:
                continue
            listed = importlib.import_module(module).CASES
            if quick:
                listed = random.Random(seed).sample(listed, min(_QUICK, len(listed)))
            for code, expected, words in listed:
                yield in_child(group, code, expected, words, scene)


def in_child(group, code, expected, words, scene):
    """The case of a call, from a process that may crash, hang or run out of memory."""
    if expected not in ("bad", "ok", "either"):
        raise ValueError(f"expected = {expected!r}: bad, ok or either")
    found, ended = forked(lambda: _called(code, scene), scene["OUT"], _SECONDS)
    name = " ; ".join(code.strip().split("\n"))
    if found is None:
        return Case(group, name, *ended)
    kind, note = found
    return Case(group, name, _verdict(kind, note, expected, words), note.split("\n")[0][:250])


def forked(function, folder, seconds):
    """What a function returns in a child (as JSON), or None and how the child has ended: verdict and note."""
    read, write = os.pipe()
    with tempfile.TemporaryFile("w+") as log:
        child = os.fork()
        if child == 0:
            os.close(read)
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
            os.chdir(folder)
            signal.alarm(seconds)
            resource.setrlimit(resource.RLIMIT_AS, (_BYTES, _BYTES))
            os.write(write, json.dumps(function()).encode())
            os._exit(0)
        os.close(write)
        with os.fdopen(read, "rb") as pipe:
            found = pipe.read()
        _, status = os.waitpid(child, 0)
        log.seek(0)
        said = " ".join(log.read()[-200:].split())
    if found:
        return json.loads(found), None
    late = os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGALRM
    return None, ("hang" if late else "crash", f"status {status}: {said}")


def _called(code, scene):
    *before, last = code.strip().split("\n")
    try:
        names_ = dict(scene)
        exec("\n".join(before), names_)
        try:
            call = compile(last, "<string>", "eval")
        except SyntaxError:
            exec(code, names_)
            return "answer", ""
        return "answer", repr(eval(call, names_))
    except pm.PolarMPMError as e:
        return "refused", str(e)
    except BaseException as e:
        return ("own" if _passed_on(e) else "raw"), f"{type(e).__name__}: {e}"


def _passed_on(error):
    """Whether it comes from a function of the code that the package has called, or is Python's own word on
    arguments that are missing."""
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
    wrappers = os.sep + "meetings.py"  # around collective calls
    ours = any(f.startswith(os.path.dirname(pm.__file__)) and not f.endswith(wrappers) for f in files)
    if isinstance(error, TypeError) and "argument" in str(error) and not ours:
        return True
    return files[-1] == "<string>" and ours


def _verdict(kind, note, expected, words):
    if kind == "answer":
        return "silent" if expected == "bad" else "right"
    if kind in ("raw", "own"):
        return "clear" if kind == "own" and expected != "ok" else "raw"
    words = (words,) if isinstance(words, str) else words
    clear = expected != "ok" and (not words or any(w.lower() in note.lower() for w in words))
    return "clear" if clear else "unclear"


def names():
    """What the codes can use: modules, materials, and small scenes."""
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    MP = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.3, l_b=0.1, l_t=0.1, psi=1.0)
    NH = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)
    VM = pm.VonMises(MP, k=1e4, H=1e4, l_p=0.1)

    def grid(dim=2):
        return pm.Grid.box((-1,) * dim, (5, 3, 3)[:dim], 1.0)

    def inside(x):
        return np.all((x >= 0) & (x <= np.array([3, 1, 1])[: x.shape[1]]), axis=1)

    def pts(dim=2, m=MP, **options):
        return pm.seed(grid(dim), inside, material=m, **options)

    def prob(dim=2, m=MP, basis="mpm", **options):
        return pm.QuasiStatic(grid(dim), pts(dim, m), basis=basis, **options)

    def clamped(dim=2, m=MP, basis="mpm", **options):
        p = prob(dim, m, basis, **options)
        p.fix(lambda x: x[:, 0] < 1e-6, u=0, **({} if m is NH else {"theta": 0}))
        return p

    def loaded(dim=2, m=MP, basis="mpm", f=10.0, **options):
        p = clamped(dim, m, basis, **options)
        tip = p.points.farthest((1,) + (0,) * (dim - 1))
        p.load(tip, force=(0,) * (dim - 1) + (f,))
        return p

    def run(p, n=1, **options):
        return list(p.march(n, progress=False, **options))

    def mesh2(n=4, m=2):
        return mesh.create_rectangle(MPI.COMM_WORLD, [[0, 0], [3, 1]], [n, m], mesh.CellType.quadrilateral)

    def fem(m=MP, **options):
        return pm.QuasiStaticFEM(pm.Elements(mesh2(), material=m, **options))

    def femc(m=MP, **options):
        p = fem(m, **options)
        p.fix(pm.plane(x=0.0), u=0, theta=0)
        return p

    def show(p):
        with contextlib.suppress(AttributeError):
            return f"mean u = {p.elements.mean_displacement()}"
        return f"mean u = {p.points.mean_displacement()}"

    plastic = {name: getattr(pm, name) for name in ("DruckerPrager", "VonMises", "UserPlasticity")}
    return {**locals(), **plastic, "np": np, "pm": pm, "ufl": ufl, "mesh": mesh, "MPI": MPI}
