"""Which points have come from which: those that are split get new ids, and what was said of them holds on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Lineage:
    """Points that have been split so far, the same on every rank. Parts of a point are equal.

    Attributes:
        parents: their ids (m,), each once.
        first: id of the first part of each (m,), ascending; the others follow on.
        count: numbers of parts (m,).
    """

    parents: np.ndarray
    first: np.ndarray
    count: np.ndarray

    @classmethod
    def none(cls) -> Lineage:
        empty = np.zeros(0, dtype=np.int64)
        return cls(empty, empty, empty)

    def with_split(self, parents: np.ndarray, count: np.ndarray, first_id: int) -> Lineage:
        """The same after more points have been split, of ascending ids, into parts with ids from `first_id`
        on."""
        first = first_id + np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64)
        return Lineage(
            np.concatenate([self.parents, parents]),
            np.concatenate([self.first, first]),
            np.concatenate([self.count, count]),
        )

    def descendants(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ascending ids (k,) of what is there now of points of ascending ids (n,), and which share of its
        point each is (k,)."""
        order = np.argsort(self.parents, kind="stable")
        parents, first, count = self.parents[order], self.first[order], self.count[order]
        share: np.ndarray = np.ones(len(ids))
        while len(parents):
            at = np.minimum(np.searchsorted(parents, ids), len(parents) - 1)
            split = parents[at] == ids
            if not np.any(split):
                break
            number = np.where(split, count[at], 1)
            within = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
            ids = np.repeat(np.where(split, first[at], ids), number) + within
            share = np.repeat(share / number, number)
        order = np.argsort(ids, kind="stable")
        return ids[order], share[order]

    def roots(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ids (n,) of the points from which points of ids (n,) have come in the end, and the shares (n,) of
        these that they are."""
        found: np.ndarray = ids.copy()
        share: np.ndarray = np.ones(len(ids))
        while len(self.first):
            at = np.searchsorted(self.first, found, side="right") - 1
            at = np.maximum(at, 0)
            part = (found >= self.first[at]) & (found < self.first[at] + self.count[at])
            if not np.any(part):
                break
            share = np.where(part, share / self.count[at], share)
            found = np.where(part, self.parents[at], found)
        return found, share
