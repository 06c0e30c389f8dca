"""What supports do to the body, and the balance of all forces and moments."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.system import NodalSystem
from ..conditions.supports import Support
from ..geometry.nodes import Nodes
from ..kinematics import rotations
from ..kinematics.moments import moments
from ..terms.obstacles import Obstacle
from ..terms.surfaces import SurfaceSupport
from ..tools.checks import refuse, vector


def _shown(values: np.ndarray) -> str:
    """Components on one line."""
    return "(" + ", ".join(f"{v:.6g}" for v in values) + ")"


class Reaction(tuple[np.ndarray, np.ndarray]):
    """What a support does to the body; unpacks into force and couple.

    Attributes:
        force: (N), shape (d,).
        couple: sum of the nodes' couples (N m), shape (r,).
        moment: of forces and couples about a point in the current configuration (N m), shape (1,) in the
            plane and (3,) in space.
        about: that point (m), (d,).
        shared: by name of supports that were given earlier and hold some of the same unknowns: the force (N),
            (d,), at those, which the earlier support's reaction states and this one doesn't.
    """

    moment: np.ndarray
    about: np.ndarray
    shared: dict[str, np.ndarray]

    def __new__(
        cls,
        force: np.ndarray,
        couple: np.ndarray,
        moment: np.ndarray,
        about: np.ndarray,
        shared: dict[str, np.ndarray] | None = None,
    ) -> Reaction:
        made = super().__new__(cls, (force, couple))
        made.moment, made.about, made.shared = moment, about, shared or {}
        return made

    def __getnewargs__(self) -> tuple[Any, ...]:  # for pickle
        return self.force, self.couple, self.moment, self.about, self.shared

    @property
    def force(self) -> np.ndarray:
        return self[0]

    @property
    def couple(self) -> np.ndarray:
        return self[1]

    def torque(self, axis: Any = None) -> float:
        """The moment (N m) about an axis through `about`, in space of a direction (3,); in the plane there is
        one axis.

        Raises:
            InputError: no direction, in space; or one in the plane.
        """
        if len(self.moment) == 1:
            if axis is not None:
                raise refuse("axis", axis, "in the plane there is one axis; None is needed")
            return float(self.moment[0])
        direction = vector("axis", axis, 3, "the direction of an axis")
        length = float(np.linalg.norm(direction))
        if not length > 0:
            raise refuse("axis", axis, "a direction isn't zero")
        return float(self.moment @ (direction / length))

    def as_dict(self) -> dict[str, np.ndarray]:
        """Columns of a table."""
        return {"force": self.force, "couple": self.couple, "moment": self.moment}

    def __repr__(self) -> str:
        also = "".join(f", shared with {name}: {_shown(f)} N" for name, f in self.shared.items())
        couple = f"couple={_shown(self.couple)} N m, " if len(self.couple) else ""
        moment = f"moment={_shown(self.moment)} N m about {_shown(self.about)} m"
        return f"Reaction(force={_shown(self.force)} N, {couple}{moment}{also})"


@dataclass(frozen=True)
class Share:
    """Part of a balance: force (N) (d,) and moment (N m) (1,) or (3,), couples included."""

    name: str
    force: np.ndarray
    moment: np.ndarray

    def __repr__(self) -> str:
        return f"Share({self.name!r}, force={_shown(self.force)} N, moment={_shown(self.moment)} N m)"


@dataclass(frozen=True)
class Balance:
    """Loads and reactions of the last converged step.

    Attributes:
        about: the point of the moments (m), (d,).
        parts: loads, terms and supports, each with its force and moment on the body.
        carried: dead forces on nodes that balanced resets carry along. They are no load, and closed by forces
            on prescribed unknowns: where there are such, they have neither a sum nor a moment.
        force, moment: sum of the parts (N, N m); zero in balance. Of a body of revolution along the axis
            only: what is across it balances over a turn.
        residue: the sizes of these two, relative to the largest force of a part, and to it times the size of
            the body (or the largest moment, where that is more).
    """

    about: np.ndarray
    parts: tuple[Share, ...]
    carried: Share
    force: np.ndarray
    moment: np.ndarray
    residue: tuple[float, float]

    def as_dict(self) -> dict[str, Any]:
        """Columns of a table."""
        names = {"force": self.residue[0], "moment": self.residue[1]}
        return {"residue": names, "force": self.force, "moment": self.moment}

    def __repr__(self) -> str:
        parts = ", ".join(part.name for part in self.parts)
        force, moment = self.residue
        return (
            f"Balance({len(self.parts)} parts: {parts}; sum {_shown(self.force)} N and {_shown(self.moment)} "
            f"N m about {_shown(self.about)} m, {force:.1e} and {moment:.1e} of the load)"
        )

    def __str__(self) -> str:
        d, m = len(self.force), len(self.moment)
        heads = [f"force {a}" for a in "xyz"[:d]] + (["moment"] if m == 1 else [f"moment {a}" for a in "xyz"])
        rows = [*self.parts, Share("sum", self.force, self.moment)]
        if np.any(self.carried.force) or np.any(self.carried.moment):
            rows.append(Share("(carried by the nodes)", self.carried.force, self.carried.moment))
        width = max(len(row.name) for row in rows)
        about = ", ".join(f"{a:g}" for a in self.about)
        lines = [" " * width + "".join(f"{h:>14}" for h in heads)]
        lines += [
            f"{row.name:<{width}}" + "".join(f"{v:14.6g}" for v in (*row.force, *row.moment)) for row in rows
        ]
        lines.append(
            f"moments about ({about}); relative to the load the sum is {self.residue[0]:.1e} (force) and "
            f"{self.residue[1]:.1e} (moment)"
        )
        return "\n".join(lines)


_ROWS = ("residual", "w", "position", "loads", "carried")


@dataclass
class Equilibrium:
    """The last converged state, as far as reactions and balance need it. Arrays are (nodes, ...), the rows of
    owned nodes first.

    Attributes:
        supports, masks: those that took part, and which nodes they hold (nodes,).
        owned: number of nodes that this rank owns.
        residual: internal minus external forces on prescribed unknowns, complete on owned rows; those of ties
            apart.
        tied: by number of a support: forces of its ties, complete on owned rows.
        w: rotation increments on which couples of the residual do work.
        position: current positions (m).
        loads, carried: spatial forces and couples of the loads, and carried ones, complete on owned rows.
        terms: each term, with its forces and couples on the body on this rank.
        nodes: of the system; None if the state was read from a file.
        points_moved: points have gone to other ranks since.
        inertia: spatial forces and couples of inertia and damping, complete on owned rows; None: there is
            none.
        axial: the body is one of revolution.
    """

    comm: MPI.Comm
    supports: tuple[Support, ...]
    masks: list[np.ndarray]
    owned: int
    residual: np.ndarray
    w: np.ndarray
    position: np.ndarray
    loads: np.ndarray
    carried: np.ndarray
    terms: list[tuple[str, np.ndarray]]
    tied: dict[int, np.ndarray]
    nodes: Nodes | None = None
    points_moved: bool = False
    inertia: np.ndarray | None = None
    axial: bool = False

    @classmethod
    def of(cls, system: NodalSystem) -> Equilibrium:
        """Of a system whose solution has just converged."""
        d, x = system.layout.dim, system.x
        terms: dict[int, tuple[str, np.ndarray]] = {}
        for piece in system.terms.pieces:
            name, forces = terms.get(id(piece.of), (piece.name, np.zeros_like(x)))
            terms[id(piece.of)] = name, forces - system.terms.forces(x, partial(operator.is_, piece))
        ties, residual = system.prescribed.ties, system.residual
        tied: dict[int, np.ndarray] = {}
        if ties is not None:
            residual, tied = ties.shares(residual)
        tied = {**tied, **system.slope_forces()}
        return cls(
            system.comm,
            system.prescribed.supports,
            system.prescribed.masks,
            system.nodes.owned,
            residual,
            x[:, d:].copy(),
            system.positions(),
            system.spatial_loads(),
            system.carried.copy(),
            list(terms.values()),
            tied,
            system.nodes,
            axial=system.layout.axial,
        )

    # files --------------------------------------------------------------------------------------------
    def saved(self) -> tuple[dict[str, list[str]], dict[str, np.ndarray]]:
        """For a restart file: names, and this rank's rows."""
        n, names = len(self.residual), {"supports": [s.name for s in self.supports]}
        rows = {name: getattr(self, name) for name in _ROWS}
        rows |= {} if self.inertia is None else {"inertia": self.inertia}
        rows["held"] = np.array(self.masks, dtype=np.uint8).reshape(-1, n).T
        rows["owned"] = (np.arange(n) < self.owned).astype(np.uint8)
        rows |= {f"term {k}": forces for k, (_, forces) in enumerate(self.terms)}
        rows |= {f"tied {k}": forces for k, forces in self.tied.items()}
        names["tied"] = [self.supports[k].name for k in self.tied]
        names |= {"symmetry": ["axial"] * self.axial}
        return names | {"terms": [name for name, _ in self.terms]}, rows

    @classmethod
    def read(
        cls,
        comm: MPI.Comm,
        supports: Sequence[Support],
        names: dict[str, list[str]],
        rows: dict[str, np.ndarray],
    ) -> Equilibrium | None:
        """From what `saved` gave, of which each rank may have other rows; None if a support is missing.

        Args:
            supports: all that the script has given.
        """
        known = {s.name: s for s in supports}
        if not set(names["supports"]) <= set(known):
            return None
        order = np.argsort(1 - rows["owned"].astype(int), kind="stable")
        rows = {name: a[order] for name, a in rows.items()}
        residual, w, position, loads, carried = (rows[name] for name in _ROWS)
        return cls(
            comm,
            tuple(known[name] for name in names["supports"]),
            [mask.astype(bool) for mask in rows["held"].T],
            int(rows["owned"].sum()),
            residual,
            w,
            position,
            loads,
            carried,
            [(name, rows[f"term {k}"]) for k, name in enumerate(names["terms"])],
            {k: rows[f"tied {k}"] for k in map(names["supports"].index, names.get("tied", []))},
            inertia=rows.get("inertia"),
            axial="axial" in names.get("symmetry", []),
        )

    # sums ---------------------------------------------------------------------------------------------
    def _spatial(self, forces: np.ndarray, rows: int) -> np.ndarray:
        """Forces and couples that do work on spins, of those that do it on increments, in the first rows."""
        d, out = self.position.shape[1], forces[:rows]
        if self.w.shape[1] == 3:  # what does work on Dw is J_r(Dw)^T times the couple
            out = np.hstack([out[:, :d], rotations.couples_on_spins(self.w[:rows], out[:, d:])])
        return out

    def _sums(self, spatial: np.ndarray) -> np.ndarray:
        """Force, couple and moment about the origin of spatial forces at the first nodes, on this rank."""
        d = self.position.shape[1]
        moment = moments(self.position[: len(spatial)], spatial[:, :d], spatial[:, d:])
        return np.concatenate([spatial.sum(axis=0), moment.sum(axis=0)])

    def _split(self, sums: np.ndarray, about: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force, couple, and moment about a point, of their sums over all ranks."""
        d = self.position.shape[1]
        m = 1 if d == 2 else 3
        force, couple, moment = sums[:d], sums[d:-m], sums[-m:]
        none = np.zeros((1, 0))
        return force, couple, moment - moments(about[None], force[None], none)[0]

    def _held(self, support: Support) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Forces (owned, block) at the unknowns of a support that no earlier one holds, and those at the
        others by the earlier one's name."""
        own, at = self.owned, self.supports.index(support)
        first = np.full(self.residual[:own].shape, -1)
        for number, one in enumerate(self.supports[: at + 1]):
            for column in one.columns:
                rows = self.masks[number][:own] & (first[:, column] < 0)
                first[rows, column] = number
        meant = np.zeros(first.shape, dtype=bool)
        for column in support.columns:
            meant[:, column] = self.masks[at][:own]
        forces = np.where(meant & (first == at), self.residual[:own], 0.0)
        if at in self.tied:
            forces = forces + self.tied[at][:own]
        comm, others = self.comm, {}
        for number, one in enumerate(self.supports[:at]):
            rows = meant & (first == number)
            if comm.allreduce(bool(np.any(rows)), op=MPI.LOR):
                others[one.name] = np.where(rows, self.residual[:own], 0.0)
        return forces, others

    def reaction(self, support: Support, about: np.ndarray) -> Reaction:
        """Reaction of a support that took part in the step. Collective."""
        forces, others = self._held(support)
        own, comm, d = self.owned, self.comm, self.position.shape[1]
        sums = comm.allreduce(self._sums(self._spatial(forces, own)))
        shared = {name: comm.allreduce(f.sum(axis=0))[:d] for name, f in others.items()}
        return Reaction(*self._split(sums, about), about, shared)

    def free_residual(self, support: Support, still: Sequence[Support]) -> np.ndarray:
        """Residual (nodes, block) at a support's unknowns that no other one of `still` holds."""
        at = self.supports.index(support)
        out, mask = np.zeros_like(self.residual), self.masks[at]
        for column in support.columns:
            rows = mask.copy()
            for number, one in enumerate(self.supports):
                if one is not support and one in still and column in one.columns:
                    rows &= ~self.masks[number]
            out[rows, column] = self.residual[rows, column]
        return out + self.tied[at] if at in self.tied else out

    # balance ------------------------------------------------------------------------------------------
    def _shares(self) -> Iterator[tuple[str, np.ndarray]]:
        own = self.owned
        yield "loads", self._sums(self.loads[:own])
        if self.inertia is not None:
            yield "inertia", self._sums(self.inertia[:own])
        for name, forces in self.terms:
            yield name, self._sums(self._spatial(forces, len(forces)))
        for support in self.supports:
            yield support.name, self._sums(self._spatial(self._held(support)[0], own))
        yield "carried", self._sums(self._spatial(self.carried, own))

    def balance(self, about: np.ndarray) -> Balance:
        """Collective."""
        comm, d = self.comm, self.position.shape[1]
        found = list(self._shares())
        sums = comm.allreduce(np.array([s for _, s in found]))
        split = [self._split(row, about) for row in sums]
        shares = [Share(name, f, m) for (name, _), (f, _, m) in zip(found, split, strict=True)]
        parts, carried = [s for s in shares[:-1] if s.name != "loads" or self._loaded()], shares[-1]
        force = sum((s.force for s in parts), np.zeros(d))
        moment = sum((s.moment for s in parts), np.zeros_like(carried.moment))
        if self.axial:
            force, moment = force * np.array([0.0, 1.0]), np.zeros_like(moment)
        length, own = self._length(), self.owned
        of_nodes = comm.allreduce(
            float(np.abs(self.residual[:own, :d]).sum() + np.abs(self.loads[:own]).sum())
        )
        largest = max((float(np.linalg.norm(s.force)) for s in parts), default=0.0)
        scale = largest if largest > 1e-9 * of_nodes else of_nodes
        turning = max([scale * length, *(float(np.linalg.norm(s.moment)) for s in parts)])
        residue = tuple(
            float(np.linalg.norm(v)) / s if s else 0.0 for v, s in ((force, scale), (moment, turning))
        )
        return Balance(about, tuple(parts), carried, force, moment, (residue[0], residue[1]))

    def _length(self) -> float:
        """Diagonal (m) of the box around all nodes. Collective."""
        here = self.position[: self.owned]
        ends = np.stack([here.max(axis=0, initial=-np.inf), -here.min(axis=0, initial=np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        return float(np.linalg.norm(ends.sum(axis=0)))

    def _loaded(self) -> bool:
        return bool(self.comm.allreduce(bool(np.any(self.loads)), op=MPI.LOR))


def point_about(about: Any, dim: int) -> np.ndarray:
    """The point about which moments are taken (d,); default: the origin.

    Raises:
        InputError: not so many finite coordinates.
    """
    if about is None:
        return np.zeros(dim)
    return vector("about", about, dim, f"{dim} finite coordinates")


def surface_reaction(support: SurfaceSupport | Obstacle, about: np.ndarray) -> Reaction:
    """Reaction of springs on a surface, or of an obstacle, which have taken part in a step."""
    assert support.reaction is not None
    assert support.moment is not None
    force, couple = support.reaction
    at = moments(about[None], force[None], np.zeros((1, 0)))[0]
    return Reaction(force, couple, support.moment - at, about)
