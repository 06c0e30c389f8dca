"""Memory that dropped problems keep: kB for each of those after the first ten, and of resets in long runs.

Each kind is a process of its own. Python's garbage collector runs when it likes; what it hasn't collected
counts.
"""

import sys
import tempfile
import warnings
from pathlib import Path

from mpi4py import MPI

from operation_cases import Case, run

import polarmpm as pm

LIMIT, STEP_LIMIT = 20.0, 10.0  # kB a problem, a step (1 kB of which is its record)
ELASTIC = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.3, l_b=0.1, l_t=0.1, psi=1.0)
YIELDING = pm.VonMises(ELASTIC, k=1e4, H=1e4, l_p=0.1)


def points(dim=2, material=ELASTIC, force=1e3, cell=1.0, **options):
    """A cantilever of material points."""
    low, high = [0.0] + [-1.0] * (dim - 1), [4.0] + [2.0] * (dim - 1)
    grid = pm.Grid.box(low, high, cell)
    body = pm.seed(grid, bounds=([0.0] * dim, [3.0] + [1.0] * (dim - 1)), material=material)
    problem = pm.QuasiStatic(grid, body, **options)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(body.farthest([1.0] + [0.0] * (dim - 1)), force=[0.0] * (dim - 1) + [force])
    return problem


def made():
    """A mesh."""
    from dolfinx import mesh

    corners = [[0.0, 0.0], [3.0, 1.0]]
    return mesh.create_rectangle(MPI.COMM_WORLD, corners, [4, 2], mesh.CellType.quadrilateral)


def elements(material=ELASTIC, surface=False, **options):
    """A cantilever of finite elements."""
    body = pm.Elements(made(), material=material, **options)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(pm.plane(x=3.0), force=(0.0, 1e3))
    if surface:
        problem.pressure(pm.plane(y=1.0), 1e2)
        problem.fix(body.surface(pm.plane(y=0.0)), uy=0, stiffness=1e4)
    return problem


def march(problem, steps=2):
    """Steps, and all results of the last one."""
    for _ in problem.march(steps, progress=False):
        pass
    problem.fields()
    problem.energies()
    problem.balance()


def failed():
    """A run that comes to no equilibrium."""
    try:
        march(points(force=1e9, reset=1))
    except pm.NotConverged:
        return
    raise SystemExit("converged")


def interrupted():
    """A run that is interrupted."""

    def stop(step):
        raise KeyboardInterrupt

    problem = points(basis="mpm", reset=1)
    march(problem)
    try:
        list(problem.march_arc_length(1e-3, until=stop, progress=False))
    except KeyboardInterrupt:
        return
    raise SystemExit("not interrupted")


def recorded():
    """A run with output, and a restart."""
    problem = points(reset=1)
    with tempfile.TemporaryDirectory() as folder:
        with pm.Recorder(folder + "/run.pvd", problem) as record:
            for step in problem.march(2, progress=False):
                record(step)
        pm.save_restart(problem, folder + "/run.h5")
        pm.load_restart(points(reset=1), folder + "/run.h5")


def surfaces():
    """Conditions on surfaces, and the ghost penalty."""
    problem = points(basis="gimpm", reset=1, ghost="thesis")
    problem.traction(pm.Surface.line((3.0, 1.0), (0.0, 1.0), 6), force=(0.0, -1e2), follows=True)
    problem.fix(pm.Surface.line((2.0, 0.0), (3.0, 0.0), 4), uy=0, stiffness=1e4, augment=True)
    march(problem)


def along():
    """The arc-length method."""
    for problem in (points(basis="mpm", reset=1), elements()):
        list(problem.march_arc_length(1e-2, steps=2, progress=False))


def turned():
    """Couples in space, of which the tangent is unsymmetric."""
    problem = points(3, reset=1)
    problem.load(problem.points.farthest((1.0, 0.0, 0.0)), couple=(10.0, 0.0, 0.0))
    march(problem)


KINDS = {
    "points, never solved": points,
    "splines": lambda: march(points(reset=1)),
    "gimpm": lambda: march(points(basis="gimpm", reset=1)),
    "no resets": lambda: march(points(basis="mpm", reset=None)),
    "plastic": lambda: march(points(material=YIELDING, force=1.5e3, reset=1)),
    "in space": lambda: march(points(3, reset=1)),
    "unsymmetric": turned,
    "MUMPS": lambda: march(points(cell=0.1, basis="mpm", reset=1), 1),
    "multigrid": lambda: march(points(3, reset=1, solver="multigrid")),
    "projection": lambda: march(points(basis="mpm", assembly="projection", reset=1)),
    "surfaces": surfaces,
    "failed": failed,
    "interrupted": interrupted,
    "recorded": recorded,
    "arc length": along,
    "mesh": made,
    "elements": lambda: pm.Elements(made(), material=ELASTIC),
    "finite elements": lambda: march(elements()),
    "finite elements, degree 2": lambda: march(elements(degree=2)),
    "finite elements, surfaces": lambda: march(elements(surface=True)),
    "plastic finite elements": lambda: march(elements(YIELDING)),
}
LONG = {
    "splines": lambda: points(reset=1, force=10.0),
    "gimpm": lambda: points(basis="gimpm", reset=1, force=10.0),
    "projection": lambda: points(basis="mpm", assembly="projection", reset=1, force=10.0),
    "multigrid": lambda: points(3, reset=1, solver="multigrid", force=10.0),
    "finite elements": elements,
    "plastic": lambda: points(material=YIELDING, force=10.0, reset=1),
}


def kept():
    """Resident memory (kB)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4.096


def measure(what, kind, first, number):
    """kB for each problem, or step, after the first ones."""
    begin = 0.0
    if what == "problems":
        for k in range(number):
            begin = kept() if k == first else begin
            KINDS[kind]()
    else:
        for k, _ in enumerate(LONG[kind]().march(number, progress=False)):
            begin = kept() if k == first else begin
    return (kept() - begin) / (number - first)


# cases --------------------------------------------------------------------------------------------------
QUICK = ("splines", "finite elements")


def case(what, kind, first, number, limit):
    """One kind in a process of its own."""
    script, here = Path(__file__).read_text(), str(Path(__file__).parent)
    path = ":".join([here, str(Path(pm.__file__).parents[1])])
    done = run(script, what, kind, str(first), str(number), timeout=300.0, PYTHONPATH=path)
    name = f"{kind}, a step" if what == "steps" else kind
    if done.status is None:
        return Case("memory", name, "hang")
    if done.status or "kept" not in done.out:
        last = (done.err.splitlines() or [""])[-1]
        return Case("memory", name, "crash" if done.crashed else "raw", last)
    found = float(done.out.split("kept")[1])
    return Case("memory", name, "right" if found < limit else "silent", f"{found:.1f} kB")


def cases(quick, seed):
    """kB a problem of each kind, and a step of long runs."""
    for kind in QUICK if quick else KINDS:
        yield case("problems", kind, 10, 40 if quick else 110, LIMIT)
    for kind in () if quick else LONG:
        yield case("steps", kind, 50, 250, STEP_LIMIT)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print("kept", measure(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])))
