"""Material points: the state of the body, rank-local, with permanent ids.

Shapes: scalar (np,), vector (np, d), tensor (np, 3, 3), quaternion (np, 4), np points of this rank and d
the space dimension. Tensors have three rows and columns in plane strain too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..kinematics import rotations
from ..kinematics.stretch import domain_half_length, right_stretch
from ..materials.base import Material, check_material
from ..tools.meetings import collective
from ..tools.parallel import Route, errors_on_all_ranks

# name -> (shape after the point axis; "d" is the space dimension, type)
FIELDS: dict[str, tuple[tuple[int | str, ...], type]] = {
    "id": ((), np.int64),
    "material": ((), np.int32),
    "X": (("d",), float),
    "x": (("d",), float),
    "F": ((3, 3), float),
    "q": ((4,), float),
    "wryness": ((3, 3), float),
    "volume0": ((), float),
    "half_length0": (("d",), float),
    "half_axes0": (("d", "d"), float),
    "unresolved": ((), float),
}

# what bodies with plastic materials have beside it
PLASTIC_FIELDS: dict[str, tuple[tuple[int | str, ...], type]] = {
    "plastic_F": ((3, 3), float),
    "plastic_wryness": ((3, 3), float),
    "hardening": ((), float),
    "dissipation": ((), float),
}


@dataclass(frozen=True, eq=False)
class Selection:
    """A set of points by permanent ids (the same on every rank).

    Attributes:
        ids: whole numbers, ascending, each once.
        body: fingerprint of the body from whose points it was made; None: ids given by hand.

    Raises:
        InputError: ids that aren't so.
    """

    ids: np.ndarray
    body: int | None = None
    alike: ClassVar = ("ids", "body")  # on all ranks

    def __post_init__(self) -> None:
        ids = np.asarray(self.ids)
        if ids.ndim != 1 or (len(ids) and ids.dtype.kind not in "iu"):
            raise InputError(
                f"Selection: ids of shape {ids.shape} and type {ids.dtype}; a list of ids is needed"
            )
        if np.any(ids[1:] <= ids[:-1]):
            raise InputError("Selection: ids are to be in ascending order, each once: np.unique(ids)")
        object.__setattr__(self, "ids", ids.astype(np.int64))

    def __len__(self) -> int:
        return len(self.ids)


class Points:
    """Material points of one body.

    Attributes:
        id: permanent ids; of points seeded on the lattice the same for any number of ranks.
        material: row of `materials`.
        X, x: initial and current position (m), vector.
        F: deformation gradient, tensor.
        q: microrotation, unit quaternion, T (3.166).
        wryness: Gamma (1/m), tensor.
        volume0: reference volume (m^3; m^2 per unit thickness in plane strain).
        half_length0: initial half-lengths of the domains (m), vector.
        half_axes0: initial half axes of the points' boxes (m), (np, d, d), one a row: the second moment of
            what a point stands for is the sum of their squares, a^T a, over 3. Zero: of a point alone.
        unresolved: share of the last step's work that is done inside the point's box, scalar: what neither
            the grid nor the points resolve.
        materials: the materials that `material` counts.
        plastic_F, plastic_wryness: Fp of F = Fe Fp and Gp (1/m) of Gamma = Ge + Gp (T 4.1), tensors; like the
            following two only in bodies with plastic materials.
        hardening: accumulated plastic strain chi, scalar.
        dissipation: plastic dissipation per reference volume so far (Pa), scalar.
    """

    id: np.ndarray
    material: np.ndarray
    X: np.ndarray
    x: np.ndarray
    F: np.ndarray
    q: np.ndarray
    wryness: np.ndarray
    volume0: np.ndarray
    half_length0: np.ndarray
    half_axes0: np.ndarray
    unresolved: np.ndarray
    plastic_F: np.ndarray
    plastic_wryness: np.ndarray
    hardening: np.ndarray
    dissipation: np.ndarray

    @collective("Points", comm=lambda self, x, volume, half_length, material, comm, *args, **options: comm)
    def __init__(
        self,
        x: np.ndarray,
        volume: np.ndarray,
        half_length: np.ndarray,
        material: Material,
        comm: MPI.Comm,
        first_id: int = 0,
        half_axes: np.ndarray | None = None,
    ):
        """Unloaded points at x (n, d) (m) with volumes (n,), domain half-lengths (n, d) and half axes
        (n, d, d) of their boxes, by default along the grid; collective."""
        self.comm, self.dim, n = comm, x.shape[1], len(x)
        self.materials: tuple[Material, ...] = (check_material(material),)
        before = comm.exscan(n) or 0
        self.id = first_id + before + np.arange(n, dtype=np.int64)
        self.material = np.zeros(n, dtype=np.int32)
        self.X, self.x = x.copy(), x.copy()
        self.F = np.tile(np.eye(3), (n, 1, 1))
        self.q = rotations.identity(n)
        self.wryness = np.zeros((n, 3, 3))
        self.volume0, self.half_length0 = volume.copy(), half_length.copy()
        along = half_length[:, None, :] * np.eye(self.dim)
        self.half_axes0 = along if half_axes is None else half_axes.copy()
        self.unresolved = np.zeros(n)
        self._has_plastic_state = False
        self._fingerprints: tuple[int, ...] = ()  # the present one, then those before other points joined
        self._add_plastic_state()

    def __len__(self) -> int:
        """Number of points of this rank."""
        return len(self.id)

    @property
    @collective("total")
    def total(self) -> int:
        """Number of points of all ranks. Collective."""
        total: int = self.comm.allreduce(len(self))
        return total

    # state --------------------------------------------------------------------------------------
    @property
    def displacement(self) -> np.ndarray:
        """x - X (m), vector."""
        u: np.ndarray = self.x - self.X
        return u

    @property
    def rotation_vector(self) -> np.ndarray:
        """Microrotation vector (rad), (np, 3); for output only, T (3.171)."""
        return rotations.to_vector(self.q)

    @property
    def volume(self) -> np.ndarray:
        """Current volume V0 J (m^3), scalar."""
        volume: np.ndarray = self.volume0 * rotations.determinant(self.F)
        return volume

    @property
    def stretch(self) -> np.ndarray:
        """Right stretch tensor U = sqrt(F^T F), tensor."""
        return right_stretch(self.F)

    @property
    def half_length(self) -> np.ndarray:
        """Current half-lengths of the domains l_i = U_ii l_i0 (m), T (2.56)-(2.58), vector."""
        return domain_half_length(self.F, self.half_length0)

    @property
    def plastic(self) -> bool:
        """Whether one of the materials can yield."""
        return any(m.plastic for m in self.materials)

    @property
    def fields(self) -> dict[str, tuple[tuple[int | str, ...], type]]:
        """Names of the state's arrays, with their shapes after the point axis and types."""
        return {**FIELDS, **PLASTIC_FIELDS} if self.plastic else FIELDS

    def plastic_state(self, rows: np.ndarray) -> tuple[np.ndarray, ...]:
        """Fp, Gp and chi of some points; nothing in an elastic body."""
        if not self.plastic:
            return ()
        return self.plastic_F[rows], self.plastic_wryness[rows], self.hardening[rows]

    def put_materials(self, materials: tuple[Material, ...], rows: np.ndarray) -> None:
        """Give the local points the materials of these rows (np,)."""
        self.materials, self.material = materials, rows.astype(np.int32)
        self._add_plastic_state()

    def _add_plastic_state(self) -> None:
        """Arrays of plastic materials, where they are needed and missing."""
        if self.plastic and not self._has_plastic_state:
            n, self._has_plastic_state = len(self), True
            self.plastic_F = np.tile(np.eye(3), (n, 1, 1))
            self.plastic_wryness = np.zeros((n, 3, 3))
            self.hardening, self.dissipation = np.zeros(n), np.zeros(n)

    def arrays(self) -> dict[str, np.ndarray]:
        """All state by name, for output and restart; the arrays themselves, not copies."""
        return {name: getattr(self, name) for name in self.fields}

    def replace(self, arrays: dict[str, np.ndarray]) -> None:
        """Put in a whole state (restart, migration): every one of `fields`, one row a point."""
        for name, (shape, kind) in self.fields.items():
            full = (len(arrays["id"]), *(self.dim if s == "d" else s for s in shape))
            setattr(self, name, np.ascontiguousarray(arrays[name], dtype=kind).reshape(full))
        self._fingerprints = ()

    def migrate(self, destination: np.ndarray) -> Route:
        """Move each point, with all its state, to rank `destination[i]`. Collective.

        Returns:
            The way that they went, for what else is kept for each point.
        """
        route, known = Route(self.comm, destination), self._fingerprints
        self.replace({name: route.forward(a) for name, a in self.arrays().items()})
        self._fingerprints = known
        return route

    @collective("join")
    def join(self, other: Points) -> None:
        """Add the points of another set (another material, say); their ids follow on. Collective."""
        if other.dim != self.dim:
            raise InputError(f"other has {other.dim} dimensions, these points have {self.dim}")
        known = self.fingerprints()
        first = self.comm.allreduce(int(self.id.max(initial=-1)), op=MPI.MAX) + 1
        number, mine = len(self.materials), self.materials
        self.materials = other.materials = mine + other.materials  # both sets know all fields
        self._add_plastic_state()
        other._add_plastic_state()
        theirs = dict(other.arrays())
        other.materials = other.materials[number:]
        theirs["id"] = theirs["id"] + first
        theirs["material"] = theirs["material"] + number
        self.replace({name: np.concatenate([a, theirs[name]]) for name, a in self.arrays().items()})
        self._fingerprints = (*self.fingerprints(), *known)  # selections of these points stay valid

    @collective("assign", compare=True)
    def assign(self, selection: Selection, material: Material) -> None:
        """Give points another material, such as a weaker one to a row. Before a problem is made of them;
        collective.

        Raises:
            InputError: no material, one with another number of unknowns, or an empty selection.
        """
        check_material(material)
        self.check(selection)
        if len(selection) == 0:
            raise InputError("selection: contains no point")
        if material.micropolar != self.materials[0].micropolar:
            raise InputError("material: micropolar and classical materials can't be mixed in one body")
        if material not in self.materials:
            self.materials = (*self.materials, material)
        self._add_plastic_state()
        self.material = self.material.copy()
        self.material[self.rows(selection)] = self.materials.index(material)

    # selections ---------------------------------------------------------------------------------
    def fingerprints(self) -> tuple[int, ...]:
        """By which selections of these points are known: a number that follows from all ids and initial
        positions, the same on any number of ranks and after a restart. Collective."""
        if not self._fingerprints:
            mixed = _mixed(self.id.astype(np.uint64))
            for column in np.ascontiguousarray(self.X + 0.0).view(np.uint64).T:
                mixed = _mixed(mixed ^ column)
            found = np.array([np.bitwise_xor.reduce(mixed), mixed.sum(dtype=np.uint64)], dtype=np.uint64)
            every = np.array(self.comm.allgather(found))
            ends = np.bitwise_xor.reduce(every[:, 0]), every[:, 1].sum(dtype=np.uint64)
            self._fingerprints = (int(_mixed(np.array(ends))[0] ^ ends[1]),)
        return self._fingerprints

    def check(self, selection: Selection) -> None:
        """Raise InputError unless a selection is one of these points. Collective."""
        if not isinstance(selection, Selection):
            raise InputError(f"selection = {selection!r}: use points.where, farthest or nearest")
        if selection.body is not None and selection.body not in self.fingerprints():
            raise InputError(
                "selection: of another body (other points, or seeded otherwise); make it of these points"
            )
        here = self.comm.allreduce(len(self.rows(selection)))
        if here != len(selection):
            raise InputError(
                f"selection: {len(selection) - here} of its {len(selection)} ids aren't of this body"
            )

    def _select(self, mask: np.ndarray) -> Selection:
        ids = np.concatenate(self.comm.allgather(self.id[mask]))
        return Selection(np.sort(ids), self.fingerprints()[0])

    @collective("where")
    def where(self, predicate: Callable[[np.ndarray], np.ndarray]) -> Selection:
        """Points whose current position fulfils a predicate of x (n, d) -> (n,) bool. Collective.

        Raises:
            InputError: the predicate returns something else.
        """
        with errors_on_all_ranks(self.comm):
            mask = np.asarray(predicate(self.x))
            if mask.shape != (len(self),) or mask.dtype != bool:
                raise InputError(
                    f"predicate: returned {mask.dtype} {mask.shape}; a bool for each point is needed"
                )
        return self._select(mask)

    @collective("farthest", compare=True)
    def farthest(self, direction: Sequence[float], tolerance: float | None = None) -> Selection:
        """The layer of points farthest in a direction, within `tolerance` (m). Collective.

        Default tolerance: what a whole box, with the largest half lengths that the points were seeded with,
        reaches from its centre in this direction. That takes all points whose boxes an end face across the
        direction touches or cuts, and no second layer of a body along the grid.
        """
        n = np.asarray(direction, float)
        if n.shape != (self.dim,) or not np.linalg.norm(n) > 0:
            raise InputError(f"direction = {direction!r}: {self.dim} numbers, not all zero")
        n = n / np.linalg.norm(n)
        along = self.x @ n
        most = self.comm.allreduce(along.max(initial=-np.inf), op=MPI.MAX)
        if tolerance is None:
            half: np.ndarray = np.max(self.half_length0, axis=0, initial=0.0)
            self.comm.Allreduce(MPI.IN_PLACE, half, op=MPI.MAX)
            # a layer next to one that is hardly there is a little more than that away
            tolerance = (1.0 - 1e-6) * float(half @ np.abs(n))
        return self._select(along >= most - tolerance)

    @collective("nearest", compare=True)
    def nearest(self, position: Sequence[float], count: int = 1) -> Selection:
        """The `count` points nearest to a position (m); ties go to the lower ids. Collective."""
        x = np.asarray(position, float)
        if x.shape != (self.dim,):
            raise InputError(f"position = {position!r}: {self.dim} coordinates are needed")
        distance = np.linalg.norm(self.x - x, axis=1)
        order = np.lexsort((self.id, distance))[:count]
        found = self.comm.allgather((distance[order], self.id[order]))
        far, ids = (np.concatenate([f[k] for f in found]) for k in (0, 1))
        return Selection(np.sort(ids[np.lexsort((ids, far))[:count]]), self.fingerprints()[0])

    def rows(self, selection: Selection | None) -> np.ndarray:
        """Local rows of a selection's points on this rank (all for None)."""
        if selection is None:
            return np.arange(len(self))
        if len(selection) == 0:
            return np.zeros(0, dtype=np.int64)
        at = np.minimum(np.searchsorted(selection.ids, self.id), len(selection) - 1)
        return np.flatnonzero(selection.ids[at] == self.id)

    @collective("mean")
    def mean(self, values: np.ndarray, selection: Selection | None = None) -> Any:
        """Plain mean over a selection of values given for the local points (np, ...). Collective."""
        if selection is not None:
            self.check(selection)
        rows = self.rows(selection)
        with errors_on_all_ranks(self.comm):
            part = np.asarray(values)[rows].sum(axis=0)
        number = self.comm.allreduce(len(rows))
        if number == 0:
            raise InputError("selection: contains no point")
        return self.comm.allreduce(part) / number

    def mean_displacement(self, selection: Selection | None = None) -> np.ndarray:
        """Mean displacement (m) of a selection, shape (d,). Collective."""
        mean: np.ndarray = self.mean(self.displacement, selection)
        return mean


def _mixed(numbers: np.ndarray) -> np.ndarray:
    """Numbers of 64 bits (n,) whose bits have been mixed well (splitmix64)."""
    z = numbers + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))
