"""Stiff parts of a body, which smooth functions let reach into what is soft beside them."""

from __future__ import annotations

import math

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..bodies.points import Points
from ..errors import TrustWarning
from ..geometry.grid import Grid, box_indices
from ..tools.parallel import warn_on_one_rank
from . import doubts

_RATIO = 20.0  # of stiffnesses, from which on the softer one counts for nothing beside the other
SHARE = 0.1  # of the work that is done in what is soft beside it: about by how much the body is too stiff


def beside_stiffer(system: LoadedPoints, start: np.ndarray, gradient: np.ndarray | None = None) -> float:
    """By about how much a body is too stiff since it lies beside far stiffer parts. Collective.

    It is which share of a material's volume lies within about half a cell of them, times its share of the
    strain energy, times the share of the energy there that is that of the traction t on the stiff part's
    side: t . A^-1 t / 2 with A = mu I + (lam + mu) n n, by so much other strains across the side could change
    the energy. Strains along the side are those of both parts, as smooth functions have them.

    Args:
        start: nodal increments (nodes, block) from which on strains count.
        gradient: as of `doubts.strains`.
    """
    i = system.interpolation
    points, moduli = i.points, _moduli(i.points)
    stiff = moduli[:, 0] + 2.0 * moduli[:, 1]
    known = np.unique(stiff[np.isfinite(stiff)])
    if i.basis.gradients_jump or not len(known) or known[-1] < _RATIO * known[0]:
        return 0.0
    strain = doubts.strains(system, start, gradient)
    lam, mu = moduli[points.material].T
    trace = np.trace(strain, axis1=1, axis2=2)
    stress = (lam * trace)[:, None, None] * np.eye(points.dim) + 2.0 * mu[:, None, None] * strain
    energy = 0.5 * points.volume0 * np.einsum("pij,pij->p", stress, strain)
    sums = np.zeros((len(known), 5))
    for one, found in zip(known, sums, strict=True):
        mine = stiff[points.material] == one
        normal = _away_from(i.grid, points, stiff[points.material] >= _RATIO * one)
        beside = mine & np.isfinite(normal[:, 0])
        between = ~normal.any(axis=1)  # what is stiff on both sides
        across = np.where(between, energy, points.volume0 * _of_traction(stress, normal, lam, mu))
        found[:2] = points.volume0[mine].sum(), energy[mine].sum()
        found[2:] = points.volume0[beside].sum(), energy[beside].sum(), across[beside].sum()
    points.comm.Allreduce(MPI.IN_PLACE, sums)
    volume, work, near, near_work, across = sums[(sums[:, 1] > 0.0) & (sums[:, 3] > 0.0)].T
    return float(np.sum(near / volume * work * across / near_work) / max(sums[:, 1].sum(), math.ulp(0.0)))


def warn_of_contrast(points: Points, share: float) -> None:
    """Warn of what `beside_stiffer` has found, where that is much. Collective."""
    if share > SHARE:
        warn_on_one_rank(
            points.comm,
            f"points: {100 * share:.0f} % of the work is done across the sides of parts that are "
            f"{_RATIO:g} times as stiff, or more, and reach over half a cell of what is beside them: the "
            "body may be too stiff by as much; take smaller cells (docs/accuracy.md)",
            TrustWarning,
        )


def _moduli(points: Points) -> np.ndarray:
    """lam and mu (m, 2) (Pa) of each material, nan where they aren't known."""
    found = [m.moduli("lam", "mu") for m in points.materials]
    return np.array([(p["lam"], p["mu"]) if len(p) == 2 else (math.nan, math.nan) for p in found])


def _of_traction(stress: np.ndarray, normal: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """Energy density (np,) (J/m^3) of the tractions on a side with a normal (np, d)."""
    traction = np.einsum("pij,pj->pi", stress, normal)
    along_normal = np.einsum("pi,pi->p", traction, normal) ** 2
    sheared = np.einsum("pi,pi->p", traction, traction) - along_normal
    found: np.ndarray = 0.5 * (sheared / mu + along_normal / (lam + 2.0 * mu))
    return found


def _away_from(grid: Grid, points: Points, hard: np.ndarray) -> np.ndarray:
    """Directions (np, d) from points of which `hard` is true, within about half a cell, zero where these are
    on both sides alike; nan where there are none. Collective."""
    comm, d = points.comm, points.dim
    body = points.body if points.bodies > 1 else np.zeros(len(points), dtype=np.int64)
    bins = np.column_stack(
        [np.floor(2.0 * grid.local(points.x)).astype(np.int64) + 4, body]
    )  # of half a cell
    shape = (*(2 * n + 8 for n in grid.shape), points.bodies)

    def code(index: np.ndarray) -> np.ndarray:
        return np.asarray(np.ravel_multi_index(tuple(index.T), shape, mode="clip"))

    there = np.unique(np.concatenate(comm.allgather(np.unique(code(bins[hard])))))
    beside, away = np.zeros(len(points), dtype=bool), np.zeros((len(points), d))
    for offset in np.pad(box_indices((3,) * d) - 1, ((0, 0), (0, 1))):
        found = np.isin(code(bins + offset), there)
        beside |= found
        away -= found[:, None] * offset[:d]
    away *= grid.sizes(grid.cells_of(points.x))
    length = np.linalg.norm(away, axis=1, keepdims=True)
    directions: np.ndarray = np.where(beside[:, None], away / np.maximum(length, 1e-300), np.nan)
    return directions
