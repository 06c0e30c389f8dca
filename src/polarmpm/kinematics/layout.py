"""How the values at a point are laid out in its vector of unknowns and in its state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Kind(Protocol):
    """A material, as far as it decides on the unknowns."""

    @property
    def micropolar(self) -> bool: ...


@dataclass(frozen=True)
class Layout:
    """Sizes of the values at a point, for a space dimension and a number of rotations."""

    dim: int
    rotations: int

    @property
    def block(self) -> int:
        """Unknowns of a node."""
        return self.dim + self.rotations

    @property
    def unknowns(self) -> int:
        """Length of z."""
        return self.dim * self.dim + self.rotations * (1 + self.dim)

    @staticmethod
    def of(material: Kind, dim: int) -> Layout:
        return Layout(dim, (1 if dim == 2 else 3) if material.micropolar else 0)


def state_size(layout: Layout, *, rotated: bool) -> int:
    """Number of scalars of a state, see `strains`."""
    d, r = layout.dim, layout.rotations
    quaternion = 0 if rotated or r == 0 else (4 if d == 3 else 2)
    return d * d + quaternion + r * d


def pack_state(layout: Layout, frame: np.ndarray, wryness: np.ndarray, q: np.ndarray | None) -> np.ndarray:
    """States (n, state_size) of tensors (n, 3, 3) and, but for the rotated frame, quaternions (n, 4)."""
    d, n = layout.dim, len(frame)
    parts: list[np.ndarray] = [frame[:, :d, :d].reshape(n, d * d)]
    if layout.rotations:
        if q is not None:
            parts.append(q if d == 3 else q[:, [0, 3]])
        parts.append(wryness.reshape(n, 9) if d == 3 else wryness[:, 2, :2])
    return np.concatenate(parts, axis=1)
