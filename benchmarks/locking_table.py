"""Locking and its cure: Cook's membrane, a strip and a layer, a footing; a table of numbers.

    python benchmarks/locking_table.py [--quick]

Reference values: Cook's membrane 6.92 (nu = 0.4999) and 7.78 (0.3), the footing 2 + pi; strip and layer are
compared with elements of degree 2. The quick run takes coarse cells only.
"""

import argparse
import math
import warnings

from mpi4py import MPI

import numpy as np
from dolfinx import mesh as dmesh

import polarmpm as pm

BASES = ("mpm", "gimpm", "bspline")
CHOICES = (None, "auto", "always")
YOUNG = 1e4


def cook(basis, nu, cell, locking, number=4, reset=None, steps=10):
    """u_y of the upper corner of Cook's membrane, and iterations in all steps."""

    def inside(x):
        low, high = 44 / 48 * x[:, 0], 44 + 16 / 48 * x[:, 0]
        return (x[:, 0] >= 0) & (x[:, 0] <= 48) & (x[:, 1] >= low) & (x[:, 1] <= high)

    inside.bounds = ((0, 0), (48, 60))
    grid = pm.Grid.box((0, -12), (60, 84), cell)
    material = pm.NeoHookean.from_engineering(E=240.565, nu=nu)
    points = pm.seed(grid, inside, material=material, points_per_cell=number)
    ghost = "light" if reset and basis != "bspline" else None
    problem = pm.QuasiStatic(grid, points, basis=basis, locking=locking, reset=reset, ghost=ghost)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.traction(pm.Surface.line((48, 44), (48, 60), 64), force=(0, 100 / 16))
    corner = np.array((48.0, 60.0))
    near = points.nearest(corner)
    iterations = sum(step.iterations for step in problem.march(steps))
    found = 0.0
    for row in points.rows(near)[:1]:
        turn = points.F[row, :2, :2] - np.eye(2)
        found = float((points.displacement[row] + turn @ (corner - points.X[row]))[1])
    return MPI.COMM_WORLD.allreduce(found), iterations


def bent(scene, nu, basis=None, locking=None, cells=(96, 24)):
    """Work of a small load on a strip that bends or a layer under a footing; by elements without a basis."""
    material = pm.NeoHookean.from_engineering(E=YOUNG, nu=nu)
    strip = scene == "strip"
    size = np.array((4.0, 1.0) if strip else (2.0, 1.0))
    lift = 0.075 if strip and basis else 0.0  # off the grid's planes
    if basis is None:
        mesh = dmesh.create_rectangle(
            MPI.COMM_WORLD, [np.zeros(2), size], cells, dmesh.CellType.quadrilateral
        )
        problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=material, degree=2))
    else:
        grid = pm.Grid.box((0, -2), (5, 3), 0.25) if strip else pm.Grid.box((0, 0), (2, 1), 0.125)
        points = pm.seed(
            grid, bounds=((0, lift), size + np.array((0, lift))), material=material, points_per_cell=4
        )
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking)
    if strip:
        problem.fix(pm.plane(x=0.0), u=0)
        loaded = pm.Surface.line((4, lift), (4, 1 + lift), 64) if basis else pm.plane(x=4.0)
    else:
        for plane in (pm.plane(x=0.0), pm.plane(x=2.0)):
            problem.fix(plane, ux=0)
        problem.fix(pm.plane(y=0.0), u=0)
        loaded = pm.Surface.line((0, 1), (0.5, 1), 64) if basis else _under
    problem.traction(loaded, force=(0, (1e-6 if strip else -1e-6) * YOUNG))
    list(problem.march(1))
    return problem.energies()["external"]


def _under(x):
    return (x[:, 1] > 1 - 1e-9) & (x[:, 0] < 0.5 + 1e-9)


def footing(basis, cells, locking, length=None):
    """Load over c b_eff of half a rough footing that is pushed in by 0.02 b, and by how much it rises."""
    elastic = pm.Hencky.from_engineering(E=YOUNG, nu=0.3)
    if length is not None:
        lam, mu = 0.3 * YOUNG / 1.3 / 0.4, YOUNG / 2.6
        elastic = pm.MicropolarElastic.bounded_stiffness(lam=lam, mu=mu, kappa=mu, l_b=length)
    material = pm.VonMises(elastic, k=math.sqrt(3.0), l_p=length)
    grid = pm.Grid.box((0, 0), (5, 2.5), 1 / cells)
    points = pm.seed(grid, material=material, points_per_cell=4)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking)
    for plane in (pm.plane(x=0.0), pm.plane(x=5.0)):
        problem.fix(plane, ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    held = problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > 2.5 - 1e-6), ux=0, uy=-0.02)
    loads = [-problem.reaction(held).force[1] for _ in problem.march(40)]
    x = problem.system.nodes.position
    top = x[np.abs(x[:, 1] - 2.5) < 1e-6, 0]
    ends = top[top < 1 + 1e-6].max(initial=0.0), top[top > 1 + 1e-6].min(initial=5.0)
    last = MPI.COMM_WORLD.allreduce(ends[0], op=MPI.MAX)
    width = 0.5 * (last + MPI.COMM_WORLD.allreduce(ends[1], op=MPI.MIN))
    return loads[-1] / width, loads[-1] / loads[len(loads) // 2 - 1] - 1


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="coarse cells, no footing")
    quick = parser.parse_args().quick
    warnings.simplefilter("ignore", pm.TrustWarning)
    tell = print if MPI.COMM_WORLD.rank == 0 else lambda *_: None
    tell("Cook's membrane: basis, nu, cell (m), locking: u_y over the limit, iterations in 10 steps")
    for basis in BASES:
        for nu, limit in ((0.3, 7.78), (0.4999, 6.92)):
            for cell in (6.0,) if quick else (6.0, 3.0, 1.5):
                for locking in CHOICES:
                    u, iterations = cook(basis, nu, cell, locking)
                    tell(f"{basis:8} {nu:6} {cell:4} {locking!s:7} {u / limit:.4f} {iterations}")
    tell("strip and layer: scene, nu, basis, locking: work over that of elements of degree 2")
    for scene in ("strip", "layer"):
        for nu in (0.4999,) if quick else (0.0, 0.3, 0.45, 0.49, 0.499, 0.4999):
            reference = bent(scene, nu)
            for basis in BASES:
                for locking in CHOICES:
                    share = bent(scene, nu, basis, locking) / reference
                    tell(f"{scene} {nu:6} {basis:8} {locking!s:7} {share:.4f}")
    tell("footing: basis, cells under its half, locking, l / b: load over c b_eff, rise in the second half")
    for basis in () if quick else BASES:
        for cells in (4, 8):
            for locking in (None, "auto"):
                for length in (None, 0.02) if cells == 4 else (None,):
                    load, rise = footing(basis, cells, locking, length)
                    tell(f"{basis:8} {cells} {locking!s:7} {length!s:5} {load:.3f} {100 * rise:.2f} %")


if __name__ == "__main__":
    main()
