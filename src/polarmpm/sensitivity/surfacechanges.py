"""How loads and supports on surfaces change with a parameter, by those of two problems beside the run.

The surfaces of a larger and a smaller value go along with the nodes' increments of their own, from cells that
the run's have chosen. At the same increments, halves of the difference of their forces are what the parameter
changes by itself, and by where surfaces have been carried to.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..assembly.nodalterms import NodalTerms
from ..basis.followed import Followed
from ..geometry.grid import Grid
from ..kinematics.layout import Layout
from ..terms.base import Piece, Setting, Term, pieces_of
from ..terms.nitsche import ConsistentSupport
from ..terms.settings import GridSetting, MeshSetting
from ..terms.sites import Sites
from ..terms.surfaceterms import SurfaceCondition
from .leading import Lead


def follows(term: Term) -> bool:
    """Whether a term is a condition on a surface whose tangent is its own."""
    if not isinstance(term, SurfaceCondition) or isinstance(term, Sites) or not term.carried:
        return False
    return type(term).moduli in (SurfaceCondition.moduli, ConsistentSupport.moduli)


class KnownCells(GridSetting):
    """A grid, with a basis that knows the cells of all places."""

    def __init__(self, grid: Grid, basis: Followed, layout: Layout):
        self.grid, self.basis, self.layout, self.comm = grid, basis, layout, grid.comm


class SurfaceChanges:
    """The conditions on surfaces of two problems.

    Args:
        problems: with a larger and a smaller value, each off by a `step` of ln m.
    """

    def __init__(self, lead: Lead, problems: Sequence[Any], step: float):
        self._lead, self._problems, self._step = lead, problems, step
        self._terms = [[t for t in p.terms if isinstance(t, SurfaceCondition)] for p in problems]
        self._nodal: list[NodalTerms] = []

    def begin(self) -> None:
        """Increments count from the present state on. Collective."""
        if not self._terms[0]:
            return
        leading = self._lead.run.problem
        self._nodal = []
        for problem, terms in zip(self._problems, self._terms, strict=True):
            setting = self._setting(problem)
            for term in terms:
                term.begin()
            pieces = [piece for term in terms for piece in pieces_of(term, setting)]
            self._nodal.append(NodalTerms(leading.system.nodes, pieces, leading.comm))

    def _setting(self, problem: Any) -> Setting:
        run = self._lead.run
        if not run.on_grid:
            return MeshSetting(problem.elements)
        basis = Followed(problem.basis)
        basis.places = run.places
        return KnownCells(run.problem.grid, basis, run.problem.layout)

    def _at(self, x: Sequence[np.ndarray], factor: float, carrying: bool) -> list[np.ndarray]:
        found = []
        for terms, nodal, increments in zip(self._terms, self._nodal, x, strict=True):
            for term in terms:
                term.set_factor(factor, carrying)
            forces = nodal.forces(increments, lambda piece: True)
            self._lead.run.problem.system.nodes.add_to_owners(forces)
            found.append(forces)
        return found

    def forces(self, x: np.ndarray, factor: float, *, carrying: bool = False) -> np.ndarray:
        """Changes of residual forces (nodes, block) at the same increments; `carrying`: those that a reset
        has to balance. Collective."""
        if not self._nodal:
            return np.zeros_like(x)
        larger, smaller = self._at([x, x], factor, carrying)
        change: np.ndarray = (larger - smaller) / (2.0 * self._step)
        return change

    def commit(self, x: np.ndarray, dx: np.ndarray) -> None:
        """The surfaces move with increments and their changes (nodes, block). Collective."""
        for sign, terms, nodal in zip((1.0, -1.0), self._terms, self._nodal, strict=False):
            nodal.commit(x + sign * self._step * dx)
            for term in terms:
                term.committed = True
                term.finished()

    def on_body(self, number: int, x: np.ndarray) -> dict[str, np.ndarray]:
        """Forces (nodes, block) of one of the problems on the body at increments, by name, on this rank."""
        if not self._nodal:
            return {}
        nodal = self._nodal[number]

        def of(term: Term) -> np.ndarray:
            def own(piece: Piece) -> bool:
                return piece.of is term

            forces: np.ndarray = -nodal.forces(x, own)
            return forces

        return {term.name: of(term) for term in self._terms[number]}
