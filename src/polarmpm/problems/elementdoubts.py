"""What plastic bodies' elements don't resolve: strains that vary within them, and a limit load's nearness."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from ..assembly.system import NodalSystem
from ..bodies.elements import Elements
from ..bodies.reference import Increments
from ..errors import TrustWarning
from ..terms.base import Term
from ..tools.parallel import warn_on_one_rank
from .doubts import ROUNDING
from .nearlimit import GIVES_WAY, NearLimit
from .work import StepStart

WITHIN = 0.5  # of the squares of strain increments: one element across what bends, and flows
NEAR_LIMIT = 0.25  # as of points, see `boxes`; of elements of degree 1
_FINER = "take smaller elements, three or more across what bends, and compare"


class ElementRecord:
    """Strains within the elements of a plastic body in the course of a run. All methods are collective.

    Attributes:
        within: largest share of a step's strain increments, squared, that are variations within elements.
        sensitive: largest product of that share and the sensitivity of displacements near a limit load.
        in_doubt: some step's was larger than it should be.
        limit: how far the body is from its limit load.
    """

    def __init__(self, elements: Elements):
        self.elements, self.points, self.comm = elements, elements.points, elements.comm
        self.within = self.sensitive = 0.0
        self.in_doubt, self.limit = False, NearLimit()
        self._doubt = ""

    def look(
        self, system: NodalSystem, start: StepStart, at_points: Increments, terms: Sequence[Term]
    ) -> None:
        """Look at a step that has converged, from `start` on to increments at the quadrature points."""
        self._doubt, linear = "", self.elements.degree == 1
        if not self.points.plastic or system.inertia is not None:
            return
        self.limit.note(system, start, terms)
        flows = self.comm.allreduce(bool(np.any(self.points.hardening > 0.0)), op=MPI.LOR)
        if not (flows or linear):
            return
        share, times = self._share(at_points.gradient), self.limit.sensitivity
        self.within = max(self.within, share)
        if share > WITHIN:
            self._doubt = (
                f"{100 * share:.0f} % of the strains' squares vary within the elements of a plastic body, as "
                f"with one across what bends: it may be far too soft: {_FINER}"
            )
        elif linear and flows and times > GIVES_WAY:
            self.sensitive = max(self.sensitive, times * share)
            if times * share > NEAR_LIMIT:
                self._doubt = (
                    f"near its limit load the body gives way {times:.1f} times as fast as its loads grow, "
                    f"and {100 * share:.2g} % of the strains' squares vary within its elements of degree 1: "
                    "what the strength is off, displacements are that many times; take degree=2, or finer"
                )

    def _share(self, gradient: np.ndarray) -> float:
        """Share of the squares of strain increments that is variation within elements, of the increments'
        gradients (np, d, d) in the undeformed body."""
        d, inside = gradient.shape[1], len(self.elements.reference_points)
        velocity = gradient @ np.linalg.inv(self.points.F[:, :d, :d] + gradient)
        strain = (0.5 * (velocity + np.swapaxes(velocity, 1, 2))).reshape(-1, inside, d * d)
        volume = self.points.volume0.reshape(-1, inside, 1)
        away = strain - (volume * strain).sum(axis=1, keepdims=True) / volume.sum(axis=1, keepdims=True)
        sums = np.array([np.sum(volume * away**2), np.sum(volume * strain**2), volume.sum()])
        self.comm.Allreduce(MPI.IN_PLACE, sums)
        return float(sums[0] / sums[1]) if sums[1] > ROUNDING**2 * sums[2] else 0.0

    def note(self, step: int) -> None:
        """Warn, once in a run, of what `look` has found."""
        if self._doubt and not self.in_doubt:
            self.in_doubt = True
            warn_on_one_rank(self.comm, f"step {step}: {self._doubt}", TrustWarning)

    def state(self) -> list[float]:
        """For a restart file."""
        return [self.within, self.sensitive, float(self.in_doubt), *self.limit.state()]

    def restore(self, state: Sequence[float]) -> None:
        """Put in what `state` gave."""
        self.within, self.sensitive, doubt, *limit = map(float, state)
        self.in_doubt = bool(doubt)
        self.limit.restore(limit)

    def summary(self) -> str:
        """What was seen, in a line; empty where nothing was looked at."""
        if not self.within:
            return ""
        near = f", near the limit load times the displacements' sensitivity {self.sensitive:.2g}"
        verdict = f"in doubt: {_FINER}" if self.in_doubt else "compare with elements of half the size"
        return (
            f"at most {100 * self.within:.2g} % of a step's strains, squared, vary within the elements"
            f"{near if self.sensitive else ''}: {verdict} (docs/accuracy.md)"
        )
