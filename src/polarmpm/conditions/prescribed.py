"""Prescribed nodal increments between two resets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from ..geometry.nodes import Positioned
from ..kinematics import rotations
from ..kinematics.layout import Layout
from .supports import Support, component_names


class Prescribed:
    """Prescribed nodal increments between two resets. Collective.

    Attributes:
        fixed: (nodes, block) bool.
    """

    def __init__(self, nodes: Positioned, supports: Sequence[Support], layout: Layout):
        self.nodes, self.supports, self.layout = nodes, supports, layout
        self.masks = [s.mask(nodes) for s in supports]
        self.fixed = np.zeros((len(nodes), layout.block), dtype=bool)
        for support, mask in zip(supports, self.masks, strict=True):
            for column in support.columns:
                self.fixed[mask, column] = True

    def totals(self, factor: float) -> np.ndarray:
        """Prescribed totals (nodes, block) at a load factor; zero where free.

        Raises:
            InputError: two supports contradict each other.
        """
        values = np.zeros(self.fixed.shape)
        owner = np.full(self.fixed.shape, -1)
        for number, (support, mask) in enumerate(zip(self.supports, self.masks, strict=True)):
            position = self.nodes.position[mask]
            for column, (amplitude, component) in support.columns.items():
                new = amplitude.at(factor, position)[:, component]
                old, taken = values[mask, column], owner[mask, column] >= 0
                clash = taken & (np.abs(new - old) > 1e-12 * np.maximum(np.abs(new), np.abs(old)))
                if np.any(clash):
                    at = int(np.argmax(clash))
                    other = self.supports[owner[mask, column][at]].name
                    where = tuple(float(round(c, 9)) for c in position[at])
                    raise InputError(
                        f"{support.name} contradicts {other}: {component_names(self.layout)[column]} of the "
                        f"node at {where} is {new[at]:g} and {old[at]:g}"
                    )
                values[mask, column], owner[mask, column] = new, number
        return values

    def increments(self, factor: float, reset: float, rotation_base: float) -> np.ndarray:
        """Prescribed increments since the last reset (rotations: since their last base), (nodes, block)."""
        d, now = self.layout.dim, self.totals(factor)
        before = self.totals(reset)
        out: np.ndarray = now - before
        if self.layout.rotations:
            base = before if rotation_base == reset else self.totals(rotation_base)
            out[:, d:] = now[:, d:] - base[:, d:]
            whole = np.all(self.fixed[:, d:], axis=1)
            if self.layout.rotations == 3:
                out[whole, d:] = rotations.relative_vector(now[whole, d:], base[whole, d:])
        return out
