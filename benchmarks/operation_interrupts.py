"""Ctrl-C, a timeout or an error at calls inside a load step, and what comes of the run.

Small scenes of every kind are run until a step in which something happens. Copies of the process (forks) then
take that step, each ended by an exception at another call of a Python or C function from the package's code.
Right is: the state (points, unknowns, progress, energies, fields, reactions) is that of the last converged
step to the bit, and both the run that goes on and one that is restored from a restart file, written then, end
with the digits of a run without interrupts. Signals at random times come on top. Started by itself with the
names of scenes, this ends a step at every call.
"""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

from mpi4py import MPI

import numpy as np
from operation_cases import Case, environment

import polarmpm as pm

PACKAGE = str(Path(pm.__file__).parent) + os.sep
ELASTIC = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.3, l_b=0.1, l_t=0.1, psi=1.0)
CLASSICAL = pm.NeoHookean(lam=1e6, mu=4e5)
YIELDING = pm.VonMises(ELASTIC, k=1e4, H=1e5, l_p=0.1)


class Timeout(Exception):
    """Of a script's own."""


class Log(pm.Observer):
    """Keeps what it is told."""

    def __init__(self):
        self.heard = []

    def after_convergence(self, problem, factor):
        self.heard.append(("converged", factor))

    def after_commit(self, problem, rebased):
        self.heard.append(("committed", problem.progress.step, rebased))


# scenes -------------------------------------------------------------------------------------------------
@dataclass
class Scene:
    """A problem, how many steps its run has, which of them is ended early, and how it marches."""

    make: object
    steps: int = 4
    ended: int = 3
    between: object = None  # what the script does after some step, by number
    along: float = 0.0  # length of steps by the arc-length method (m)

    def begin(self, steps=0):
        """A problem that has taken a number of steps."""
        problem = self.make()
        for k in range(steps):
            self.meanwhile(problem, k)
            next(self.march(problem, self.steps - k))
        self.meanwhile(problem, steps)
        return problem

    def meanwhile(self, problem, step):
        """What the script does then."""
        if self.between and step in self.between:
            self.between[step](problem)

    def march(self, problem, left):
        """The rest of the steps."""
        if self.along:
            return problem.march_arc_length(self.along, steps=left, progress=False)
        return problem.march(left, progress=False)

    def restored(self, file, step):
        """A problem that goes on from a file."""
        problem = self.make()
        for k in sorted(self.between or {}):
            if k <= step:
                self.between[k](problem)
        pm.load_restart(problem, file)
        return problem

    def finish(self, problem):
        """March to the end."""
        done = problem.progress.step
        for step in self.march(problem, self.steps - done) if done < self.steps else ():
            self.meanwhile(problem, step.number)
        return problem


def beam(material=ELASTIC, force=(0.0, 2e4), size=(3.0, 1.0), cell=0.5, turns=1.0, **options):
    """A cantilever of material points."""
    dim = len(size)
    low, high = [0.0] + [-1.0] * (dim - 1), [s + 1.0 for s in size]
    grid = pm.Grid.box(low, high, cell)
    points = pm.seed(grid, bounds=([0.0] * dim, list(size)), material=material, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, **options)
    problem.rotation_limit = turns
    theta = {"theta": 0} if material.micropolar else {}
    problem.support = problem.fix(pm.plane(x=0.0), u=0, **theta)
    problem.load(points.farthest([1.0] + [0.0] * (dim - 1)), force=force)
    problem.rows["mine"] = np.arange(len(points), dtype=float)
    problem.observers.append(Log())
    return problem


def surfaces():
    """Ghost penalty, a traction that follows, and springs whose forces are kept."""
    problem = beam(force=(0.0, 2e3), basis="gimpm", reset=2, ghost="thesis")
    problem.traction(pm.Surface.line((3.0, 1.0), (0.0, 1.0), 12), force=(0.0, -4e3), follows=True)
    problem.pressure(pm.Surface.line((0.0, 0.0), (3.0, 0.0), 12), p=2e3)
    held = pm.Surface.line((2.0, 0.0), (3.0, 0.0), 8)
    problem.fix(held, uy=0.05, stiffness=1e5, augment=True)
    return problem


