"""Stress tests of load steps: ten times too large, and a thousand times too small."""

from __future__ import annotations

from functools import partial

import numpy as np
from stress_cases import COMM, MICROPOLAR, YOUNG, Watch, block_points, free_tangent

import polarmpm as pm

HALF_WAY = "let go, one half way"
RESETS = {
    "no resets": {"reset": None},
    HALF_WAY: {"reset": None},
    "balanced, when distorted": {"reset": pm.WhenDistorted(0.2), "balanced_reset": True},
    "balanced, every step": {"reset": 1, "balanced_reset": True},
    "let go, every step": {"reset": 1},
}
# with the same resets the answer is the same; with others it isn't, and what is let go adds up
LIMITS = {"no resets": 1e-8, HALF_WAY: 1e-8, "let go, every step": 1.0}
LIMITS |= dict.fromkeys(["balanced, when distorted", "balanced, every step"], 0.03)
UNEQUAL = "largest difference of displacements"


def cantilever(basis, *, load=0.004, **options):
    """A strip of 5 x 1 cells, clamped at a wall of the grid; a body force bends it, upwards and outwards.

    Args:
        load: body force in the direction of its deflection, as a share of Young's modulus over a cell.
    """
    grid = pm.Grid.box((0, -3), (8, 7), 1.0, COMM)
    options = {**pm.PUBLISHED, "basis": basis, **options}
    problem = pm.QuasiStatic(grid, block_points((0, 0.2), (5, 1), (3, 4), MICROPOLAR), **options)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0.0, load * YOUNG))
    return problem


def elements(*, load=0.004):
    """The same strip of finite elements of degree 2."""
    from dolfinx import mesh

    made = mesh.create_rectangle(COMM, [[0, 0], [5, 1]], [5, 1], mesh.CellType.quadrilateral)
    problem = pm.QuasiStaticFEM(pm.Elements(made, material=MICROPOLAR, degree=2))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0.0, load * YOUNG))
    return problem


def distance(a, b):
    """Largest difference of two runs' points, over the largest displacement."""
    return float(np.abs(a.points.x - b.points.x).max() / np.abs(b.points.displacement).max())


def same_resets(problem, steps, **options):
    """March with a single reset, half way; the watch of the second half."""
    watch = Watch(problem, steps // 2, to=0.5, **options)
    problem.progress.reset_due = True
    after = Watch(problem, steps // 2, **options)
    after.iterations, after.cuts = max(watch.iterations, after.iterations), watch.cuts + after.cuts
    after.failure = watch.failure or after.failure
    return after


def too_large(basis, resets, steps=20, factor=10, load=0.03):
    """Steps ten times too large, cut where need be, against small ones."""
    march = same_resets if resets == HALF_WAY else Watch
    small, large = (cantilever(basis, load=load, **RESETS[resets]) for _ in range(2))
    careful = march(small, steps, tangents=False)
    watch = march(large, steps // factor, adaptive=True, largest=1.0)
    error, limit = distance(large, small), LIMITS[resets]
    number = f"{len(large.steps)} steps, {watch.cuts} cuts, against {len(small.steps)}"
    for name, problem in (("small", small), ("large", large)):
        if np.linalg.eigvalsh(free_tangent(problem))[0] < 0:
            number += f", the {name} steps end unstable"
    passed = not careful.failure and watch.cuts > 0 and error < limit
    case = f"too large, {basis}, {resets}, load {load:g}"
    return watch.record("steps", case, passed, error=error, measure=f"{number}: {UNEQUAL}")


def too_small(basis, resets, steps=4, factor=1000, load=0.008):
    """Steps a thousand times too small; `basis` may be "FEM"."""
    build = elements if basis == "FEM" else partial(cantilever, basis, **RESETS[resets])
    march = same_resets if resets == HALF_WAY else Watch
    few, many = build(load=load), build(load=load)
    march(few, steps, tangents=False)
    watch = march(many, steps * factor, tangents=False)
    if basis != "FEM":
        watch.look()
    error, limit = distance(many, few), LIMITS[resets]
    measure = f"{steps * factor} steps against {steps}: {UNEQUAL}"
    return watch.record("steps", f"too small, {basis}, {resets}", error < limit, error=error, measure=measure)
