"""Systems that solve with another one's factor: of runs beside a run, which differ from it by little."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..conditions.prescribed import Prescribed
from ..kernels.kernel import Kernel
from ..tools.timing import Timer
from .elements import ElementSystem
from .elementscalars import scalars_of
from .elementsums import SummedElements
from .interpolation import Interpolation
from .loadedpoints import LoadedPoints
from .points import PointSystem


class BorrowedPoints(PointSystem):
    """Residual of points; the tangent is that of a leader's system.

    Args:
        leader: gives the system that is solved with. The nodes are numbered alike, and the same unknowns are
            prescribed.
    """

    borrows = True

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

    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        found: np.ndarray = self._leader().solve_again(right)
        return found

    def assemble_moduli(self, blocks: Sequence[np.ndarray], shift: float) -> None:
        """The leader has summed its own."""
        self.moduli_shift = self._leader().moduli_shift

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
