"""Accidents on one of several ranks: the run has to end soon, with that rank's message and a status other than 0.

Each case is a few lines of a script on a small problem; `bad` is true on one of the ranks, which one and of how
many is drawn at random. Cases that are to come through end in `done()`.
"""

import random
import re

from operation_cases import Case, run

LIMIT = 20.0  # seconds until a run counts as one that hangs
QUICK = ("fine", "load raises", "script raises", "energies on one rank", "another force")

START = """
import os, signal, sys, time, warnings
import numpy as np
from mpi4py import MPI
import polarmpm as pm
comm = MPI.COMM_WORLD
bad = comm.rank == int(sys.argv[1])
MATERIAL = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.3, l_b=0.1, l_t=0.1, psi=1.0)
def fails(text="user"):
    if bad:
        raise RuntimeError(text)
def block(x):
    return (x[:, 0] >= 0) & (x[:, 0] <= 6) & (x[:, 1] >= 0) & (x[:, 1] <= 1)
def seeded(inside=block, comm=comm, **options):
    grid = pm.Grid.box((-1, -1), (8, 3), 1.0, comm)
    return grid, pm.seed(grid, inside, material=MATERIAL, points_per_cell=3, **options)
def bare(comm=comm, **options):
    grid, points = seeded(comm=comm)
    return pm.QuasiStatic(grid, points, **{"basis": "mpm", "reset": 1, **options})
def held(comm=comm, **options):
    problem = bare(comm, **options)
    problem.fix(lambda x: x[:, 0] < 1e-6, u=0, theta=0)
    return problem
def loaded(comm=comm, **options):
    problem = held(comm, **options)
    problem.body_load(force=lambda t, X: np.tile([0, -100.0 * t], (len(X), 1)))
    return problem
def meshed():
    from dolfinx import mesh
    box = mesh.create_rectangle(comm, [(0.0, 0.0), (6.0, 1.0)], [12, 2], mesh.CellType.quadrilateral)
    problem = pm.QuasiStaticFEM(pm.Elements(box, material=MATERIAL, degree=2))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    return problem
def solve(problem, steps=3):
    for step in problem.march(steps, progress=False):
        yield step
def done(*checks):
    assert all(checks), checks
    print("done", flush=True)
"""

