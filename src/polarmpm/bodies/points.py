"""Material points: the state of the body, rank-local, with permanent ids.

Shapes: scalar (np,), vector (np, d), tensor (np, 3, 3), quaternion (np, 4), np points of this rank and d
the space dimension. Tensors have three rows and columns in plane strain too.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..geometry.surfaces import Surface
from ..kinematics import rotations
from ..kinematics.stretch import domain_half_length, right_stretch
from ..materials.base import Material, check_material
from ..tools import checks
from ..tools.checks import refuse, whole
from ..tools.meetings import collective
from ..tools.parallel import Route, communicator_named, errors_on_all_ranks, name_of
from .regions import Regions
from .selection import Selection, check_selection, fingerprint

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


_PRIVATE = ("_has_plastic_state", "_fingerprints")  # what copies take along besides public attributes


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
        steps: how often load steps have changed them, of whatever problem; the same on all ranks.
        plastic_F, plastic_wryness: Fp of F = Fe Fp and Gp (1/m) of Gamma = Ge + Gp (T 4.1), tensors; like the
            following two only in bodies with plastic materials.
        hardening: accumulated plastic strain chi, scalar.
        dissipation: plastic dissipation per reference volume so far (Pa), scalar.
        regions, surfaces: physical groups of the mesh that the points come from; see `region` and `surface`.
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
    plastic_F: np.ndarray
    plastic_wryness: np.ndarray
    hardening: np.ndarray
    dissipation: np.ndarray
    steps: int = 0
    _mesh: Any = None  # of elements, whose communicator it is and dies with it

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
        (n, d, d) of their boxes, by default along the grid; collective.

        Raises:
            InputError: an array that isn't so, a volume that isn't positive, a negative half-length, no point
                on any rank, or another number of dimensions on another rank.
        """
        self.comm = checks.communicator("comm", comm)
        self.materials: tuple[Material, ...] = (check_material(material),)
        with errors_on_all_ranks(comm):
            self._put_positions(x, volume, half_length, half_axes)
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
        self._has_plastic_state = False
        self._fingerprints: tuple[int, ...] = ()  # the present one, then those before other points joined
        self.arrangements = 0
        self._add_plastic_state()

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

    def replace(self, arrays: dict[str, np.ndarray], same: bool = False) -> None:
        """Put in a whole state (restart, migration): every one of `fields`, one row a point. `same`: they
        are the points of before, so that selections of them stay valid; collective."""
        known = self.fingerprints() if same else ()
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

    @collective("join")
    def join(self, other: Points) -> None:
        """Add the points of another set (another material, say); their ids follow on. Before a problem is
        made of them; collective.

        Raises:
            InputError: no points, these points themselves, or points that don't go together with them.
        """
        checks.instance("other", other, Points, "material points, as seed makes them, are")
        if other is self:
            raise InputError("other: these points themselves; a body isn't there twice")
        if other.comm != self.comm:
            raise InputError("other: its points live on another communicator")
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
        self.regions += tuple(r.joined(first) for r in other.regions)
        for group, surface in other.surfaces.items():
            mine_too = self.surfaces.get(group)
            self.surfaces[group] = surface if mine_too is None else mine_too.joined(surface)
        self._fingerprints = (*self.fingerprints(), *known)  # selections of these points stay valid
        self.arrangements += 1

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
        self.arrangements += 1

    # selections ---------------------------------------------------------------------------------
    def fingerprints(self) -> tuple[int, ...]:
        """By which selections of these points are known: a number that follows from all ids and initial
        positions, the same on any number of ranks and after a restart. Collective."""
        if not self._fingerprints:
            self._fingerprints = (fingerprint(self.comm, self.id, self.X),)
        return self._fingerprints

    def check(self, selection: Selection) -> None:
        """Raise InputError unless a selection is one of these points. Collective."""
        check_selection(selection)
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
        """Points whose current position fulfils a predicate of x (n, d) -> (n,) bool; there may be none, on
        which nothing can act. Collective.

        Raises:
            InputError: not a predicate, or it returns something else. What it raises itself is raised on its
                rank, and as `ErrorOnAnotherRank` on the others.
        """
        with errors_on_all_ranks(self.comm):
            checks.function("predicate", predicate, "a predicate of positions is", takes=("x",))
            mask = checks.mask("predicate", predicate(self.x.copy()), len(self))  # it may change what it gets
        return self._select(mask)

    def region(self, name: str | int) -> Selection:
        """Points seeded in a region of a mesh, a physical group of its cells, by its name or tag, wherever
        they are now. Collective.

        Raises:
            InputError: no such region, or points that don't come from a mesh with regions.
        """
        if not isinstance(name, str):
            name = whole("region", name, allowed="the name or the number of a physical group is needed")
        masks = [m for m in (r.mask(self.id, name) for r in self.regions) if m is not None]
        if not masks:
            raise refuse("region", name, _among([k for r in self.regions for k in r.known], "regions"))
        return self._select(np.any(masks, axis=0))

    def surface(self, name: str | int) -> Surface:
        """The boundary of the undeformed body in a physical group of facets of the mesh that it was seeded
        from, by its name or tag: for `fix`, `load`, `traction` and `pressure`, as `Elements.surface`.

        Raises:
            InputError: no such group on the boundary, or points that don't come from a mesh with groups.
        """
        if not isinstance(name, str):
            name = whole("surface", name, allowed="the name or the number of a physical group is needed")
        if name not in self.surfaces:
            raise refuse("surface", name, _among(list(map(repr, self.surfaces)), "groups of boundary facets"))
        return self.surfaces[name]

    @collective("farthest", compare=True)
    def farthest(self, direction: Sequence[float], tolerance: float | None = None) -> Selection:
        """The layer of points farthest in a direction, within `tolerance` (m). Collective.

        Default tolerance: what a whole box, with the largest half lengths that the points were seeded with,
        reaches from its centre in this direction. That takes all points whose boxes an end face across the
        direction touches or cuts, and no second layer of a body along the grid.

        Raises:
            InputError: a direction or a tolerance that isn't so.
        """
        with errors_on_all_ranks(self.comm):
            n = checks.vector("direction", direction, self.dim)
            if not np.any(n):
                raise checks.refuse("direction", direction, f"{self.dim} numbers, not all zero")
            if tolerance is not None:
                tolerance = checks.number("tolerance", tolerance, least=0)
        n = n / np.abs(n).max()
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
        """The `count` points nearest to a position (m); ties go to the lower ids. All points where there are
        fewer. Collective.

        Raises:
            InputError: a position that isn't one, or a count below one.
        """
        with errors_on_all_ranks(self.comm):
            x = checks.vector("position", position, self.dim)
            count = checks.whole("count", count, least=1)
        scale = 1.0 if np.abs(x).max() < 1e100 else 2.0**-500  # its square must be a number
        distance = np.linalg.norm((self.x - x) * scale, axis=1)
        order = np.lexsort((self.id, distance))[:count]
        found = self.comm.allgather((distance[order], self.id[order]))
        far, ids = (np.concatenate([f[k] for f in found]) for k in (0, 1))
        return Selection(np.sort(ids[np.lexsort((ids, far))[:count]]), self.fingerprints()[0])

    def rows(self, selection: Selection | None) -> np.ndarray:
        """Local rows of a selection's points on this rank (all for None); none of ids that aren't here."""
        if selection is None:
            return np.arange(len(self))
        check_selection(selection)
        if len(selection) == 0:
            return np.zeros(0, dtype=np.int64)
        at = np.minimum(np.searchsorted(selection.ids, self.id), len(selection) - 1)
        return np.flatnonzero(selection.ids[at] == self.id)

    @collective("mean")
    def mean(self, values: np.ndarray, selection: Selection | None = None) -> Any:
        """Plain mean over a selection of values given for the local points (np, ...). Collective.

        Raises:
            InputError: values that aren't a row for each local point, or a selection without points.
        """
        with errors_on_all_ranks(self.comm):
            # the mean of booleans is a share
            found = checks.numeric("values", values, "one row for each local point", "biuf")
            if found.ndim == 0 or len(found) != len(self):
                what = f"a row for each of the {len(self)} local points is needed"
                raise checks.refuse("values", values, f"{what}; the shape is {found.shape}")
        if selection is not None:
            self.check(selection)
        rows = self.rows(selection)
        number = self.comm.allreduce(len(rows))
        if number == 0:
            raise InputError("selection: contains no point")
        return self.comm.allreduce(found[rows].sum(axis=0)) / number

    def mean_displacement(self, selection: Selection | None = None) -> np.ndarray:
        """Mean displacement (m) of a selection, shape (d,). Collective."""
        mean: np.ndarray = self.mean(self.displacement, selection)
        return mean


def _among(known: list[str], what: str) -> str:
    if not known:
        return f"these points have no {what}; pm.seed_mesh keeps those of a mesh with physical groups"
    return f"the {what} are {', '.join(dict.fromkeys(known))}"
