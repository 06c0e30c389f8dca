"""What every nonlinear system of nodal increments shares, however it is assembled."""

from __future__ import annotations

import math

from mpi4py import MPI

import numpy as np

from ..conditions.prescribed import Prescribed
from ..geometry.nodes import Nodes
from ..kinematics.layout import Layout
from ..solvers.choice import is_large
from ..solvers.direct import ACCURACY
from ..tools.timing import Timer

_ROUNDING = 16 * float(np.finfo(float).eps)


class NodalSystem:
    """Implements `newton.System` but for the assembly and the linear solution.

    Attributes:
        x: nodal increments since the reset (nodes, block), ghosts included.
        before: what they were before the last correction; at the start of a step, and where prescribed values
            have just been put in, the same.
        external: forces on the nodes, complete on owned rows.
        residual: internal minus external and carried forces of the last evaluation; complete on owned rows.
        first: the residual as it was when the step began.
        carried: forces on the nodes that stand for what the basis could not balance at the last reset.
        length: size of a cell (m) in each direction, which tells what a displacement means as a strain.
    """

    def __init__(
        self,
        nodes: Nodes,
        layout: Layout,
        prescribed: Prescribed,
        length: np.ndarray,
        comm: MPI.Comm,
        timer: Timer,
    ):
        self.nodes, self.layout, self.prescribed = nodes, layout, prescribed
        self.length, self.comm, self.timer = length, comm, timer
        shape = (len(nodes), layout.block)
        self.x: np.ndarray = np.zeros(shape)
        self.before: np.ndarray = self.x
        self._last: np.ndarray = np.zeros(shape)
        self.residual: np.ndarray = np.zeros(shape)
        self.first: np.ndarray = self.residual
        self._begun = False
        self.external: np.ndarray = np.zeros(shape)
        self.carried: np.ndarray = np.zeros(shape)
        self._lift: np.ndarray = np.zeros(shape)
        self._lift_forces: np.ndarray = np.zeros(shape)
        self._pending = self._moved = False
        self._rounding: np.ndarray | None = None
        # a couple counts as a force at the distance of a cell, so that measures don't depend on units
        self._cell = float(np.prod(length)) ** (1.0 / len(length))
        self._as_force = np.array([1.0] * layout.dim + [1.0 / self._cell] * layout.rotations)

    @property
    def dim(self) -> int:
        """Space dimension: so many components of a node's unknowns are displacements."""
        return self.layout.dim

    @property
    def owned(self) -> int:
        """Number of nodes that this rank owns."""
        return self.nodes.owned

    # what an assembly provides --------------------------------------------------------------------
    def assemble(self, tangent: bool) -> np.ndarray:
        """Internal minus external forces (nodes, block), complete on owned rows; with `tangent` also the
        matrix and, where prescribed values are pending, their forces `_lift_forces`. Collective."""
        raise NotImplementedError

    def put_external(self, forces: np.ndarray) -> None:
        """Take dead forces on the nodes (nodes, block), complete on owned rows, for all loads."""
        raise NotImplementedError

    def diagonal(self) -> np.ndarray:
        """Diagonal of the tangent (owned nodes, block)."""
        raise NotImplementedError

    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        """Solve with the tangent for (owned nodes, block); `fresh`: it has no factor yet; `accuracy`:
        relative residual that an iterative solver may leave. Collective."""
        raise NotImplementedError

    def destroy(self) -> None:
        """Release PETSc's objects."""
        raise NotImplementedError

    def start_elastic(self, on: bool) -> bool:
        """Whether points on the yield surface begin a step with their elastic tangent; False where there is
        no such choice."""
        return False

    def positions(self) -> np.ndarray:
        """Current positions (nodes, d) (m)."""
        return self.nodes.position + self.x[:, : self.layout.dim]

    def is_large(self) -> bool:
        """Whether `solver="auto"` takes multigrid. Collective."""
        position = self.nodes.position[: self.nodes.owned]
        ends = np.stack([position.max(axis=0, initial=-np.inf), -position.min(axis=0, initial=np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        layers = 1.0 + float((ends.sum(axis=0) / self.length).max())
        return is_large(self.layout.dim, self.nodes.total / layers, self.comm.size)

    def weak_nodes(self) -> np.ndarray:
        """Owned nodes at which there is hardly any of the body, bool. Collective."""
        return np.zeros(self.nodes.owned, dtype=bool)

    def solver_hints(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a multigrid solver wants to know: rigid motions of the body as it is now (k, owned nodes,
        block), zero at prescribed unknowns; the weak nodes; by which factors (block,) the residual's
        components count as forces. Collective."""
        from ..solvers.multigrid import rigid_motions  # small problems don't know of it

        own, d = slice(0, self.nodes.owned), self.layout.dim
        motions = rigid_motions(self.positions()[own], self.x[own, d:], self.comm)
        motions = np.where(self.prescribed.fixed[own], 0.0, motions)
        return motions, self.weak_nodes(), self._as_force

    def carry_imbalance(self) -> None:
        """Take the present state as an equilibrium: carry along what is out of balance in it. Collective."""
        free = ~self.prescribed.fixed
        self.carried = np.where(free, self.assemble(False), 0.0)

    # newton.System ----------------------------------------------------------------------------------
    def set_prescribed(self, increments: np.ndarray) -> None:
        """Target of the prescribed unknowns, as increments since the reset (nodes, block); begins a step.
        Collective."""
        self._rounding, self._begun, self._moved = None, True, False
        self.before = self.x
        self._lift = np.where(self.prescribed.fixed, increments - self.x, 0.0)
        self._pending = bool(self.comm.allreduce(bool(np.any(self._lift)), op=MPI.LOR))

    def pending(self) -> bool:
        return self._pending

    def evaluate(self, tangent: bool) -> None:
        with self.timer("assembly"):
            self.residual = self.assemble(tangent) - self.carried
            if self._begun:
                self.first, self._begun = self.residual, False
            if tangent and self._rounding is None:  # at the start: iterates that run away must not set it
                self._rounding = self._rounding_squares()

    def measures(self) -> tuple[float, float]:
        with np.errstate(over="ignore", invalid="ignore"):  # what diverges is told by the numbers
            return self._measures()

    def _measures(self) -> tuple[float, float]:
        own = slice(0, self.nodes.owned)
        free = ~self.prescribed.fixed[own]
        r, external = self.residual[own], self.external[own]
        # |f_ext + f_rct|: at supports the reaction makes it the internal force
        total = np.where(free, external, r + external)
        sums = np.array(
            [
                np.sum((r * free * self._as_force) ** 2),
                np.sum((total * self._as_force) ** 2),
                abs(np.sum((r * free) * self._last[own])),
                np.sum(total * self.x[own]),
            ]
        )
        self.comm.Allreduce(MPI.IN_PLACE, sums)
        out, loads = np.sqrt(sums[:2])
        # before the first correction loads as small as rounding are still to be felt
        if (self._moved or loads == 0.0) and out <= self._rounding_level():
            return 0.0, 0.0
        force = out / loads if loads > 0 else np.inf
        energy = sums[2] / abs(sums[3]) if sums[3] != 0 else np.inf
        return float(force), float(energy)

    def _rounding_squares(self) -> np.ndarray:
        """Squares of the out-of-balance forces (N) that a relative rounding of strains makes, and of those
        that one of rotations of a radian makes beside. Collective.

        Strains and rotations are rounded by so much of one, which the tangent's diagonal turns into forces: a
        rotation is a strain, and a displacement one over a cell. Not so where bending stiffness is large: a
        change of the wryness is rounded by so much of itself, and is as small as the rotations are.
        """
        diagonal, d = np.abs(self.diagonal()), self.layout.dim
        forces = diagonal[:, :d] * self.length
        couples = diagonal[:, d:] / self._cell
        strains = np.minimum(couples, forces.mean(axis=1, keepdims=True))
        squares = np.array([np.sum(forces**2) + np.sum(strains**2), np.sum(couples**2)])
        return _ROUNDING**2 * np.asarray(self.comm.allreduce(squares))

    def _rounding_level(self) -> float:
        """Out-of-balance force (N) that rounding makes at the present increments; loads so small that their
        strains are near rounding can't be balanced more closely than this. Collective.
        """
        if self._rounding is None:
            return 0.0
        turned = 0.0
        if self.layout.rotations:
            most = float(np.abs(self.x[:, self.layout.dim :]).max(initial=0.0))
            turned = min(1.0, self.comm.allreduce(most, op=MPI.MAX))
        return math.sqrt(self._rounding[0] + turned**2 * self._rounding[1])

    def advance(self, fresh: bool, accuracy: float = ACCURACY) -> None:
        fixed = self.prescribed.fixed
        step = self.solve_free(-(self.residual + self._lift_forces), fresh, accuracy)
        if self._pending:
            step[fixed] = self._lift[fixed]
        self.add(step)
        if self._pending:  # a large prescribed motion is no correction, from which to predict stresses
            self.before = self.x
        self._pending = False
        self._lift[:] = 0.0
        self._lift_forces[:] = 0.0

    def solve_free(self, forces: np.ndarray, fresh: bool, accuracy: float = ACCURACY) -> np.ndarray:
        """What forces (nodes, block), complete on owned rows, move with the last tangent; prescribed
        unknowns stay. Collective."""
        fixed, own = self.prescribed.fixed, self.nodes.owned
        step = np.zeros_like(self.x)
        step[:own] = self.solve(np.where(fixed[:own], 0.0, forces[:own]), fresh, accuracy)
        self.nodes.update_ghosts(step)
        step[fixed] = 0.0
        return step

    def add(self, step: np.ndarray) -> None:
        """Add a correction (nodes, block) to the unknowns."""
        self.before, self.x = self.x, self.x + step
        self._last, self._moved = step, True

    def jump(self, x: np.ndarray) -> None:
        """Put in nodal increments (nodes, block) that no correction has led to."""
        self.before = self.x = x

    def retreat(self) -> bool:
        if not self._moved:
            return False
        self._last = 0.5 * self._last
        self.x = self.x - self._last
        self._lift = self._lift + np.where(self.prescribed.fixed, self._last, 0.0)
        self._pending = bool(self.comm.allreduce(bool(np.any(self._lift)), op=MPI.LOR))
        return True