# name: (lines, pattern of the message; None: it has to come through)
CASES = {
    "fine": ("list(solve(loaded())); done()", None),
    # functions of the script
    "inside raises": ("seeded(lambda x: fails() or block(x))", "RuntimeError: user"),
    "predicate raises": (
        "q = bare(); q.fix(lambda x: fails() or x[:, 0] < 1e-6, u=0); list(solve(q))",
        "RuntimeError: user",
    ),
    "predicate of the wrong type": (
        "q = bare(); q.fix(lambda x: np.zeros(3) if bad else x[:, 0] < 1e-6, u=0); list(solve(q))",
        "support 1.*predicate returned",
    ),
    "load raises": (
        "q = held(); q.body_load(force=lambda t, X: fails() or np.zeros((len(X), 2))); list(solve(q))",
        "RuntimeError: user",
    ),
    "load raises before a mean": (
        "q = held(); p = q.points; q.body_load(force=lambda t, X: (fails() or p.mean(p.volume)) * X); list(solve(q))",
        "RuntimeError: user",
    ),
    "load is not a number": (
        "q = held(); q.body_load(force=lambda t, X: np.full((len(X), 2), np.nan if bad and t > 0.5 else 1.0)); "
        "list(solve(q))",
        "load 1, force is nan",
    ),
    "load exits": (
        "q = held(); q.body_load(force=lambda t, X: sys.exit(3) if bad and t > 0.5 else 0 * X); list(solve(q))",
        r"exit\(3\)|SystemExit",
    ),
    "couple raises": (
        "q = held(); q.body_load(couple=lambda t, X: fails() or np.zeros(len(X))); list(solve(q))",
        "RuntimeError: user",
    ),
    "prescribed value raises": (
        "q = loaded(); q.fix(lambda x: x[:, 0] > 5.9, ux=lambda t, x: fails() or 0 * x[:, 0]); list(solve(q))",
        "RuntimeError: user",
    ),
    "traction raises": (
        "q = held(reset=None); q.traction(pm.Surface.line((6, 0.25), (6, 0.75), 2), "
        "force=lambda t, X: fails() or 0 * X); list(solve(q))",
        "RuntimeError: user",
    ),
    "selection raises": ("seeded()[1].where(lambda x: fails() or x[:, 0] > 5)", "RuntimeError: user"),
    "selection of a rank without points": (
        "g = pm.Grid.box((0, 0), (2, 2), 0.5); p = pm.seed(g, bounds=((0, 0), (0.5, 0.5)), "
        "material=pm.NeoHookean(lam=1e6, mu=1e6)); p.where(lambda x: x[:, 0] > x[:, 0].max() - 0.1)",
        "zero-size array",
    ),
    "column raises": (
        "q = loaded()\nwith pm.Table('t.csv', a=lambda: fails() or 1.0) as t:\n    [t(s) for s in solve(q)]",
        "RuntimeError: user",
    ),
    "column raises before its energies": (
        "q = loaded()\nwith pm.Table('t.csv', b=lambda: 1, a=lambda: fails() or q.energies(), c=q.energy) as t:\n"
        "    [t(s) for s in solve(q)]",
        "RuntimeError: user",
    ),
    "column is refused": (
        "q = loaded()\nwith pm.Table('t.csv', a=lambda: 'x' if bad else 1.0) as t:\n    [t(s) for s in solve(q)]",
        "column 'a'",
    ),
    "column asks for energies": (
        "q = loaded()\nwith pm.Table('t.csv', a=lambda: q.energy() if bad else 1.0) as t:\n"
        "    [t(s) for s in solve(q)]",
        "energy.*table|table.*energy",
    ),
    "until raises": (
        "q = held(); q.body_load(force=(0, -100)); "
        "list(q.march_arc_length(0.1, until=lambda s: fails(), progress=False))",
        "RuntimeError: user",
    ),
    "policy raises": (
        "class Own:\n    def due(self, steps, gradient, comm):\n        fails(); return comm.allreduce(True)\n"
        "list(solve(loaded(reset=Own())))",
        "RuntimeError: user",
    ),
    "policy differs": (
        "class Own:\n    def due(self, steps, gradient, comm):\n        return bad\nlist(solve(loaded(reset=Own())))",
        "reset policy",
    ),
    "field raises": (
        "q = loaded()\nwith pm.Recorder('a.pvd', q, fields=pm.Field('a', lambda p: fails() or p.x)) as r:\n"
        "    [r(s) for s in solve(q)]",
        "user",
    ),
    "observer raises before energies": (
        "class Own(pm.Observer):\n    def after_commit(self, problem, rebased):\n        fails(); problem.energies()\n"
        "q = loaded(); q.observers.append(Own()); list(solve(q))",
        "RuntimeError: user",
    ),
    "piece of a term raises": (
        "class Own(pm.SurfaceTerm):\n    def energy(self, at, p):\n        return 500 * at.u[0] ** 2\n    def evaluate(self, *a):\n"
        "        fails(); return super().evaluate(*a)\n"
        "q = held(reset=None); q.add(Own('own', pm.Surface.line((6, 0.25), (6, 0.75), 2))); list(solve(q))",
        "user|Error",
    ),
    "warning is an error": (
        "from polarmpm.errors import TrustWarning\nwarnings.simplefilter('error')\n"
        "import polarmpm.problems.points as m\nm.warn_of_locking = lambda *a, **o: warnings.warn('low', TrustWarning)\n"
        "bare()",
        "TrustWarning: low",
    ),
    # the script itself
    "script raises": ("q = loaded()\nfor s in solve(q): fails() if s.number == 1 else 0", "RuntimeError: user"),
    "script raises at first": ("fails(); list(solve(loaded()))", "RuntimeError: user"),
    "script raises, others at a barrier": ("q = loaded(); fails(); comm.Barrier()", "RuntimeError: user"),
    "script raises, others at work": ("q = loaded(); fails(); time.sleep(30)", "RuntimeError: user"),
    "interrupt": (
        "q = loaded()\nfor s in solve(q):\n    if bad: raise KeyboardInterrupt",
        "KeyboardInterrupt",
    ),
    "exits with 3": ("q = loaded()\nfor s in solve(q):\n    if bad: sys.exit(3)", r"sys.exit\(3\)"),
    "exits with 3, others at a barrier": ("loaded()\nif bad: sys.exit(3)\ncomm.Barrier()", r"sys.exit\(3\)"),
    "exits with a text": ("q = loaded()\nfor s in solve(q):\n    if bad: sys.exit('no more')", "no more"),
    "exits with 0": ("q = loaded()\nfor s in solve(q):\n    if bad: sys.exit(0)", "has ended"),
    "exits with 0 at first": ("if bad: sys.exit(0)\nlist(solve(loaded()))", "has ended"),
    "raises SystemExit": ("q = loaded()\nfor s in solve(q):\n    if bad: raise SystemExit(4)", "has ended"),
    "is killed": ("q = loaded()\nfor s in solve(q):\n    if bad: os.kill(os.getpid(), 9)", "signal 9"),
    "crashes": ("q = loaded()\nfor s in solve(q):\n    if bad: os.kill(os.getpid(), 11)", "signal (number )?11"),
    "leaves by os._exit": ("q = loaded()\nfor s in solve(q):\n    if bad: os._exit(3)", "Exit code: *3|non-zero"),
    "swallows an error": (
        "q = loaded(); p = q.points; v = p.volume[:-1, None] if bad else p.volume\n"
        "try: p.mean(v)\nexcept IndexError: pass\nlist(solve(q))",
        "IndexError|Error",
    ),
    # other calls
    "record on one rank": (
        "q = loaded(); r = pm.Recorder('z.pvd', q)\nfor s in solve(q):\n    if bad: r.record(s)",
        "record.*step|step.*record",
    ),
    "recorder on one rank": (
        "q = loaded()\nfor s in solve(q):\n    if bad: pm.Recorder('z.pvd', q).record(s)",
        "Recorder.*step|step.*Recorder",
    ),
    "energies on one rank": (
        "q = loaded()\nfor s in solve(q):\n    if bad: q.energies()",
        "energies.*step|step.*energies",
    ),
    "mean on one rank": (
        "q = loaded()\nfor s in solve(q):\n    if bad: q.points.mean_displacement()",
        "mean.*step|step.*mean",
    ),
    "one step more": ("list(solve(loaded(), 3 + bad))", "load factor 0.3333"),
    "goes on alone": ("q = loaded(); list(solve(q))\nif bad: list(q.march(2, to=2.0, progress=False))", "has ended"),
    "to another factor": ("list(loaded().march(2, to=2.0 if bad else 1.0, progress=False))", "load factor 0.5"),
    "save on one rank": (
        "q = loaded(); s = solve(q); next(s)\nif bad: pm.save_restart(q, 'a.h5')\nlist(s)",
        "save_restart.*step|step.*save_restart",
    ),
    # other conditions
    "load differs": (
        "q = held(); q.body_load(force=lambda t, X: np.full((len(X), 2), 1.0 + bad)); list(solve(q))",
        "body load 1.*rank",
    ),
    "prescribed value differs": (
        "q = loaded(); q.fix(lambda x: x[:, 0] > 5.9, ux=lambda t: t * (1 + bad)); list(solve(q))",
        "support 2.*rank",
    ),
    "predicate differs": (
        "q = loaded(); q.fix(lambda x: (x[:, 0] > 0.5) & bad, ux=0); list(solve(q))",
        "support 2.*rank",
    ),
    "another force": ("q = held(); q.body_load(force=(0, -100 * (1 + bad))); list(solve(q))", "body_load.*-200"),
    "no load": ("q = held(); bad or q.body_load(force=(0, -100.0)); list(solve(q))", "body_load.*step|step.*body_load"),
    "one support more": (
        "q = loaded()\nif bad: q.fix(lambda x: x[:, 0] > 5.9, u=0)\nlist(solve(q))",
        "fix.*step|step.*fix",
    ),
    "another plane": ("q = bare(); q.fix(pm.plane(x=1.0 * bad), u=0, theta=0)", "fix.*plane|fix.*Plane"),
    "release on one rank": (
        "q = bare(); s = q.fix(pm.plane(x=0.0), u=0, theta=0)\nif bad: q.release(s)\nlist(solve(q))",
        "release.*step|step.*release",
    ),
    "other controls": ("loaded(controls=pm.Controls(max_iterations=9 + bad))", "QuasiStatic.*max_iterations"),
    "other controls later": (
        "q = loaded()\nif bad: q.controls = pm.Controls(max_iterations=9)\nlist(solve(q))",
        "step to load factor.*max_iterations",
    ),
    "another basis": ("loaded(basis='mpm' if bad else 'bspline')", "QuasiStatic.*bspline"),
    "other points": ("seeded(cut=bad)", "seed.*cut"),
    # elements
    "elements: traction raises": (
        "q = meshed(); q.traction(pm.plane(x=6.0), force=lambda t, X: fails() or 0 * X); list(solve(q))",
        "RuntimeError: user",
    ),
    "elements: record on one rank": (
        "q = meshed(); q.load(pm.plane(x=6.0), force=(0, -1)); r = pm.Recorder('z.pvd', q)\nfor s in solve(q):\n"
        "    if bad: r.record(s)",
        "record.*step|step.*record",
    ),
    "elements: a table on one rank": (
        "q = meshed(); q.load(pm.plane(x=6.0), force=(0, -1))\nif bad: pm.Table('t.csv')\nlist(solve(q))",
        "Table.*step|step.*Table",
    ),
    # files
    "restart path is a folder": ("q = loaded(); os.makedirs('k', exist_ok=True); pm.save_restart(q, 'k')", "k"),
    "restart without a data set": (
        "import h5py\nq = loaded(); list(solve(q)); pm.save_restart(q, 'm.h5')\nif bad:\n"
        "    with h5py.File('m.h5', 'a') as h: del h['points/F']\ncomm.Barrier(); pm.load_restart(q, 'm.h5')",
        "points/F|m.h5",
    ),
    "restart file seen by one rank": (
        "q = loaded(); pm.save_restart(q, 'm.h5'); pm.load_restart(q, 'm.h5' if bad else 'none/m.h5')",
        "none/m.h5.*can't be read",
    ),
    # all ranks alike
    "all raise": ("q = loaded(); raise RuntimeError('user')", "RuntimeError: user", 1),
    "all exit with 3": ("q = loaded(); sys.exit(3)", "code: +3|non-zero"),
    "none converges": (
        "q = loaded(controls=pm.Controls(max_iterations=1)); q.body_load(force=(0, -1e5)); list(solve(q, 1))",
        "no equilibrium",
        1,
    ),
    # what is to come through
    "caught everywhere": (
        "q = held(); q.body_load(force=lambda t, X: (fails() if 0.5 < t < 0.6 else 0) or "
        "np.tile([0, -100.0 * t], (len(X), 1)))\n"
        "a = solve(q, 1); caught = 0\n"
        "try: list(q.march(1, to=0.55, progress=False))\nexcept RuntimeError: caught = 1\n"
        "list(solve(q)); r = loaded(); list(solve(r))\n"
        "done(caught, np.allclose(q.points.mean_displacement(), r.points.mean_displacement(), rtol=1e-6))",
        None,
    ),
    "each rank alone": (
        "q = held(MPI.COMM_SELF); q.body_load(force=(0, -100.0 * (1 + comm.rank))); list(solve(q, 1 + comm.rank)); "
        "done()",
        None,
    ),
    "two groups": (
        "half = comm.Split(int(comm.rank == 0)); q = held(half); q.body_load(force=(0, -100.0 * (1 + (comm.rank == 0))))"
        "; list(solve(q, 1 + 2 * (comm.rank == 0))); q.energies(); done()",
        None,
    ),
    "one of two groups raises": (
        "half = comm.Split(int(bad)); q = loaded(half)\nfor s in solve(q): fails()\ncomm.Barrier()",
        "RuntimeError: user",
    ),
}

