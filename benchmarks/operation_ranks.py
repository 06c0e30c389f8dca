"""Accidents on one of several ranks: the run has to end soon, with that rank's message and an error's status.

Each case is a few lines of a script on a small problem; `bad` is true on one of the ranks, which one and of
how many is drawn at random. Cases that are to come through end in `done()`.
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

# Name, pattern of the message (done: it has to come through), whether it may be there once only; then lines.
TEXT = r"""
## fine | done
list(solve(loaded()))
done()
## inside raises | RuntimeError: user
seeded(lambda x: fails() or block(x))
## predicate raises | RuntimeError: user
q = bare()
q.fix(lambda x: fails() or x[:, 0] < 1e-6, u=0)
list(solve(q))
## predicate of the wrong type | support 1.*predicate: returned
q = bare()
q.fix(lambda x: np.zeros(3) if bad else x[:, 0] < 1e-6, u=0)
list(solve(q))
## load raises | RuntimeError: user
q = held()
q.body_load(force=lambda t, X: fails() or np.zeros((len(X), 2)))
list(solve(q))
## load raises before a mean | RuntimeError: user
q = held()
p = q.points
q.body_load(force=lambda t, X: (fails() or p.mean(p.volume)) * X)
list(solve(q))
## load is not a number | load 1, force is nan
q = held()
q.body_load(force=lambda t, X: np.full((len(X), 2), np.nan if bad and t > 0.5 else 1.0))
list(solve(q))
## load exits | exit\(3\)|SystemExit
q = held()
q.body_load(force=lambda t, X: sys.exit(3) if bad and t > 0.5 else 0 * X)
list(solve(q))
## couple raises | RuntimeError: user
q = held()
q.body_load(couple=lambda t, X: fails() or np.zeros(len(X)))
list(solve(q))
## prescribed value raises | RuntimeError: user
q = loaded()
q.fix(lambda x: x[:, 0] > 5.9, ux=lambda t, x: fails() or 0 * x[:, 0])
list(solve(q))
## traction raises | RuntimeError: user
q = held(reset=None)
q.traction(pm.Surface.line((6, 0.25), (6, 0.75), 2), force=lambda t, X: fails() or 0 * X)
list(solve(q))
## selection raises | RuntimeError: user
seeded()[1].where(lambda x: fails() or x[:, 0] > 5)
## selection of a rank without points | zero-size array
g = pm.Grid.box((0, 0), (2, 2), 0.5)
p = pm.seed(g, bounds=((0, 0), (0.5, 0.5)), material=pm.NeoHookean(lam=1e6, mu=1e6))
p.where(lambda x: x[:, 0] > x[:, 0].max() - 0.1)
## column raises | RuntimeError: user
q = loaded()
with pm.Table('t.csv', a=lambda: fails() or 1.0) as t:
    [t(s) for s in solve(q)]
## column raises before its energies | RuntimeError: user
q = loaded()
with pm.Table('t.csv', b=lambda: 1, a=lambda: fails() or q.energies(), c=q.energy) as t:
    [t(s) for s in solve(q)]
## column is refused | column 'a'
q = loaded()
with pm.Table('t.csv', a=lambda: 'x' if bad else 1.0) as t:
    [t(s) for s in solve(q)]
## column asks for energies | energy.*table|table.*energy
q = loaded()
with pm.Table('t.csv', a=lambda: q.energy() if bad else 1.0) as t:
    [t(s) for s in solve(q)]
## until raises | RuntimeError: user
q = held()
q.body_load(force=(0, -100))
list(q.march_arc_length(0.1, until=lambda s: bool(fails()), progress=False))
## policy raises | RuntimeError: user
class Own:
    def due(self, steps, gradient, comm):
        fails(); return comm.allreduce(True)
list(solve(loaded(reset=Own())))
## policy differs | reset policy
class Own:
    def due(self, steps, gradient, comm):
        return bad
list(solve(loaded(reset=Own())))
## field raises | user
q = loaded()
with pm.Recorder('a.pvd', q, fields=pm.Field('a', lambda p: fails() or p.x)) as r:
    [r(s) for s in solve(q)]
## observer raises before energies | RuntimeError: user
class Own(pm.Observer):
    def after_commit(self, problem, rebased):
        fails(); problem.energies()
q = loaded()
q.observers.append(Own())
list(solve(q))
## piece of a term raises | user|Error
class Own(pm.SurfaceTerm):
    def energy(self, at, p):
        return 500 * at.u[0] ** 2
    def evaluate(self, *a):
        fails(); return super().evaluate(*a)
