"""The tangent-linear run: derivatives that are solved for, beside a run (docs/sensitivity.md).

Where a step of the run has converged, the derivative of its nodal increments solves the linear equation
K dx = -(dR at the same x), with all that depends on what has been before. Its right-hand side and products
with K are sums over points of the kernels' derivatives (`assembly.batchrates`); the run's factor
preconditions.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.batchrates import BatchRates
from ..assembly.ratestate import At, Change
from ..forms.directional import FormAlong, InitialAlong, MotionAlong
from ..terms.ghost import GhostFaces
from . import building
from .balance import Carried, closing_change
from .leading import Lead, Leader
from .pointrates import PointRates
from .readers import Reader
from .solving import preconditioned, solve


class Linearised:
    """A run's converged steps, as the tangents of all parameters need them."""

    def __init__(self, leader: Leader):
        problem, comm = leader.problem, leader.problem.comm
        self._lead = Lead(leader)
        self.along = [FormAlong(form, comm) for form in self._forms(problem)]
        self._initial: dict[Any, InitialAlong] = {}
        self.motion: MotionAlong | None = None
        self.tangents: list[Tangent] = []
        self._names: list[str] = []
        self.carried: Carried | None = None
        self.batches: list[BatchRates] = []
        self.at: list[At] = []
        self.x: np.ndarray = np.zeros((0, 0))
        self.directions: list[tuple[np.ndarray, ...]] = []  # of this step, and their products
        self._path: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        leader.followers.append(self)

    def _forms(self, problem: Any) -> Sequence[Any]:
        return problem.forms  # type: ignore[no-any-return]

    def add(self, name: str, reader: Reader) -> None:
        """Differentiate by a parameter."""
        self._names.append(name)
        self.tangents.append(self._tangent(reader))

    def _tangent(self, reader: Reader) -> Tangent:
        return Tangent(self, reader)

    def by_name(self) -> Iterator[tuple[str, Tangent]]:
        """Tangents by parameter."""
        return iter(zip(self._names, self.tangents, strict=True))

    def follow(self, problem: Any) -> None:
        """Differentiate the step that the run has taken. Collective."""
        building.check_step(problem, self.leader)
        for tangent in self.tangents:
            tangent.follow()

    def close(self) -> None:
        """Free memory. Collective."""
        for tangent in self.tangents:
            tangent.reader.close()

    @property
    def leader(self) -> Leader:
        return self._lead.run

    @property
    def problem(self) -> Any:
        return self.leader.problem

    @property
    def system(self) -> Any:
        """Of the run."""
        return self.problem.system

    @property
    def reference(self) -> Any:
        """The state from which increments count."""
        return self.system.interpolation.reference

    @property
    def mappings(self) -> Any:
        """Return mappings of the batches; None: they don't yield."""
        return self.system.mappings

    def reset(self) -> None:
        """The run has reset its grid. Collective."""
        building.check_whole_points(self.problem)
        system = self.system
        interpolation, n = system.interpolation, len(system.nodes)
        self.batches = [BatchRates(interpolation, k, along, n) for k, along in enumerate(self.along)]
        p = self.problem
        balanced = p.balanced_reset if p.progress.step else p.balanced_at_rest
        self.carried = Carried(self) if balanced else None
        for tangent in self.tangents:
            tangent.reset()

    def converged(self) -> None:
        """A step of the run has converged, and isn't put into the points yet. Collective."""
        problem, system = self.problem, self.system
        if self.motion is None:
            self.motion = MotionAlong(problem._compiled.motion, problem.comm)
        self.x, self.loads, self.terms = system.x.copy(), problem._attempted, system.terms
        self._path, self.directions = None, []
        self.at = self.points_at(self.x, True)
        self.put_couples(self.at, self.loads[1])
        for tangent in self.tangents:
            tangent.prepare()

    def points_at(self, x: np.ndarray, yielding: bool) -> list[At]:
        """The points of all batches at increments (nodes, block)."""
        system, out = self.system, []
        for k, batch in enumerate(self.batches):
            mapping = system.mappings[k] if yielding else None
            state, boxes = batch.batch.batch.kept["state"], system._boxes is not None
            at = batch.at(x, state, system.kernels[k], mapping, boxes=boxes)
            if system.initial is not None and system.initial._any:
                self.take_initial(k)
                batch.take_initial(at, system.initial._packed[k])
            if yielding:
                self.compile_returns(k, at)
            out.append(at)
        return out

    def compile_returns(self, k: int, at: At) -> None:
        """Compile for all ranks what a batch's points need that yield on any. Collective."""
        along = self.along[k]
        if self.mappings[k] is None:
            return
        used = np.zeros(len(along.form.regions), dtype=np.int32)  # type: ignore[attr-defined]
        used[[] if at.yielding is None else np.unique(at.yielding.region)] = 1
        self.problem.comm.Allreduce(MPI.IN_PLACE, used, op=MPI.MAX)
        for region in np.flatnonzero(used):
            along.returned(int(region))
        if along.form.scalars and np.any(used):
            _ = along.bent

    @property
    def carried_loads(self) -> tuple[np.ndarray, np.ndarray]:
        """Forces (np, d) and couples (np, r) at the points that the last reset has balanced. Collective."""
        p = self.problem
        found: tuple[np.ndarray, np.ndarray] = p._converged_loads or p._loads_at(p.progress.factor)
        return found

    def put_couples(self, at: list[At], couples: np.ndarray) -> None:
        """Let dead couples (np, r) act where they are no plain loads."""
        kernel = self.system.couple_kernel
        if kernel is not None:
            for batch, here in zip(self.batches, at, strict=True):
                batch.take_couples(here, kernel, np.ascontiguousarray(couples[batch.batch.rows]))

    def take_initial(self, k: int) -> None:
        """Let a batch know the kernels of its initial stresses. Collective."""
        kernels = self.system.initial.kernels[k]
        if kernels.form not in self._initial:
            self._initial[kernels.form] = InitialAlong(kernels, self.problem.comm)
        self.batches[k].initial = kernels, self._initial[kernels.form]

    def precondition(self, forces: np.ndarray) -> np.ndarray:
        """Increments (nodes, block) by which the factor at hand makes up for forces. Collective."""
        return preconditioned(self.system, forces)

    def path_of_loads(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How nodes (nodes, block) move as the load factor grows, with which forces, and what these
        leave (nodes, block). Collective."""
        if self._path is None:
            forces = self._growth()
            start = np.zeros_like(forces)
            moved, _, rest = solve(self.system, -forces, self.products, start, self.directions)
            self._path = moved, forces, rest
        return self._path

    def _growth(self) -> np.ndarray:
        grown, forces = np.hstack(load_growth(self.problem)), np.zeros_like(self.x)
        for batch in self.batches:
            forces += batch.functions.loads(grown[batch.batch.rows])
        self.system.nodes.add_to_owners(forces)
        return forces

    def products(self, dx: np.ndarray) -> np.ndarray:
        """K dx (nodes, block) on all unknowns, complete on owned rows. Collective."""
        return self.forces(self.at, self.x, dx, None)

    def forces(
        self, at: list[At], x: np.ndarray, dx: np.ndarray | None, changes: list[Change] | None
    ) -> np.ndarray:
        """Changes of internal forces (nodes, block), complete on owned rows. Collective."""
        system, out = self.system, np.zeros_like(x)
        for k, batch in enumerate(self.batches):
            out += batch.forces(at[k], x, dx, None if changes is None else changes[k])
        if dx is not None and len(self.terms):
            out += self.terms.products(x, dx)
        system.nodes.add_to_owners(out)
        return out


class Tangent:
    """Derivatives of a run by the logarithm of a parameter.

    Attributes:
        check: imbalance of the linear equation of the last step, over that of its right-hand side.
        factor: derivative of the load factor, along the path.
        moved: of the nodes' positions (nodes, d).
    """

    def __init__(self, run: Linearised, reader: Reader):
        self._run, self.reader, self.check = weakref.ref(run), reader, 0.0  # no circles
        self.factor = 0.0
        self.points = PointRates(run.problem, reader.at_the_beginning())

    @property
    def run(self) -> Linearised:
        run = self._run()
        assert run is not None
        return run

    @property
    def at(self) -> np.ndarray:
        return self.run.x

    @property
    def moved(self) -> np.ndarray:
        of_nodes: np.ndarray = self.increments[:, : self.run.problem.layout.dim]
        return of_nodes

    @property
    def turned(self) -> np.ndarray:
        return np.zeros((0, 4))

    # between two steps ----------------------------------------------------------------------------------
    def reset(self) -> None:
        """The run has reset its grid. Collective."""
        run = self.run
        interpolation = run.system.interpolation
        self.points.reset()
        self.reader.reset()
        chosen = run.leader.chosen
        assert chosen is not None
        table = self.points.tables(chosen, interpolation)
        self.increments = np.zeros_like(run.system.x)
        self._carried = np.zeros_like(self.increments)
        self._fixed = np.zeros_like(self.increments)
        self._changes = []
        for k, (batch, rates) in enumerate(zip(run.batches, self.reader.numbers, strict=True)):
            patches = None
            if batch.patches is not None and table is not None:
                patches = self.points.patches(batch, chosen.cells, interpolation)
            state = self.points.state(batch, run.reference, self.reader.stabilisation[k])
            own = self.points.functions(batch, table), self.points.axes(batch)
            turn = self.points.turn(batch, run.reference)
            self._changes.append(Change(rates, state, *own, patches, turn))
        self._forces_alone: np.ndarray | None = None
        if run.carried is not None:
            still, factor = np.zeros_like(self.increments), run.problem.progress.factor
            of_loads = self._external(*self._last_loads())
            of_loads = of_loads - self.reader.surfaces.forces(still, factor, carrying=True)
            found = run.carried.rates(self._changes, of_loads)
            self._forces_alone, carried = found
            self._carried = carried + self._closing(carried, still)

    def prepare(self) -> None:
        """A step of the run has converged: the state that it has begun with. Collective."""
        if not self.run.problem.progress.since_reset:
            return
        held = self.reader.stabilisation
        for batch, change, s in zip(self.run.batches, self._changes, held, strict=True):
            change.state = self.points.state(batch, self.run.reference, s)

    # a step -----------------------------------------------------------------------------------------------
    def follow(self) -> None:
        """Find the derivatives of the step that the run has taken. Collective."""
        run, system, path = self.run, self.run.system, self.run.leader.record.path
        dx, external = self._prescribed(), self._loads()
        if self._forces_alone is not None and run.leader.fell_back:
            alone = self._forces_alone
            self._carried = alone + self._closing(alone, np.zeros_like(alone))
            for of_state in self._changes:
                of_state.initial = None
        more = self._of_terms() - external - self._carried
        aim = run.forces(run.at, run.x, dx if np.any(dx) else None, self._changes) + more
        dx, self.check, self.residual = solve(system, aim, run.products, dx, run.directions)
        self.factor = 0.0
        if path is not None and not path.stopped:
            along, growth, rest = run.path_of_loads()
            self.factor = self._along_path(dx, along)
            dx, external = dx + self.factor * along, external + self.factor * growth
            self.residual = self.residual + self.factor * rest
        for batch, at, change in zip(run.batches, run.at, self._changes, strict=True):
            batch.settle(at, run.x, dx, change)
        self.increments, self.loads = dx, external
        if run.carried is not None:
            before = self._carried
            free = np.where(system.prescribed.fixed, 0.0, before)
            self._carried = free + self._closing(free, dx)
            self.residual = self.residual + before - self._carried
        self._move()
        self.reader.surfaces.commit(run.x, self.increments)
        self.reader.read(self)

    def _loads(self) -> np.ndarray:
        """Of the loads' forces (nodes, block). Collective."""
        return self._external(self.run.loads, self.reader.loads())

    def _along_path(self, dx: np.ndarray, along: np.ndarray) -> float:
        """Of the load factor, with which a step along the path stays as long as it is. Collective."""
        run, system, d = self.run, self.run.system, self.run.problem.layout.dim
        own, moved = slice(0, system.owned), run.x - run.leader.record.start
        volume, change = system.node_volumes(), self._volumes()

        def inner(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> float:
            here = np.einsum("n,ni,ni->", weight[own], a[own, :d], b[own, :d])
            return float(system.comm.allreduce(float(here)))

        longer = 2.0 * inner(moved, dx - self.increments, volume) + inner(moved, moved, change)
        return -longer / (2.0 * inner(moved, along, volume))

    def _volumes(self) -> np.ndarray:
        """Of the nodes' shares of the body's volume (nodes,), complete on owned rows. Collective."""
        run, out = self.run, np.zeros((len(self.increments), 1))
        for batch, change in zip(run.batches, self._changes, strict=True):
            volume = run.problem.points.volume0[batch.batch.rows][:, None]
            for functions in change.functions:
                out += functions.loads(volume)
        run.system.nodes.add_to_owners(out)
        volumes: np.ndarray = out[:, 0]
        return volumes

    def _closing(self, change: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """Of what closes the carried forces, as these change (nodes, block), and nodes move. Collective."""
        system, d = self.run.system, self.run.problem.layout.dim
        free = np.where(system.prescribed.fixed, 0.0, system.carried)
        return closing_change(system, free, change, dx[:, :d], self._volumes())

    def _prescribed(self) -> np.ndarray:
        """Of prescribed increments (nodes, block); zero elsewhere."""
        self._fixed = self._fixed + self.reader.prescribed()
        fixed: np.ndarray = self._fixed.copy()
        return fixed

    def _last_loads(self) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """Of the last step at the points, as they are after a reset: forces, couples, and their changes."""
        problem, own = self.run.problem, self.reader.loads()
        if self.factor:
            grown = load_growth(problem)
            own = own[0] + self.factor * grown[0], own[1] + self.factor * grown[1]
        return self.run.carried_loads, own

    def _external(self, at_points: Any, changes: Any) -> np.ndarray:
        """Of the loads' forces (nodes, block), complete on owned rows, of forces and couples at the points
        and their changes. Collective."""
        run = self.run
        out: np.ndarray = np.zeros_like(run.system.x)
        loads, change = np.hstack(at_points), np.hstack(changes)
        if run.system.couple_kernel is not None:  # what couples do work on changes, too
            d = run.problem.layout.dim
            for batch, of_state in zip(run.batches, self._changes, strict=True):
                of_state.couples = np.ascontiguousarray(changes[1][batch.batch.rows])
            loads[:, d:], change[:, d:] = 0.0, 0.0
        for batch, of_state in zip(run.batches, self._changes, strict=True):
            rows = batch.batch.rows
            if np.any(change[rows]):
                out += batch.functions.loads(change[rows])
            for functions in of_state.functions if np.any(loads[rows]) else ():
                out += functions.loads(loads[rows])
        run.system.nodes.add_to_owners(out)
        return out

    def _of_terms(self) -> np.ndarray:
        """Of the terms' forces (nodes, block) at the same increments. Collective."""
        run, system = self.run, self.run.system
        out, scale = np.zeros_like(run.x), self.reader.ghost()
        if scale is not None:
            out = system.terms.forces(run.x, lambda piece: isinstance(piece, GhostFaces)) * scale
            system.nodes.add_to_owners(out)
        out += self.reader.surfaces.forces(run.x, run.leader.factor)
        return out

    def _move(self) -> None:
        """Of the points' state."""
        run, points = self.run, self.points
        reference, motion = run.reference, run.motion
        assert motion is not None
        done = {name: rates.copy() for name, rates in points.now.items()}
        parts = list(zip(run.batches, run.at, self._changes, strict=True))
        for batch, at, change in parts:
            points.move(batch, at, change, (run.x, self.increments), reference, motion, done)
        for k, (batch, at, change) in enumerate(parts):
            points.flow(batch, at, change, reference, run.mappings[k], done)
        points.now = done


def load_growth(problem: Any) -> tuple[np.ndarray, np.ndarray]:
    """By which forces (np, d) and couples (np, r) at the points grow with the load factor, along the path.
    Collective."""
    begin, end = (problem._loads_at(factor) for factor in (0.0, 1.0))
    return end[0] - begin[0], end[1] - begin[1]
