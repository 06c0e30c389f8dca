"""Stiff parts of a body, which smooth functions let reach into what is soft beside them."""

from __future__ import annotations

import math

from mpi4py import MPI

import numpy as np

from ..basis.base import Basis
from ..bodies.points import Points
from ..errors import TrustWarning
from ..geometry.grid import Grid, box_indices
from ..tools.parallel import warn_on_one_rank

_RATIO = 20.0  # of stiffnesses, from which on the softer one counts for nothing beside the other
_SHARE = 0.1  # of the soft volume: about by how much the body is too stiff then


def warn_of_contrast(grid: Grid, points: Points, basis: Basis) -> None:
    """Warn where much of a material lies beside a far stiffer one, within about half a cell. Collective."""
    stiff = _stiffnesses(points)
    known = stiff[np.isfinite(stiff)]
    if basis.gradients_jump or not len(known) or known.max() < _RATIO * known.min():
        return
    share = max(_beside(grid, points, stiff, one) for one in np.unique(known))
    if share > _SHARE:
        warn_on_one_rank(
            points.comm,
            f"points: {100 * share:.0f} % of a material's volume lie within half a cell of one that is "
            f"{_RATIO:g} times as stiff, or more, which reaches over it: the body may be too stiff by as "
            "much; take smaller cells (docs/accuracy.md)",
            TrustWarning,
        )


def _stiffnesses(points: Points) -> np.ndarray:
    """lam + 2 mu of each material (Pa), nan where it isn't known."""
    found = [m.moduli("lam", "mu") for m in points.materials]
    return np.array([p["lam"] + 2 * p["mu"] if len(p) == 2 else math.nan for p in found])


def _beside(grid: Grid, points: Points, stiff: np.ndarray, soft: float) -> float:
    """Which share of the volume that is as soft lies beside what is far stiffer. Collective."""
    comm, d, of = points.comm, points.dim, stiff[points.material]
    body = points.body if points.bodies > 1 else np.zeros(len(points), dtype=np.int64)
    bins = np.column_stack(
        [np.floor(2.0 * grid.local(points.x)).astype(np.int64) + 4, body]
    )  # of half a cell
    shape = (*(2 * n + 8 for n in grid.shape), points.bodies)

    def code(index: np.ndarray) -> np.ndarray:
        return np.asarray(np.ravel_multi_index(tuple(index.T), shape, mode="clip"))

    hard = np.unique(bins[of >= _RATIO * soft], axis=0)
    offsets = np.pad(box_indices((3,) * d) - 1, ((0, 0), (0, 1)))
    around = np.unique(code((hard[:, None] + offsets).reshape(-1, d + 1)))
    mine, near = of == soft, np.isin(code(bins), np.concatenate(comm.allgather(around)))
    sums = np.array([points.volume0[mine & near].sum(), points.volume0[mine].sum()])
    comm.Allreduce(MPI.IN_PLACE, sums)
    return float(sums[0] / sums[1]) if sums[1] else 0.0
