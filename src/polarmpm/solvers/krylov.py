"""Krylov methods on arrays of the owned unknowns. Collective."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

Map = Callable[[np.ndarray], np.ndarray]

_QUICK = 1e-6  # relative residual that is hardly reached with numbers in single precision
INDEFINITE, BROKEN, LIMIT = "indefinite", "broken", "limit"


@dataclass
class Result:
    """How a method ended: iterations, and why there is no solution; "" if there is."""

    iterations: int = 0
    failed: str = ""


@dataclass
class Equations:
    """A linear system.

    Attributes:
        product: times the matrix, (n,) -> (n,); the next product may overwrite it.
        quick_product: the same with its numbers in single precision; what it leaves of the residual is
            measured by `product`, and where that is too much methods go on with `product`.
        precondition: times an approximate inverse; the same.
        weight: of the residual's entries (n,) in the norm of forces.
    """

    product: Map
    quick_product: Map
    precondition: Map
    weight: np.ndarray
    comm: MPI.Comm

    def dot(self, a: np.ndarray, b: np.ndarray) -> float:
        """Sum of products over all ranks."""
        here = float(np.dot(a, b))
        return float(self.comm.allreduce(here)) if self.comm.size > 1 else here

    def product_for(self, aim: float) -> Map:
        """The product to begin with, where the residual is to become `aim` times the right-hand side."""
        return self.quick_product if aim > _QUICK else self.product

    def residual(self, x: np.ndarray, right: np.ndarray) -> np.ndarray:
        """What x (n,) leaves of the right-hand side (n,), a new array; zeros, as solutions begin, aren't
        multiplied."""
        some = bool(np.any(x))
        if self.comm.size > 1:
            some = bool(self.comm.allreduce(some, op=MPI.LOR))
        return right - self.product(x) if some else right.copy()

    def norm(self, r: np.ndarray) -> float:
        """Norm of forces."""
        with np.errstate(over="ignore", invalid="ignore"):
            forces = r * self.weight
            return math.sqrt(self.dot(forces, forces))


def conjugate_gradients(e: Equations, x: np.ndarray, right: np.ndarray, aim: float, limit: int) -> Result:
    """Improve x (n,) until the residual is `aim` times the right-hand side (n,), in the norm of forces and in
    the energy norm of the preconditioner."""
    out, search = Result(), Search(aim * e.norm(right), aim, limit)
    product, r = e.product_for(aim), e.residual(x, right)
    for _ in range(_ROUNDS):
        _conjugate(e, product, x, r, search, out)
        if out.failed and (product == e.product or out.failed == LIMIT):
            return out
        if out.failed:  # which rounding may have done
            out.failed, x[:] = "", 0.0
        elif search.ended:
            return out
        r, product = e.residual(x, right), e.product  # what rounding has made of it
        if e.norm(r) <= 2.0 * search.allowed:
            return out
    out.failed = LIMIT
    return out


@dataclass
class Search:
    """When conjugate gradients end.

    Attributes:
        allowed: norm of forces of the residual.
        aim: energy norm of the residual over that of the first one.
        limit: iterations.
        energy: square of the latter; zero before it's known.
        ended: the residual is as small from the beginning.
    """

    allowed: float
    aim: float
    limit: int
    energy: float = 0.0
    ended: bool = False


def _conjugate(e: Equations, product: Map, x: np.ndarray, r: np.ndarray, search: Search, out: Result) -> None:
    """Improve x (n,), and its residual r (n,), until that is small enough as far as it is known here."""
    z, scaled = e.precondition(r), np.empty_like(r)
    work = e.dot(r, z)
    search.energy = search.energy or work
    if work == 0.0 and e.norm(r) <= search.allowed:
        search.ended = True
        return
    if not (work > 0.0 and math.isfinite(work)):
        out.failed = BROKEN
        return
    p = z.copy()
    while True:
        q = product(p)
        curvature = e.dot(p, q)
        if not curvature > 0.0:
            out.failed = INDEFINITE if curvature <= 0.0 else BROKEN
            return
        length = work / curvature
        x += np.multiply(p, length, out=scaled)
        r -= np.multiply(q, length, out=scaled)
        out.iterations += 1
        z = e.precondition(r)
        before, work = work, e.dot(r, z)
        if not (work >= 0.0 and math.isfinite(work)):
            out.failed = BROKEN
            return
        if work <= search.aim**2 * search.energy and e.norm(r) <= search.allowed:
            return
        if out.iterations >= search.limit:
            out.failed = LIMIT
            return
        p *= work / before
        p += z


_ROUNDS = 4  # solutions for what is left of the residual


def flexible_gmres(
    e: Equations, x: np.ndarray, right: np.ndarray, aim: float, limit: int, restart: int
) -> Result:
    """The same by GMRES, preconditioned from the right, in the norm of forces."""
    out, allowed = Result(), aim * e.norm(right)
    if not math.isfinite(allowed):
        out.failed = BROKEN
        return out
    before, product = math.inf, e.product_for(aim)
    while True:
        r = e.residual(x, right)
        size = e.norm(r)
        if size <= allowed:
            return out
        if not size < math.inf or size > 0.999 * before:
            out.failed = LIMIT if math.isfinite(size) else BROKEN
            return out
        if out.iterations >= limit:
            out.failed = LIMIT
            return out
        before = size
        most = min(restart, limit - out.iterations)
        if not _cycle(e, product, x, r * (e.weight / size), size, allowed, most, out):
            out.failed = BROKEN
            return out
        product = e.product


def _cycle(
    e: Equations,
    product: Map,
    x: np.ndarray,
    first: np.ndarray,
    size: float,
    allowed: float,
    most: int,
    out: Result,
) -> bool:
    """Arnoldi's method until the residual is small enough; whether its numbers are finite."""
    basis, moved, k = [first], [], 0
    rotation: list[tuple[float, float]] = []
    H, g = np.zeros((most + 1, most)), np.zeros(most + 1)
    g[0] = size
    while k < most:
        z = e.precondition(basis[k] / e.weight)
        w = product(z) * e.weight
        for _ in range(2):
            for i, v in enumerate(basis):
                h = e.dot(w, v)
                H[i, k] += h
                w -= h * v
        length = math.sqrt(e.dot(w, w)) if np.all(np.isfinite(H[:, k])) else math.nan
        if not math.isfinite(length):
            return False
        moved.append(z.copy())
        column = H[:, k]
        column[k + 1] = length
        for i, (c, s) in enumerate(rotation):
            column[i], column[i + 1] = c * column[i] + s * column[i + 1], c * column[i + 1] - s * column[i]
        radius = math.hypot(column[k], column[k + 1])
        if radius == 0.0:
            return False
        c, s = column[k] / radius, column[k + 1] / radius
        rotation.append((c, s))
        column[k], column[k + 1] = radius, 0.0
        g[k], g[k + 1] = c * g[k], -s * g[k]
        k += 1
        out.iterations += 1
        if abs(g[k]) <= 0.9 * allowed or length <= 1e-14 * radius:
            break
        basis.append(w / length)
    for share, z in zip(np.linalg.solve(np.triu(H[:k, :k]), g[:k]), moved, strict=True):
        x += share * z
    return True
