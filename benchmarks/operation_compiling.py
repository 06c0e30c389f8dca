"""Compilers and caches of compiled code that fail, are damaged, foreign or stopped half-way."""

import contextlib
import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from operation_cases import Case, environment, run

GROUP = "compiling"
SCENE = """
import os, sys
nobody, mask = os.environ.get("AS_NOBODY"), os.environ.get("UMASK")
if mask:
    os.umask(int(mask, 8))
if nobody:
    os.setgid(65534), os.setuid(65534)
import polarmpm as pm
from mpi4py import MPI
if os.environ.get("NO_PATH"):
    os.environ["PATH"] = "/nonexistent"
def points():
    grid = pm.Grid.box((-1, -1), (4, 3), 1.0)
    body = pm.seed(grid, bounds=((0, 0), (3, 1)), material=pm.NeoHookean(lam=1e6, mu=1e6))
    return pm.QuasiStatic(grid, body, basis="mpm")
def elements():
    import dolfinx.mesh
    mesh = dolfinx.mesh.create_unit_square(MPI.COMM_WORLD, 2, 1)
    return pm.QuasiStaticFEM(pm.Elements(mesh, material=pm.NeoHookean(lam=1e6, mu=1e6)))
try:
    problem = points() if sys.argv[1] == "points" else elements()
    problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=(0, 1e3))
    for step in problem.march(1, progress=False):
        pass
    force, stress = problem.steps[-1].history[0][0], abs(problem.fields().stress).max()
    told = f"RESULT {force} {MPI.COMM_WORLD.allreduce(stress, op=MPI.MAX)}"
except pm.PolarMPMError as e:
    told = f"CLEAR {e}"
except Exception as e:
    told = f"RAW {type(e).__name__} {e}"
report = os.path.join(os.environ["REPORT"], str(MPI.COMM_WORLD.rank))
open(report, "w").write(" ".join(told.split()))  # lines of ranks may run into each other
"""
RAW_LINES = ("INFO:", "gcc", "CHOLMOD", "error: ", "Traceback", "CRITICAL", "warning: ")
WAY_OUT = ("POLARMPM_CACHE", "CC", "gcc")
EVIL = """
#include <stdio.h>
#include <stdlib.h>
__attribute__((constructor)) static void f(void) { FILE *g = fopen(getenv("TAKEN"), "w"); if (g) fclose(g); }
"""


class Scene:
    """A scene of points or of elements, its right answer, and a cache that has all it compiles."""

    def __init__(self, kind, folder):
        self.kind, self.folder, self.good = kind, folder, folder / f"good-{kind}"
        self.report = folder / f"report-{kind}"
        self.report.mkdir()
        self.report.chmod(0o777)
        self._run(self.good)
        self.expected = self._result(self.told())

    def _run(self, cache, ranks=1, timeout=45.0, **env):
        for file in self.report.iterdir():
            file.unlink()
        places = {"XDG_CACHE_HOME": str(cache), "POLARMPM_CACHE": "", "REPORT": str(self.report), **env}
        return run(SCENE, self.kind, ranks=ranks, timeout=timeout, **places)

    def told(self):
        """What each rank has found."""
        return [file.read_text() for file in sorted(self.report.iterdir())]

    @staticmethod
    def _result(told):
        return [float(x) for x in told[0].split()[1:]]

    def copy(self, name):
        """A cache to be damaged."""
        target = self.folder / f"{self.kind} {name}".replace("/", "-")
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(self.good, target)
        return target

    def case(self, name, cache, ranks=1, refused=False, **env):
        """Run it. `refused`: there's no right answer, only a clear message."""
        begin = time.monotonic()
        found = self._run(cache, ranks, **env)
        verdict, note = self._verdict(found, ranks, refused)
        seconds = time.monotonic() - begin
        return Case(GROUP, f"{self.kind}: {name}", verdict, f"{note[:200]} ({seconds:.0f} s)".strip())

    def _verdict(self, found, ranks, refused):
        if found.status is None:
            return "hang", found.err.strip()[-150:]
        told = self.told()
        said = [line for line in found.err.splitlines() if line.strip()]
        raw = [line for line in (*found.out.splitlines(), *said) if any(w in line for w in RAW_LINES)]
        if found.crashed or len(told) < ranks:
            return "crash", " ".join(said[-2:])
        if any(line.startswith("RAW") for line in told):
            return "raw", told[0]
        if any(line.startswith("CLEAR") for line in told):
            clear = all(line.startswith("CLEAR") and any(w in line for w in WAY_OUT) for line in told)
            return ("clear" if clear and not raw else "unclear"), told[0] + (f" raw: {raw[0]}" if raw else "")
        if refused:
            return "silent", "no error"
        if not self._same(self._result(told), ranks):
            return "silent", f"{told[0]} instead of {self.expected}"
        if raw:
            return "unclear", f"raw lines: {raw[0]}"
        return "right", said[0] if said else ""

    def _same(self, values, ranks):
        tolerance = 0.0 if ranks == 1 else 1e-8
        return all(abs(a - b) <= tolerance * abs(b) for a, b in zip(values, self.expected, strict=True))


