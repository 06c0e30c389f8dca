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
        free: distance (m) from the nearest surface that faces it (n,), or less.
        nearest: the nearest site that faces it, partner or not (n,); -1: there is none around.
    """

    site: np.ndarray
    gap: np.ndarray
    free: np.ndarray
    nearest: np.ndarray


def find(
    x: np.ndarray,
    normal: np.ndarray,
    span: np.ndarray,
    side: np.ndarray,
    body: np.ndarray,
    reach: float,
    far: float,
) -> Partners:
    """Partners of sites at x (n, d) (m) with outward normals (n, d).

    Args:
        span: how far (m) from its middle a site's piece of the surface reaches (n,).
        side: sites of one number don't face each other (n,).
        body: number of the body of each (n,).
        reach: largest distance (m) before a partner's plane.
        far: how far (m) sites are looked for.
    """
    n = len(x)
    slave, master = _near(x, far)
    keep = side[slave] != side[master]
    slave, master = slave[keep], master[keep]
    turned = np.sum(normal[slave] * normal[master], axis=1)
    distance = np.linalg.norm(x[slave] - x[master], axis=1)
    # how far the faces are, of each body, that look where the site's own one does
    bodies, same = int(body.max()) + 1, turned > -_OPPOSED
    back = np.full(n * bodies, np.inf)
    np.minimum.at(back, slave[same] * bodies + body[master[same]], distance[same])
    keep = turned < _OPPOSED
    slave, master, distance = slave[keep], master[keep], distance[keep]
    away = x[slave] - x[master]
    gap = np.sum(away * normal[master], axis=1)
    aside = np.linalg.norm(away - gap[:, None] * normal[master], axis=1)
    free = np.maximum(_from_others(x, side), far)
    np.minimum.at(free, slave, distance)
    order = np.lexsort((master, np.rint(distance / (_TIE * far)), slave))
    slave, master, gap, aside, distance = (a[order] for a in (slave, master, gap, aside, distance))
    nearest, site, found = (np.full(n, value) for value in (-1, -1, np.inf))
    of, first = np.unique(slave, return_index=True)
    nearest[of] = master[first]
    # inside of a body its near face is nearer than its far one
    inside = (gap >= 0.0) | (distance < back[slave * bodies + body[master]])
    keep = np.flatnonzero((gap <= reach) & (aside <= span[master]) & inside)
    of, first = np.unique(slave[keep], return_index=True)
    site[of], found[of] = master[keep[first]], gap[keep[first]]
    return Partners(site, found, free, nearest)


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
