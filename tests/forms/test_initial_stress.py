"""The energy of initial stresses at a point, and its kernels."""

from __future__ import annotations

import numpy as np
import pytest

from polarmpm.forms.initialstress import InitialStressForm
from polarmpm.kinematics import rotations
from polarmpm.kinematics.layout import SECOND, Layout
from tests.conftest import COMM, rotation

LAYOUTS = [(2, 0, False), (2, 0, True), (2, 1, False), (3, 0, False), (3, 0, True), (3, 3, False)]
KINDS = pytest.mark.parametrize(("dim", "turns", "green"), LAYOUTS)
N = 5


class Case:
    """Kernels, and stresses and frames of some points."""

    def __init__(self, dim: int, turns: int, green: bool):
        rng = np.random.default_rng(dim + turns)
        self.layout = Layout(dim, turns)
        self.kernels = InitialStressForm(self.layout, green=green).compile(COMM)
        self.stress = rng.normal(size=(N, self.layout.block, dim))
        if not turns:
            self.stress += np.swapaxes(self.stress, 1, 2)
        self.frame = np.eye(dim) + 0.1 * rng.normal(size=(N, dim, dim))
        self.packed = self.kernels.form.pack(self.stress, self.frame)
        self.z = 0.1 * rng.normal(size=(N, self.layout.unknowns))

    def energy(self, z: np.ndarray) -> np.ndarray:
        return self.kernels.energy(z, self.frame, self.packed)[:, 0]

    def residual(self, z: np.ndarray) -> np.ndarray:
        return self.kernels.residual(z, self.frame, self.packed)

    def in_frame(self, gradient: np.ndarray, w: np.ndarray, change: np.ndarray) -> np.ndarray:
        """z of du/dx~ (N, d, d), w (N, r) and dw/dx~ (N, r, d)."""
        value = np.concatenate([np.zeros((N, self.layout.dim)), w], axis=1)
        return self.layout.pack(value, np.concatenate([gradient, change], axis=1) @ self.frame)


