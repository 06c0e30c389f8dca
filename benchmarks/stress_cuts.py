"""Stress tests of where a body is cut by the grid: blocks at random positions, slivers, points on faces."""

from __future__ import annotations

import numpy as np
from stress_cases import COMM, YOUNG, Watch, block_points, clamp

import polarmpm as pm

KINDS = ("anywhere", "sliver", "corner sliver", "on faces", "on corners")
RESETS = (
    {"reset": 1, "balanced_reset": False},
    {"reset": 1, "balanced_reset": True},
    {"reset": pm.WhenDistorted(0.1), "balanced_reset": True},
)


def draw(number, dim, kind, single):
    """Corner and size (cells) of a block, and its points per cell, for a number.

    Kinds: its end, or one of its corners, reaches 1e-12 to 1e-2 of a cell across a plane; points (with
    one row to start with) lie on planes in one or in all directions.

    Args:
        single: with one point a cell in some direction, else with 2 to 6 (in space: 2 or 3) in each.
    """
    rng = np.random.default_rng([number, dim, single])
    most = 6 if dim == 2 else 3
    per_cell = rng.integers(1 if single else 2, most + 1, dim)
    if single:
        per_cell[rng.integers(0, dim)] = 1
    size = rng.uniform([2.2, 0.6, 0.6][:dim], [4.2, 2.0, 1.6][:dim])
    size = np.ceil(size * per_cell) / per_cell  # whole rows
    corner = rng.uniform(1.0, 2.0, dim)
    if kind != "anywhere":
        axes = [rng.integers(0, dim)] if kind in ("sliver", "on faces") else range(dim)
        for axis in axes:
            spacing = 1 / per_cell[axis]
            if "sliver" in kind:  # the last row of points, or the end of its domains
                row = 0.5 * spacing * rng.integers(0, 2)
                corner[axis] = np.ceil(2.0 + size[axis]) - size[axis] + row + 10 ** rng.uniform(-12, -2)
            else:
                corner[axis] = 2.0 - 0.5 * spacing
    return corner, size, per_cell


def block(number, dim, kind, basis, material, *, single=False, ghost=None):
    """The block, clamped at its end, pulled and sheared by a body force."""
    corner, size, per_cell = draw(number, dim, kind, single)
    rng = np.random.default_rng([number, dim, 1])
    grid = pm.Grid.box((-1,) * dim, (10,) + (7,) * (dim - 1), 1.0, COMM)
    points = block_points(corner, size, per_cell, material)
    problem = pm.QuasiStatic(grid, points, basis=basis, ghost=ghost, **RESETS[number % len(RESETS)])
    clamp(problem, corner[0] + 0.75)
    length = size[0]
    across = rng.normal(size=dim - 1)
    across *= 0.15 * YOUNG * size[1:].min() ** 2 / length**3 / np.linalg.norm(across)
    problem.body_load(force=(rng.uniform(0, 0.15) * YOUNG / length, *across))
    return problem


def run(numbers, dim, basis, material, *, single=False, ghost=None, steps=4):
    """A record of the blocks of these numbers; kinds take turns. The error is the share that failed."""
    watches = {}
    for number in numbers:
        kind = KINDS[number % len(KINDS)]
        problem = block(number, dim, kind, basis, material, single=single, ghost=ghost)
        watches[number] = Watch(problem, steps, adaptive=True)
        watches[number].problem = None  # its matrices aren't needed any more
    failed = [n for n, w in watches.items() if w.failure]
    cut = sum(w.cuts > 0 for w in watches.values())
    worst = Watch.worst(watches.values())
    name = "micropolar" if material.micropolar else "classical"
    points = (
        "one point a cell in some direction"
        if single
        else f"2 to {6 if dim == 2 else 3} points a cell and direction"
    )
    case = f"{dim}D {name} {basis}" + (f" with ghost={ghost!r}" if ghost else "") + f", {points}"
    measure = f"{len(failed)} of {len(watches)} positions failed, {cut} needed smaller steps"
    if failed and len(failed) < 6:
        measure += f" (failed: {', '.join(f'{n} {KINDS[n % len(KINDS)]}' for n in failed)})"
    return worst.record("cuts", case, error=len(failed) / len(watches), measure=measure)
