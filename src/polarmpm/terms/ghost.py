"""Ghost penalty: keeps the tangent regular when the body cuts cells slightly (T 2.3.4).

Over the faces of boundary cells the jump of the solution's normal derivative is penalised, T (2.59):

    gamma_g h^3 / 3 * integral over the face of [du/dn] . [dv/dn] dA

for displacements with gamma_g1 and for rotations with gamma_g2 (T after (3.174)). T writes the jump as a
matrix of normals times strains (2.60). On faces of the grid that is the jump of the whole normal derivative,
as it stands here (but for a misprint in its last row): the functions are continuous and multilinear, so that
derivatives along the face don't jump.

Gradients of quadratic splines don't jump, but their second derivatives do. What is penalised there is the
jump of the second derivative along the normal, gamma_g h^(2 + power) * integral of [d2u/dn2] . [d2v/dn2] dA,
with the cells' size h along the normal.

With h^3 the parameters strictly have the units Pa / m^2 and N / m^2. T takes the numbers of moduli; on cells
of one metre that is a share of the stiffness, on smaller ones much less. With h in its place (`power=1`, the
default) the parameters are shares of the moduli whatever the size of the cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from mpi4py import MPI

import numpy as np

from ..basis.base import Basis
from ..basis.registry import names
from ..errors import InputError
from ..geometry.cells import unit_corners
from ..geometry.grid import MARGIN, Grid
from ..kinematics.layout import Layout
from ..materials.base import Material
from ..tools import checks
from ..tools.parallel import lowest_ranks, values_by_number
from .base import Boxes, Piece, Setting, Term, multiply
from .settings import GridSetting

_SHARES = {"thesis": 1e-2, "light": 1e-5}  # of the moduli; "thesis" as in T 4.4
_POWERS = {"thesis": 3, "light": 1}


@dataclass(frozen=True)
class GhostPenalty:
    """Parameters of the ghost penalty.

    Args:
        displacement: gamma_g1 (Pa; see the module's note on units).
        rotation: gamma_g2 (N).
        power: of the faces' size h, 1, or 3 as in T (2.59).

    Raises:
        InputError: a parameter is negative or not finite; power is neither 1 nor 3.
    """

    displacement: float
    rotation: float = 0.0
    power: int = 1

    def __post_init__(self) -> None:
        for name in ("displacement", "rotation"):
            value = checks.number(f"GhostPenalty: {name}", getattr(self, name), least=0.0)
            object.__setattr__(self, name, value)
        power = checks.whole("GhostPenalty: power", self.power, allowed="allowed are 1 and 3")
        if power not in (1, 3):
            raise checks.refuse("GhostPenalty: power", self.power, "allowed are 1 and 3")
        object.__setattr__(self, "power", power)


def make_penalty(
    ghost: Any, materials: Sequence[Material], layout: Layout, basis: Basis, assembly: str
) -> GhostPenalty | None:
    """Check what a user gives as `ghost`.

    Args:
        ghost: None, "light", "thesis" or a `GhostPenalty`. "thesis" takes lambda / 100 and gamma / 100 of the
            stiffest material and h^3 (T 4.4), "light" lambda / 1e5, gamma / 1e5 and h: enough for the
            tangent's condition; where lambda isn't positive, mu stands in.

    Raises:
        InputError: an unknown choice; materials that don't name their moduli; a basis or an assembly without
            ghost penalty.
    """
    if ghost is None:
        return None
    if not isinstance(ghost, GhostPenalty) and not (isinstance(ghost, str) and ghost in _SHARES):
        raise InputError(f"ghost = {ghost!r}: allowed are None, 'light', 'thesis' and a GhostPenalty")
    if not (basis.gradients_jump or (basis.curvatures_jump and isinstance(ghost, GhostPenalty))):
        instead = "cell aggregation, which is always on, serves there. " if basis.sliver else ""
        raise InputError(
            f"ghost: gradients of basis = {basis.name!r} don't jump across faces, there is nothing to "
            f"penalise; {instead}Allowed are {names(lambda b: b.gradients_jump)}"
        )
    if assembly != "direct":
        raise InputError(
            f"ghost: assembly = {assembly!r} has no room for couplings across faces; allowed is 'direct'"
        )
    if isinstance(ghost, GhostPenalty):
        return ghost
    share = _SHARES[ghost]
    rotation = max(_modulus(ghost, m, ("gamma",)) for m in materials) if layout.rotations else 0.0
    stiffest = max(_modulus(ghost, m, ("lam", "mu")) for m in materials)
    return GhostPenalty(share * stiffest, share * rotation, _POWERS[ghost])


def _modulus(ghost: str, material: Material, names: tuple[str, ...]) -> float:
    """The first of a material's moduli that is positive; zero when all of those it has are zero."""
    known = material.moduli(*names).values()
    if not known:
        raise InputError(
            f"ghost = {ghost!r}: {type(material).__name__} has no parameter named {' or '.join(names)}; give "
            "numbers, GhostPenalty(displacement=..., rotation=...)"
        )
    return next((value for value in known if value > 0), 0.0)


# faces ------------------------------------------------------------------------------------------
def boundary_faces(grid: Grid, reached: np.ndarray, beyond: bool = False) -> list[np.ndarray]:
    """Faces of boundary cells towards other active cells, T 2.3.4: for each axis the lattice numbers of the
    cells below the faces across it. Each face is on one rank. Collective.

    A cell of the grid is active when some point or domain reaches it, on any rank (`reached`: this rank's,
    ascending), and a boundary cell when a cell next to it is empty. Beyond the grid's walls there are no
    cells, or, with `beyond`, those that domains reach, all of them boundary cells.
    """
    comm, steps, last = grid.comm, np.concatenate([-grid.strides, grid.strides]), np.array(grid.shape) - 1
    index = grid.node_index(reached)
    kept = np.all((index >= 0) & (index <= last), axis=1)
    cells = reached if beyond else reached[kept]
    cells = cells[lowest_ranks(comm, cells) == comm.rank]
    index = grid.node_index(cells)
    within = np.all((index >= 0) & (index <= last), axis=1)
    inside = within[:, None] & np.hstack([index > 0, index < last])  # the cell and the one beside it
    far = MARGIN if beyond else 0
    exists = np.hstack([index > -far, index < last + far])
    wanted = (cells[:, None] + steps).ravel()
    active = values_by_number(comm, cells, np.ones((len(cells), 1)), wanted).reshape(exists.shape) > 0
    boundary = np.any(inside & ~active, axis=1) | ~within
    beside = values_by_number(comm, cells, boundary[:, None].astype(float), wanted).reshape(exists.shape) > 0
    face = (exists & active & (boundary[:, None] | beside))[:, grid.dim :]
    return [cells[face[:, axis]] for axis in range(grid.dim)]


def penalty_form(mesh: Any, space: Any, size: float, power: int = 3, facets: Any = None) -> Any:
    """T (2.59) for scalar functions as a UFL form.

    Args:
        size: of the faces, h (m).
        facets: measure of the interior faces; default: all of the mesh.
    """
    import ufl
    from dolfinx import fem

    # a constant isn't part of the form's name: other sizes compile nothing
    factor = fem.Constant(mesh, np.float64(size**power / 3))
    u, v, n = ufl.TrialFunction(space), ufl.TestFunction(space), ufl.FacetNormal(mesh)
    faces = ufl.Measure("dS", domain=mesh) if facets is None else facets
    return factor * ufl.jump(ufl.grad(u), n) * ufl.jump(ufl.grad(v), n) * faces


def face_size(cell: Sequence[float], axis: int) -> float:
    """The largest side (m) of the faces across an axis; in the plane the length of the edge."""
    return max(side for k, side in enumerate(cell) if k != axis)


@lru_cache(maxsize=32)
def stencil(cell: tuple[float, ...], axis: int, power: int = 3, above: float | None = None) -> np.ndarray:
    """Matrix (n, n) of a face across an axis on the box of its two cells' nodes, assembled by dolfinx.

    Args:
        cell: sizes (m) of the cell below the face.
        above: size (m) along the axis of the one above; default: the same.
    """
    from ..tools import compat

    dim, name = len(cell), "quadrilateral" if len(cell) == 2 else "hexahedron"
    boxes = Boxes(tuple(3 if k == axis else 2 for k in range(dim)), np.zeros(1, dtype=np.int64))
    count, positions = boxes.count, boxes.offsets * np.array(cell)
    along = np.array([0.0, cell[axis], cell[axis] + (cell[axis] if above is None else above)])
    positions[:, axis] = along[boxes.offsets[:, axis]]
    corner = unit_corners(dim)
    lower = [np.ravel_multi_index(tuple(corner.T), count)]
    upper = [np.ravel_multi_index(tuple((corner + (np.arange(dim) == axis)).T), count)]
    mesh = compat.create_mesh(MPI.COMM_SELF, np.array(lower + upper, dtype=np.int64), positions, name)
    compat.name_variant(mesh)
    space = compat.function_space(mesh, 1, 1)
    form = compat.compile_form(penalty_form(mesh, space, face_size(cell, axis), power))
    matrix = compat.create_matrix(form)
    compat.add_to_matrix(matrix, form)
    matrix.assemble()
    at = np.arange(len(positions), dtype=np.int32)
    dense = matrix.getValues(at, at)
    matrix.destroy()
    x = space.tabulate_dof_coordinates()[:, :dim]
    order = np.argmin(np.linalg.norm(positions[:, None] - x, axis=2), axis=1)
    return np.asarray(dense[np.ix_(order, order)])


def curvature_jumps(grid: Grid, basis: Basis, axis: int, cells: np.ndarray, power: int) -> np.ndarray:
    """Matrices (m, n, n) of the jumps of second derivatives over faces across an axis above cells (m,), on
    the functions of both cells, which are numbered like a box of nodes."""
    index = grid.node_index(cells)
    step = (np.arange(grid.dim) == axis).astype(index.dtype)
    size = grid.sizes(index)
    x, m, f = grid.position(index + step), len(cells), basis.functions
    jump = np.zeros((m, f + 1))
    jump[:, :-1] -= basis.curvatures(grid, x, index)[:, axis]
    jump[:, 1:] += basis.curvatures(grid, x, index + step)[:, axis]
    normal = 0.5 * (size + grid.sizes(index + step))[:, axis]
    out = np.ones((m, 1, 1))
    points, weights = np.polynomial.legendre.leggauss(f)
    for k in range(grid.dim):
        factor = normal[:, None, None] ** (2 + power) * jump[:, :, None] * jump[:, None]
        if k != axis:
            factor = np.zeros((m, f, f))
            for point, weight in zip(points, weights, strict=True):
                value = basis.lines(grid, grid.position(index) + 0.5 * (1.0 + point) * size, index)[:, k, 0]
                factor += 0.5 * weight * size[:, k, None, None] * value[:, :, None] * value[:, None]
        n = out.shape[1] * factor.shape[1]
        out = np.einsum("mij,mkl->mikjl", out, factor).reshape(m, n, n)
    return out


_ABOVE = (1.0, 2.0, 0.5)  # sizes above unit cells whose stencils give those of any sizes


def stencils(grid: Grid, axis: int, cells: np.ndarray, power: int, unit: Sequence[np.ndarray]) -> np.ndarray:
    """Matrices (m, n, n) of the faces across an axis above cells (m,) of any sizes.

    The jump is linear in one over the sizes a below and b above, so that the matrix of a face of unit area
    and size is A / a^2 + B / (a b) + C / b^2.

    Args:
        unit: `stencil` of unit cells with the sizes `_ABOVE` above them.
    """
    index = grid.node_index(cells)
    size = grid.sizes(index)
    above = grid.sizes(index + (np.arange(grid.dim) == axis))[:, axis]
    across = 1.0 / np.stack([size[:, axis] ** 2, size[:, axis] * above, above**2], axis=1)
    ones = np.array([[1.0, 1.0 / b, 1.0 / b**2] for b in _ABOVE])
    parts = across @ np.linalg.inv(ones)
    along = np.delete(size, axis, axis=1)
    parts *= (np.prod(along, axis=1) * along.max(axis=1, initial=0.0) ** power)[:, None]
    made: np.ndarray = np.einsum("mk,kab->mab", parts, np.array(unit))
    return made


def _turns(grid: Grid, axis: int, cells: np.ndarray) -> np.ndarray:
    """Lengths of a turn (m,) (m) at the middles of faces, for the cells below them."""
    index = grid.node_index(cells)
    share = 1.0 if axis == 0 else 0.5
    radius: np.ndarray = grid.corners(index)[:, 0] + share * grid.sizes(index)[:, 0]
    return 2.0 * np.pi * radius


# terms ------------------------------------------------------------------------------------------
@dataclass
class GhostFaces(Piece):
    """Ghost forces of the faces across one axis, T (2.61)-(2.62); a `terms.base.Piece`.

    The forces are those of the increments since the reset.
    """

    boxes: Boxes
    matrix: np.ndarray  # (1 or faces, n, n, b)
    name = "ghost"
    symmetric = True
    linear = True
    external = False

    def __post_init__(self) -> None:
        self.pairs = np.tile(np.arange(self.matrix.shape[3])[:, None], (1, 2))

    def forces(self, x: np.ndarray) -> np.ndarray:
        return multiply(self.pairs, self.matrix, x)

    def matrices(self, x: np.ndarray) -> np.ndarray:
        return self.matrix


class Ghost(Term):
    """The ghost penalty. Its forces start anew at each reset. With `beyond` it acts beyond the grid's walls,
    too, where domains reach over them."""

    name = "ghost"

    def __init__(self, penalty: GhostPenalty, layout: Layout, beyond: bool = False):
        self.penalty, self._axial, self._beyond = penalty, layout.axial, beyond
        self.scale = np.repeat([penalty.displacement, penalty.rotation], [layout.dim, layout.rotations])

    def pieces(self, setting: Setting) -> list[Piece]:
        assert isinstance(setting, GridSetting)
        if setting.basis.gradients_jump:
            return self.faces(setting.grid, setting.reached)
        return self.curved_faces(setting.grid, setting.basis, setting.reached)

    def curved_faces(self, grid: Grid, basis: Basis, reached: np.ndarray) -> list[Piece]:
        """The same of functions whose second derivatives jump. Collective."""
        out: list[Piece] = []
        for axis, cells in enumerate(boundary_faces(grid, reached, self._beyond)):
            count = tuple(basis.functions + (k == axis) for k in range(grid.dim))
            matrices = curvature_jumps(grid, basis, axis, cells, self.penalty.power)
            if self._axial:
                matrices = matrices * _turns(grid, axis, cells)[:, None, None]
            out.append(GhostFaces(Boxes(count, cells), matrices[..., None] * self.scale))
        return out

    def faces(self, grid: Grid, reached: np.ndarray) -> list[Piece]:
        """Forces of the faces across each axis, for the cells that this rank's points reach. Collective."""
        out: list[Piece] = []
        for axis, cells in enumerate(boundary_faces(grid, reached, self._beyond)):
            count = tuple(3 if k == axis else 2 for k in range(grid.dim))
            if grid.equal:
                matrices = self._stencil(grid, axis, grid.smallest)[None]
            else:
                unit = [self._stencil(grid, axis, (1.0,) * grid.dim, above) for above in _ABOVE]
                matrices = stencils(grid, axis, cells, self.penalty.power, unit)
            if self._axial:
                matrices = matrices * _turns(grid, axis, cells)[:, None, None]
            out.append(GhostFaces(Boxes(count, cells), matrices[..., None] * self.scale))
        return out

    def _stencil(
        self, grid: Grid, axis: int, size: tuple[float, ...], above: float | None = None
    ) -> np.ndarray:
        """Made on one rank, so that only one compiles; sizes as of `stencil`. Collective."""
        made, error = None, None
        if grid.comm.rank == 0:
            try:
                made = stencil(size, axis, self.penalty.power, above)
            except Exception as e:
                error = e
        made, error = grid.comm.bcast((made, error))
        if error is not None:
            raise error
        return np.asarray(made)
