"""Stress tests of where a body is cut by the grid: blocks at random positions, slivers, points on faces."""

from __future__ import annotations

import numpy as np
from stress_cases import BASES, COMM, MICROPOLAR, NEO_HOOKEAN, YOUNG, Watch, block_points, clamp

import polarmpm as pm

KINDS = ("anywhere", "sliver", "corner sliver", "on faces", "on corners")
RESETS = (
    {"reset": 1},
    {"reset": 1, "balanced_reset": True},
    {"reset": pm.WhenDistorted(0.1), "balanced_reset": True},
)


def draw(number, dim, kind):
    """Corner and size (cells) of a block, and its points per cell, for a number.

    Kinds: its end, or one of its corners, reaches 1e-12 to 1e-2 of a cell across a plane; points (with
    one row to start with) lie on planes in one or in all directions.
    """
    rng = np.random.default_rng([number, dim])
    per_cell = rng.integers(1, 7 if dim == 2 else 4, dim)
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


def block(number, dim, kind, basis, material):
    """The block, clamped at its end, pulled and sheared by a body force."""
    corner, size, per_cell = draw(number, dim, kind)
    rng = np.random.default_rng([number, dim, 1])
    grid = pm.Grid.box((-1,) * dim, (10,) + (7,) * (dim - 1), 1.0, COMM)
    points = block_points(corner, size, per_cell, material)
    problem = pm.QuasiStatic(grid, points, basis=basis, **RESETS[number % len(RESETS)])
    clamp(problem, corner[0] + 0.75)
    length = size[0]
    across = rng.normal(size=dim - 1)
    across *= 0.15 * YOUNG * size[1:].min() ** 2 / length**3 / np.linalg.norm(across)
    problem.body_load(force=(rng.uniform(0, 0.15) * YOUNG / length, *across))
    return problem


def run(numbers, dim, basis, material, kinds=KINDS, steps=4):
    """Blocks of these numbers, kind after kind; a record for each kind."""
    name = "micropolar" if material.micropolar else "classical"
    records = []
    for k, kind in enumerate(kinds):
        watches = {}
        for number in numbers:
            if number % len(kinds) == k:
                watches[number] = Watch(block(number, dim, kind, basis, material), steps, adaptive=True)
        failed = [n for n, w in watches.items() if w.failure]
        worst = Watch.worst(watches.values())
        case = f"{dim}D {name} {basis}, {kind}"
        measure = f"{len(failed)} of {len(watches)} failed" + (f": {failed}" if failed else "")
        error = len(failed) / len(watches)
        records.append(worst.record("cuts", case, not failed, error=error, measure=measure))
    return records