q = held(reset=None)
q.add(Own('own', pm.Surface.line((6, 0.25), (6, 0.75), 2)))
list(solve(q))
## pieces of a term raise | RuntimeError: user
class Own(pm.SurfaceTerm):
    def energy(self, at, p):
        return 500 * at.u[0] ** 2
    def pieces(self, setting):
        fails()
        return super().pieces(setting)
q = held(reset=None)
q.add(Own('own', pm.Surface.line((6, 0.25), (6, 0.75), 2)))
list(solve(q))
## warning is an error | TrustWarning: low
from polarmpm.errors import TrustWarning
warnings.simplefilter('error')
import polarmpm.problems.points as m
m.warn_of_locking = lambda *a, **o: warnings.warn('low', TrustWarning)
bare()
## script raises | RuntimeError: user
q = loaded()
for s in solve(q): fails() if s.number == 1 else 0
## script raises at first | RuntimeError: user
fails()
list(solve(loaded()))
## script raises, others at a barrier | RuntimeError: user
q = loaded()
fails()
comm.Barrier()
## script raises, others at work | RuntimeError: user
q = loaded()
fails()
time.sleep(30)
## interrupt | KeyboardInterrupt
q = loaded()
for s in solve(q):
    if bad: raise KeyboardInterrupt
## exits with 3 | sys.exit\(3\)
q = loaded()
for s in solve(q):
    if bad: sys.exit(3)
## exits with 3, others at a barrier | sys.exit\(3\)
loaded()
if bad: sys.exit(3)
comm.Barrier()
## exits with a text | no more
q = loaded()
for s in solve(q):
    if bad: sys.exit('no more')
## exits with 0 | ha(s|ve) ended
q = loaded()
for s in solve(q):
    if bad: sys.exit(0)
## exits with 0 at first | ha(s|ve) ended
if bad: sys.exit(0)
list(solve(loaded()))
## exits with 0 long before | ha(s|ve) ended
if bad: sys.exit(0)
time.sleep(5)
list(solve(loaded()))
## raises SystemExit | ha(s|ve) ended
q = loaded()
for s in solve(q):
    if bad: raise SystemExit(4)
## is killed | signal 9
q = loaded()
for s in solve(q):
    if bad: os.kill(os.getpid(), 9)
## crashes | signal (number )?11
q = loaded()
for s in solve(q):
    if bad: os.kill(os.getpid(), 11)
## leaves by os._exit | Exit code: *3|non-zero
q = loaded()
for s in solve(q):
    if bad: os._exit(3)
## swallows an error | IndexError|Error
q = loaded()
p = q.points
v = p.volume[:-1, None] if bad else p.volume
try: p.mean(v)
except IndexError: pass
list(solve(q))
## record on one rank | record.*step|step.*record
q = loaded()
r = pm.Recorder('z.pvd', q)
for s in solve(q):
    if bad: r.record(s)
## recorder on one rank | Recorder.*step|step.*Recorder
q = loaded()
for s in solve(q):
    if bad: pm.Recorder('z.pvd', q).record(s)
## energies on one rank | energies.*step|step.*energies
q = loaded()
for s in solve(q):
    if bad: q.energies()
## mean on one rank | mean.*step|step.*mean
q = loaded()
for s in solve(q):
    if bad: q.points.mean_displacement()
