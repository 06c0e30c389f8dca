"""What the operational tests of files share: a small run, and what it answers."""

import numpy as np

import polarmpm as pm

MATERIAL = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.3, l_b=0.1, l_t=0.1, psi=1.0)
YIELDING = pm.VonMises(MATERIAL, k=2e4, H=1e5, l_p=0.1)


def strip(cell=0.5, per_cell=2, material=MATERIAL, load=2e3, **options):
    """A cantilever in the plane, four by one metres."""
    grid = pm.Grid.box((0, -2), (6, 3), cell)
    points = pm.seed(grid, bounds=((0, 0), (4, 1)), material=material, points_per_cell=per_cell)
    problem = pm.QuasiStatic(grid, points, **{"basis": "mpm", "reset": 2, **options})
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0.0, -load))
    return problem


def mesh(material=MATERIAL, divisions=(8, 2)):
    """The same of finite elements."""
    from mpi4py import MPI

    from dolfinx import mesh as dmesh

    cells = dmesh.create_rectangle(
        MPI.COMM_WORLD, [np.zeros(2), np.array([4.0, 1.0])], divisions, dmesh.CellType.quadrilateral
    )
    problem = pm.QuasiStaticFEM(pm.Elements(cells, material=material))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(pm.plane(x=4.0), force=(0.0, -2e3))
    return problem


def state(problem):
    """All numbers of the body's state."""
    arrays = [np.asarray(a, dtype=float).ravel() for a in problem.points.arrays().values()]
    if hasattr(problem, "elements"):
        arrays += [problem.elements.displacement.ravel(), problem.elements.q.ravel()]
    elif problem.increments() is not None:
        arrays.append(problem.increments()[2].ravel())
    return np.concatenate([*arrays, [problem.progress.factor, problem.progress.step]])
