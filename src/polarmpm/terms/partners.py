"""Which site of another body each site of contact faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.grid import box_indices

_OPPOSED = -0.3  # cosine between the outward normals of sites that may press against each other
_TIE = 1e-9  # of the reach: sites that are as near as that are equally near, and the first one counts


@dataclass
class Partners:
    """Of each of n sites the nearest one of another side, whose surface faces it.

    Attributes:
        site: its number (n,); -1: there is none within reach.
        gap: distance (m) from its tangent plane (n,); infinite without a partner.
        free: distance (m) from the nearest surface that faces it (n,), or less; of sites without a partner.
    """

    site: np.ndarray
    gap: np.ndarray
    free: np.ndarray


def find(
    x: np.ndarray, normal: np.ndarray, span: np.ndarray, side: np.ndarray, reach: float, far: float
) -> Partners:
    """Partners of sites at x (n, d) (m) with outward normals (n, d).

    Args:
        span: how far (m) from its middle a site's piece of the surface reaches (n,).
        side: number of the body, or group of bodies, of each (n,).
        reach: largest distance (m) before a partner's plane.
        far: how far (m) sites are looked for.
    """
    n = len(x)
    slave, master = _near(x, far)
    keep = side[slave] != side[master]
    slave, master = slave[keep], master[keep]
    keep = np.sum(normal[slave] * normal[master], axis=1) < _OPPOSED
    slave, master = slave[keep], master[keep]
    away = x[slave] - x[master]
    distance = np.linalg.norm(away, axis=1)
    gap = np.sum(away * normal[master], axis=1)
    aside = np.linalg.norm(away - gap[:, None] * normal[master], axis=1)
    free = np.maximum(_from_others(x, side), far)
    np.minimum.at(free, slave, distance)
    keep = (gap <= reach) & (aside <= span[master])
    slave, master, gap = slave[keep], master[keep], gap[keep]
    order = np.lexsort((master, np.rint(distance[keep] / (_TIE * far)), slave))
    slave, first = np.unique(slave[order], return_index=True)
    site, found = np.full(n, -1, dtype=np.int64), np.full(n, np.inf)
    site[slave], found[slave] = master[order][first], gap[order][first]
    return Partners(site, found, free)


def _near(x: np.ndarray, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of sites no farther from each other than `far` (m) along each axis, and some others."""
    index = np.floor((x - x.min(axis=0)) / far).astype(np.int64) + 1
    sides = index.max(axis=0) + 2
    code = np.ravel_multi_index(tuple(index.T), tuple(sides))
    order = np.argsort(code, kind="stable")
    codes, every = code[order], np.arange(len(x))
    slaves, masters = [], []
    for step in box_indices((3,) * x.shape[1]) - 1:
        there = np.ravel_multi_index(tuple((index + step).T), tuple(sides))
        first, last = np.searchsorted(codes, there, "left"), np.searchsorted(codes, there, "right")
        count = last - first
        slaves.append(np.repeat(every, count))
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        masters.append(order[np.repeat(first, count) + within])
    return np.concatenate(slaves), np.concatenate(masters)


def _from_others(x: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Distances (m), (n,), of sites from the boxes around those of other sides, or less; infinite without."""
    out = np.full(len(x), np.inf)
    for one in np.unique(side):
        mine = side == one
        beyond = np.maximum(np.maximum(x[mine].min(axis=0) - x[~mine], x[~mine] - x[mine].max(axis=0)), 0.0)
        out[~mine] = np.minimum(out[~mine], np.linalg.norm(beyond, axis=1))
    return out
