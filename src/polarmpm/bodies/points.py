"""Material points: the state of the body, rank-local, with permanent ids.

Shapes: scalar (np,), vector (np, d), tensor (np, 3, 3), quaternion (np, 4), np points of this rank and d
the space dimension. Tensors have three rows and columns in plane strain too.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.surfaces import Surface
from ..kinematics import rotations
from ..kinematics.stretch import domain_half_length, right_stretch
from ..materials.base import Material, check_material
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import Route, communicator_named, errors_on_all_ranks, name_of
from .misfit import warn_of_misfit
from .overlap import warn_of_overlap
from .pointfields import (
    BODY_FIELDS,
    COUNTED_FIELDS,
    FIELDS,
    MOTION_FIELDS,
    PLASTIC_FIELDS,
    SECOND_FIELDS,
    SIDE_FIELDS,
)
from .regions import Regions
from .revolution import check_axisymmetric
from .selection import Selection, fingerprint
from .several import Several
from .sides import WithSides

_PRIVATE = (
    "_has_plastic_state",
    "_fingerprints",
    "_last_id",
)  # what copies take along besides public attributes


class Points(Several, WithSides):
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
        steps: how often load steps have changed them, of whatever problem; the same on all ranks.
        plastic_F, plastic_wryness: Fp of F = Fe Fp and Gp (1/m) of Gamma = Ge + Gp (T 4.1), tensors; like the
            following two only in bodies with plastic materials.
        grad_F: second gradient of the motion H_iJK = d^2 x_i / dX_J dX_K (1/m), (np, 3, 3, 3), symmetric in
            J and K; only in bodies with second-gradient materials, and zero at points of others.
        side_F, side_wryness, side_gradients: how they vary within the points' boxes, see `WithSides`.
        counted_from: positions (m) from which displacements count, vector; only after
            `problem.zero_displacements()`, else these are X.
        hardening: accumulated plastic strain chi, scalar.
        dissipation: plastic dissipation per reference volume so far (Pa), scalar.
        velocity, acceleration: (m/s, m/s^2), vectors, and spin, spin_rate: of the microrotation (rad/s,
            rad/s^2), (np, 3); only once a dynamic problem has been made of the body. Accelerations are those
            of the method in time, not forces over masses.
        body: number of the body that a point belongs to, scalar; only once some are apart (`separate`).
        bodies: how many there are: bodies share no nodes, and meet through `problem.contact` alone.
        axisymmetric: the body is one of revolution, x the radius and y along the axis: volumes are those of
            whole turns, and F and the wryness have their hoop components in the third row and column.
        regions, surfaces: physical groups of the mesh that the points come from; see `region` and `surface`.
        lattices: graded grids that the points were seeded on, with the points a cell (d,).
        lineage: which points have been split, by re-gridding or as their boxes are as large as a cell, see
            `Lineage`; None: none.
        arrangements: how often points have joined or been assigned a material; a problem is made of one.

    A copy (`copy.copy`, `copy.deepcopy`) is a body of its own, on the same communicator. Selections of the
    points are valid for it, too: it has the same ids. A pickle holds the points of the rank that made it.
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
    counted_from: np.ndarray
    grad_F: np.ndarray
    plastic_F: np.ndarray
    plastic_wryness: np.ndarray
    hardening: np.ndarray
    dissipation: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    spin: np.ndarray
    spin_rate: np.ndarray
    steps: int = 0
    axisymmetric: bool = False
    _mesh: Any = None  # of elements, whose communicator it is and dies with it

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
        axisymmetric: bool = False,
    ):
        """Unloaded points at x (n, d) (m) with volumes (n,), domain half-lengths (n, d) and half axes
        (n, d, d) of their boxes, by default along the grid; collective.

        Raises:
            InputError: an array that isn't so, a volume that isn't positive, a negative half-length, no point
                on any rank, or another number of dimensions on another rank.
        """
        self.comm = checks.communicator("comm", comm)
        self.materials: tuple[Material, ...] = (check_material(material),)
        self.axisymmetric = checks.flag("axisymmetric", axisymmetric)
        with errors_on_all_ranks(comm):
            self._put_positions(x, volume, half_length, half_axes)
            if self.axisymmetric:
                check_axisymmetric(self.X, material)
            material.check_dimension(self.dim)
            first_id = checks.whole("first_id", first_id, least=0, most=2**61)
        n = len(self.x)
        sizes = np.array(comm.allgather((n, self.dim)))
        if not np.any(sizes[:, 0]):
            raise InputError("x: no point on any rank; a body has one at least")
        if np.any(sizes[:, 1] != self.dim):
            raise InputError("x: points of two and of three dimensions, on different ranks")
        before = int(sizes[: comm.rank, 0].sum())
        self.id = first_id + before + np.arange(n, dtype=np.int64)
        self.material = np.zeros(n, dtype=np.int32)
        self.F = np.tile(np.eye(3), (n, 1, 1))
        self.q = rotations.identity(n)
        self.wryness = np.zeros((n, 3, 3))
        self.unresolved = np.zeros(n)
        self.regions: tuple[Regions, ...] = ()
        self.surfaces: dict[str | int, Surface] = {}
        self.lattices: tuple[tuple[Grid, np.ndarray], ...] = ()
        self._has_plastic_state = False
        self._fingerprints: tuple[int, ...] = ()  # the present one, then those before other points joined
        self._last_id = -1  # of points that have been there
        self.arrangements = 0
        self.add_state()

    def _put_positions(self, x: Any, volume: Any, half_length: Any, half_axes: Any) -> None:
        """Check and copy what a point is seeded with."""
        found = checks.numeric("x", x, "positions (m)")
        if found.ndim != 2 or found.shape[1] not in (2, 3):
            raise checks.refuse("x", x, f"positions (n, 2) or (n, 3) are needed: not of shape {found.shape}")
        n, self.dim = found.shape
        self.X = checks.array("x", found, (n, self.dim), "positions (m)")
        self.x = self.X.copy()
        self.volume0 = checks.array("volume", volume, (n,), "one for each point")
        if n and not self.volume0.min() > 0:
            raise InputError(f"volume = {self.volume0.min():g} of a point: volumes must be positive")
        self.half_length0 = checks.array("half_length", half_length, (n, self.dim), "a row for each point")
        if n and self.half_length0.min() < 0:
            raise InputError(f"half_length = {self.half_length0.min():g} of a point: no length is negative")
        if half_axes is None:
            self.half_axes0 = self.half_length0[:, None, :] * np.eye(self.dim)
        else:
            what = "half axes of each point's box, one a row"
            self.half_axes0 = checks.array("half_axes", half_axes, (n, self.dim, self.dim), what)

    # copies -------------------------------------------------------------------------------------
    def __repr__(self) -> str:
        of = "" if self.comm.size == 1 else f" of rank {self.comm.rank}, of {self.comm.size} ranks,"
        where, unit = ("in space", "m^3") if self.dim == 3 else ("in the plane", "m^2")
        if self.axisymmetric:
            where, unit = "of a body of revolution", "m^3"
        kinds = ", ".join(dict.fromkeys(type(m).__name__ for m in self.materials))
        return f"<Points: {len(self)} point(s){of} {where}, {self.volume0.sum():.6g} {unit}, {kinds}>"

    def _copied(self, copied: Callable[[Any], Any]) -> Points:
        made = object.__new__(type(self))
        mine = {k: v for k, v in self.__dict__.items() if not k.startswith("_") or k in _PRIVATE}
        made.__dict__.update({k: v if k == "comm" else copied(v) for k, v in mine.items()})
        return made

    def __copy__(self) -> Points:
        return self._copied(lambda v: v.copy() if isinstance(v, np.ndarray) else v)

    def __deepcopy__(self, memo: dict[int, Any]) -> Points:
        made = self._copied(lambda v: copy.deepcopy(v, memo))
        memo[id(self)] = made
        return made

    def __getstate__(self) -> dict[str, Any]:
        made = self._copied(lambda v: v)
        return {**made.__dict__, "comm": name_of(self.comm), "ranks": self.comm.size}

    def __setstate__(self, state: dict[str, Any]) -> None:
        ranks, comm = state.pop("ranks"), communicator_named(state["comm"])
        if comm.size != ranks:
            raise InputError(
                f"points were pickled on {ranks} rank(s) and are read on {comm.size}; use save_restart"
            )
        self.__dict__.update({**state, "comm": comm})

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
        """x - X (m), or what it has grown by since `problem.zero_displacements()`, vector."""
        u: np.ndarray = self.x - vars(self).get("counted_from", self.X)
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
    def second_gradient(self) -> bool:
        """Whether one of the materials has second gradients."""
        return any(m.second_gradient for m in self.materials)

    @property
    def moving(self) -> bool:
        """Whether a dynamic problem has been made of them, so that they have velocities."""
        return "velocity" in vars(self)

    def set_moving(self) -> None:
        """Give them velocities and accelerations, zero, if they have none."""
        if not self.moving:
            n = len(self)
            self.velocity, self.acceleration = np.zeros((n, self.dim)), np.zeros((n, self.dim))
            self.spin, self.spin_rate = np.zeros((n, 3)), np.zeros((n, 3))

    @property
    def fields(self) -> dict[str, tuple[tuple[int | str, ...], type]]:
        """Names of the state's arrays, with their shapes after the point axis and types."""
        found = {**FIELDS, **PLASTIC_FIELDS} if self.plastic else FIELDS
        found = {**found, **SECOND_FIELDS} if self.second_gradient else found
        found = {**found, **MOTION_FIELDS} if self.moving else found
        found = {**found, **BODY_FIELDS} if self.bodies > 1 else found
        found = {**found, **SIDE_FIELDS} if self.has_sides else found
        return {**found, **COUNTED_FIELDS} if "counted_from" in vars(self) else found

    def plastic_state(self, rows: np.ndarray) -> tuple[np.ndarray, ...]:
        """Fp, Gp and chi of some points; nothing in an elastic body."""
        if not self.plastic:
            return ()
        return self.plastic_F[rows], self.plastic_wryness[rows], self.hardening[rows]

    def put_materials(self, materials: tuple[Material, ...], rows: np.ndarray) -> None:
        """Give the local points the materials of these rows (np,)."""
        self.materials, self.material = materials, rows.astype(np.int32)
        self.add_state()

    def add_state(self) -> None:
        """Arrays of plastic and of second-gradient materials, where they are needed and missing."""
        if self.second_gradient and "grad_F" not in vars(self):
            self.grad_F = np.zeros((len(self), 3, 3, 3))
        if self.plastic and not self._has_plastic_state:
            n, self._has_plastic_state = len(self), True
            self.plastic_F = np.tile(np.eye(3), (n, 1, 1))
            self.plastic_wryness = np.zeros((n, 3, 3))
            self.hardening, self.dissipation = np.zeros(n), np.zeros(n)

    def arrays(self) -> dict[str, np.ndarray]:
        """All state by name, for output and restart; the arrays themselves, not copies."""
        return {name: getattr(self, name) for name in self.fields}

    def replace(self, arrays: dict[str, np.ndarray], same: bool = False) -> None:
        """Put in a whole state (restart, migration): every one of `fields`, one row a point. `same`: they
        are the points of before, so that selections of them stay valid; collective."""
        known = self.fingerprints() if same else ()
        for name in (*COUNTED_FIELDS, *SIDE_FIELDS):  # whether it is there is part of the state
            vars(self).pop(name, None)
            if name in arrays:
                setattr(self, name, arrays[name])
        for name, (shape, kind) in self.fields.items():
            full = (len(arrays["id"]), *(self.dim if s == "d" else s for s in shape))
            setattr(self, name, np.ascontiguousarray(arrays[name], dtype=kind).reshape(full))
        self._fingerprints = known

    def migrate(self, destination: np.ndarray) -> Route:
        """Move each point, with all its state, to rank `destination[i]`. Collective.

        Returns:
            The way that they went, for what else is kept for each point.
        """
        route, known = Route(self.comm, destination), self._fingerprints
        self.replace({name: route.forward(a) for name, a in self.arrays().items()})
        self._fingerprints = known
        return route

    def remember_ids(self) -> None:
        """Points that join get ids beyond the present ones, also when these are gone then. Collective."""
        last = self.comm.allreduce(int(self.id.max(initial=-1)), op=MPI.MAX)
        self._last_id = max(last, self._last_id)

    @collective("join", compare=True)
    def join(self, other: Points, *, apart: bool = False) -> None:
        """Add the points of another set (another material, say); their ids follow on. Before a problem is
        made of them; collective.

        Args:
            apart: they are a body of their own, see `separate`. Default: where both touch, they are welded;
                where they lie in each other there is a `TrustWarning`.

        Raises:
            InputError: no points, these points themselves, or points that don't go together with them.
        """
        checks.instance("other", other, Points, "material points, as seed makes them, are")
        if other is self:
            raise InputError("other: these points themselves; a body isn't there twice")
        if other.lineage is not None:
            raise InputError("other: some of its points have been split; join points before they are")
        if other.comm != self.comm:
            raise InputError("other: its points live on another communicator")
        if other.dim != self.dim:
            raise InputError(f"other has {other.dim} dimensions, these points have {self.dim}")
        if other.axisymmetric != self.axisymmetric:
            which = "other" if other.axisymmetric else "these points"
            raise InputError(f"other: of both only {which} are a body of revolution (axisymmetric)")
        apart, known = checks.flag("apart", apart), self.fingerprints()
        bodies = self._join_bodies(other, apart)
        self.remember_ids()
        first = self._last_id + 1
        number, mine = len(self.materials), self.materials
        self.materials = other.materials = mine + other.materials  # both sets know all fields
        for one, two in ((self, other), (other, self)):
            if "counted_from" in vars(one) and "counted_from" not in vars(two):
                two.counted_from = two.X.copy()
            if one.has_sides and not two.has_sides:
                two.begin_sides()
        self.add_state()
        other.add_state()
        theirs = dict(other.arrays())
        other.materials = other.materials[number:]
        theirs["id"] = theirs["id"] + first
        theirs["material"] = theirs["material"] + number
        theirs["body"] = bodies
        self.replace({name: np.concatenate([a, theirs[name]]) for name, a in self.arrays().items()})
        self.regions += tuple(r.joined(first) for r in other.regions)
        self.lattices += other.lattices
        for group, surface in other.surfaces.items():
            mine_too = self.surfaces.get(group)
            self.surfaces[group] = surface if mine_too is None else mine_too.joined(surface)
        self._fingerprints = (*self.fingerprints(), *known)  # selections of these points stay valid
        self.arrangements += 1
        if not apart:
            warn_of_overlap(self.comm, self, first)

    @collective("assign", compare=True)
    def assign(self, selection: Selection, material: Material) -> None:
        """Give points another material, such as a weaker one to a row. Before a problem is made of them;
        collective. Boxes aren't cut: where parts of a body have to be met better than to a box, seed each
        with its material and `join` them. There is a `TrustWarning` where the limit of the selection's
        predicate makes the volume a twentieth larger or smaller.

        Raises:
            InputError: no material, one with another number of unknowns, or an empty selection.
        """
        check_material(material, self.dim)
        self.check(selection)
        if len(selection) == 0:
            raise InputError("selection: contains no point")
        if self.axisymmetric:
            check_axisymmetric(self.X, material)
        if material.micropolar != self.materials[0].micropolar:
            raise InputError("material: micropolar and classical materials can't be mixed in one body")
        warn_of_misfit(self, selection)
        if material not in self.materials:
            self.materials = (*self.materials, material)
        self.add_state()
        self.material = self.material.copy()
        self.material[self.rows(selection)] = self.materials.index(material)
        self.arrangements += 1

    # selections ---------------------------------------------------------------------------------
    def fingerprints(self) -> tuple[int, ...]:
        """By which selections of these points are known: a number that follows from all ids and initial
        positions, the same on any number of ranks and after a restart. Collective."""
        if not self._fingerprints:
            self._fingerprints = (fingerprint(self.comm, self.id, self.X),)
        return self._fingerprints