def upset():
    """A block between walls, one of which moves and takes the grid along; and a load of its own on top."""
    grid = pm.Grid.box((0.0, 0.0), (2.0, 2.0), 0.5)
    points = pm.seed(grid, bounds=((0.0, 0.0), (1.5, 2.0)), material=ELASTIC, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, reset=1)
    problem.fix(pm.plane(y=0.0), u=0, theta=0)
    problem.support = problem.fix(pm.plane(y=2.0, moving=True), uy=-0.4, theta=0)
    return problem


def propped():
    """A cantilever with a prop at its end."""
    problem = beam(basis="mpm", reset=3)
    problem.support = problem.fix(lambda x: x[:, 0] > 2.9, uy=0)
    return problem


def halved():
    """Half of a beam between two walls, on its plane of symmetry; the wall holds the slope."""
    grid = pm.Grid.box((0.0, -0.5), (1.5, 1.5), 0.5)
    points = pm.seed(grid, bounds=((0.0, 0.0), (1.5, 1.0)), material=ELASTIC, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, reset=3)
    problem.support = problem.symmetry(pm.plane(x=0.0))
    problem.fix(pm.plane(x=1.5), u=0, slope=0, theta=0)
    problem.body_load(force=(0.0, 2e4))
    return problem


def release(problem):
    """Let a support go, over a part of the load."""
    if problem.progress.step:  # else it's being restored, and the file knows
        problem.release(problem.support, over=0.3)


def more(problem):
    """A load that comes in mid-run."""
    problem.body_load(force=(2e3, 0.0))


def springs(problem):
    """A support is released at once, springs come in its place."""
    if problem.progress.step:
        problem.release(problem.support)
    foot = pm.Surface.line((0.0, 0.0), (0.0, 1.0), 6)
    problem.fix(foot, u=(0.0, 0.0), theta=0, stiffness=1e7, rotation_stiffness=1e5)


def mesh(material=ELASTIC, force=(0.0, 1e4), surface=False, degree=1, **options):
    """A cantilever of finite elements."""
    from dolfinx import mesh as dmesh

    made = dmesh.create_rectangle(
        MPI.COMM_WORLD, [[0.0, 0.0], [3.0, 1.0]], [5, 2], dmesh.CellType.quadrilateral
    )
    elements = pm.Elements(made, material=material, degree=degree)
    problem = pm.QuasiStaticFEM(elements, **options)
    problem.support = problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(pm.plane(x=3.0), force=force)
    if surface:
        problem.pressure(pm.plane(y=1.0), 2e3)
        held = elements.surface(pm.plane(y=0.0))
        problem.fix(held, uy=0, stiffness=1e4, augment=True)
    problem.observers.append(Log())
    return problem


SCENES = {
    "points": Scene(lambda: beam(basis="mpm", reset=None)),
    "reset": Scene(lambda: beam(reset=2)),
    "plain reset": Scene(lambda: beam(basis="gimpm", reset=1, balanced_reset=False)),
    "rotation base": Scene(lambda: beam(turns=0.02, reset=3), ended=2),
    "classical": Scene(lambda: beam(CLASSICAL, (0.0, 5e3), reset=1)),
    "plastic": Scene(lambda: beam(YIELDING, (0.0, 1.2e3), reset=2, turns=0.01), ended=4),
    "in space": Scene(lambda: beam(size=(2.0, 1.0, 1.0), cell=1.0, force=(0.0, 0.0, 2e4), reset=2), ended=3),
    "multigrid": Scene(
        lambda: beam(
            size=(2.0, 1.0, 1.0), cell=1.0, force=(0.0, 0.0, 2e4), reset=2, basis="mpm", solver="multigrid"
        )
    ),
    "projection": Scene(lambda: beam(basis="mpm", assembly="projection", reset=2)),
    "surfaces": Scene(surfaces),
    "moving plane": Scene(upset),
    "fading support": Scene(propped, between={2: release}),
    "fading symmetry": Scene(halved, between={2: release}),
    "other support": Scene(lambda: beam(force=(0.0, 5e3), reset=2), between={2: springs}),
    "load in mid-run": Scene(lambda: beam(reset=None), between={2: more}),
    "elements": Scene(mesh),
    "elements, degree 2": Scene(lambda: mesh(degree=2), ended=1),
    "elements, surfaces": Scene(lambda: mesh(surface=True)),
    "plastic elements": Scene(lambda: mesh(YIELDING, (0.0, 1.2e3)), ended=4),
    "arc length": Scene(lambda: beam(basis="mpm", reset=2), along=0.05),
    "arc length, elements": Scene(mesh, along=0.05),
}