@KINDS
def test_residual_and_tangent_are_derivatives_of_the_energy(dim, turns, green):
    c, h = Case(dim, turns, green), 1e-5
    steps = h * np.eye(c.layout.unknowns)
    first = np.stack([(c.energy(c.z + s) - c.energy(c.z - s)) / (2 * h) for s in steps], axis=1)
    second = np.stack([(c.residual(c.z + s) - c.residual(c.z - s)) / (2 * h) for s in steps], axis=2)
    blocks = c.kernels.blocks(c.z, c.frame, c.packed)
    np.testing.assert_allclose(blocks[:, : c.layout.unknowns], c.residual(c.z), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(c.residual(c.z), first, atol=1e-6)
    upper = np.triu_indices(c.layout.unknowns)
    np.testing.assert_allclose(blocks[:, c.layout.unknowns :], second[:, upper[0], upper[1]], atol=1e-6)


@KINDS
def test_it_is_the_stress_of_the_reset(dim, turns, green):
    """At z = 0 the work on gradients by x~ is the stress itself, and the energy is zero."""
    c = Case(dim, turns, green)
    start = np.zeros_like(c.z)
    work = c.residual(start)
    rows = np.concatenate([c.layout.part(work, f, 1) for f in ("displacement", "rotation")], axis=1)
    np.testing.assert_allclose(rows @ np.swapaxes(c.frame, 1, 2), c.stress, rtol=0, atol=1e-12)
    assert not np.any(c.energy(start))


@KINDS
def test_a_rigid_motion_does_no_work(dim, turns, green):
    """Nor does it change the forces, but for their direction: they balance wherever the body goes."""
    c = Case(dim, turns, green)
    vector = np.array([0.0, 0.0, 0.7]) if dim == 2 else np.array([0.5, -0.4, 0.8])
    turn = rotation(vector)[:dim, :dim]
    gradient = np.broadcast_to(turn - np.eye(dim), (N, dim, dim))
    w = np.broadcast_to(vector[3 - turns :], (N, turns))
    z = c.in_frame(gradient, w, np.zeros((N, turns, dim)))
    np.testing.assert_allclose(c.energy(z), 0.0, atol=1e-12)
    forces = c.layout.part(c.residual(z), "displacement", 1) @ np.swapaxes(c.frame, 1, 2)
    np.testing.assert_allclose(forces, turn @ c.stress[:, :dim], atol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_measures_of_classical_bodies(dim):
    """In a pure stretch U: Green's strain, or U - I to second order."""
    rng = np.random.default_rng(1)
    strain = rng.normal(size=(dim, dim))
    strain = 1e-3 * (strain + strain.T)
    for green in (False, True):
        c = Case(dim, 0, green)
        z = c.in_frame(np.broadcast_to(strain, (N, dim, dim)), np.zeros((N, 0)), np.zeros((N, 0, dim)))
        measure = strain + 0.5 * strain @ strain if green else strain
        expected = np.einsum("nij,ij->n", c.stress, measure)
        third = 2 * abs(c.stress).max() * np.linalg.norm(strain) ** 3
        np.testing.assert_allclose(c.energy(z), expected, rtol=0, atol=third)


@pytest.mark.parametrize("dim", [2, 3])
def test_micropolar_measures(dim):
    """B0 : (Q^T F - I) and M0 : J_r(w) grad w."""
    turns = 1 if dim == 2 else 3
    c, rng = Case(dim, turns, False), np.random.default_rng(2)
    gradient, change = 0.3 * rng.normal(size=(N, dim, dim)), rng.normal(size=(N, turns, dim))
    w = 0.5 * rng.normal(size=(N, turns))
    turn = rotations.to_tensor(rotations.from_vector(rotations.in_space(w)))[:, :dim, :dim]
    strain = np.swapaxes(turn, 1, 2) @ (np.eye(dim) + gradient) - np.eye(dim)
    wryness = change if dim == 2 else rotations.right_tangent(w) @ change
    expected = np.sum(c.stress * np.concatenate([strain, wryness], axis=1), axis=(1, 2))
    np.testing.assert_allclose(c.energy(c.in_frame(gradient, w, change)), expected, atol=1e-12)


class Second:
    """Kernels of points with second gradients, and their stresses, frames and H~."""

    def __init__(self, dim: int):
        rng = np.random.default_rng(dim)
        self.layout = Layout(dim, 0, SECOND)
        self.kernels = InitialStressForm(self.layout).compile(COMM)
        stress, pairs = rng.normal(size=(N, dim, dim)), len(self.layout.axes(2))
        work = rng.normal(size=(N, dim, pairs))
        self.stress = np.concatenate([stress + np.swapaxes(stress, 1, 2), work], axis=2)
        self.frame = np.eye(dim) + 0.1 * rng.normal(size=(N, dim, dim))
        self.grown = 0.3 * rng.normal(size=(N, dim, pairs))
        self.packed = self.kernels.form.pack(self.stress, self.frame, self.grown)
        self.z = 0.1 * rng.normal(size=(N, self.layout.unknowns))

    def energy(self, z: np.ndarray) -> np.ndarray:
        return self.kernels.energy(z, self.frame, self.packed)[:, 0]

    def in_frame(self, gradient: np.ndarray, second: np.ndarray) -> np.ndarray:
        """z of du/dx~ (N, d, d) and its symmetric gradient (N, d, d, d)."""
        h = np.einsum("nimp,nmj,npk->nijk", second, self.frame, self.frame)
        h = h + np.einsum("nim,nmjk->nijk", gradient, self.layout.symmetric(self.grown))
        return self.layout.pack(np.zeros((N, self.layout.dim)), gradient @ self.frame, h)


@pytest.mark.parametrize("dim", [2, 3])
def test_second_gradients(dim):
    """Derivatives, the work at the reset, and no energy of a rigid motion."""
    c, h, rng = Second(dim), 1e-5, np.random.default_rng(0)
    steps, upper = h * np.eye(c.layout.unknowns), np.triu_indices(c.layout.unknowns)
    first = np.stack([(c.energy(c.z + s) - c.energy(c.z - s)) / (2 * h) for s in steps], axis=1)

    def residual(z):
        return c.kernels.residual(z, c.frame, c.packed)

    second = np.stack([(residual(c.z + s) - residual(c.z - s)) / (2 * h) for s in steps], axis=2)
    blocks = c.kernels.blocks(c.z, c.frame, c.packed)
    np.testing.assert_allclose(residual(c.z), first, atol=1e-6)
    np.testing.assert_allclose(blocks[:, c.layout.unknowns :], second[:, upper[0], upper[1]], atol=1e-6)
    # at the reset
    gradient, half = rng.normal(size=(N, dim, dim)), rng.normal(size=(N, dim, dim, dim))
    curved, pairs = half + np.swapaxes(half, 2, 3), c.layout.pairs
    work = np.sum(residual(np.zeros_like(c.z)) * c.in_frame(gradient, curved), axis=1)
    expected = np.sum(c.stress[:, :, :dim] * gradient, axis=(1, 2))
    expected += np.sum(c.stress[:, :, dim:] * curved[:, :, pairs[0], pairs[1]], axis=(1, 2))
    np.testing.assert_allclose(work, expected, atol=1e-11)
    # turned
    vector = np.array([0.0, 0.0, 0.7]) if dim == 2 else np.array([0.5, -0.4, 0.8])
    turn = np.broadcast_to(rotation(vector)[:dim, :dim] - np.eye(dim), (N, dim, dim))
    still = c.in_frame(turn, np.zeros((N, dim, dim, dim)))
    np.testing.assert_allclose(c.energy(still), 0.0, atol=1e-11)
