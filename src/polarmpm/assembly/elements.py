"""The nonlinear system of a finite element mesh, assembled by dolfinx."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..conditions.prescribed import Prescribed
from ..forms.elements import ElementForms
from ..tools import compat
from ..tools.timing import Timer
from .formmatrix import FormMatrix
from .system import NodalSystem


class ElementSystem(NodalSystem):
    """Residual and tangent of the increments since the last converged state.

    Args:
        dead: compiled linear forms of loads that don't depend on the unknowns.
        varying: loads that do (followers; couples in space), compiled; they make the tangent unsymmetric.
    """

    def __init__(
        self,
        forms: ElementForms,
        dead: Sequence[Any],
        varying: Sequence[Any],
        prescribed: Prescribed,
        timer: Timer,
        solver: str = "auto",
    ):
        e = forms.elements
        length = np.full(e.dim, e.cell_size)
        super().__init__(e.nodes, forms.layout, prescribed, length, e.comm, timer)
        self.forms, self._dead, self._varying = forms, dead, varying
        with timer("compile"):
            self._residual = forms.residual
            tangents = [forms.tangent, *(v.tangent for v in varying)]
        with timer("pattern"):
            symmetric = forms.symmetric and not varying
            self.matrix = FormMatrix(
                tangents,
                prescribed.fixed,
                symmetric,
                e.nodes.owned,
                not forms.symmetric,
                solver,
                self.is_large(),
                self.solver_hints,
            )
        self._dead_forces: np.ndarray = np.zeros_like(self.x)

    @property
    def varying(self) -> bool:
        """Some loads depend on the unknowns."""
        return bool(self._varying)

    def set_loads(self) -> None:
        """Assemble the dead loads whose functions have been set. Collective."""
        self._put(self.x)
        self._dead_forces = self._sum(self._dead)
        self.external = self._dead_forces + self._sum([v.residual for v in self._varying])

    def put_external(self, forces: np.ndarray) -> None:
        self._dead_forces = self.external = forces

    def start_elastic(self, on: bool) -> bool:
        return self.forms.start_elastic(on)

    def _put(self, x: np.ndarray, before: np.ndarray | None = None) -> None:
        self.forms.x.x.array[:] = x.ravel()
        if before is not None:
            self.forms.before.x.array[:] = before.ravel()
            self.forms.correction.x.array[:] = (x - before).ravel()

    def _sum(self, linear: Sequence[Any]) -> np.ndarray:
        """Nodal sums of linear forms, complete on owned rows."""
        total = np.zeros_like(self.x)
        for form in linear:
            total += compat.assemble_vector(form, len(self.nodes)).reshape(total.shape)
        if linear:
            self.nodes.add_to_owners(total)
        return total

    def assemble(self, tangent: bool) -> np.ndarray:
        self._put(self.x, self.before if tangent else None)
        self.forms.update(tangent)
        internal = self._sum([self._residual])
        if self._varying:
            self.external = self._dead_forces + self._sum([v.residual for v in self._varying])
        self._lift_forces = np.zeros_like(self.x)
        if tangent:
            product = self.matrix.assemble(self._lift if self._pending else None)
            if product is not None:
                self._lift_forces = product
        return internal - self.external

    def positions(self) -> np.ndarray:
        return super().positions() + self.forms.elements.displacement

    def diagonal(self) -> np.ndarray:
        return self.matrix.diagonal

    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        if fresh:
            with self.timer("factor"):
                self.matrix.solver.factor()
        with self.timer("solve"):
            return self.matrix.solver.solve(right.ravel(), accuracy).reshape(right.shape)

    def destroy(self) -> None:
        self.matrix.destroy()