# states -------------------------------------------------------------------------------------------------
def state(problem):
    """All that a script can see of the last converged step, by name."""
    out = {f"points.{name}": a.copy() for name, a in problem.points.arrays().items()}
    out |= {f"progress.{name}": np.array(v) for name, v in asdict(problem.progress).items()}
    out |= {f"rows.{name}": a.copy() for name, a in problem.rows.items()}
    out["steps"] = np.array([s.factor for s in problem.steps])
    out["heard"] = np.array([repr(problem.observers[0].heard)] if problem.observers else [])
    if hasattr(problem, "elements"):
        out |= {"displacement": problem.elements.displacement.copy(), "turns": problem.elements.q.copy()}
    if problem.system is not None:
        out |= {"x": problem.system.x.copy(), "carried": problem.system.carried.copy()}
    for k, term in enumerate(problem.terms):
        out |= {f"term {k}.{name}": np.array(a) for name, a in term.state().items()}
    if problem.progress.step:
        fields = problem.fields()
        out |= {name: np.array(fields[name]) for name in ("energy", "stress", "couple_stress")}
        out |= {f"energies.{name}": np.array(v) for name, v in problem.energies().items()}
        balance = problem.balance()
        out |= {"balance": np.concatenate([balance.force, balance.moment])}
        for support in problem.supports:
            try:
                force, couple = problem.reaction(support)
            except pm.InputError:  # a new one
                continue
            out[f"reaction {support.name}"] = np.concatenate([force, couple])
    return out


def differing(found, expected):
    """Names of what isn't the same to the bit."""
    names = {*found, *expected}
    same = {n for n in names if n in found and n in expected and alike(found[n], expected[n])}
    return sorted(names - same)


def alike(one, other):
    """The same numbers; NaN where nothing is known yet."""
    return np.array_equal(one, other, equal_nan=one.dtype.kind == other.dtype.kind == "f")


def off(found, expected):
    """How far the ends of two runs are apart, relative to the motion, and to the work that is done."""
    key = "displacement" if "displacement" in expected else "points.x"
    size = np.abs(expected[key] - (0 if key == "displacement" else expected["points.X"])).max()
    parts = [np.abs(found[key] - expected[key]).max() / size]
    work = max(abs(float(v)) for n, v in expected.items() if n.startswith("energies."))
    parts += [abs(float(found[n] - v)) / work for n, v in expected.items() if n.startswith("energies.")]
    return max(parts)


CLOSE = 1e-9


# an exception at a call ---------------------------------------------------------------------------------
class Stopper:
    """Counts calls from the package's code; raises at one of them."""

    def __init__(self, at=None, error=KeyboardInterrupt):
        self.at, self.error, self.count, self.where = at, error, 0, ""

    def __call__(self, frame, event, argument):
        if event in ("call", "c_call") and frame.f_code.co_filename.startswith(PACKAGE):
            self.count += 1
            if self.count == self.at:
                name = frame.f_code.co_filename[len(PACKAGE) :]
                self.where = f"{name}:{frame.f_lineno} {frame.f_code.co_name}"
                raise self.error

    def run(self, function):
        """Call a function; whether it was ended by the exception."""
        sys.setprofile(self)
        try:
            function()
        except self.error:
            return True
        finally:
            sys.setprofile(None)
        return False


def calls(scene):
    """How many there are in the step that is ended."""
    problem, stopper = scene.begin(scene.ended - 1), Stopper()
    stopper.run(lambda: next(scene.march(problem, scene.steps - scene.ended + 1)))
    return stopper.count


def ended(scene, problem, at, before, end, file=None):
    """What is wrong after an exception at a call of the next step of a problem; empty: nothing.

    Args:
        before, end: states that are right at the beginning of the step, and of the last step.
        file: for a restart.
    """
    step = problem.progress.step
    stopper = Stopper(at, (KeyboardInterrupt, Timeout)[at % 2])
    stopped = stopper.run(lambda: next(scene.march(problem, scene.steps - step)))
    wrong = []
    if stopped:
        names = differing(state(problem), before)
        wrong += [f"other {', '.join(names[:4])}"] if names else []
    if file is not None:
        pm.save_restart(problem, file)
        restored = scene.restored(file, problem.progress.step)
        wrong += wrong_end(scene, restored, end, "restored")
    wrong += wrong_end(scene, problem, end, "going on")
    return "; ".join([f"at {stopper.where}", *wrong]) if wrong else ""


