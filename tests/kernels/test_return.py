"""Local systems of LANES points that are solved at once: common pivots, and a lane's own."""

import ctypes

import numpy as np
import pytest

from polarmpm.kernels import native
from polarmpm.kernels.csource import LANES

KERNEL = ctypes.CFUNCTYPE(None, ctypes.POINTER(ctypes.c_double), ctypes.POINTER(ctypes.c_double))
N, NZ = 7, 3


def solve(
    matrices: np.ndarray, tangent: bool, bend: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """X, what is returned, and status of r = A X + bend X^3 - 1, s = c X, with A in the inputs."""
    count = len(matrices)
    size = N + N * N
    c = np.arange(1.0, N + 1)

    def read(p: object, rows: int) -> np.ndarray:
        return np.ctypeslib.as_array(p, shape=(rows, LANES))

    def local(given: object, out: object) -> None:
        values, written = read(given, N * N + N), read(out, size)
        A, X = values[: N * N].reshape(N, N, LANES), values[N * N :]
        slope = A + 3 * bend * np.einsum("ij,jl->ijl", np.eye(N), X**2)
        written[:N] = np.einsum("ijl,jl->il", A, X) + bend * X**3 - 1.0
        written[N:] = slope.reshape(N * N, LANES)

    def stress(given: object, out: object) -> None:
        X = read(given, N * N + N)[N * N :]
        read(out, NZ)[:] = np.array([(c**k) @ X for k in range(NZ)])

    def moduli(given: object, out: object) -> None:
        stress(given, out)
        written = read(out, NZ + NZ * NZ + 2 * NZ * N)
        written[NZ : NZ + NZ * NZ] = 0.0
        sx = np.array([c**k for k in range(NZ)])
        rz = np.array([[float(i == j) for j in range(NZ)] for i in range(N)])
        written[NZ + NZ * NZ :] = np.concatenate([sx.ravel(), rz.ravel()])[:, None]

    callbacks = [KERNEL(f) for f in (local, stress, moduli)]
    controls = native.Return()
    addresses = [ctypes.cast(f, ctypes.c_void_p).value for f in callbacks]
    names = dict(zip(("local", "stress", "moduli"), addresses, strict=True))
    native.fill(
        controls, **names, row_scale=np.ones(N), tolerance=1e-12, loose=1e-9, nin=N * N, nx=N, nz=NZ, most=60
    )
    X, returned = np.zeros((count, N + 1)), np.zeros((count, NZ * (1 + NZ)))
    status, iterations = np.zeros(count, dtype=np.int8), np.zeros(count, dtype=np.int32)
    native.library().polarmpm_return(
        ctypes.byref(controls), count, np.arange(count), matrices.reshape(count, -1), int(tangent), N + 1, X,
        NZ * (1 + NZ), returned, status, iterations,
    )  # fmt: skip
    assert np.all(X[:, N] == 0.0)
    return X[:, :N], returned, status


def solution(A: np.ndarray) -> np.ndarray:
    return np.linalg.solve(A, np.ones((len(A), N, 1)))[:, :, 0]


@pytest.mark.parametrize("kind", ["alike", "permuted", "one permuted"])
def test_lanes_solve_their_own_systems(kind: str) -> None:
    rng = np.random.default_rng(3)
    A = np.eye(N) + 0.2 * rng.standard_normal((21, N, N))
    if kind == "permuted":  # no row is a good pivot of all lanes
        for matrix in A:
            matrix[:] = matrix[rng.permutation(N)]
    elif kind == "one permuted":
        A[10] = A[10][::-1] * [1e-9, 1, 1, 1, 1, 1, 1]
    X, returned, status = solve(A, tangent=True)
    assert not status.any()
    np.testing.assert_allclose(X, solution(A), rtol=1e-9)
    c = np.arange(1.0, N + 1)
    for k in range(21):
        sx = np.array([c**j for j in range(NZ)])
        np.testing.assert_allclose(returned[k, :NZ], sx @ X[k], rtol=1e-12)
        expected = -sx @ np.linalg.inv(A[k])[:, :NZ]
        np.testing.assert_allclose(returned[k, NZ:].reshape(NZ, NZ), expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("bad", [0.0, np.nan])
def test_a_lane_without_a_solution_fails_alone(bad: float) -> None:
    rng = np.random.default_rng(4)
    A = np.eye(N) + 0.2 * rng.standard_normal((LANES, N, N))
    A[3, :, 2] = bad
    X, _, status = solve(A, tangent=True)
    np.testing.assert_array_equal(status, np.arange(LANES) == 3)
    others = np.arange(LANES) != 3
    np.testing.assert_allclose(X[others], solution(A[others]), rtol=1e-9)


@pytest.mark.parametrize("tangent", [False, True])
def test_lanes_take_iterations_of_their_own(tangent: bool) -> None:
    rng = np.random.default_rng(5)
    A = np.eye(N) * rng.uniform(0.1, 10.0, (13, 1, 1)) + 0.01 * rng.standard_normal((13, N, N))
    X, _, status = solve(A, tangent, bend=2.0)
    assert not status.any()
    residual = np.einsum("kij,kj->ki", A, X) + 2.0 * X**3 - 1.0
    assert np.abs(residual).max() < 1e-12
