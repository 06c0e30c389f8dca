"""Whether the state of points is one: scripts may write to its arrays, and what they do is to be seen."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..errors import InputError
from ..kinematics import rotations
from ..tools.parallel import errors_on_all_ranks
from ..tools.rows import flat
from .pointfields import SIDE_FIELDS
from .points import Points

_SEALED = ("x", "F", "q", "wryness", "grad_F")  # what a step puts in, from the state at the last reset


def check_state(points: Points, *, everything: bool = True) -> None:
    """Raise InputError, on all ranks alike, unless the arrays of the points are what `Points` says.

    Positions that aren't finite are for `check_inside`, as being nowhere.

    Args:
        everything: also what no step changes.
    """
    with errors_on_all_ranks(points.comm):
        fields, n, dim = points.fields, len(points.id), points.dim
        for name, (shape, kind) in fields.items():
            array = getattr(points, name, None)
            full = (n, *[dim if s == "d" else s for s in shape])
            if not isinstance(array, np.ndarray) or array.shape != full or array.dtype != kind:
                found = (
                    f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
                )
                raise InputError(f"points.{name}: {found}; {np.dtype(kind)} {full} is needed")
        changing = ("F", "q", "wryness", "grad_F", "plastic_F", "plastic_wryness", "hardening", *SIDE_FIELDS)
        names = [n for n, (_, kind) in fields.items() if kind is float and n != "x"]
        for name in names if everything else [n for n in names if n in changing]:
            array = getattr(points, name)
            if not math.isfinite(np.add.reduce(array, axis=None)):  # a tenth of the time of looking at each
                finite = np.isfinite(flat(array)).all(axis=1)
                _refuse(points, name, ~finite, "isn't finite")
        length = np.einsum("ni,ni->n", points.q, points.q)
        _refuse(points, "q", np.abs(length - 1.0) > 1e-6, "isn't a unit quaternion")
        _refuse(points, "F", ~(rotations.determinant(points.F) > 0), "has no positive determinant")
        if points.second_gradient:
            apart = flat(np.abs(points.grad_F - np.swapaxes(points.grad_F, 2, 3)))
            size = flat(np.abs(points.grad_F)).max(axis=1)
            bad = apart.max(axis=1) > 1e-12 * size
            _refuse(points, "grad_F", bad, "isn't symmetric in its last two indices")
        if points.plastic:
            bad = ~(rotations.determinant(points.plastic_F) > 0)
            _refuse(points, "plastic_F", bad, "has no positive determinant")
        _refuse(points, "volume0", ~(points.volume0 > 0), "isn't positive")
        if everything:
            _refuse(points, "half_length0", (points.half_length0 < 0).any(axis=1), "is negative")


def _refuse(points: Points, name: str, bad: Any, what: str) -> None:
    if np.any(bad):
        rows = np.flatnonzero(bad)
        ids = ", ".join(map(str, np.sort(points.id[rows])[:8])) + (", ..." if len(rows) > 8 else "")
        raise InputError(f"points.{name} {what}: {len(rows)} point(s), ids {ids}")


class Seal:
    """Tells whether somebody has written to the points' state since a step put it there.

    Increments count from the last reset, so that the next step would overwrite what was written, without a
    word. At a reset the state is taken as it is.
    """

    def __init__(self, points: Points):
        sealed = [name for name in _SEALED if name in points.fields]
        self._sums = {name: float(getattr(points, name).sum()) for name in sealed}

    def check(self, points: Points) -> None:
        """Raise InputError, on all ranks alike, if it is broken. Collective."""
        with errors_on_all_ranks(points.comm):
            for name, known in self._sums.items():
                if float(np.sum(getattr(points, name))) != known:
                    raise InputError(
                        f"points.{name} was changed between two steps. Increments count from the last reset, "
                        "so the change would be lost: change the state before the first step, or make a new "
                        "problem"
                    )
