"""Materials, small bodies and numerical tools that several test modules share.

Every test is collective on COMM_WORLD, so that the suite also passes under `mpirun -n 2 python -m pytest
-m "not slow and not mpi"`. Tests marked `mpi` start mpirun themselves and are left out there.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.basis.registry import BASES
from polarmpm.solvers import newton
from polarmpm.tools import compat

COMM = MPI.COMM_WORLD

MICROPOLAR = pm.MicropolarElastic(lam=3e3, mu=2e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=17.0)
NEO_HOOKEAN = pm.NeoHookean(lam=3e3, mu=2e3)
HENCKY = pm.Hencky(lam=3e3, mu=2e3)
# the energy of MICROPOLAR in the reference frame instead of the rotated one
GENERAL = pm.UserEnergy(MICROPOLAR.energy, MICROPOLAR.parameters())


def _fibres(E: Any, G: Any, p: Any) -> Any:
    fibre = ufl.as_vector((0.6, 0.8, 0.0))
    return MICROPOLAR.energy(E, G, p) + p.k * ufl.dot(fibre, ufl.dot(E, fibre)) ** 2 * (1 + ufl.tr(E) ** 2)


# stiff along one direction of the reference configuration
ANISOTROPIC = pm.UserEnergy(_fibres, {**MICROPOLAR.parameters(), "k": 5e3})


_compile_form = compat.compile_form


def _compile_form_fast(form: Any, optimisation: str = "") -> Any:
    """dolfinx' forms are for a few cells here; optimising them takes six times as long as not to."""
    return _compile_form(form, "-O0")


compat.compile_form = _compile_form_fast


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--every 2` for a run that repeats on other ranks what another one has seen whole."""
    parser.addoption("--every", type=int, default=1, metavar="N", help="every N-th of the tests alone")


def _version() -> int:
    """A number that each change of the package changes, so that in time each test has its turn."""
    files = sorted(path for path in Path(pm.__file__).parent.rglob("*") if path.suffix in {".py", ".c", ".h"})
    return zlib.crc32(b"".join(path.read_bytes() for path in files))


@pytest.hookimpl(trylast=True)  # after markers have chosen
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """mpirun can't be started from within mpirun."""
    every = config.getoption("--every")
    first = _version() % every if every > 1 else 0
    config.hook.pytest_deselected(items=[item for k, item in enumerate(items) if k % every != first])
    items[:] = items[first::every]
    if COMM.size > 1:
        for item in items:
            if item.get_closest_marker("mpi"):
                item.add_marker(pytest.mark.skip(reason="starts mpirun itself"))


def pytest_collection_finish() -> None:
    """Messages list the bases: the recipe's own is known to its own tests only."""
    BASES.pop("hats", None)


def rotation(vector: Any) -> np.ndarray:
    """exp(hat(w)) by Rodrigues' formula, independent of the package."""
    w = np.asarray(vector, float)
    angle = np.linalg.norm(w)
    if angle == 0.0:
        return np.eye(3)
    a = w / angle
    hat = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + np.sin(angle) * hat + (1 - np.cos(angle)) * hat @ hat


def by_id(points: pm.Points, values: np.ndarray) -> np.ndarray:
    """Values of all ranks' points in the order of the permanent ids. Collective."""
    ids = np.concatenate(COMM.allgather(points.id))
    return np.concatenate(COMM.allgather(np.asarray(values)))[np.argsort(ids)]


def assert_repeated(found: Any, expected: Any, name: str = "", tolerance: float = 1e-9) -> None:
    """The same digits on one rank; on several, direct solvers don't repeat their sums. Collective."""
    if COMM.size == 1:
        np.testing.assert_array_equal(found, expected, err_msg=name)
    else:
        size = COMM.allreduce(np.abs(expected).max(initial=0.0), op=MPI.MAX)
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * size, err_msg=name)


def derivative_error(function: Callable, jacobian: Callable, x: np.ndarray, step: float = 1e-5) -> float:
    """Largest difference of a Jacobian from central differences, relative to its largest entry.

    function: (n, a) -> (n, b), jacobian: (n, a) -> (n, b, a).
    """
    exact = jacobian(x)
    difference = np.empty_like(exact)
    for j in range(x.shape[1]):
        e = np.zeros(x.shape[1])
        e[j] = step
        difference[:, :, j] = (function(x + e) - function(x - e)) / (2 * step)
    return float(np.abs(difference - exact).max() / np.abs(exact).max())


def beam(
    dim: int = 2,
    material: pm.Material = MICROPOLAR,
    *,
    scale: float = 1.0,
    per_cell: int | None = None,
    comm: MPI.Comm = COMM,
    **options: Any,
) -> pm.QuasiStatic:
    """A short cantilever of 3.5 x 1 (x 1) cells, held at x = 0, without a load; lengths times `scale`.

    Its faces stand clear of the grid's planes.
    """
    low, high = (-1.0, -3.0, -2.0)[:dim], (6.0, 3.0, 3.0)[:dim]
    grid = pm.Grid.box(np.multiply(scale, low), np.multiply(scale, high), scale, comm)
    upper = np.multiply(scale, (3.5, 1.0, 1.0)[:dim])
    points = pm.seed(grid, material=material, points_per_cell=per_cell or dim, bounds=(np.zeros(dim), upper))
    points.x = points.X = points.x + np.multiply(scale, (0.0, 0.3, 0.2)[:dim])
    problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, **options})
    theta = {"theta": 0} if material.micropolar else {}
    problem.fix(pm.plane(x=0.0), u=0, **theta)
    return problem


def release_supports(problem: Any) -> None:
    """Take all supports away."""
    for support in problem.supports:
        problem.release(support)


@pytest.fixture
def strict() -> pm.Controls:
    """Newton's tolerances at which answers are the same to about 1e-12."""
    return newton.Controls(force_tolerance=1e-12, energy_tolerance=1e-26)


@pytest.fixture
def folder(tmp_path):
    """One folder for all ranks."""
    return COMM.bcast(tmp_path)
