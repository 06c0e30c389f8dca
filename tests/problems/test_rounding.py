"""Where Newton's method meets rounding: motions without stress, tiny loads, slivers of domains."""

from __future__ import annotations

import numpy as np
import pytest

from tests.assembly.test_system import PATCHES, patch, prescribe_motion
from tests.conftest import HENCKY, MICROPOLAR, NEO_HOOKEAN, beam, rotation


@pytest.mark.parametrize("basis", ["gimpm", "mpm"])
@pytest.mark.parametrize(("dim", "material"), PATCHES)
def test_patch_rigid_rotation(dim, material, basis):
    """A rotation by 0.9 rad leaves points at any random places free of stress, to 1e-10."""
    vector = np.array([0.0, 0.0, 0.9]) if dim == 2 else 0.9 * np.array([2.0, -1.0, 2.0]) / 3
    F = rotation(vector)
    problem = patch(dim, material, basis, F, vector, periodic=False, reset=None)
    prescribe_motion(problem, lambda t: rotation(t * vector), vector)
    list(problem.march(3))
    points = problem.points
    np.testing.assert_allclose(points.F, np.broadcast_to(F, points.F.shape), rtol=0, atol=1e-10)
    assert abs(problem.fields().stress).max(initial=0.0) < 1e-9 * 2e3


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize("dim", [2, 3])
def test_tiny_loads_converge(dim, size):
    """The smaller the load, the more linear the problem: never more iterations than for the full load."""
    problem = beam(dim)
    problem.load(
        problem.points.farthest((1.0, 0.0, 0.0)[:dim]), force=np.multiply(size, (4.0, -8.0, 0.0)[:dim])
    )
    (step,) = problem.march(1)
    assert step.iterations <= 4


@pytest.mark.parametrize("steps", [2, 4, 8, 16])
@pytest.mark.parametrize("material", [MICROPOLAR, HENCKY, NEO_HOOKEAN])
@pytest.mark.parametrize("basis", ["gimpm", "mpm"])
def test_slivers_after_a_reset(steps, material, basis):
    """A body aligned with the grid has domains that reach a hair across faces after its first reset."""
    problem = beam(2, material, basis=basis)
    problem.load(problem.points.farthest((1.0, 0.0)), force=(4.0, -8.0))
    assert max(step.iterations for step in problem.march(steps)) <= 6
