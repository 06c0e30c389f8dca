"""The tangent-linear run of elements: as of points, without resets, with loads that dolfinx sums."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..assembly.elementrates import ElementRates
from ..assembly.ratestate import At, Change
from ..forms.directional import MotionAlong
from ..kinematics import rotations
from .differences import along
from .leading import Leader
from .readers import STEP, Reader
from .tangents import Linearised, Tangent


@dataclass
class Start:
    """The body at the beginning of a step, at its quadrature points and nodes."""

    x: np.ndarray
    F: np.ndarray
    q: np.ndarray
    wryness: np.ndarray
    nodal_q: np.ndarray


class LinearisedElements(Linearised):
    """The converged steps of a run of elements."""

    def __init__(self, leader: Leader):
        super().__init__(leader)
        self._start: Start | None = None
        self._growing: np.ndarray | None = None

    def _forms(self, problem: Any) -> Sequence[Any]:
        forms: Sequence[Any] = problem.forms.point_forms
        return forms

    def _tangent(self, reader: Reader) -> Tangent:
        return ElementTangent(self, reader)

    @property
    def reference(self) -> Any:
        return self._start

    @property
    def mappings(self) -> Any:
        return self.system._mappings

    def converged(self) -> None:
        problem, system = self.problem, self.system
        p, e, forms = problem.points, problem.elements, problem.forms
        if self.motion is None:
            self.motion = MotionAlong(problem._motion, problem.comm)
            n = len(system.nodes)
            self.batches = [ElementRates(forms, k, own, n) for k, own in enumerate(self.along)]
            for tangent in self.tangents:
                tangent.reset()
        self.x, self.terms = system.x.copy(), system.terms
        self._start = Start(p.x, p.F, p.q, p.wryness, e.q)
        self._path, self.directions, self._growing = None, [], None
        total = np.zeros_like(self.x)
        total[:, : e.dim] = e.moved
        self.at = [self._at(k, batch, total) for k, batch in enumerate(self.batches)]
        for load in system._of_loads:
            load.renew()
        for tangent in self.tangents:
            tangent.prepare()

    def _at(self, k: int, batch: Any, total: np.ndarray) -> At:
        system, start = self.system, self.reference
        batch.begin(start.q, total, start.F)
        states = self.problem.forms._states
        found: At = batch.at(self.x, states[k], system._kernels[k], system._mappings[k])
        self.compile_returns(k, found)
        return found

    def forces(
        self, at: list[At], x: np.ndarray, dx: np.ndarray | None, changes: list[Change] | None
    ) -> np.ndarray:
        out = super().forces(at, x, dx, changes)
        return out if dx is None else out + self.of_varying(dx)

    def of_varying(self, dx: np.ndarray) -> np.ndarray:
        """What increments (nodes, block) take off loads that depend on them (nodes, block). Collective."""
        out = np.zeros_like(dx)
        for load in self.system._of_loads:
            load.multiply(dx, out)
        return out

    # loads ----------------------------------------------------------------------------------------------
    def load_change(self, reader: Reader, moved: np.ndarray) -> np.ndarray:
        """Changes of the loads' forces (nodes, block) at the same increments, where the nodes have moved by
        so much more (nodes, d) before. Collective."""
        problem, system, factor = self.problem, self.system, self.leader.factor
        pairs = [p for p, _ in reader.pair]
        values = []
        for k, load in enumerate(problem._surface_loads):
            larger, smaller = (p._surface_loads[k] for p in pairs)
            at = [one.amplitude.at(factor, load.position) * one.share for one in (larger, smaller)]
            values.append((at[0] - at[1]) / (2.0 * STEP))
        body = None
        if problem._body is not None:
            larger, smaller = (np.hstack(p._loads_at(factor)) for p in pairs)
            body = (larger - smaller) / (2.0 * STEP)
        with self._other_loads(values, body):
            system._put(self.x)
            out: np.ndarray = system._sum([*system._dead, *(v.residual for v in system._varying)])
        earlier = np.zeros_like(out)
        earlier[:, : moved.shape[1]] = moved
        out -= self.of_varying(earlier)
        return out

    @contextmanager
    def _other_loads(self, values: Sequence[np.ndarray], body: np.ndarray | None) -> Iterator[None]:
        """Put other loads into the forms' functions, for a while."""
        problem = self.problem
        functions = [load.function for load in problem._surface_loads]
        functions += [] if problem._body is None else [problem._body]
        kept = [function.x.array.copy() for function in functions]
        for load, value in zip(problem._surface_loads, values, strict=True):
            load.function.x.array.reshape(-1, load.amplitude.size)[load.rows] = value
        if body is not None:
            problem.forms.put_at_points(problem._body, body / problem.elements.mesh_volume[:, None])
        try:
            yield
        finally:
            for function, before in zip(functions, kept, strict=True):
                function.x.array[:] = before

    def _growth(self) -> np.ndarray:
        assert self._growing is not None
        return self._growing

    def find_growth(self) -> None:
        """By which forces dead loads grow with the load factor, along the path. Collective."""
        if self._growing is None:
            problem, system, ends = self.problem, self.system, []
            for factor in (0.0, 1.0):
                values = [
                    load.amplitude.at(factor, load.position) * load.share for load in problem._surface_loads
                ]
                body = None if problem._body is None else np.hstack(problem._loads_at(factor))
                with self._other_loads(values, body):
                    ends.append(system._sum(system._dead))
            self._growing = ends[1] - ends[0]


class ElementTangent(Tangent):
    """Derivatives of a run of elements by the logarithm of a parameter."""

    run: LinearisedElements

    def reset(self) -> None:
        run = self.run
        self.reader.begin()
        still = np.zeros_like(run.system.x)
        self._moved: np.ndarray = still[:, : run.problem.layout.dim]
        self._turned: np.ndarray = np.zeros_like(run.problem.elements.q)
        self._forces_alone = None
        self._carried = still

    def prepare(self) -> None:
        run, reader, points = self.run, self.reader, self.points
        points.before = dict(points.now)
        reader.surfaces.begin()
        self.increments = self._fixed = np.zeros_like(run.x)
        self._changes = []
        for k, batch in enumerate(run.batches):
            assert isinstance(batch, ElementRates)
            rows = batch.batch.rows
            state = points.state(batch, run.reference, reader.stabilisation[k])
            functions = batch.bent_functions(self._nodal(self._moved), points.before["F"])
            turn = points.turn(batch, run.reference)
            change = Change(reader.numbers[k], state, functions, turn=turn)
            q, dq = run.reference.q[rows], points.before["q"][rows]
            change.frames = along(batch._turned_back, [q], [dq])
            self._changes.append(change)
        self._of_loads = run.load_change(reader, self._moved)
        if run.leader.record.path is not None:
            run.find_growth()

    def _nodal(self, moved: np.ndarray) -> np.ndarray:
        out = np.zeros_like(self.run.x)
        out[:, : moved.shape[1]] = moved
        return out

    @property
    def moved(self) -> np.ndarray:
        return self._moved

    def _loads(self) -> np.ndarray:
        return self._of_loads

    def _volumes(self) -> np.ndarray:
        return np.zeros(len(self.increments))

    def _move(self) -> None:
        super()._move()
        run, d = self.run, self.run.problem.layout.dim
        self._moved = self._moved + self.increments[:, :d]
        if run.problem.layout.rotations:
            at, change = [run.reference.nodal_q, run.x[:, d:]], [self._turned, self.increments[:, d:]]
            self._turned = along(rotations.turned, at, change)

    @property
    def turned(self) -> np.ndarray:
        """Of the nodes' microrotations (nodes, 4)."""
        return self._turned
