"""Krylov methods with two products, of which the quick one is not exact."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from polarmpm.solvers.krylov import INDEFINITE, Equations, conjugate_gradients, flexible_gmres

N, AIM = 60, 1e-5


def matrix(least: float) -> np.ndarray:
    """Symmetric (N, N), with eigenvalues from `least` to 1."""
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(N, N)))
    return (q * np.geomspace(least, 1.0, N)) @ q.T


def equations(A: np.ndarray, quick: np.ndarray) -> tuple[Equations, dict[str, int]]:
    """A system, and how often each product was asked for."""
    asked = {"exact": 0, "quick": 0}

    def times(name: str, B: np.ndarray):
        def product(x: np.ndarray) -> np.ndarray:
            asked[name] += 1
            return B @ x

        return product

    inverse = np.diag(1.0 / np.diag(A))
    made = Equations(
        times("exact", A), times("quick", quick), lambda r: inverse @ r, np.ones(N), MPI.COMM_SELF
    )
    return made, asked


METHODS = pytest.mark.parametrize(
    "solve",
    [conjugate_gradients, lambda *system: flexible_gmres(*system, 100)],
    ids=["conjugate gradients", "GMRES"],
)


@METHODS
@pytest.mark.parametrize("rounding", [0.0, 1e-11, 1e-5])
def test_the_residual_is_that_of_the_exact_product(solve, rounding):
    """A quick product that is good enough does nearly all the work; another one costs iterations, no
    accuracy."""
    A, b = matrix(1e-3), np.random.default_rng(1).normal(size=N)
    noise = np.random.default_rng(2).normal(size=(N, N)) * rounding
    system, asked = equations(A, A + noise + noise.T)
    x = np.zeros(N)
    result = solve(system, x, b, AIM, 400)
    assert not result.failed
    assert np.linalg.norm(b - A @ x) <= 2.0 * AIM * np.linalg.norm(b)
    assert asked["quick"] > 20
    if rounding < AIM:
        assert asked["exact"] <= 2
    else:
        assert asked["exact"] > 5


def test_a_product_that_rounding_made_indefinite_gives_way_to_the_exact_one():
    A, b = matrix(1e-4), np.random.default_rng(1).normal(size=N)
    values, vectors = np.linalg.eigh(A)
    rounded = A - 2.0 * values[0] * np.outer(vectors[:, 0], vectors[:, 0])
    system, asked = equations(A, rounded)
    x = np.zeros(N)
    result = conjugate_gradients(system, x, b, AIM, 1000)
    assert not result.failed
    assert asked["quick"] > 0
    assert np.linalg.norm(b - A @ x) <= 2.0 * AIM * np.linalg.norm(b)


def test_an_indefinite_matrix_is_told():
    A, b = matrix(1e-3), np.random.default_rng(1).normal(size=N)
    vectors = np.linalg.eigh(A)[1]
    A = A - 2.0 * np.outer(vectors[:, 0], vectors[:, 0])
    system, _ = equations(A, A)
    assert conjugate_gradients(system, np.zeros(N), b, AIM, 1000).failed == INDEFINITE
