"""Recording the steps of a run for ParaView."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..bodies.recovery import Stencil, stencil
from ..errors import InputError
from ..geometry.cells import corner_numbers, occupied_cells
from ..problems.base import Problem
from ..problems.elements import QuasiStaticFEM
from ..solvers.stepping import Step
from ..terms.sites import Sites
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import values_by_number
from .fields import AnyField, choose, field_arrays
from .mesh import NODAL, OF_CELLS, mesh_piece
from .paraview import Collection, box_corners, mark_of, padded

_NOWHERE = 1e30  # m: the gap of a site that faces nothing


class Recorder:
    """Writes states of a problem for ParaView; all methods are collective.

    `arch.pvd` is the file to open; the folder `arch` next to it has one .vtu file for each step and rank.
    The collection is rewritten after every step, so that a run that was killed leaves a readable one. A run
    that goes on from a restart file, with a recorder of the same path that was made before or after it was
    loaded, goes on with the collection: steps up to the saved state stay, later ones are written again.

        with pm.Recorder("arch.pvd", problem, fields=("displacement", "stress")) as recorder:
            for step in problem.march(10):
                recorder.record(step)

    Finite elements are written as the undeformed mesh of degree 1 or 2 (of degree 3: of degree 1, through the
    corners of its cells), with displacement and rotation at its nodes: ParaView's "Warp By Vector" shows
    the deformed body. The other fields are on the cells: means over the quadrature points weighted by
    reference volume; volume and id are the cell's own.

    Args:
        path: of the collection, ending in .pvd; missing folders are made.
        problem: whose states are written.
        fields: any of displacement (m), rotation (rotation vector, rad), F, stretch (U), wryness (1/m),
            stress (Cauchy, Pa), couple_stress (N/m), mean_pressure (Pa), p (the same), q (Pa), von_mises (the
            same), lode_angle (rad), principal_stress (Pa, the largest first), skew_stress (Pa), energy (per
            reference volume, Pa), volume (m^3; m^2 in plane strain), id, material, unresolved (share of the
            last step's work that is done inside a point's box); with plastic materials hardening (chi),
            plastic_strain (logarithmic), equivalent_plastic_strain and dissipation (per reference volume,
            Pa); with second-gradient materials grad_F (1/m) and double_stress (N/m); in dynamic problems
            velocity (m/s) and spin (rad/s). Tensors have 9 components, row by row, named xx, xy and so on,
            grad_F and double_stress 27. A field of your own is a `Field`, a function of the points, or a
            `MaterialField`, a UFL expression: `pm.Field("J", lambda points: np.linalg.det(points.F))`,
            `pm.MaterialField("deviator", lambda s: ufl.dev(s.stress), "Pa")`.
        grid: also write the occupied cells of the background grid to `arch_grid.pvd`, at their position
            at the last reset, with displacement_increment (m) and rotation_increment (rad) since then.
        contact: also write the sites of all obstacles to `arch_contact.pvd`, where they are: obstacle (its
            number), gap (m), pressure (Pa), traction (on the body, Pa), area (m^2; m in plane strain), with
            microrotations couple (N/m).
        domains: show a point as the box of its current GIMPM domain, with the fields on cells; False as
            a vertex, with the fields on points. Of finite elements, False shows the quadrature points at
            their current positions.
        smooth: of finite elements, fields at the nodes instead of cells' means: fitted to the quadrature
            points around them, see `problem.recover`.
        initial: write the present state on entering the `with` statement, unless a collection is gone on with
            that has it.

    Raises:
        InputError: an argument is not what it should be, an unknown field, a grid of finite elements, or
            files that can't be written; on every rank alike. When states are written: a user's field without
            a row for each point.
        OutputError: a file can't be written, such as on a full disc; what was written before stays, and the
            run can go on.
    """

    @collective("Recorder", comm=lambda self, path, problem, *args, **options: problem.comm, compare=True)
    def __init__(
        self,
        path: str | os.PathLike[str],
        problem: Any,
        *,
        fields: str | AnyField | Sequence[str | AnyField] = ("displacement", "rotation"),
        grid: bool = False,
        contact: bool = False,
        domains: bool = True,
        smooth: bool = False,
        initial: bool = True,
    ):
        checks.instance("problem", problem, Problem, "a QuasiStatic or QuasiStaticFEM is")
        self.problem, self.domains = problem, checks.flag("domains", domains)
        self.initial, grid = checks.flag("initial", initial), checks.flag("grid", grid)
        self.fields = choose(fields, problem.points)
        self._meshed = isinstance(problem, QuasiStaticFEM)
        self.smooth = checks.flag("smooth", smooth)
        self._around: Stencil | None = None
        if smooth and not (self._meshed and self.domains):
            raise InputError("smooth = True: of finite elements with domains=True; points have no nodes")
        if grid and self._meshed:
            raise InputError("grid = True: finite elements have no background grid")
        file = checks.path("path", path, "the name of a .pvd file")
        folder = file.with_suffix("")
        self._points = Collection(file, folder, problem.comm)
        self._grid: Collection | None = None
        if grid:
            self._grid = Collection(file.with_name(f"{file.stem}_grid.pvd"), folder, problem.comm)
        self._contact: Collection | None = None
        if checks.flag("contact", contact):
            self._contact = Collection(file.with_name(f"{file.stem}_contact.pvd"), folder, problem.comm)

    def __enter__(self) -> Recorder:
        if self.initial and not self._points.has(self.problem.progress.step, self.problem.restored):
            self.record()
        return self

    def __exit__(self, *error: object) -> None:
        """Nothing is left to do: every record is complete."""

    @collective("record of a Recorder", comm=lambda self, *args, **options: self.problem.comm)
    def record(self, step: Step | None = None, *, time: float | None = None) -> None:
        """Write the current state.

        Args:
            step: the last step of `march`; its number and load factor are used.
            time: shown in ParaView instead of the load factor (for unloading, as its times have to grow).

        Raises:
            InputError: the step is not the last one, whose state has been overwritten; a time that isn't
                finite.
            OutputError: a file can't be written; the step isn't in the collection.
        """
        progress = self.problem.progress
        if step is not None:
            checks.instance("step", step, Step, "a step of march is")
        if step is not None and step.number != progress.step:
            raise InputError(f"step {step.number} can't be recorded: the points are at step {progress.step}")
        time = float(progress.factor) if time is None else checks.number("time", time)
        with self.problem.timer("output"):
            self._record_points(progress.step, time)
            if self._grid is not None:
                self._record_grid(self._grid, progress.step, time)
            if self._contact is not None:
                self._record_contact(self._contact, progress.step, time)

    __call__ = record

    def _of_step(self, number: int) -> dict[str, Any]:
        """What tells the step from that of another run."""
        steps = self.problem.steps
        known = steps[-1] if steps and steps[-1].number == number else None
        return {"mark": mark_of(known), "run": self.problem.restored}

    def _record_points(self, number: int, time: float) -> None:
        if self._meshed and self.domains:
            at_points = field_arrays(self.problem, [f for f in self.fields if f.name not in NODAL])
            at_nodes = self._smoothed(at_points) if self.smooth else {}
            names = [f.name for f in self.fields]
            piece = mesh_piece(self.problem.elements, names, at_points, at_nodes)
            self._points.add(number, time, **piece, **self._of_step(number))
            return
        points, data = self.problem.points, field_arrays(self.problem, self.fields)
        if self.domains:
            corners = box_corners(points.x, points.half_length)
            cells = np.arange(corners.shape[0] * corners.shape[1]).reshape(corners.shape[:2])
            x = corners.reshape(-1, points.dim)
            self._points.add(number, time, x, cells, cell_data=data, **self._of_step(number))
        else:
            vertices = np.arange(len(points))[:, None]
            self._points.add(number, time, points.x, vertices, point_data=data, **self._of_step(number))

    def _smoothed(self, at_points: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Take fields out of those at the points, and give their values at the local nodes. Collective."""
        points, names = self.problem.points, [name for name in at_points if name not in OF_CELLS]
        if self._around is None:
            self._around = stencil(points, self.problem.elements.nodes.position)
        return {name: self._around.apply(points, at_points.pop(name)) for name in names}

    def _record_contact(self, collection: Collection, number: int, time: float) -> None:
        """All ranks know all sites; each writes some of them."""
        comm, dim = self.problem.comm, self.problem.layout.dim
        own = slice(comm.rank, None, comm.size)
        obstacles = [term for term in self.problem.terms if isinstance(term, Sites)]
        names = ("gap", "pressure", "area", "traction", "couple")
        data = {"obstacle": [np.full(len(one.gap), k + 1)[own] for k, one in enumerate(obstacles)]}
        data |= {
            name: [np.nan_to_num(getattr(one, name), posinf=_NOWHERE)[own] for one in obstacles]
            for name in names
        }
        joined = {name: np.concatenate(parts) for name, parts in data.items() if parts}
        for name in ("traction", "couple"):
            values = joined.get(name, np.zeros((0, 0)))
            if name == "couple" and values.shape[1] == 1:
                values = np.pad(values, ((0, 0), (2, 0)))
            joined[name] = padded(values)
        if not self.problem.layout.rotations:
            del joined["couple"]
        x = np.concatenate([np.zeros((0, dim)), *(one.x[own] for one in obstacles)])
        vertices = np.arange(len(x))[:, None]
        collection.add(number, time, x, vertices, point_data=joined, **self._of_step(number))

    def _record_grid(self, collection: Collection, number: int, time: float) -> None:
        problem, grid = self.problem, self.problem.grid
        dim, system = grid.dim, problem.system
        # The increments belong to the lattice at the last reset, hence to the cells occupied then.
        x = problem.points.x if system is None else system.interpolation.reference.x
        if problem.basis.sliver:  # a sliver's far corners have no value
            index = problem.basis.supporting_cells(grid, x)
            x = grid.corners(index) + 0.5 * grid.sizes(index)
        cells = corner_numbers(grid, occupied_cells(grid, x))
        numbers, table = np.unique(cells, return_inverse=True)
        increments = np.zeros((len(numbers), problem.layout.block))
        if system is not None:
            # splines have no nodes at the corners; domains of no length have the standard weights
            corners = grid.node_position(numbers)
            nodes, weight = problem.basis.weights(grid, corners, np.zeros_like(corners)).products(grid)
            wanted, at = np.unique(nodes, return_inverse=True)
            own = system.nodes.owned
            nodal = values_by_number(
                grid.comm, system.nodes.lattice[:own], np.asarray(system.x[:own]), wanted
            )
            increments = np.einsum("nk,nkc->nc", weight, nodal[at.reshape(nodes.shape)])
        data = {"displacement_increment": padded(increments[:, :dim])}
        if problem.layout.rotations:
            rotation = increments[:, dim:]
            data["rotation_increment"] = rotation if dim == 3 else np.pad(rotation, ((0, 0), (2, 0)))
        x, shaped = grid.node_position(numbers), table.reshape(cells.shape)
        collection.add(number, time, x, shaped, data, **self._of_step(number))
