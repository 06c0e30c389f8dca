"""Factors of small matrices whose unknowns, in a good order, are coupled to near ones only."""

from __future__ import annotations

import math

import numpy as np

from ..kernels import native
from .linear import ACCURACY, Rows

_FAR = 64.0  # nodes in a row of a factor, on average, from which on others take less time
_BEFORE = 8  # numbers in front of a factor, which compiled code reads and doesn't use
_IMPROVED = 8  # times a solution is improved before the factor is given up
_ROUNDING = 1e-6  # what rounding may leave of a right-hand side: bent bodies have large forces in balance
# Relative shift of the diagonal, as some tangents are exactly singular. Slender bodies have modes as soft as
# a larger one is stiff: MUMPS' is a hundred times as large, and takes a Krylov method to it.
SHIFT = 1e-14


class Band:
    """Cholesky's factor of a symmetric matrix, L and U of another one, with rows as long as the order of the
    unknowns makes them. There is no pivoting: each solution is held against the matrix, and improved.

    Attributes:
        entries: of the factor's upper triangle.
    """

    def __init__(self, rows: Rows, symmetric: bool):
        self.rows, self.symmetric = rows, symmetric
        n, library = len(rows.indptr) - 1, native.library()
        nodes = n // rows.block
        self._position, self._begin = np.empty(nodes, dtype=np.int32), np.zeros(n + 1, dtype=np.int64)
        layout = rows.block, rows.indptr, rows.indices, self._position, self._begin
        if library.polarmpm_band_order(nodes, *layout):
            raise MemoryError("no memory to find an order of the unknowns")
        self.entries = int(self._begin[-1])
        self._place: np.ndarray = np.zeros(0)
        self._factor: np.ndarray = self._place
        self._work: np.ndarray = self._place

    @property
    def pays(self) -> bool:
        """Whether other factors take more time."""
        return self.entries <= _FAR * self.rows.block * len(self.rows.indptr)

    def factor(self, shift: float = SHIFT) -> bool:
        """Factor the matrix as it stands, its diagonal larger by a share; False where it isn't definite, a
        pivot is zero, or entries aren't finite."""
        r, n, library = self.rows, len(self._begin) - 1, native.library()
        entries, symmetric = int(r.indptr[-1]), int(self.symmetric)
        if not len(self._work):
            self._place, self._work = np.empty(entries, dtype=np.int64), np.empty(n)
            self._factor = np.zeros(_BEFORE + self.entries * (2 - symmetric))[_BEFORE:]
            layout = r.indptr, r.indices, self._position, self._begin
            library.polarmpm_band_places(n, r.block, symmetric, *layout, self._place)
        given = self._begin, entries, self._place, r.values, shift, self._factor
        return not library.polarmpm_band_factor(n, r.block, symmetric, *given)

    def apply(self, right: np.ndarray) -> np.ndarray:
        """What the factor alone makes of a right-hand side (n,)."""
        n, out = len(self._work), np.empty(len(self._work))
        given = self._position, self._begin, self._factor, right, self._work, out
        native.library().polarmpm_band_solve(n, self.rows.block, int(self.symmetric), *given)
        return out

    def solve(self, right: np.ndarray) -> np.ndarray | None:
        """Solution (n,) with a residual of at most `ACCURACY` times the right-hand side, or as small as
        rounding lets it become; None: there is none with this factor."""
        right, r, before = np.ascontiguousarray(right), self.rows, math.inf
        rest, solution = np.empty(len(right)), self.apply(right)
        size = math.sqrt(right @ right)
        for _ in range(_IMPROVED):
            matrix = r.indptr, r.indices, r.values
            native.library().polarmpm_band_rest(
                len(right), int(self.symmetric), *matrix, solution, right, rest
            )
            left = math.sqrt(rest @ rest)
            if left <= ACCURACY * size or (0.5 * before <= left <= _ROUNDING * size):
                return solution
            before, solution = left, solution + self.apply(rest)
        return None
