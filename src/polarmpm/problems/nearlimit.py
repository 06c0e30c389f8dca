"""How far a body that flows is from its limit load, as the loads' work tells it step by step."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..assembly.system import NodalSystem
from ..terms.base import Term
from ..terms.ghost import Ghost
from ..terms.surfaces import Pressure, SurfaceSupport, Traction
from ..tools.parallel import reduce_in_place
from .work import StepStart

GIVES_WAY = 2.0  # times as fast as the loads: near a limit load displacements grow so
GROWN = 1e-3  # of the loads in a step: below, nothing is learnt of how displacements grow with them


def known(terms: Iterable[Term]) -> bool:
    """Whether the work of all terms on their motion is that of loads: what moves the body, such as a wall,
    counts as a load elsewhere."""
    return all(isinstance(term, Ghost | Traction | Pressure) or _holds_still(term) for term in terms)


def _holds_still(term: Term) -> bool:
    if not isinstance(term, SurfaceSupport):
        return False
    return all(a.function is None and not np.any(a.constant) for a in term.amplitudes())


class NearLimit:
    """How much faster displacements grow than the loads that drive them.

    With loads s f, a motion du in a step does the work s f . du at the loads of the step's end, and less at
    those of its beginning: from both follow s and the displacement u = f . du along the loads. What the
    strength of a body is off, its displacements are d ln u / d ln s times as much.

    Attributes:
        sensitivity: d ln u / d ln s in the last step, 1 of a linear body; 0 where loads don't grow, or don't
            drive the body.
    """

    def __init__(self) -> None:
        self.sensitivity = 0.0
        self._scale, self._displacement = 0.0, 0.0

    def note(self, system: NodalSystem, start: StepStart, terms: Iterable[Term]) -> None:
        """Take note of what loads, some of them `terms`, have done in a step that has converged.
        Collective."""
        if not known(terms):
            self.forget()
            return
        own = slice(0, system.nodes.owned)
        moved, held = system.x[own] - start.x[own], system.prescribed.fixed[own]
        assert system.step.initial is not None
        reactions = np.abs((system.step.initial + start.new - start.before + system.residual)[own])
        works = [np.sum(loads[own] * moved) for loads in (start.before, system.working_loads())]
        sums = np.array([*works, 0.5 * np.sum(reactions[held] * np.abs(moved[held]))])
        reduce_in_place(system.comm, sums)
        self.take(*map(float, sums))

    def take(self, before: float, after: float, held: float) -> None:
        """Take note of a step's work (J) at the loads of its beginning and of its end, and of the work on
        supports that move."""
        self.sensitivity = 0.0
        if before <= 0.0 or after <= 0.0 or not self._displacement:
            begins = abs(before) <= GROWN * after  # from nothing: what has moved before is known
            self._scale, self._displacement = 1.0, after if begins else 0.0
            return
        last, grown = self._displacement, np.log(after / before)
        self._scale *= after / before
        self._displacement += after / self._scale
        if grown > GROWN and held < 0.5 * (before + after):
            self.sensitivity = float(np.log(self._displacement / last) / grown)

    def forget(self) -> None:
        """Take note of a step of which it isn't known what loads do in it."""
        self.sensitivity = self._displacement = 0.0

    def state(self) -> list[float]:
        """For a restart file."""
        return [self.sensitivity, self._scale, self._displacement]

    def restore(self, state: list[float]) -> None:
        """Put in what `state` gave."""
        self.sensitivity, self._scale, self._displacement = map(float, state)