def wrong_end(scene, problem, end, how):
    """Whether a run comes to another end."""
    try:
        there = state(scene.finish(problem))
    except Exception as e:
        return [f"{how}: {type(e).__name__}: {e}".splitlines()[0]]
    return [f"{how}: {off(there, end):.1e} off"] if not off(there, end) < CLOSE else []


def right(scene):
    """States before the step that is ended, and at the end."""
    problem = scene.begin(scene.ended - 1)
    before = state(problem)
    return before, state(scene.finish(problem))


# cases --------------------------------------------------------------------------------------------------
def forked(work, seconds=60):
    """What a function says in a copy of this process."""
    read, write = os.pipe()
    child = os.fork()
    if not child:
        signal.alarm(seconds)
        said = ""
        try:
            said = work()
        except BaseException as e:
            said = f"!{type(e).__name__}: {e}"
        os.write(write, said[:4000].encode())
        os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        said = pipe.read().decode()
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        return "hang" if os.WTERMSIG(status) == signal.SIGALRM else "crash", said
    if said.startswith("!"):
        return "raw", said[1:].splitlines()[0]
    return ("silent", said) if said else ("right", "")


def at_calls(name, scene, most, draw):
    """Cases of a scene, at most so many."""
    before, end = right(scene)
    problem, number = scene.begin(scene.ended - 1), calls(scene)
    chosen = range(1, number + 1) if number <= most else sorted(draw.sample(range(1, number + 1), most))
    with tempfile.TemporaryDirectory() as folder:
        for k in chosen:
            file = Path(folder, "now.h5") if k % 5 == 0 else None
            verdict, note = forked(lambda k=k, file=file: ended(scene, problem, k, before, end, file))
            yield Case("interrupts", f"{name}, call {k} of {number}", verdict, note)


def at_random(name, scene, number, draw):
    """Signals at random times of a run."""
    _, end = right(scene)

    def run(delay):
        problem, kind = scene.begin(), draw.choice((signal.SIGALRM, signal.SIGINT))

        def caught(*_):
            raise Timeout

        if kind == signal.SIGALRM:
            signal.signal(signal.SIGALRM, caught)
        else:
            signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
            signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, delay)
        with contextlib.suppress(KeyboardInterrupt, Timeout):
            scene.finish(problem)
        signal.setitimer(signal.ITIMER_REAL, 0)
        done = problem.progress.step
        wrong = [] if len(problem.steps) == done else [f"{len(problem.steps)} steps, {done} of them taken"]
        return "; ".join(wrong + wrong_end(scene, problem, end, "going on"))

    begin = MPI.Wtime()
    scene.finish(scene.begin())
    whole = MPI.Wtime() - begin
    for k in range(number):
        delay = 1e-3 + draw.random() * whole
        verdict, note = forked(lambda delay=delay: run(delay))
        yield Case("interrupts", f"{name}, signal {k}", verdict, note)


QUICK = ("reset", "elements")


MOST, QUICKLY = 40, 15  # calls of a scene


def found(quick, seed, names=()):
    """Some calls of all scenes, and signals; or every call of those that are named."""
    draw = random.Random(seed)
    for name in names or (QUICK if quick else SCENES):
        scene = SCENES[name]
        yield from at_calls(name, scene, 10**6 if names else QUICKLY if quick else MOST, draw)
        if not scene.between and not quick:
            yield from at_random(name, scene, 4, draw)


def cases(quick, seed):
    """An exception at some calls in each scene, and signals. In a process with one thread, as forks don't
    inherit OpenMP's."""
    command = [sys.executable, __file__, str(int(quick)), str(seed)]
    alone = environment(OMP_THREAD_LIMIT="1")
    with subprocess.Popen(command, env=alone, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            if line.startswith("["):
                yield Case(*json.loads(line))
    if process.returncode:
        yield Case("interrupts", "the run", "crash", f"ended with {process.returncode}")


def main(quick, seed, *names):
    """Print cases as they come, for `cases`; of named scenes those at every call:
    `OMP_THREAD_LIMIT=1 python benchmarks/operation_interrupts.py 0 0 elements`."""
    warnings.simplefilter("ignore")
    for case in found(quick == "1", int(seed), names):
        print(json.dumps([case.group, case.name, case.verdict, case.note]), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
