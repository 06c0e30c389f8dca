"""Systems that solve with another one's factor: of runs beside a run, which differ from it by little."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from ..conditions.prescribed import Prescribed
from ..kernels.kernel import Kernel
from ..tools.timing import Timer
from .carrying import Moduli
from .elements import ElementSystem
from .elementscalars import scalars_of
from .elementsums import SummedElements
from .interpolation import Interpolation
from .loadedpoints import LoadedPoints, Shift
from .points import PointSystem

if TYPE_CHECKING:
    from ..forms.returnmapping import Yielding

_GRADIENTS = 1e-10, 1e-6  # relative residuals of the first motion, and of one that improves it
_MOST_GRADIENTS, _WORSE = 60, 100.0  # iterations; growth of a square at which they lead nowhere


def _yielding_near(leader: Callable[[], Any], k: int, rows: np.ndarray) -> Yielding | None:
    """What the leader has found at the points of batch k, rows (n,), that yield."""
    lead = leader()
    if not np.array_equal(lead.interpolation.batches[k].rows, rows):
        return None
    found: Yielding | None = lead.mappings[k].yielding
    return found


class BorrowedPoints(PointSystem):
    """Residual of points; the tangent is that of a leader's system.

    Args:
        leader: gives the system that is solved with. The nodes are numbered alike, and the same unknowns are
            prescribed.
    """

    def __init__(
        self,
        interpolation: Interpolation,
        kernels: Sequence[tuple[Kernel, Kernel]],
        couple_kernel: Kernel | None,
        prescribed: Prescribed,
        timer: Timer,
        solver: str,
        *,
        leader: Callable[[], Any],
    ):
        LoadedPoints.__init__(self, interpolation, kernels, couple_kernel, prescribed, timer)
        self._leader, self._keeps_boxes, self._few = leader, False, False
        for k, (mapping, batch) in enumerate(zip(self.mappings, interpolation.batches, strict=True)):
            if mapping is not None:  # which must not hold this system: no circles
                mapping.near = partial(_yielding_near, leader, k, batch.rows)

    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        found: np.ndarray = self._leader().solve_again(right)
        return found

    # balanced resets ------------------------------------------------------------------------------
    def assemble_moduli(self, blocks: Sequence[np.ndarray], shift: float) -> None:
        """The leader has summed its own."""

    def carrying_motion(self, left: np.ndarray, k: int, moduli: Sequence[Moduli]) -> np.ndarray:
        """By conjugate gradients from the leader's motion on, preconditioned with its factor. What the
        material hardly resists, and moves nearly without end where forces are the least out of place, can't
        be left to the factor alone.

        Forces that are left are carried: they are of second order in what the two systems differ by.
        """
        lead = self._leader()
        if len(lead.carried_by) <= k:
            return np.zeros_like(left)
        self._find_shift(lead.moduli_shift, moduli)
        w = lead.carried_by[k]
        rest = -self.on_free(left + self._product(w, moduli))
        least = w, self._square(rest, rest)
        aim, along, square = _GRADIENTS[k > 0] ** 2 * self._square(left, left), np.zeros_like(w), 1.0
        for number in range(_MOST_GRADIENTS):
            if not aim < least[1] or self._square(rest, rest) > _WORSE * least[1]:
                break
            z = self._preconditioned(rest)
            before, square = square, self._square(rest, z)
            along = z if number == 0 else z + (square / before) * along
            forces = self.on_free(self._product(along, moduli))
            share = square / self._square(along, forces)
            w, rest = w + share * along, rest - share * forces
            now = self._square(rest, rest)
            least = (w, now) if now < least[1] else least
        motion: np.ndarray = least[0]
        return motion

    def _square(self, a: np.ndarray, b: np.ndarray) -> float:
        """Sum of a b over owned nodes. Collective."""
        own = slice(0, self.owned)
        return float(self.comm.allreduce(float(np.vdot(a[own], b[own]))))

    def _product(self, w: np.ndarray, moduli: Sequence[Moduli]) -> np.ndarray:
        """K w (nodes, block), complete on owned rows. Collective."""
        out, i = np.zeros_like(w), self.interpolation
        for k, (b, a) in enumerate(zip(i.batches, moduli, strict=True)):
            z = i.kernel_inputs(b, w)[:, : b.form.layout.unknowns]
            self.add_given(k, a.work(z), False, out, None)
        self.nodes.add_to_owners(out)
        s = self.moduli_shift
        if s.share is not None and s.most is not None:
            out[: self.owned] += s.factor * s.share * s.most * w[: self.owned]
        return out

    def _preconditioned(self, forces: np.ndarray) -> np.ndarray:
        own, out = self.owned, np.zeros_like(self.x)
        solver = self._leader().solver
        out[:own] = solver.precondition(forces[:own].ravel()).reshape(out[:own].shape)
        self.complete(out)
        out[self.prescribed.fixed] = 0.0
        return out

    def _find_shift(self, lead: Shift, moduli: Sequence[Moduli]) -> None:
        """The leader's, but for the size of the diagonal, which is this system's own: that of the nodes at
        which the leader's is largest. Collective."""
        self.moduli_shift = Shift()
        if lead.share is None or lead.most is None:
            return
        most, diagonal = np.zeros_like(lead.most), self._leader().unshifted
        for c in range(len(most)):
            unit = np.zeros_like(self.x)
            at = np.flatnonzero(diagonal[:, c] >= lead.most[c] * (1.0 - 1e-12))[:1]
            unit[at, c] = 1.0
            self.complete(unit)
            product = self._product(unit, moduli)[at, c] / lead.share[at, 0]
            most[c] = self.comm.allreduce(float(product.max(initial=0.0)), op=MPI.MAX)
        self.moduli_shift = Shift(lead.factor, lead.share, most)

    def destroy(self) -> None:
        self.step.boxes = self.box_tangent = None


class BorrowedElements(SummedElements):
    """The same of elements."""

    def __init__(self, *arguments: Any, leader: Callable[[], Any], **options: Any):
        self._leader = leader
        ElementSystem.__init__(self, *arguments, **options)

    def _build(self, solver: str) -> None:
        with self.timer("compile"):
            self._kernels, self._mappings = self.forms.compiled
        self._columns = self._leader()._columns
        self._of_loads = []
        self.projected = scalars_of(self.forms, self.comm)
        self._patched = [None] * len(self.projected)

    def _bind_terms(self) -> None:
        """No tangent, no places in it."""

    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        found: np.ndarray = self._leader().solve_again(right)
        return found

    def destroy(self) -> None:
        """There is nothing of PETSc's."""