def verdict(found, ranks, pattern, messages):
    """Verdict and note on how a run has ended."""
    text = found.out + found.err
    if found.status is None:
        said = re.search(pattern, text) if pattern else None
        return "hang", "with the message" if said else "without a message"
    if pattern is None:
        if found.status == 0 and found.out.count("done") == ranks:
            return "right", "came through"
        return ("raw" if found.status else "silent"), last(text)
    if found.status == 0:
        return "silent", "ended with status 0"
    if not re.search(pattern, text):
        return "unclear", last(text)
    if messages and text.count("Traceback") > messages:
        return "unclear", f"{text.count('Traceback')} times the same message"
    return "clear", next((line for line in text.splitlines() if re.search(pattern, line)), last(text))[:200]


def last(text):
    """The line of an error, or the last one."""
    lines = [line for line in text.splitlines() if line.strip("- ")]
    errors = [line for line in lines if re.match(r"\S*(Error|Exit|Interrupt|Apart)\b", line)]
    return ([*errors, *lines[-1:]] or ["nothing"])[0][:200]


def cases(quick, seed):
    """All cases; the number of ranks and the one with the accident are drawn."""
    draw = random.Random(seed)
    for name, (code, pattern, *messages) in CASES.items():
        ranks = draw.choice((2, 3))
        culprit = draw.randrange(ranks)
        if quick and name not in QUICK:
            continue
        found = run(f"{START}\n{code}\n", str(culprit), ranks=ranks, timeout=LIMIT)
        sign, note = verdict(found, ranks, pattern, messages[0] if messages else 0)
        yield Case("ranks", f"{name} ({culprit} of {ranks})", sign, note)