def libraries(cache):
    return sorted(p for p in cache.rglob("*.so") if p.is_file())


def damage(scene, name, change, **options):
    cache = scene.copy(name)
    for file in libraries(cache):
        change(file)
    return scene.case(name, cache, **options)


def damaged(scene, quick, draw):
    """Libraries that are not what was compiled."""
    short = scene.kind == "elements"  # which take longer to compile
    for part in (0.0,) if quick else (0.0, 0.5) if short else (0.0, 0.1, 0.5, 0.9, 0.99):
        yield damage(
            scene, f"libraries cut to {part:.0%}", lambda f, p=part: os.truncate(f, int(p * f.stat().st_size))
        )
    if quick:
        return

    def flip(file):
        data = bytearray(file.read_bytes())
        for _ in range(3):
            data[draw.randrange(0x1000, min(len(data), 0x3000))] ^= 1 << draw.randrange(8)
        file.write_bytes(data)

    for i in range(1 if short else 3):
        yield damage(scene, f"flipped bits {i}", flip)
    yield damage(scene, "text instead of libraries", lambda f: f.write_text("no library"))

    def folder(file):
        file.unlink()
        file.mkdir()

    def link(file):
        other = file.with_suffix(".elsewhere")
        file.rename(other)
        file.symlink_to(other)

    if not short:
        yield damage(scene, "folders instead of libraries", folder)
        yield damage(scene, "links instead of libraries", link)
        yield damage(scene, "libraries that nobody may read", lambda f: f.chmod(0))
    cache = scene.copy("swapped")
    files = libraries(cache)
    contents = [f.read_bytes() for f in files]
    for file, content in zip(files, contents[1:] + contents[:1], strict=True):
        file.write_bytes(content)
    yield scene.case("libraries swapped", cache)
    cache = scene.copy("only libraries")
    for file in cache.rglob("*"):
        if file.is_file() and file.suffix != ".so":
            file.unlink()
    yield scene.case("only libraries left", cache)
    cache = scene.copy("no libraries")
    for file in libraries(cache):
        file.unlink()
    yield scene.case("no libraries left", cache)
    yield damage(scene, "libraries cut", lambda f: os.truncate(f, 1000), ranks=2)


