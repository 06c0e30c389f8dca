"""Weighting functions against the formulas of T (2.26)-(2.27), and what any basis must fulfil."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.basis.base import Weights
from polarmpm.basis.registry import basis_of
from polarmpm.geometry.grid import MARGIN
from polarmpm.kinematics.stretch import domain_half_length

ALL = ("gimpm", "mpm", "bspline", "bspline3")
ORIGIN, CELL, CELLS = (-1.3, 0.4, 2.0), (0.5, 0.8, 1.25), (6, 5, 7)


def weights(basis: str, grid: pm.Grid, x: np.ndarray, half: np.ndarray) -> Weights:
    return basis_of(basis).weights(grid, x, half)


def lattice(dim: int) -> pm.Grid:
    lower = np.array(ORIGIN[:dim])
    return pm.Grid.box(lower, lower + np.multiply(CELL[:dim], CELLS[:dim]), CELL[:dim])


def five_cases(x: float, L: float, l: float) -> tuple[float, float]:
    """T (2.26)-(2.27): weight and gradient at a distance x from a node, cell size L, half-length l."""
    if x <= -L - l or x >= L + l:
        return 0.0, 0.0
    if x <= -L + l:
        return (L + l + x) ** 2 / (4 * L * l), (L + l + x) / (2 * L * l)
    if x <= -l:
        return 1 + x / L, 1 / L
    if x <= l:
        return 1 - (x**2 + l**2) / (2 * L * l), -x / (L * l)
    if x <= L - l:
        return 1 - x / L, -1 / L
    return (L + l - x) ** 2 / (4 * L * l), -(L + l - x) / (2 * L * l)


def mean_of_tent(x: float, L: float, l: float) -> tuple[float, float]:
    """Mean of the tent function and of its slope over [x - l, x + l], for domains of any length."""
    grid = np.unique(np.clip([x - l, -L, 0.0, L, x + l], x - l, x + l))
    middle, width = 0.5 * (grid[1:] + grid[:-1]), np.diff(grid)
    tent = np.maximum(0.0, 1 - abs(middle) / L)
    slope = np.where(abs(middle) < L, -np.sign(middle) / L, 0.0)
    return float(tent @ width) / (2 * l), float(slope @ width) / (2 * l)


def one_axis(w: Weights, p: int, axis: int) -> dict[int, tuple[float, float]]:
    """Lattice index -> (weight, gradient) of a point in one direction."""
    return {
        int(w.lowest[p, axis]) + k: (w.table[p, axis, 0, k], w.table[p, axis, 1, k])
        for k in range(w.count[p, axis])
    }


def nodal(grid: pm.Grid, w: Weights, p: int, basis: str = "mpm") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Node positions (n, d), weights (n,) and gradients (n, d) of a point, by (2.28)-(2.30)."""
    index = np.stack(np.meshgrid(*(range(c) for c in w.count[p]), indexing="ij"), axis=-1).reshape(
        -1, grid.dim
    )
    axes = range(grid.dim)
    value = np.prod([w.table[p, i, 0, index[:, i]] for i in axes], axis=0)
    gradient = np.stack(
        [np.prod([w.table[p, i, int(i == j), index[:, i]] for i in axes], axis=0) for j in axes], axis=1
    )
    return basis_of(basis).positions(grid, grid.node_number(w.lowest[p] + index)), value, gradient


