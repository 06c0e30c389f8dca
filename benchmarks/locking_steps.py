"""Large plastic steps with and without the cure of locking: all of a scene's load in one adaptive step.

    python benchmarks/locking_steps.py [names ...]

A line a scene: linear solves, also those of attempts that failed, and cuts, without a cure and with it.
"""

import math
import sys
import warnings

from mpi4py import MPI

import numpy as np
from dolfinx import mesh as dmesh

import polarmpm as pm

HENCKY = pm.Hencky.from_engineering(E=1e4, nu=0.3)
MICROPOLAR = pm.MicropolarElastic.bounded_stiffness(lam=5.77e3, mu=3.85e3, kappa=3.85e3, l_b=0.05)
K = math.sqrt(3.0)
SOILS = {
    "von Mises": pm.VonMises(HENCKY, k=K),
    "micropolar": pm.VonMises(MICROPOLAR, k=K, l_p=0.05),
    "cone": pm.DruckerPrager(HENCKY, phi=math.radians(20), psi=math.radians(20), c=1.0, cone="plane strain"),
}


def sides(problem, size):
    """Smooth sides and a rough base."""
    *across, up = "xyz"[: len(size)]
    for axis, length in zip(across, size, strict=False):
        for place in (0.0, length):
            problem.fix(pm.plane(**{axis: place}), **{f"u{axis}": 0})
    problem.fix(pm.plane(**{up: 0.0}), u=0)


def footing(basis, locking, soil, depth, cells=4):
    """Half of a rough footing of half the width 1 m."""
    if basis.startswith("fem"):
        counts = [5 * cells, 5 * cells // 2]
        body = dmesh.create_rectangle(
            MPI.COMM_WORLD, [(0, 0), (5, 2.5)], counts, dmesh.CellType.quadrilateral
        )
        problem = pm.QuasiStaticFEM(pm.Elements(body, material=soil, degree=int(basis[3])), locking=locking)
    else:
        grid = pm.Grid.box((0, 0), (5, 2.5), 1 / cells)
        points = pm.seed(grid, material=soil, points_per_cell=4)
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking)
    sides(problem, (5.0, 2.5))
    problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > 2.5 - 1e-6), ux=0, uy=-depth)
    return problem


def footing_in_space(basis, locking, soil, depth):
    """A quarter of a square one."""
    grid = pm.Grid.box((0, 0, 0), (2, 2, 1), 0.25)
    points = pm.seed(grid, material=soil, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking)
    sides(problem, (2.0, 2.0, 1.0))
    problem.fix(lambda x: (x[:, :2] < 0.5 + 1e-6).all(axis=1) & (x[:, 2] > 1 - 1e-6), u=(0, 0, -depth))
    return problem


def column(basis, locking, soil, depth, dim=2):
    """A column between rough plates, as in a biaxial or triaxial test."""
    cell = 0.25 if dim == 2 else 1 / 3
    wide = (1.0,) * (dim - 1)
    low, high = (*(-2 * cell for _ in wide), 0.0), (*(1 + 2 * cell for _ in wide), 2.0)
    grid = pm.Grid.box(low, high, cell)
    bounds = ((0.0,) * dim, (*wide, 2.0))
    points = pm.seed(grid, bounds=bounds, material=soil, points_per_cell=5 - dim)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking)
    *across, up = "xyz"[:dim]
    problem.fix(pm.plane(**{up: 0.0}), u=0)
    problem.fix(pm.plane(**{up: 2.0}), **{f"u{axis}": 0 for axis in across}, **{f"u{up}": -depth})
    return problem


def slope(basis, locking, soil, weight):
    """A step in the ground that is loaded by its weight (Pa/m)."""

    def inside(x):
        return x[:, 1] <= 1 + np.clip(4 - x[:, 0], 0.0, 1.0)

    inside.bounds = ((0, 0), (6, 2))
    grid = pm.Grid.box((0, 0), (6, 2.5), 0.25)
    points = pm.seed(grid, inside, material=soil, points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking)
    sides(problem, (6.0, 2.5))
    problem.body_load(force=(0, -weight))
    return problem


def scenes():
    """(name, function of `locking` that gives the problem)."""
    for kind, *numbers in (
        *((footing, basis, "von Mises", 0.005) for basis in ("mpm", "gimpm", "bspline", "fem1", "fem2")),
        (footing, "mpm", "von Mises", 0.02),
        *((footing, basis, "von Mises", 0.001, 8) for basis in ("mpm", "bspline")),
        *((footing, basis, soil, 0.005) for soil in ("micropolar", "cone") for basis in ("mpm", "bspline")),
        *((footing_in_space, basis, "von Mises", 0.005) for basis in ("mpm", "bspline")),
        *((column, basis, "von Mises", 0.02) for basis in ("mpm", "bspline")),
        *((column, basis, "von Mises", 0.02, 3) for basis in ("mpm", "bspline")),
        (column, "bspline", "micropolar", 0.02),
        *((column, basis, "cone", push) for push in (0.02, -0.01) for basis in ("mpm", "bspline")),
        *((slope, basis, "von Mises", 3.5) for basis in ("mpm", "bspline")),
        (slope, "bspline", "cone", 5.0),
    ):
        basis, soil, *rest = numbers
        name = f"{kind.__name__} {basis} {soil} {' '.join(map(str, rest))}"
        yield name, lambda locking, k=kind, b=basis, s=soil, r=rest: k(b, locking, SOILS[s], *r)


def run(problem):
    """Linear solves of all attempts, and cuts."""
    attempts, solve = [], problem.attempt

    def counted(factor):
        attempts.append(solve(factor))
        return attempts[-1]

    problem.attempt = counted
    cuts = sum(step.cuts for step in problem.march(1, adaptive=True, progress=False))
    return sum(outcome.iterations for outcome in attempts), cuts


def main():
    warnings.simplefilter("ignore", pm.TrustWarning)
    chosen = sys.argv[1:]
    for name, make in scenes():
        if not chosen or any(word in name for word in chosen):
            found = [run(make(locking)) for locking in (None, "always")]
            if MPI.COMM_WORLD.rank == 0:
                plain, cured = (f"{solves} solves, {cuts} cuts" for solves, cuts in found)
                print(f"{name:42} none: {plain}; cured: {cured}", flush=True)


if __name__ == "__main__":
    main()