def stopped(scene, quick, draw):
    """Compiles that are killed half-way, and what they leave."""
    script = scene.folder / "scene.py"
    script.write_text(SCENE)
    for i in range(1 if quick else 4):
        cache = scene.folder / f"{scene.kind} killed {i}"
        group, delay = bool(i % 2), draw.uniform(0.0, 0.2 if scene.kind == "points" else 2.0)
        process = subprocess.Popen(
            [sys.executable, str(script), scene.kind],
            env=environment(XDG_CACHE_HOME=str(cache), POLARMPM_CACHE="", REPORT=str(scene.report)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        end = time.monotonic() + 30.0
        while time.monotonic() < end and not any(cache.rglob("*.c")) and process.poll() is None:
            time.sleep(0.01)
        time.sleep(delay)
        (os.killpg if group else os.kill)(process.pid, signal.SIGKILL)
        process.wait()
        case = scene.case(f"killed {i} while compiling", cache)
        left = [p.name for p in cache.rglob("*") if p.name.startswith((".polarmpm-", "tmp"))]
        if left and case.verdict == "right":
            case = Case(GROUP, case.name, "unclear", f"left behind: {left[0]}")
        yield case
    if quick:
        return
    cache = scene.copy("stale locks")
    for file in cache.rglob("*"):
        if file.is_file() and file.suffix != ".c":
            file.unlink()
    yield scene.case("locks of a dead process", cache)
    cache = scene.folder / f"{scene.kind} race"
    reports, together = [scene.folder / f"{scene.kind} race {i}" for i in range(4)], []
    for report in reports:
        report.mkdir()
        together.append(
            subprocess.Popen(
                [sys.executable, str(script), scene.kind],
                env=environment(XDG_CACHE_HOME=str(cache), POLARMPM_CACHE="", REPORT=str(report)),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        )
    for process in together:
        process.wait(timeout=120)
    told = [(report / "0").read_text() if (report / "0").exists() else "RAW no end" for report in reports]
    wrong = [text for text in told if not text.startswith("RESULT")]
    yield Case(GROUP, f"{scene.kind}: four at once", "raw" if wrong else "right", next(iter(wrong), ""))


def compilers(scene, quick):
    """No compiler, or one that fails: a clear message that says what to install or to set."""
    told = [("CC missing", {"CC": "/nonexistent/cc"}), ("CC fails", {"CC": "false"})]
    if not quick:
        told += [
            ("CC may not be run", {"CC": "/etc/passwd"}),
            ("CC does nothing", {"CC": "true"}),
            ("CC is no command", {"CC": 'gcc "'}),
            ("CC is killed", {"CC": "sh -c 'kill -9 $$'"}),
            ("no compiler on PATH", {"CC": "", "NO_PATH": "1"}),
        ]
    for name, env in told:
        yield scene.case(name, scene.folder / f"{scene.kind} {name}", refused=True, **env)
    if not quick:
        yield scene.case("CC blank", scene.folder / f"{scene.kind} blank", CC=" ")
        name = "CC missing, two ranks"
        yield scene.case(name, scene.folder / f"{scene.kind} {name}", 2, True, CC="/nonexistent/cc")


@contextlib.contextmanager
def mounted(folder, options):
    """A file system of its own, or None where one may not mount."""
    folder.mkdir(parents=True)
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    done = shutil.which("mount") and subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        yield folder if done else None
    finally:
        if done:
            subprocess.run(["umount", "-l", str(folder)], check=False)


def unwritable(scene, quick):
    """Caches that can't be written, or whose libraries can't be loaded."""
    file = scene.folder / f"{scene.kind} a file"
    file.write_text("")
    yield scene.case("the cache is a file", file)
    if quick:
        return
    yield scene.case("the cache is under /proc", "/proc/nocache")
    yield scene.case("a dangling link", scene.folder / "link" / "nowhere")
    yield scene.case("relative path", "relative")
    yield scene.case("no home", "", HOME="", AS_NOBODY="")
    if os.geteuid() == 0:
        yield scene.case("read-only folder of root's", scene.copy("of root"), AS_NOBODY="1")
        empty = scene.folder / f"{scene.kind} empty"
        empty.mkdir(mode=0o755)
        yield scene.case("empty folder of root's", empty, AS_NOBODY="1")
    options = {"disc of 64 kB": "size=64k", "read-only disc": "ro,size=1m", "noexec": "noexec,size=64m"}
    for name, words in options.items():
        for ranks in (1, 2):
            shown = f"{name}, {ranks} ranks"
            with mounted(scene.folder / f"{scene.kind} {shown}", words) as place:
                if place is not None:
                    yield scene.case(shown, place, ranks)


def foreign(scene, quick):
    """Caches that others may write to: their code must not be run."""
    evil, taken = scene.folder / "evil.so", scene.folder / "taken"
    source = evil.with_suffix(".c")
    source.write_text(EVIL)
    subprocess.run(["cc", "-shared", "-fPIC", str(source), "-o", str(evil)], check=True)

    def tempt(name, mode, owner):
        cache = scene.copy(name)
        for file in libraries(cache):
            shutil.copy(evil, file)
            file.chmod(0o777)
        for path in (cache, *cache.rglob("*")):
            if owner and os.geteuid() == 0:
                os.chown(path, owner, owner)
            if path.is_dir():
                path.chmod(mode)
        case = scene.case(name, cache, TAKEN=str(taken))
        if taken.exists():
            taken.unlink()
            return Case(GROUP, case.name, "silent", "foreign code has been run")
        return case

    yield tempt("everybody may write, another user's", 0o777, 65534)
    if quick:
        return
    yield tempt("another user's", 0o755, 65534)
    yield tempt("everybody may write", 0o777, 0)
    cache = scene.copy("open")
    for path in (cache, *cache.rglob("*")):
        path.chmod(stat.S_IMODE(path.stat().st_mode) | 0o002)
    yield scene.case("everybody may write, right libraries", cache)
    for mask in ("000", "002", "077"):
        cache = scene.folder / f"{scene.kind} umask {mask}"
        yield scene.case(f"umask {mask}", cache, UMASK=mask)
        before = {f: f.stat().st_mtime_ns for f in libraries(cache)}
        case = scene.case(f"umask {mask}, again", cache, UMASK=mask)
        if case.verdict == "right" and before != {f: f.stat().st_mtime_ns for f in libraries(cache)}:
            case = Case(GROUP, case.name, "unclear", "compiled again")
        yield case


def cases(quick, seed):
    draw = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        points, elements = Scene("points", Path(folder)), Scene("elements", Path(folder))
        for scene in (points, elements):
            yield from stopped(scene, quick, draw)
            if scene is points or not quick:
                yield from damaged(scene, quick, draw)
        yield from compilers(points, quick)
        yield from unwritable(points, quick)
        yield from foreign(points, quick)
        if not quick:
            yield from compilers(elements, True)
            yield from unwritable(elements, True)
            yield from foreign(elements, True)