def random_points(grid: pm.Grid, largest: float, n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    lower, upper = np.array(grid.origin), np.array(grid.upper)
    return rng.uniform(lower, upper, (n, grid.dim)), rng.uniform(0.01, largest, (n, grid.dim)) * grid.cell


@pytest.mark.parametrize("dim", [2, 3])
def test_gimpm_weights_are_the_five_cases(dim):
    """Weights and gradients of all nodes near a point are T's formulas, to rounding."""
    grid = lattice(dim)
    x, half = random_points(grid, 0.5)
    w = weights("gimpm", grid, x, half)
    for p in range(len(x)):
        for axis in range(dim):
            L, l = grid.cell[axis], half[p, axis]
            found = one_axis(w, p, axis)
            for node in range(-3, CELLS[axis] + 4):
                distance = x[p, axis] - (grid.origin[axis] + node * L)
                value, gradient = found.pop(node, (0.0, 0.0))
                expected = five_cases(distance, L, l)
                assert value == pytest.approx(expected[0], abs=1e-13)
                assert gradient == pytest.approx(expected[1], abs=1e-12 / L)
            assert not found


def test_the_two_references_agree():
    """The formula by cases is the mean of the tent function, the definition behind it."""
    for x in np.linspace(-1.6, 1.6, 101):
        assert five_cases(x, 1.1, 0.4) == pytest.approx(mean_of_tent(x, 1.1, 0.4), abs=1e-13)


@pytest.mark.parametrize("largest", [0.6, 1.0, 2.2])
def test_long_domains(largest):
    """Domains over three and more cells are the mean of the tent too; the five cases don't hold there."""
    grid = lattice(2)
    x, half = random_points(grid, largest)
    half = np.minimum(half, 2.2 * np.array(grid.cell))
    w = weights("gimpm", grid, x, half)
    if largest > 1.5:
        assert w.count.max() >= 5
    for p in range(len(x)):
        for axis in range(2):
            for node, (value, gradient) in one_axis(w, p, axis).items():
                distance = x[p, axis] - (grid.origin[axis] + node * grid.cell[axis])
                expected = mean_of_tent(distance, grid.cell[axis], half[p, axis])
                assert (value, gradient) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("basis", ALL)
@pytest.mark.parametrize("dim", [2, 3])
def test_partition_of_unity_and_linear_completeness(dim, basis):
    """Weights sum to 1 and gradients to 0; nodal positions are reproduced, and their gradient is I."""
    grid = lattice(dim)
    x, half = random_points(grid, 1.3)
    special = special_places(grid)
    x, half = (
        np.concatenate([x, special]),
        np.concatenate([half, np.tile(0.25 * np.array(grid.cell), (len(special), 1))]),
    )
    w = weights(basis, grid, x, half)
    for p in range(len(x)):
        position, value, gradient = nodal(grid, w, p, basis)
        assert value.min() >= 0.0
        assert value.sum() == pytest.approx(1.0, abs=1e-13)
        np.testing.assert_allclose(gradient.sum(axis=0), 0.0, atol=1e-12)
        np.testing.assert_allclose(value @ position, x[p], atol=1e-12)
        np.testing.assert_allclose(position.T @ gradient, np.eye(dim), atol=1e-12)


def special_places(grid: pm.Grid) -> np.ndarray:
    """Corners of the grid, faces, inner nodes, and places a domain's half-length from a plane."""
    lower, upper, cell = map(np.array, (grid.origin, grid.upper, grid.cell))
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, grid.dim)
    inner = lower + cell * np.arange(1, grid.dim + 1)
    return np.concatenate([corners, [inner, inner + 0.25 * cell, inner - 0.25 * cell, inner + 0.5 * cell]])


@pytest.mark.parametrize("basis", ALL)
def test_gradient_is_the_derivative_of_the_weight(basis):
    """Central differences in the point's position, wherever no domain end is within a step of a plane."""
    grid, h = lattice(2), 1e-6
    x, half = random_points(grid, 0.45)
    x = np.clip(x, np.array(grid.origin) + 1e-3, np.array(grid.upper) - 1e-3)
    w = weights(basis, grid, x, half)
    edges = np.concatenate([grid.local(x + s * half * (basis == "gimpm")) for s in (-1, 1)], axis=1)
    smooth = np.all(abs(edges - np.rint(edges)) > 1e-4, axis=1)
    assert smooth.sum() > 150
    for axis in range(2):
        shift = np.eye(2)[axis] * h
        up, down = (weights(basis, grid, x + s * shift, half) for s in (1, -1))
        assert np.all(up.lowest[smooth] == w.lowest[smooth])
        difference = (up.table[smooth, axis, 0] - down.table[smooth, axis, 0]) / (2 * h)
        np.testing.assert_allclose(difference, w.table[smooth, axis, 1], atol=1e-8)


@pytest.mark.parametrize("length", [0.0, 1e-15, 1e-12, 1e-9])
def test_tiny_domains_are_standard_mpm(length):
    """Domains without length have the standard weights, also on planes, where a gradient has two values."""
    grid = lattice(3)
    x, _ = random_points(grid, 0.5)
    x = np.concatenate([x, special_places(grid)])
    tiny = weights("gimpm", grid, x, np.full_like(x, length))
    standard = weights("mpm", grid, x, np.full_like(x, 0.3))
    np.testing.assert_array_equal(tiny.lowest, standard.lowest)
    np.testing.assert_array_equal(tiny.count, standard.count)
    np.testing.assert_allclose(tiny.table, standard.table, atol=1e-8)


def test_standard_weights_stay_in_one_cell():
    """Two nodes in each direction, inside the grid even for a point on its upper corner."""
    grid = lattice(3)
    x = np.concatenate([random_points(grid, 0.5)[0], special_places(grid)])
    w = weights("mpm", grid, x, np.ones_like(x))
    assert np.all(w.count == 2)
    assert np.all(w.lowest >= 0)
    assert np.all(w.lowest + 1 <= np.array(grid.shape))