## one step more | load factor 0.3333
list(solve(loaded(), 3 + bad))
## goes on alone | ha(s|ve) ended
q = loaded()
list(solve(q))
if bad: list(q.march(2, to=2.0, progress=False))
## to another factor | load factor 0.5
list(loaded().march(2, to=2.0 if bad else 1.0, progress=False))
## save on one rank | save_restart.*step|step.*save_restart
q = loaded()
s = solve(q)
next(s)
if bad: pm.save_restart(q, 'a.h5')
list(s)
## load differs | body load 1.*rank
q = held()
q.body_load(force=lambda t, X: np.full((len(X), 2), 1.0 + bad))
list(solve(q))
## prescribed value differs | support 2.*rank
q = loaded()
q.fix(lambda x: x[:, 0] > 5.9, ux=lambda t: t * (1 + bad))
list(solve(q))
## predicate differs | support 2.*rank
q = loaded()
q.fix(lambda x: (x[:, 0] > 0.5) & bad, ux=0)
list(solve(q))
## another force | body_load.*-200
q = held()
q.body_load(force=(0, -100 * (1 + bad)))
list(solve(q))
## no load | body_load.*step|step.*body_load
q = held()
bad or q.body_load(force=(0, -100.0))
list(solve(q))
## one support more | fix.*step|step.*fix
q = loaded()
if bad: q.fix(lambda x: x[:, 0] > 5.9, u=0)
list(solve(q))
## another plane | fix.*plane|fix.*Plane
q = bare()
q.fix(pm.plane(x=1.0 * bad), u=0, theta=0)
## conditions left different | another|conditions=
q = loaded()
try: q.fix(pm.plane(x=6.0), ux=lambda t: fails() or 0.0)
except RuntimeError: pass
try: list(solve(q))
except pm.PolarMPMError: pass
list(solve(q))
## release on one rank | release.*step|step.*release
q = bare()
s = q.fix(pm.plane(x=0.0), u=0, theta=0)
if bad: q.release(s)
list(solve(q))
## other controls | QuasiStatic.*max_iterations
loaded(controls=pm.Controls(max_iterations=9 + bad))
## other controls later | step to load factor.*max_iterations
q = loaded()
if bad: q.controls = pm.Controls(max_iterations=9)
list(solve(q))
## another basis | QuasiStatic.*bspline
loaded(basis='mpm' if bad else 'bspline')
## other points | seed.*cut
seeded(cut=bad)
## elements: traction raises | RuntimeError: user
q = meshed()
q.traction(pm.plane(x=6.0), force=lambda t, X: fails() or 0 * X)
list(solve(q))
## elements: record on one rank | record.*step|step.*record
q = meshed()
q.load(pm.plane(x=6.0), force=(0, -1))
r = pm.Recorder('z.pvd', q)
for s in solve(q):
    if bad: r.record(s)
## elements: a table on one rank | Table.*step|step.*Table
q = meshed()
q.load(pm.plane(x=6.0), force=(0, -1))
if bad: pm.Table('t.csv')
list(solve(q))
## restart path is a folder | k
q = loaded()
os.makedirs('k', exist_ok=True)
pm.save_restart(q, 'k')
## restart without a data set | points/F|m.h5
import h5py
q = loaded()
list(solve(q))
pm.save_restart(q, 'm.h5')
if bad:
    with h5py.File('m.h5', 'a') as h: del h['points/F']
comm.Barrier()
pm.load_restart(q, 'm.h5')
## restart file seen by one rank | none/m.h5.*can't be read
q = loaded()
pm.save_restart(q, 'm.h5')
pm.load_restart(q, 'm.h5' if bad else 'none/m.h5')
## all raise | RuntimeError: user | once
q = loaded()
raise RuntimeError('user')
## all exit with 3 | code: +3|non-zero
q = loaded()
sys.exit(3)
## none converges | no equilibrium | once
q = loaded(controls=pm.Controls(max_iterations=1))
q.body_load(force=(0, -1e5))
list(solve(q, 1))
## caught everywhere | done
q = held()
q.body_load(force=lambda t, X: (fails() if 0.5 < t < 0.6 else 0) or np.tile([0, -100.0 * t], (len(X), 1)))
a = solve(q, 1)
caught = 0
try: list(q.march(1, to=0.55, progress=False))
except RuntimeError: caught = 1
list(solve(q))
r = loaded()
list(solve(r))
done(caught, np.allclose(q.points.mean_displacement(), r.points.mean_displacement(), rtol=1e-6))
## each rank alone | done
q = held(MPI.COMM_SELF)
q.body_load(force=(0, -100.0 * (1 + comm.rank)))
list(solve(q, 1 + comm.rank))
done()
## two groups | done
half = comm.Split(int(comm.rank == 0))
q = held(half)
q.body_load(force=(0, -100.0 * (1 + (comm.rank == 0))))
list(solve(q, 1 + 2 * (comm.rank == 0)))
q.energies()
done()
## one of two groups raises | RuntimeError: user
half = comm.Split(int(bad))
q = loaded(half)
for s in solve(q): fails()
comm.Barrier()
"""


def _read():
    """Lines, pattern and whether the message may be there once only, by the cases' names."""
    found = {}
    for part in TEXT.split("\n## ")[1:]:
        head, _, lines = part.partition("\n")
        name, pattern, *once = head.split(" | ")
        found[name] = lines, None if pattern == "done" else pattern, bool(once)
    return found


CASES = _read()


def verdict(found, ranks, pattern, once):
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
    if once and text.count("Traceback") > 1:
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
    for name, (code, pattern, once) in CASES.items():
        ranks = draw.choice((2, 3))
        culprit = draw.randrange(ranks)
        if quick and name not in QUICK:
            continue
        found = run(f"{START}\n{code}\n", str(culprit), ranks=ranks, timeout=LIMIT)
        sign, note = verdict(found, ranks, pattern, once)
        yield Case("ranks", f"{name} ({culprit} of {ranks})", sign, note)
