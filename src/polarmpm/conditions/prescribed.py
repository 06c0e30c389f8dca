"""Prescribed nodal increments between two resets."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..geometry.nodes import Positioned
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..tools.parallel import errors_on_all_ranks, reduce_in_place
from .supports import Support, component_names
from .ties import Ties

_ROUNDING = 1e-12  # of the largest prescribed value: so far two supports that agree may be apart


class Prescribed:
    """Prescribed nodal increments between two resets. Collective.

    Increments lead on from a converged state, the base: there the nodes have increments x (nodes, block) at a
    load factor. From then on they move by what the supports' values gain. A support in `total` that hasn't
    taken part in a step moves them, in its first one, from where the body is to where it prescribes.

    Args:
        length: size of a cell (m), which tells what rounding is.

    Attributes:
        fixed: (nodes, block) bool.
        ties: unknowns that follow others; None: there are none.
    """

    def __init__(
        self,
        nodes: Positioned,
        supports: Sequence[Support],
        layout: Layout,
        comm: MPI.Comm = MPI.COMM_SELF,
        length: float = 1.0,
    ):
        self.nodes, self.supports, self.layout = nodes, tuple(supports), layout
        self.comm, self.length = comm, length
        with errors_on_all_ranks(comm):
            self.masks = [s.mask(nodes) for s in supports]
        self.fixed = np.zeros((len(nodes), layout.block), dtype=bool)
        for support, mask in zip(supports, self.masks, strict=True):
            for column in support.columns:
                self.fixed[mask, column] = True
        self.ties: Ties | None = None
        if any(s.mirror is not None for s in supports):
            self.ties = Ties(nodes, supports, self.fixed, comm)
            self.fixed = self.ties.fixed
        self.start_from(0.0, np.zeros(self.fixed.shape))
        self.turns: np.ndarray = np.zeros((len(nodes), 3))

    @property
    def free(self) -> np.ndarray:
        """Unknowns (nodes, block) that are neither prescribed nor follow another one, bool."""
        free: np.ndarray = ~self.fixed if self.ties is None else ~(self.fixed | self.ties.tied)
        return free

    @property
    def touched(self) -> np.ndarray:
        """Unknowns (nodes, block) on which supports act, bool."""
        return self.fixed if self.ties is None else self.fixed | self.ties.touched

    def start_from(self, factor: float, x: np.ndarray) -> None:
        """Lead on from a converged state with increments x (nodes, block) at a load factor."""
        self.factor, self.base = factor, x.copy()
        self.moved: np.ndarray | None = None

    def put_motion(self, moved: np.ndarray, q: np.ndarray) -> None:
        """Displacements (nodes, d) and rotations (nodes, 4) of the body so far, at the base, for supports in
        total that are new."""
        r = self.layout.rotations
        turned = rotations.to_vector(np.where(q[:, :1] < 0, -q, q))
        self.moved = np.hstack([moved, turned if r == 3 else turned[:, 2:] if r else turned[:, :0]])
        for support, mask in zip(self.supports, self.masks, strict=True):
            if support.total and support.committed:  # there the motion is known exactly
                for column, (amplitude, k) in support.columns.items():
                    self.moved[mask, column] = amplitude.at(self.factor, self.nodes.position[mask])[:, k]

    @property
    def needs_motion(self) -> bool:
        """Whether there are new supports in total."""
        return any(s.total and not s.committed for s in self.supports)

    def totals(self, factor: float) -> np.ndarray:
        """Prescribed totals (nodes, block) at a load factor; zero where free. Collective.

        Raises:
            InputError: two supports contradict each other.
        """
        return self._values(factor)[0]

    def _values(self, factor: float) -> tuple[np.ndarray, np.ndarray]:
        """Prescribed values (nodes, block) at a load factor and at the base; zero where free. Collective."""
        with errors_on_all_ranks(self.comm):
            found = [
                self._of(support, mask, factor)
                for support, mask in zip(self.supports, self.masks, strict=True)
            ]
        floor = [1e-3 * self.length] * self.layout.dim + [1e-3] * self.layout.rotations
        scale = np.array(floor)
        for values in found:
            for column, (now, before) in values.items():
                size = max(float(np.abs(v).max(initial=0.0)) for v in (now, before))
                scale[column] = max(scale[column], size)
        for part in (slice(0, self.layout.dim), slice(self.layout.dim, None)):
            scale[part] = scale[part].max(initial=0.0)
        reduce_in_place(self.comm, scale, MPI.MAX)
        with errors_on_all_ranks(self.comm):
            return self._put_together(found, _ROUNDING * scale)

    def _of(
        self, support: Support, mask: np.ndarray, factor: float
    ) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """A support's values at a load factor and at the base by column, at its nodes."""
        position, out, known = self.nodes.position[mask], {}, {}
        fresh = support.total and not support.committed
        for column, (amplitude, component) in support.columns.items():
            if amplitude not in known:
                known[amplitude] = amplitude.at(factor, position), amplitude.at(self.factor, position)
            now, before = (values[:, component] for values in known[amplitude])
            if fresh:
                before = np.zeros(len(now)) if self.moved is None else self.moved[mask, column]
            out[column] = now, before
        return out

    def _put_together(
        self, found: Sequence[dict[int, tuple[np.ndarray, np.ndarray]]], rounding: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        values, base = np.zeros(self.fixed.shape), np.zeros(self.fixed.shape)
        owner = np.full(self.fixed.shape, -1)
        for number, (mask, of_support) in enumerate(zip(self.masks, found, strict=True)):
            rows = np.flatnonzero(mask)
            for column, (now, before) in of_support.items():
                taken = owner[rows, column] >= 0
                if not taken.any():
                    values[rows, column], base[rows, column], owner[rows, column] = now, before, number
                    continue
                gap = (now - before) - (values[mask, column] - base[mask, column])
                clash = taken & (np.abs(gap) > rounding[column])
                if np.any(clash):
                    self._contradiction(number, owner[mask, column], column, mask, clash, (now, values[mask]))
                more = rows[~taken]
                values[more, column], base[more, column] = now[~taken], before[~taken]
                owner[more, column] = number
        return values, base

    def _contradiction(
        self,
        number: int,
        owner: np.ndarray,
        column: int,
        mask: np.ndarray,
        clash: np.ndarray,
        values: tuple[np.ndarray, np.ndarray],
    ) -> None:
        at, (new, old) = int(np.argmax(clash)), values
        where = tuple(float(round(c, 9)) for c in self.nodes.position[mask][at])
        late = " since one of them was added in mid-run" if self.factor else ""
        raise InputError(
            f"{self.supports[number].name} contradicts {self.supports[owner[at]].name}: "
            f"{component_names(self.layout)[column]} of the node at {where} is {new[at]:g} and "
            f"{old[at, column]:g}{late if new[at] == old[at, column] else ''}"
        )

    def increments(self, factor: float) -> np.ndarray:
        """Prescribed increments (nodes, block) at a load factor; zero where free. Collective.

        Raises:
            InputError: two supports contradict each other.
        """
        d = self.layout.dim
        now, before = self._values(factor)
        gained = now - before
        whole = np.all(self.fixed[:, d:], axis=1)
        if (
            self.layout.rotations == 1 and self.moved is not None
        ):  # the body's angle is known up to whole turns
            gained[:, d:] = np.where(self._fresh[:, d:], _short(gained[:, d:]), gained[:, d:])
        out: np.ndarray = np.where(self.fixed, self.base + gained, 0.0)
        if self.layout.rotations == 3:
            with errors_on_all_ranks(self.comm):
                self._check_turns(before, now, whole)
            way = rotations.relative_vector(now[whole, d:], before[whole, d:])
            if np.any(self.base[whole, d:]):
                q = rotations.turned(rotations.from_vector(self.base[whole, d:]), way)
                way = rotations.to_vector(np.where(q[:, :1] < 0, -q, q))
            out[whole, d:] = way
        if self.ties is not None:
            self.ties.put_prescribed(out, self.base)
        return out

    def _check_turns(self, before: np.ndarray, now: np.ndarray, whole: np.ndarray) -> None:
        """Raise InputError for rotations, where all components are prescribed, that change by so much
        that another way leads to the same place."""
        d = self.layout.dim
        far = np.zeros(len(whole), dtype=bool)
        far[whole] = turns_too_far(before[whole, d:], now[whole, d:])
        for support, mask in zip(self.supports, self.masks, strict=True):
            if np.any(far & mask) and any(column >= d for column in support.columns):
                raise InputError(f"{support.name}: {TOO_FAR}")

    @property
    def _fresh(self) -> np.ndarray:
        """Unknowns (nodes, block) of new supports in total, bool."""
        out = np.zeros(self.fixed.shape, dtype=bool)
        for support, mask in zip(self.supports, self.masks, strict=True):
            for column in support.columns if support.total and not support.committed else ():
                out[mask, column] = True
        return out


TOO_FAR = (
    "theta changes by pi or more in one step, after which a body in space isn't where the numbers say; "
    "take more load steps"
)


def turns_too_far(before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Whether rotation vectors (n, 3) change by pi or more. Those of functions that keep within a turn of pi
    jump to the other side there, which is no change."""
    change = np.linalg.norm(now - before, axis=1)
    largest = np.maximum(np.linalg.norm(now, axis=1), np.linalg.norm(before, axis=1))
    far: np.ndarray = (change >= np.pi) & (largest > (1 + 1e-6) * np.pi)
    return far


def _short(angle: np.ndarray) -> np.ndarray:
    """Angles (rad) between -pi and pi that turn as far."""
    out: np.ndarray = np.remainder(angle + np.pi, 2 * np.pi) - np.pi
    return out
