"""What a parameter changes by itself, and observables of the tangent-linear run.

Problems that `build` makes of a slightly larger and a slightly smaller value tell how the material's numbers,
loads and supports depend on a parameter, whatever formulas a script has for them. They take no steps. After
each step the run's state and its changes are put into them, and their own observables are read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from ..errors import InputError
from ..materials.base import parameter_values
from ..problems.reactions import Equilibrium
from ..terms.ghost import Ghost
from .leading import Lead, Leader
from .pointrates import STATE, PointRates
from .surfacechanges import SurfaceChanges
from .twins import distribute

STEP = 1e-5  # of ln m
_CLOSE = 1e-6  # of an observable, relative: what the mean of the two may be off the run's


def _forms(problem: Any) -> Any:
    return getattr(problem.forms, "point_forms", problem.forms)


class Rates(Protocol):
    """Derivatives of a step by the logarithm of a parameter.

    Attributes:
        points: of their state.
        at: increments of the run (nodes, block).
        increments, residual, loads: of nodes (nodes, block); moved, turned: of
            their positions (nodes, d) and, of elements, microrotations (nodes, 4).
        factor: of the load factor.
    """

    points: PointRates
    increments: np.ndarray
    residual: np.ndarray
    loads: np.ndarray
    factor: float

    @property
    def at(self) -> np.ndarray: ...

    @property
    def moved(self) -> np.ndarray: ...

    @property
    def turned(self) -> np.ndarray: ...


class Reader:
    """A pair of problems of a parameter.

    Args:
        pair: with a larger and a smaller value: (problem, observables).
    """

    def __init__(self, leader: Leader, name: str, pair: list[tuple[Any, Mapping[str, Any]]]):
        self.name, self.pair, self._lead = name, pair, Lead(leader)
        numbers = [[parameter_values(m) for m in p.points.materials] for p, _ in pair]
        self.numbers = [(a - b) / (2.0 * STEP) for a, b in zip(*numbers, strict=True)]
        held = [[getattr(form, "stabilisation", 0.0) for form in _forms(p)] for p, _ in pair]
        self.stabilisation = [(a - b) / (2.0 * STEP) for a, b in zip(*held, strict=True)]
        self._prescribers: list[Any] = []
        self._before: np.ndarray | None = None
        self.surfaces = SurfaceChanges(self._lead, [p for p, _ in pair], STEP)

    def _difference(self, larger: Any, smaller: Any) -> Any:
        return (larger - smaller) / (2.0 * STEP)

    def at_the_beginning(self) -> dict[str, np.ndarray]:
        """Of the points' state before the first step: an initial stress depends on the moduli. Local."""
        larger, smaller = (p.points for p, _ in self.pair)
        names = ("plastic_F", "hardening") if larger.plastic else ()
        return {n: self._difference(getattr(larger, n), getattr(smaller, n)) for n in names}

    # what the run needs -------------------------------------------------------------------------------------
    def reset(self) -> None:
        """The run has reset its grid. Collective."""
        leading = self._lead.run.problem
        factor = leading.progress.factor
        for problem, _ in self.pair:
            distribute(self._lead, problem.points)
            moved = problem._moving.at(factor if leading.progress.step else None, problem.supports)
            self._check_grid(moved, leading.grid)
            problem._put_grid(leading.grid)
        self.begin()

    def begin(self) -> None:
        """Nodes are numbered as they are now. Collective."""
        leading = self._lead.run.problem
        self._prescribers = [p._prescribed(leading.system.nodes) for p, _ in self.pair]
        self._before = self._totals(leading.progress.factor)
        self.surfaces.begin()

    def _check_grid(self, grid: Any, leading: Any) -> None:
        for axis in range(grid.dim):
            lines = [np.array([g.plane(axis, i) for i in range(g.shape[axis] + 1)]) for g in (grid, leading)]
            if not np.array_equal(lines[0], lines[1]):
                raise InputError(
                    f'{self.name}: the grid\'s lines move with it (fix on a moving plane); method="exact" '
                    'doesn\'t carry that, take method="twins"'
                )

    def _totals(self, factor: float) -> np.ndarray:
        larger, smaller = (prescribed.totals(factor) for prescribed in self._prescribers)
        found: np.ndarray = self._difference(larger, smaller)
        return found

    def prescribed(self) -> np.ndarray:
        """Change of what supports have prescribed in the last step (nodes, block). Collective."""
        now, before = self._totals(self._lead.run.problem.progress.factor), self._before
        assert before is not None
        self._before = now
        moved, layout = now - before, self._lead.run.problem.layout
        if layout.rotations == 3 and self._lead.run.problem.comm.allreduce(
            int(np.any(moved[:, layout.dim :]))
        ):
            raise InputError(
                f'{self.name}: prescribed rotations in space change with it; method="exact" doesn\'t carry '
                'that, take method="twins"'
            )
        fixed: np.ndarray = np.where(self._prescribers[0].fixed, moved, 0.0)
        return fixed

    def loads(self) -> tuple[np.ndarray, np.ndarray]:
        """Of forces (np, d) and couples (np, r) at the points, at the last step's load factor. Collective."""
        factor = self._lead.run.problem.progress.factor
        larger, smaller = (p._loads_at(factor) for p, _ in self.pair)
        return self._difference(larger[0], smaller[0]), self._difference(larger[1], smaller[1])

    def ghost(self) -> np.ndarray | None:
        """Of the ghost penalty's factors, over these (block,); None: they stay."""
        scales = [[t.scale for t in p.terms if isinstance(t, Ghost)] for p, _ in self.pair]
        if not scales[0] or np.array_equal(scales[0][0], scales[1][0]):
            return None
        larger, smaller = scales[0][0], scales[1][0]
        mean = 0.5 * (larger + smaller)
        out: np.ndarray = np.where(
            mean != 0.0, self._difference(larger, smaller) / np.where(mean, mean, 1), 0
        )
        return out

    # observables ------------------------------------------------------------------------------------------
    def read(self, tangent: Rates) -> None:
        """Put in the run's state after a step and its changes. Collective."""
        run = self._lead.run.problem
        for k, (problem, _) in enumerate(self.pair):
            sign = (STEP, -STEP)[k]
            for name in STATE:
                if name in tangent.points.now:
                    now = getattr(run.points, name) + sign * tangent.points.now[name]
                    setattr(problem.points, name, now)
            if not self._lead.run.on_grid:
                e, nodes = problem.elements, run.elements
                e.moved, e.q = nodes.moved + sign * tangent.moved, nodes.q + sign * tangent.turned
            if problem.points.plastic:
                problem.points.dissipation = np.full_like(run.points.dissipation, np.nan)
            problem.progress = replace(
                run.progress,
                factor=run.progress.factor + sign * tangent.factor,
                external_work=np.nan,
                carried_work=np.nan,
                ghost_work=np.nan,
                patch_work=np.nan,
                term_work=np.nan,
            )
            of_surfaces = self.surfaces.on_body(k, tangent.at + sign * tangent.increments)
            e = run._equilibrium
            terms = [(name, of_surfaces.get(name, np.full_like(f, np.nan))) for name, f in e.terms]
            problem._equilibrium = replace(self._equilibrium(problem, e, tangent, sign), terms=terms)
            problem.steps.append(replace(run.steps[-1], factor=problem.progress.factor))

    def _equilibrium(self, problem: Any, e: Equilibrium, tangent: Rates, sign: float) -> Equilibrium:
        run = self._lead.run.problem
        given = [entry.condition for entry in run.given.entries]
        own = [entry.condition for entry in problem.given.entries]
        supports = tuple(own[given.index(s)] for s in e.supports)
        residual, tied, ties = tangent.residual, e.tied, run.system.prescribed.ties
        if ties is not None:
            residual, changed = ties.shares(residual)
            tied = {k: e.tied[k] + sign * f for k, f in changed.items()}
        dx, d = tangent.increments, run.layout.dim
        return replace(
            e,
            supports=supports,
            residual=e.residual + sign * residual,
            tied=tied,
            w=e.w + sign * dx[:, d:],
            position=e.position + sign * tangent.moved,
            loads=np.full_like(e.loads, np.nan) if self._turning() else e.loads + sign * tangent.loads,
            carried=np.full_like(e.carried, np.nan),
        )

    def _turning(self) -> bool:
        """Whether loads turn with the body, whose forces aren't carried."""
        system = self._lead.run.problem.system
        return bool(getattr(system, "couple_kernel", None) or getattr(system, "varying", False))

    @property
    def observables(self) -> list[Mapping[str, Any]]:
        """Of both problems."""
        return [observables for _, observables in self.pair]

    def rates(self, values: Mapping[str, Any], found: list[dict[str, Any]], value: float) -> dict[str, Any]:
        """Derivatives by the parameter of a value, of observables that have been read.

        Raises:
            InputError: an observable is read of what isn't carried.
        """
        out = {}
        for name, here in values.items():
            larger, smaller = (np.asarray(f[name]) for f in found)
            scale = np.abs(here).max(initial=0.0)
            off = np.abs(0.5 * (larger + smaller) - here).max(initial=0.0)
            if not off <= _CLOSE * max(scale, np.abs(larger - smaller).max(initial=0.0)):
                raise InputError(
                    f'observables: {name} depends on what method="exact" doesn\'t carry, such as energies or '
                    'what terms do; take method="twins"'
                )
            out[name] = (larger - smaller) / (2.0 * STEP * value)
        return out

    def close(self) -> None:
        """Collective."""
        for problem, _ in self.pair:
            problem.close()
