"""A batch's points at some nodal values, and what changes at them: what `batchrates` takes and gives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from .pointfunctions import Functions
from .stiffscalars import Mean

if TYPE_CHECKING:
    from ..forms.returnmapping import Yielding


class Moduli(Protocol):
    """Derivatives of what does work on the points' unknowns by these, see `ratemoduli`."""

    def scalars(self, dz: np.ndarray, dzk: np.ndarray | None) -> np.ndarray: ...

    def times(
        self, dz: np.ndarray, dzk: np.ndarray | None, dt: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]: ...


@dataclass
class At:
    """A batch's points at some nodal values.

    Attributes:
        g, gk: unknowns and their derivatives along the half axes, in the lattice's axes; z, zk: in
            the frames.
        state: (n, packed size), with projected scalars and conjugates as they are in equilibrium.
        work, sides: what does work on z and zk, per volume.
        measure: the stiff scalars e and e_z; by_t: their conjugates L_t (n, m); moments: of e and of these
            over the patches; conjugate: pi (n, m).
        yielding: points that yield.
        initial: packed initial stresses; None: there are none.
        couples: dead couples in space (n, 3); None: there are none.
        inverses: of the local equations' derivatives by their unknowns, by region.
        make_moduli: makes `moduli`, those of the points, for products; None: kernels give products.
    """

    g: np.ndarray
    gk: np.ndarray | None
    z: np.ndarray
    zk: np.ndarray | None
    state: np.ndarray
    work: np.ndarray
    sides: np.ndarray | None = None
    measure: Mean | None = None
    by_t: np.ndarray | None = None
    moments: tuple[np.ndarray, np.ndarray] | None = None
    conjugate: np.ndarray | None = None
    yielding: Yielding | None = None
    initial: np.ndarray | None = None
    couples: np.ndarray | None = None
    inverses: dict[int, np.ndarray] = field(default_factory=dict)
    make_moduli: Callable[[], Moduli] | None = None

    @cached_property
    def moduli(self) -> Moduli | None:
        return None if self.make_moduli is None else self.make_moduli()


@dataclass
class Change:
    """What changes at a batch's points, besides nodal values.

    Attributes:
        parameters: the material's numbers (nparam,).
        state: (n, packed size).
        functions: one direction of the lattice after the other; empty: they stay.
        axes: functions with the change of the half axes; None: they stay.
        patches: of the patches' functions (n, functions).
        turn: of what takes the stiff scalars into the frame in which they are averaged (n, m, m).
        initial: of packed initial stresses.
        couples: of dead couples in space (n, 3).
        frames: of the kernels' frames (n, d, d), where the state doesn't tell.
    """

    parameters: np.ndarray
    state: np.ndarray
    functions: Sequence[Functions] = ()
    axes: Functions | None = None
    patches: np.ndarray | None = None
    turn: np.ndarray | None = None
    initial: np.ndarray | None = None
    couples: np.ndarray | None = None
    frames: np.ndarray | None = None
    given: dict[str, Any] = field(default_factory=dict)
