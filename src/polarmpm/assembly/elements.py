"""The nonlinear system of a finite element mesh, assembled by dolfinx."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from ..conditions.prescribed import Prescribed
from ..forms.elements import ElementForms
from ..geometry.spacenodes import SpaceNodes
from ..kinematics import rotations
from ..terms.base import Piece
from ..tools import compat
from ..tools.disposal import dispose_with, weakly
from ..tools.timing import Timer
from .formmatrix import FormMatrix
from .nodalterms import NodalTerms
from .stepstate import Assembled
from .system import NodalSystem


class ElementSystem(NodalSystem):
    """Residual and tangent of the increments since the last converged state.

    A subclass may sum them in another way: `_build`, `assemble` and what follows from its matrix.

    Args:
        pieces: of the terms, as of now.
        dead: compiled linear forms of loads that don't depend on the unknowns.
        varying: loads that do (followers; couples in space), compiled; they make the tangent unsymmetric.
    """

    nodes: SpaceNodes

    def __init__(
        self,
        forms: ElementForms,
        dead: Sequence[Any],
        varying: Sequence[Any],
        prescribed: Prescribed,
        timer: Timer,
        solver: str = "auto",
        pieces: Sequence[Piece] = (),
    ):
        e = forms.elements
        length = np.full(e.dim, e.cell_size)
        super().__init__(e.nodes, forms.layout, prescribed, length, e.comm, timer, pieces)
        self.forms, self._dead, self._varying = forms, dead, varying
        self._build(solver)

    def _build(self, solver: str) -> None:
        """Make ready for the sums, and for solutions. Collective."""
        forms, fixed = self.forms, self.prescribed.fixed
        with self.timer("compile"):
            self._residuals = forms.residuals
            tangents = [*forms.tangents, *(v.tangent for v in self._varying)]
        with self.timer("pattern"):
            self.matrix = FormMatrix(
                tangents,
                fixed,
                self.symmetric,
                self.nodes.owned,
                not forms.symmetric,
                solver,
                self.is_large(),
                weakly(self.near_null_space),
            )
            self._dispose = dispose_with(self, self.comm, self.matrix.destroy)

    @property
    def symmetric(self) -> bool:
        return self.forms.symmetric and not self._varying and self.terms.symmetric

    @property
    def varying(self) -> bool:
        """Some loads depend on the unknowns."""
        return bool(self._varying) or self.terms.external

    def put_pieces(self, pieces: Sequence[Piece]) -> None:
        """Replace the terms' pieces, on the same nodes: increments count from the present state on."""
        self.terms = NodalTerms(self.nodes, pieces, self.comm)

    def set_loads(self) -> None:
        """Assemble the loads whose functions have been set. Collective."""
        self._put(self.x)
        self.put_external(self._sum(self._dead))

    def working_loads(self) -> np.ndarray:
        return self.with_terms(self._body_loads())

    def _body_loads(self) -> np.ndarray:
        """Dead loads, and those that depend on the unknowns (nodes, block)."""
        return self.loads + self._sum([v.residual for v in self._varying]) if self._varying else self.loads

    def node_volumes(self) -> np.ndarray:
        shares = self.forms.elements.node_volumes()
        out = np.tile(shares[:, None], (1, self.layout.block))  # what the mesh's vectors hold
        self.nodes.add_to_owners(out)
        return out[:, 0]

    def spatial_loads(self) -> np.ndarray:
        loads, d = self._body_loads(), self.layout.dim
        if self.layout.rotations == 3:  # what does work on Dw is J_r(Dw)^T times the couple
            loads = np.hstack([loads[:, :d], rotations.couples_on_spins(self.x[:, d:], loads[:, d:])])
        return loads

    @cached_property
    def _functions(self) -> np.ndarray:
        """Values of the nodes' functions at the quadrature points of a cell, (nq, n)."""
        e = self.forms.elements
        values: np.ndarray = compat.tabulate(e.body.cell, e.degree, e.reference_points)[0]
        return values

    def at_points(self, x: np.ndarray) -> np.ndarray:
        e = self.forms.elements
        of_cells = x[e.live_nodes]
        values: np.ndarray = self._functions @ of_cells
        return values.reshape(len(of_cells) * len(self._functions), x.shape[1])

    def from_points(self, values: np.ndarray) -> np.ndarray:
        e = self.forms.elements
        nodes, b = e.live_nodes, values.shape[1]
        of_cells = self._functions.T @ values.reshape(len(nodes), len(self._functions), b)
        at = nodes.ravel()
        sums = [np.bincount(at, of_cells[:, :, i].ravel(), minlength=len(self.x)) for i in range(b)]
        out = np.stack(sums, axis=1).astype(float)  # without any elements they are integers
        self.nodes.add_to_owners(out)
        return out

    def point_volumes(self) -> np.ndarray:
        return self.forms.elements.points.volume0

    @property
    def plastic(self) -> bool:
        return any(m.plastic for m in self.forms.elements.points.materials)

    def dissipate(self, share: float) -> None:
        self.forms.dissipate(share)

    def start_elastic(self, on: bool) -> bool:
        return self.forms.start_elastic(on)

    def projected_F(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows of points whose deformation is projected, and the projected F; dolfinx' forms project none."""
        return []

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

    def assemble(self, tangent: bool, lift: np.ndarray | None = None) -> Assembled:
        self._put(self.x, self.before if tangent else None)
        self.forms.update(tangent)
        internal = self._sum(self._residuals)
        own = self.forms.own_forces()
        if own is not None:
            self.nodes.add_to_owners(own)
            internal += own
        loads = self.external = self._body_loads()
        if len(self.terms):
            internal += self.term_forces()
        lifted = self.matrix.assemble(lift, self._dense_terms()) if tangent else None
        return Assembled(internal - loads, lifted)

    def slope_forces(self) -> dict[int, np.ndarray]:
        held = self.forms.held
        number = {support: k for k, support in enumerate(self.prescribed.supports)}
        found = {number[support]: -self.forms.held_forces(one) for support, one in held.items()}
        for forces in found.values():
            self.nodes.add_to_owners(forces)
        return found

    def _dense_terms(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Global numbers of the nodes of each set of the terms, and of the forms' own, and its tangent."""
        for rows, matrix in chain(self.terms.dense(self.x), self.forms.dense()):
            yield self.nodes.number[rows], matrix

    def positions(self) -> np.ndarray:
        x: np.ndarray = super().positions() + self.forms.elements.moved
        return x

    @property
    def tangent(self) -> Any:
        return self.matrix.matrix

    def diagonal(self) -> np.ndarray:
        return self.matrix.diagonal

    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        if fresh:
            with self.timer("factor"):
                self.matrix.solver.factor()
        with self.timer("solve"):
            return self.matrix.solver.solve(right.ravel(), accuracy).reshape(right.shape)

    def destroy(self) -> None:
        self._dispose()