def test_spline_weights_belong_to_the_cell():
    """Three functions in each direction, those of the last cell on the grid's upper boundary."""
    grid = lattice(3)
    x = np.concatenate([random_points(grid, 0.5)[0], special_places(grid)])
    w = weights("bspline", grid, x, np.ones_like(x))
    assert np.all(w.count == 3)
    np.testing.assert_array_equal(w.lowest, grid.cells_of(x))
    numbers, value = w.products(grid)
    position = basis_of("bspline").positions(grid, numbers.ravel()).reshape(*numbers.shape, 3)
    np.testing.assert_allclose(np.einsum("nk,nkd->nd", value, position), x, atol=1e-12)


def test_domain_that_ends_on_a_plane_stays_in_its_cell():
    """Touching a plane, or missing it by rounding, activates no node beyond it."""
    grid = pm.Grid.box((0, 0), (1, 1), 0.1)
    for noise in (0.0, 1e-13, -1e-13):
        x = np.array([[0.325, 0.975]]) + noise
        w = weights("gimpm", grid, x, np.array([[0.025, 0.025]]))
        np.testing.assert_array_equal(w.lowest, [[3, 9]])
        np.testing.assert_array_equal(w.count, [[2, 2]])


def test_domains_beyond_the_wall():
    """Domains may reach past the grid, up to the nodes that exist there; farther is an error."""
    grid = pm.Grid.box((0, 0), (2, 2), 1.0)
    x = np.array([[0.1, 1.9]])
    w = weights("gimpm", grid, x, np.array([[0.4, 0.4]]))
    np.testing.assert_array_equal(w.lowest, [[-1, 1]])
    np.testing.assert_array_equal(w.count, [[3, 3]])
    position, value, _ = nodal(grid, w, 0)
    np.testing.assert_allclose(value @ position, x[0], atol=1e-14)
    with pytest.raises(pm.InputError, match=f"{MARGIN} cells beyond"):
        weights("gimpm", grid, x, np.array([[MARGIN + 0.2, 0.4]]))


def test_gradients_of_full_cells_cancel():
    """Over cells tiled by domains the gradients of inner nodes cancel: no force by uniform stress."""
    grid = pm.Grid.box((0, 0), (6, 6), 1.0)
    fine = (np.arange(18) + 0.5) / 3 + 0.13  # a shifted body of points
    x = np.stack(np.meshgrid(fine, fine, indexing="ij"), axis=-1).reshape(-1, 2)
    x = x[np.all(x < 6.0, axis=1)]
    w = weights("gimpm", grid, x, np.full_like(x, 1 / 6))
    total = np.zeros((9, 9, 2))
    for p in range(len(x)):
        position, _, gradient = nodal(grid, w, p)
        at = np.rint(position).astype(int) + 1
        np.add.at(total, (at[:, 0], at[:, 1]), gradient)
    np.testing.assert_allclose(total[4:6, 4:6], 0.0, atol=1e-12)


@pytest.mark.parametrize("bad", ["GIMPM", "splines", "", None])
def test_unknown_basis(bad):
    """The message names what was given and what is allowed."""
    with pytest.raises(pm.InputError, match=r"basis = .*gimpm, mpm, bspline"):
        weights(bad, lattice(2), np.zeros((1, 2)), np.zeros((1, 2)))


@pytest.mark.parametrize("spread", [0.0, 1e-9, 1e-4, 0.5])
def test_half_lengths_are_those_of_the_right_stretch(spread):
    """U_ii l_i0 with the U of an eigenvalue solver, for equal stretches and for some that are far apart."""
    rng = np.random.default_rng(3)
    n = 200
    axes = [np.linalg.qr(rng.normal(size=(n, 3, 3)))[0] for _ in range(2)]
    stretch = np.exp(spread * rng.normal(size=(n, 3)))
    F = axes[0] @ (stretch[:, :, None] * np.swapaxes(axes[1], 1, 2))
    U = (axes[1] * stretch[:, None, :]) @ np.swapaxes(axes[1], 1, 2)
    for dim in (2, 3):
        l0 = rng.uniform(0.1, 1.0, (n, dim))
        expected = np.diagonal(U, axis1=1, axis2=2)[:, :dim] * l0
        error = abs(domain_half_length(F, l0) - expected) / stretch.max(axis=1)[:, None]
        assert error.max() < 1e-12
