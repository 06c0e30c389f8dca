"""Terms on nodes that no material point reaches, and what becomes of these when a term is released."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import NEO_HOOKEAN


class Springs(pm.Piece):
    """From each node of some boxes to the ground."""

    name, symmetric, linear, external = "springs", True, True, False

    def __init__(self, boxes: pm.Boxes):
        self.boxes, self.pairs = boxes, np.tile(np.arange(2)[:, None], (1, 2))

    def forces(self, x: np.ndarray) -> np.ndarray:
        return 1e3 * x

    def matrices(self, x: np.ndarray) -> np.ndarray:
        return np.tile(1e3 * np.eye(x.shape[1])[None, :, :, None], (len(x), 1, 1, x.shape[2]))


class InEmptySpace(pm.Term):
    name = "springs in empty space"

    def pieces(self, setting: object) -> list[pm.Piece]:
        grid = setting.grid
        cells = grid.node_number(np.array([[12, 12], [13, 12]]))
        count = (setting.basis.functions,) * 2
        return [Springs(pm.Boxes(count, cells if grid.comm.rank == 0 else cells[:0]))]


@pytest.mark.parametrize("basis", ["mpm", "bspline"])
def test_nodes_of_a_released_term_stay_where_they_are(basis):
    """The body deforms as without the term; nothing else is disturbed, with the last increments kept."""
    found = []
    for term in (None, InEmptySpace()):
        grid = pm.Grid.box((0, 0), (4, 4), 0.25)
        points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=NEO_HOOKEAN)
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None)
        problem.fix(pm.plane(y=0.0), u=0)
        problem.load(points.farthest((0, 1)), force=(0, -0.02 * NEO_HOOKEAN.mu))
        if term is not None:
            problem.add(term)
        list(problem.march(2, progress=False))
        if term is not None:
            problem.release(term)
        list(problem.march(2, to=2.0, progress=False))
        found.append(points.mean_displacement())
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-9)
