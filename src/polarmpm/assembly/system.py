"""What every nonlinear system of nodal increments shares, however it is assembled."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..conditions.prescribed import Prescribed
from ..geometry.nodes import Nodes
from ..kernels import native
from ..kinematics.layout import Layout
from ..solvers.choice import is_large
from ..solvers.linear import ACCURACY, NearNullSpace
from ..terms.base import Piece
from ..tools.parallel import reduce_in_place, reduced
from ..tools.timing import Timer
from . import rounding
from .inertia import Inertia
from .nodalterms import NodalTerms
from .stepstate import Assembled, StepState
from .viscosity import Viscosity


class NodalSystem(ABC):
    """Implements `solvers.newton.System` but for the assembly and the linear solution.

    Attributes:
        x: nodal increments since the reset (nodes, block), ghosts included.
        before: what they were before the last correction; at the start of a step, and where prescribed values
            have just been put in, the same.
        loads: forces of the loads on the nodes (nodes, block), complete on owned rows, without those of
            terms.
        external: the same with those of terms, as of the last evaluation.
        residual: internal minus external and carried forces of the last evaluation; complete on owned rows.
        carried: forces on the nodes that stand for what neither the basis nor initial stresses could balance
            at the last reset.
        step: where the iterations of the present step stand.
        terms: what acts on the nodes besides the body's stresses and loads.
        length: size of the smallest cell (m) in each direction (d,).
        sizes: of the cells around the nodes (nodes, d), or of all (d,), which tells what a displacement means
            as a strain.
        as_force: factors (block,) by which forces and couples count as forces.
        inertia, viscosity: of the points; None where loads are slow, or without any.
        on_lattice: nodes are on one, and the tangent's rows are at hand.
    """

    on_lattice = False
    inertia: Inertia | None = None
    viscosity: Viscosity | None = None

    def __init__(
        self,
        nodes: Nodes,
        layout: Layout,
        prescribed: Prescribed,
        length: np.ndarray,
        comm: MPI.Comm,
        timer: Timer,
        pieces: Sequence[Piece] = (),
        sizes: np.ndarray | None = None,
    ):
        self.nodes, self.layout, self.prescribed = nodes, layout, prescribed
        self.length, self.comm, self.timer = length, comm, timer
        self.sizes = length if sizes is None else sizes
        self.terms = NodalTerms(nodes, pieces, comm)
        shape = (len(nodes), layout.block)
        self.x: np.ndarray = np.zeros(shape)
        self.before: np.ndarray = self.x
        self.residual: np.ndarray = np.zeros(shape)
        self.loads: np.ndarray = np.zeros(shape)
        self.external: np.ndarray = self.loads
        self.carried: np.ndarray = np.zeros(shape)
        self.step = StepState(np.zeros(shape))
        # a couple counts as a force at the distance of a cell, so that measures don't depend on units
        equal = sizes is None
        self.mean_size = float(np.prod(length)) ** (1.0 / len(length)) if equal else self._mean_size()
        self.as_force = np.array([1.0] * layout.dim + [1.0 / self.mean_size] * layout.rotations)

    def _mean_size(self) -> float:
        """Geometric mean (m) of the sizes of cells around all nodes. Collective."""
        sums = np.array([np.log(self.sizes[: self.nodes.owned]).sum(), self.nodes.owned * self.layout.dim])
        logarithms, number = self.comm.allreduce(sums)
        return math.exp(logarithms / max(number, 1.0))

    @property
    def dim(self) -> int:
        """Space dimension: so many components of a node's unknowns are displacements."""
        return self.layout.dim

    @property
    def owned(self) -> int:
        """Number of nodes that this rank owns."""
        return self.nodes.owned

    # what an assembly provides --------------------------------------------------------------------
    @abstractmethod
    def assemble(self, tangent: bool, lift: np.ndarray | None = None) -> Assembled:
        """Sums at the present increments, with `tangent` also the matrix. Collective.

        Args:
            lift: prescribed increments (nodes, block) that are still to be put in.
        """

    @property
    @abstractmethod
    def symmetric(self) -> bool:
        """Whether the tangent is symmetric."""

    @property
    @abstractmethod
    def tangent(self) -> Any:
        """PETSc's matrix of the last solution, of unknowns in the order of global numbers; rows and columns
        of prescribed unknowns are left out, but for the diagonal. Of a symmetric one maybe the upper triangle
        only. None where it has another order."""

    @property
    def diagonal_shift(self) -> float:
        """What `solve` adds to the tangent's diagonal, relative to it."""
        return 0.0

    @abstractmethod
    def diagonal(self) -> np.ndarray:
        """Diagonal of the tangent (owned nodes, block)."""

    @abstractmethod
    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        """Solve with the tangent for (owned nodes, block); `fresh`: it has no factor yet; `accuracy`:
        relative residual that an iterative solver may leave. Collective."""

    @abstractmethod
    def node_volumes(self) -> np.ndarray:
        """Shares of the body's volume (nodes,), complete on owned rows. Collective."""

    @abstractmethod
    def at_points(self, x: np.ndarray) -> np.ndarray:
        """Values (np, block) at this rank's points of nodal ones (nodes, block)."""

    @abstractmethod
    def from_points(self, values: np.ndarray) -> np.ndarray:
        """Sums (nodes, block) of point values (np, block) with the nodes' functions, complete on owned rows.
        Collective."""

    @abstractmethod
    def point_volumes(self) -> np.ndarray:
        """Reference volumes (np,) of this rank's points."""

    @abstractmethod
    def destroy(self) -> None:
        """Release PETSc's objects."""

    def changing(self) -> Iterator[tuple[Any, tuple[str, ...] | None]]:
        """What a load step changes: objects, and which of their attributes; None: all."""
        yield (
            self,
            ("x", "before", "residual", "loads", "external", "carried", "terms", "inertia", "viscosity"),
        )
        for of_motion in (self.inertia, self.viscosity):
            if of_motion is not None:
                yield of_motion, None
        yield self.prescribed, None
        for piece in self.terms.pieces:
            yield piece, None

    def put_back(self) -> None:  # noqa: B027
        """What a load step had changed has been put back: whatever follows from it, too. Local."""

    def put_external(self, forces: np.ndarray) -> None:
        """Take dead forces on the nodes (nodes, block), complete on owned rows, for all loads."""
        self.loads = self.external = forces

    def working_loads(self) -> np.ndarray:
        """Forces (nodes, block) of the loads that are set, such as do work on the increments. Collective."""
        return self.with_terms(self.loads)

    def spatial_loads(self) -> np.ndarray:
        """Forces and couples (nodes, block) of the loads, those of terms apart, complete on owned rows;
        couples do work on spins. Collective."""
        return self.loads

    @property
    def plastic(self) -> bool:
        """Whether there are points that may yield, on any rank."""
        return False

    def dissipate(self, share: float) -> None:  # noqa: B027
        """Take what yielding points dissipate in the present state for a share of the whole step's. Local."""

    def start_elastic(self, on: bool) -> bool:
        """Whether points on the yield surface begin a step with their elastic tangent; False where there is
        no such choice."""
        return False

    def leave_out_boxes(self, on: bool) -> bool:
        """Whether points stand for themselves alone from now on; False where they do anyway."""
        return False

    def flow_in_boxes(self, on: bool) -> bool:
        """Whether the boxes of points that flow in this step count as of points that have flowed; False where
        they are few, and stay as they are. Collective."""
        return False

    def positions(self) -> np.ndarray:
        """Current positions (nodes, d) (m)."""
        x: np.ndarray = self.nodes.position + self.x[:, : self.layout.dim]
        return x

    def is_large(self) -> bool:
        """Whether `solver="auto"` takes multigrid. Collective."""
        position = self.nodes.position[: self.nodes.owned]
        ends = np.stack([position.max(axis=0, initial=-np.inf), -position.min(axis=0, initial=np.inf)])
        reduce_in_place(self.comm, ends, MPI.MAX)
        return self._is_large(float((ends.sum(axis=0) / self.length).max()))

    def _is_large(self, cells: float) -> bool:
        """The same of a body so many cells long."""
        layer, unknowns = self.nodes.total / (1.0 + cells), self.nodes.total * self.layout.block
        return is_large(self.layout.dim, layer, self.comm.size, self.on_lattice, unknowns)

    def weak_nodes(self) -> np.ndarray:
        """Owned nodes at which there is hardly any of the body, bool. Collective."""
        return np.zeros(self.nodes.owned, dtype=bool)

    def near_null_space(self) -> NearNullSpace:
        """What the tangent hardly resists, of the body as it is now. Collective."""
        from ..solvers.rigidmotions import rigid_motions  # lazy import: small problems need no multigrid

        own, d = slice(0, self.nodes.owned), self.layout.dim
        motions = rigid_motions(self.positions()[own], self.x[own, d:], self.comm)
        motions = np.where(self.prescribed.free[own], motions, 0.0)
        return NearNullSpace(motions, self.weak_nodes(), self.as_force)

    # terms ------------------------------------------------------------------------------------------
    def term_forces(self) -> np.ndarray:
        """Residual forces (nodes, block) of the terms, complete on owned rows; external ones go into
        `external`, too. Collective."""
        forces = self.terms.forces(self.x, lambda piece: not piece.external)
        self.nodes.add_to_owners(forces)
        before = self.external
        self.external = self.with_terms(before)
        residual: np.ndarray = forces + (before - self.external)
        return residual

    def with_terms(self, loads: np.ndarray) -> np.ndarray:
        """Loads (nodes, block) and those of the terms. Collective."""
        if not self.terms.external:
            return loads
        of_terms = self.terms.forces(self.x, lambda piece: piece.external)
        self.nodes.add_to_owners(of_terms)
        with_them: np.ndarray = loads - of_terms
        return with_them

    def lifted_by_terms(self, lift: np.ndarray) -> np.ndarray:
        """Tangents of the terms times a lift (nodes, block), on this rank."""
        return self.terms.products(self.x, lift)

    def slope_forces(self) -> dict[int, np.ndarray]:
        """By number of a support: forces (nodes, block) on the body with which it holds slopes by other means
        than ties, complete on owned rows. Collective."""
        return {}

    def initial_energy(self, x: np.ndarray) -> float:
        """Energy (J) of initial stresses at increments (nodes, block), on this rank."""
        return 0.0

    def viscous_forces(self) -> np.ndarray:
        """Forces (nodes, block) of the viscosity, complete on owned rows. Collective."""
        return np.zeros_like(self.x)

    def holding_energy(self, x: np.ndarray) -> float:
        """Energy (J) that holds points to patches at increments (nodes, block), on this rank."""
        return 0.0

    def imbalance(self) -> np.ndarray:
        """Internal minus external forces (nodes, block) at free unknowns, complete on owned rows, but for
        terms that a reset doesn't carry along or that have just been added. Collective."""

        def apart(piece: Piece) -> bool:
            return piece.fresh or not piece.carried

        forces = self.assemble(False).forces
        if any(apart(piece) for piece in self.terms.pieces):
            left_out = self.terms.forces(self.x, apart)
            self.nodes.add_to_owners(left_out)
            forces = forces - left_out
        return self.on_free(forces)

    def on_free(self, forces: np.ndarray) -> np.ndarray:
        """Forces (nodes, block), complete on owned rows, on the free unknowns, where those also act that are
        on unknowns which follow them; zero at the others. Collective."""
        ties = self.prescribed.ties
        if ties is not None:
            return ties.fold(forces)
        free: np.ndarray = np.where(self.prescribed.fixed, 0.0, forces)
        return free

    def forget_rotations(self) -> None:
        """Rotation increments count from the present rotations on: set them to zero. The equilibrium stays,
        as terms' forces that depended on the increments are carried along. Collective."""
        before, self.x = self.x, self.x.copy()
        self.x[:, self.layout.dim :] = 0.0
        if len(self.terms):

            def own(piece: Piece) -> bool:
                return piece.carried and not piece.external

            lost = self.terms.forces(before, own) - self.terms.forces(self.x, own)
            self.nodes.add_to_owners(lost)
            self.carried = self.carried - self.on_free(lost)

    # solvers.newton.System --------------------------------------------------------------------------
    def set_prescribed(self, increments: np.ndarray) -> None:
        """Begin a step: targets of the prescribed unknowns, increments (nodes, block) since the reset.
        Collective."""
        self.before = self.x
        self.step = StepState(np.where(self.prescribed.fixed, increments - self.x, 0.0))
        self._find_pending()

    def _find_pending(self) -> None:
        self.step.pending = bool(reduced(self.comm, bool(self.step.lift.any()), MPI.LOR))

    def pending(self) -> bool:
        return self.step.pending

    def waits(self) -> bool:
        return False

    def evaluate(self, tangent: bool) -> None:
        s = self.step
        self.terms.check_admitted(self.x)
        with self.timer("assembly"):
            sums = self.assemble(tangent, s.lift if tangent and s.pending else None)
            self.residual, s.lifted = sums.forces - self.carried, sums.lifted
            if tangent:
                s.condensed = self.terms.condensed(self.x)
                if s.condensed is not None and s.lifted is not None:
                    s.lifted = s.lifted - s.condensed.product(s.lift)
            s.initial = self.residual if s.initial is None else s.initial
            if tangent and s.rounding is None:  # at the start: iterates that run away must not set it
                diagonal = self.diagonal()
                sizes = self.sizes if self.sizes.ndim == 1 else self.sizes[: len(diagonal)]
                s.rounding = rounding.squares(diagonal, sizes, self.mean_size, self.comm)

    def convergence_measures(self) -> tuple[float, float]:
        last, prescribed, sums, balance = self.step.correction, self.prescribed, np.empty(5), None
        if prescribed.ties is not None:
            with np.errstate(over="ignore", invalid="ignore"):  # divergence shows in the measures
                balance = self.on_free(self.residual)
        # |f_ext + f_rct|: at supports the reaction makes it the internal force
        sizes, external = (self.layout.block, self.layout.dim), np.ascontiguousarray(self.external)
        forces = self.residual, balance, prescribed.fixed.view(np.uint8), external
        measure = native.library().polarmpm_measures
        measure(self.nodes.owned, *sizes, *forces, last, self.x, self.as_force, sums)
        sums[2] = abs(sums[2])
        reduce_in_place(self.comm, sums[:4])
        first, second, work, done, most = sums.tolist()
        out, loads = math.sqrt(first), math.sqrt(second)
        level = rounding.level(self.step.rounding, reduced(self.comm, most, MPI.MAX))
        # before the first correction loads as small as rounding still count
        if (last is not None or loads == 0.0) and out <= level:
            return 0.0, 0.0
        force = out / loads if loads > 0 else math.inf
        energy = work / abs(done) if done != 0 else math.inf
        return force, energy

    def update(self, fresh: bool, accuracy: float = ACCURACY) -> None:
        fixed, s = self.prescribed.fixed, self.step
        s.solutions += 1
        out_of_balance = self.residual if s.lifted is None else self.residual + s.lifted
        step = self.solve_free(-out_of_balance, fresh, accuracy)
        s.origin = None if s.pending else (self.x, self.residual, s.projected)
        if s.pending:
            step[fixed] = s.lift[fixed]
        self.add(step)
        if s.pending:  # a large prescribed motion is no correction, from which to predict stresses
            self.before = self.x
            s.lift, s.lifted, s.pending = np.zeros_like(s.lift), None, False

    def solve_free(self, forces: np.ndarray, fresh: bool, accuracy: float = ACCURACY) -> np.ndarray:
        """Increments (nodes, block) by which forces, complete on owned rows, move the nodes with the last
        tangent; prescribed unknowns stay. Collective."""
        step = self.solve_alone(forces, fresh, accuracy)
        if self.step.condensed is None:
            return step
        return self.step.condensed.completed(step, lambda right: self.solve_alone(right, False, accuracy))

    def solve_alone(self, forces: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        """The same with the nodes' own tangent."""
        prescribed, own = self.prescribed, self.nodes.owned
        step = np.zeros_like(self.x)
        step[:own] = self.solve(self.on_free(forces)[:own], fresh, accuracy)
        self.complete(step)
        step[prescribed.fixed] = 0.0
        return step

    def complete(self, step: np.ndarray) -> None:
        """Complete a motion (nodes, block), known at free unknowns of owned nodes, at ghosts and at unknowns
        that follow others. Collective."""
        self.nodes.update_ghosts(step)
        if self.prescribed.ties is not None:
            self.prescribed.ties.follow(step)

    def add(self, step: np.ndarray) -> None:
        """Add a correction (nodes, block) to the unknowns."""
        self.before, self.x = self.x, self.x + step
        self.step.correction = self.step.direction = step

    def slope(self, start: bool = False) -> float | None:
        s, own = self.step, slice(0, self.nodes.owned)
        if s.origin is None or s.direction is None or not self.plastic:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            forces = self.on_free(s.origin[1] if start else self.residual)
            work = float(np.sum(forces[own] * s.direction[own]))
        total: float = self.comm.allreduce(work)
        return total

    def take(self, share: float) -> None:
        s = self.step
        assert s.origin is not None
        assert s.direction is not None
        self.before, _, s.projected = s.origin
        s.correction = share * s.direction
        self.x = self.before + s.correction

    def jump(self, x: np.ndarray) -> None:
        """Put in nodal increments (nodes, block) that no correction has led to."""
        self.before = self.x = x
        self.step.projected = None

    def backtrack(self) -> bool:
        s = self.step
        if s.correction is None:
            return False
        s.correction = s.direction = 0.5 * s.correction
        self.x = self.x - s.correction
        s.lift = s.lift + np.where(self.prescribed.fixed, s.correction, 0.0)
        self._find_pending()
        return True
