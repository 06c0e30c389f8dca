"""Directors of a micro-space: unit vectors of the undeformed body, and a length along each."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import ufl

from ..errors import InputError
from ..kinematics.tensors import cofactor
from ..tools import checks

_UNIT = 1e-9  # deviation of a length from one, and of a product from zero, that is rounding


class MicroSpace(NamedTuple):
    """Lengths (k,) (m) along directors, the rows of (k, 3)."""

    lengths: tuple[float, ...]
    directors: tuple[tuple[float, ...], ...]

    @staticmethod
    def of(lengths: Any, directors: Any = None, *, count: int | None = None) -> MicroSpace:
        """Checked; see `GradientElastic` for what is allowed.

        Args:
            count: how many directors there have to be; None allows one to three.
        """
        rows = None if directors is None else _unit_vectors(directors)
        allowed = "one length or one for each of 1 to 3 directors (m), not negative"
        if isinstance(lengths, str | bytes | dict | set):
            raise checks.refuse("lengths", lengths, allowed)
        if not checks.several(lengths):
            value = checks.number("lengths", lengths, least=0.0, allowed=allowed)
            given = [value] * (3 if rows is None else len(rows))
        else:
            given = [checks.number(f"lengths[{i}]", l, least=0.0) for i, l in enumerate(lengths)]
        if not 1 <= len(given) <= 3:
            raise checks.refuse("lengths", lengths, allowed)
        rows = np.eye(3)[: len(given)] if rows is None else rows
        if len(rows) != len(given):
            raise checks.refuse("lengths", lengths, f"one for each of the {len(rows)} directors is needed")
        if count is not None and len(given) != count:
            raise checks.refuse("lengths", lengths, f"one length, or {count} of them (m), not negative")
        return MicroSpace(tuple(given), tuple(tuple(row) for row in rows.tolist()))

    @property
    def orthonormal(self) -> bool:
        rows = np.array(self.directors)
        return bool(np.abs(rows @ rows.T - np.eye(len(rows))).max() <= _UNIT)

    def described(self) -> dict[str, str | bool]:
        """Directors by name, with all their digits."""
        return {f"d_{a}": ", ".join(map(repr, d)) for a, d in enumerate(self.directors, 1)}

    def check_dimension(self, dim: int) -> None:
        """Raise InputError where a director leaves the plane of a plane problem at an angle."""
        rows = np.array(self.directors)
        oblique = (abs(rows[:, 2]) > _UNIT) & (abs(rows[:, 2]) < 1 - _UNIT)
        if dim == 2 and oblique.any():
            shown = ", ".join(f"{c:.6g}" for c in rows[oblique][0])
            raise InputError(f"directors: ({shown}) leaves the plane; in it or normal to it is needed")

    def along(self, H: Any) -> list[Any]:
        """Derivatives F,a of the deformation gradient along the directors (3 x 3), of a second gradient H."""
        found = []
        for d in self.directors:
            rows = [[sum(H[i, J, K] * d[K] for K in range(3) if d[K]) for J in range(3)] for i in range(3)]
            found.append(ufl.as_tensor(rows))
        return found

    def normals(self, F: Any, H: Any) -> list[Any]:
        """Gradients n_a,J (3 x 3) of the directors as normals, n_a = cof(F) d_a / |cof(F) d_a|."""
        found = []
        by = [ufl.as_tensor([[H[i, J, K] for J in range(3)] for i in range(3)]) for K in range(3)]
        for d in self.directors:
            one, two = (ufl.as_vector(v.tolist()) for v in _complement(np.array(d)))
            c = ufl.dot(cofactor(F), ufl.as_vector(d))
            length = ufl.sqrt(ufl.dot(c, c))
            n = c / length
            columns = []
            for g in by:  # F,K
                change = ufl.cross(ufl.dot(g, one), ufl.dot(F, two)) + ufl.cross(
                    ufl.dot(F, one), ufl.dot(g, two)
                )
                columns.append((change - ufl.dot(n, change) * n) / length)
            found.append(ufl.as_tensor([[columns[J][i] for J in range(3)] for i in range(3)]))
        return found


def _unit_vectors(directors: Any) -> np.ndarray:
    """1 to 3 unit vectors (k, 3); those of a plane may have two components."""
    found = checks.numeric("directors", directors, "unit vectors, one a row")
    found = found[None] if found.ndim == 1 else found
    good = found.ndim == 2 and 1 <= len(found) <= 3 and found.shape[1] in (2, 3)
    if not good or not np.isfinite(found).all():
        raise checks.refuse("directors", directors, "1 to 3 unit vectors are needed, one a row")
    length = np.linalg.norm(found, axis=1)
    if (abs(length - 1) > 1e-6).any():
        shown = ", ".join(f"{l:.9g}" for l in length)
        raise checks.refuse("directors", directors, f"unit vectors are needed; their lengths are {shown}")
    found = found / length[:, None]
    return np.pad(found, ((0, 0), (0, 3 - found.shape[1])))


def _complement(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two vectors that make a right-handed triad with a unit vector: d = one x two."""
    one = np.cross(d, np.eye(3)[np.argmin(np.abs(d))])
    one /= np.linalg.norm(one)
    two = np.cross(d, one)
    return one, two
