"""Meshed bodies with second gradients of which closed forms are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.tools import compat
from tests.conftest import COMM
from tests.helpers.bodies import box
from tests.helpers.gradient import gradient_solid


def ring(radial: int, around: int, cell: str = "quadrilateral", comm: Any = COMM) -> Any:
    """Mesh of a quarter of a ring, radii 2 and 5."""
    mesh = box(cell, (radial, around), comm=comm)
    x = mesh.geometry.x
    r, t = 2 + 3 * x[:, 0], np.pi / 2 * x[:, 1]
    x[:, 0], x[:, 1] = r * np.cos(t), r * np.sin(t)
    return mesh


def curved_ring(radial: int, around: int) -> Any:
    """The same of quadrilaterals whose geometry is of degree 2. Collective."""
    square = box("quadrilateral", (radial, around), comm=MPI.COMM_SELF)
    space = compat.function_space(square, 2, 2)
    r, t = space.tabulate_dof_coordinates()[:, :2].T * [[3.0], [np.pi / 2]] + [[2.0], [0.0]]
    x, given = np.stack([r * np.cos(t), r * np.sin(t)], axis=1), slice(None if COMM.rank == 0 else 0)
    cells = compat.cell_dofs(space)[given].astype(np.int64)
    return compat.create_mesh(COMM, cells, x[given], "quadrilateral", degree=2, ghosts=True)


def ring_displacement(p: float, E: float, g: float) -> Callable[[np.ndarray], np.ndarray]:
    """Radial displacement of a ring of radii 2 and 5, nu = 0, under pressure from outside (small strains):
    A r + B/r + C I1(r/g) + D K1(r/g), the energy's stationary point (Gao & Park 2007)."""
    from scipy import special

    a, b, mu = 2.0, 5.0, E / 2

    def functions(r: np.ndarray) -> np.ndarray:
        """Values, first and second derivatives (3, 4, n)."""
        parts = [(r, 1 + 0 * r, 0 * r), (1 / r, -1 / r**2, 2 / r**3)]
        for f, derivative, end in ((special.iv, special.ivp, b), (special.kv, special.kvp, a)):
            of = [f(1, r / g), derivative(1, r / g) / g, derivative(1, r / g, 2) / g**2]
            parts.append(tuple(v / f(1, end / g) for v in of))
        return np.swapaxes(np.array(parts), 0, 1)

    x, w = np.polynomial.legendre.leggauss(60)
    r, w = (a + b) / 2 + (b - a) / 2 * x, w * (b - a) / 2
    u, du, ddu = functions(r)
    q = du / r - u / r**2
    squares = [(1, du), (1, u / r), (g**2, ddu), (3 * g**2, q)]
    matrix = 2 * mu * sum(c * np.einsum("ir,jr,r->ij", v, v, w * r) for c, v in squares)
    factors = np.linalg.solve(matrix, -p * b * functions(np.array([b]))[0][:, 0])
    return lambda r: factors @ functions(np.asarray(r))[0]


def pressed_ring(
    mesh: Any,
    *,
    slopes: bool = True,
    length: float = 4.0,
    load: float = 1e-5,
    degree: int = 2,
    **options: Any,
) -> pm.QuasiStaticFEM:
    """A quarter of a ring under a pressure of 54.0189 MPa times `load`, E = 20 GPa."""
    body = pm.Elements(mesh, material=gradient_solid(20e9, 0.0, (length, length)), degree=degree)
    problem = pm.QuasiStaticFEM(body, **options)
    for axis in "xy":
        where = pm.plane(**{axis: 0.0})
        if slopes:
            problem.symmetry(where)
        else:
            problem.fix(where, **{f"u{axis}": 0})

    def pressure(t: float, X: np.ndarray) -> np.ndarray:
        return -54.0189e6 * load * t * X / np.linalg.norm(X, axis=1)[:, None]

    outer = body.facets(lambda x: np.linalg.norm(x, axis=1) > 5 - 1e-6)
    problem.traction(outer, force=pressure)
    return problem


def clamped_beam(
    cells: tuple[int, int], lengths: Sequence[float], *, held: bool, alpha: float = 2.0, **options: Any
) -> pm.QuasiStaticFEM:
    """A cantilever of 20 x 1 under a dead force at its tip, P L^2 / EI_eff = alpha."""
    mesh = box("quadrilateral", cells, (20.0, 1.0))
    body = pm.Elements(mesh, material=gradient_solid(1e6, 0.0, lengths), degree=2)
    problem = pm.QuasiStaticFEM(body, **options)
    problem.fix(pm.plane(x=0.0), u=0, **({"slope": 0} if held else {}))
    force = alpha * 1e6 / 12 * (1 + lengths[1] ** 2) / 400
    problem.load(pm.plane(x=20.0), force=(0.0, -force))
    return problem
