"""How the points' state changes with a parameter: what of it is carried from step to step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.batchrates import BatchRates
from ..assembly.bodyweights import patches_of_bodies
from ..assembly.interpolation import Interpolation
from ..assembly.pointfunctions import Functions
from ..assembly.ratestate import At, Change
from ..forms.directional import MotionAlong
from ..forms.projected import ProjectedForm
from ..kinematics import rotations
from ..tools.parallel import values_by_number
from .differences import along

STATE = ("x", "F", "q", "wryness", "plastic_F", "plastic_wryness", "hardening")


class PointRates:
    """Derivatives of the points' state by the logarithm of a parameter, row by row.

    Args:
        begin: of the state with which the run begins, where it depends on the parameter.

    Attributes:
        now: of the last converged state, by attribute of `Points`; before: of the last reset's.
    """

    def __init__(self, problem: Any, begin: Mapping[str, np.ndarray]):
        self.problem, self._ids = problem, problem.points.id.copy()
        self.now = {name: np.zeros_like(getattr(problem.points, name)) for name in self._names()}
        self.now |= begin
        self.before = dict(self.now)

    def _names(self) -> Iterator[str]:
        return (name for name in STATE if isinstance(getattr(self.problem.points, name, None), np.ndarray))

    def reset(self) -> None:
        """The grid has been reset, and points may have gone to other ranks. Collective."""
        points, comm = self.problem.points, self.problem.comm
        if comm.allreduce(int(not np.array_equal(points.id, self._ids)), op=MPI.MAX):
            for name, rows in self.now.items():
                flat = rows.reshape(len(rows), int(np.prod(rows.shape[1:], dtype=int)))
                moved = values_by_number(comm, self._ids, flat, points.id)
                self.now[name] = moved.reshape(len(moved), *rows.shape[1:])
        self._ids, self.before = points.id.copy(), dict(self.now)

    # functions ------------------------------------------------------------------------------------------
    def tables(self, chosen: Any, interpolation: Interpolation) -> np.ndarray | None:
        """Changes of the tables of weights (n, d, orders, slots); None where points stay."""
        p, r, dx = self.problem, interpolation.reference, self.before["x"]
        moving = float(np.abs(dx).max(initial=0.0)) + float(np.abs(self.before["F"]).max(initial=0.0))
        if not p.comm.allreduce(moving, op=MPI.MAX):
            return None
        cell = min(interpolation.grid.smallest)
        basis, at, change, sizes = p.basis, [r.x], [dx], [cell]
        if basis.uses_domains:  # whose half lengths F makes
            at, change, sizes = [*at, r.F], [*change, self.before["F"]], [cell, 1.0]

        def table(x: np.ndarray, F: np.ndarray | None = None) -> np.ndarray:
            half = None
            if F is not None:
                half0 = p.points.half_length0
                half = np.minimum(basis.domains(F, half0), p._most_growth * half0)
            found: np.ndarray = basis.continued(interpolation.grid, x, half, chosen).table
            return found

        return along(table, at, change, sizes)

    def functions(self, batch: BatchRates, table: np.ndarray | None) -> list[Functions]:
        """Of a batch, one direction of the lattice after the other."""
        if table is None:
            return []
        own, axes = batch.batch.batch.kept["weights"], None
        axes = None if batch.boxes is None else batch.boxes._axes
        out = []
        for i in range(batch.layout.dim):
            weights = own.copy()
            weights[:, i] = table[batch.batch.rows][:, i, :, : own.shape[-1]]
            out.append(Functions(batch.batch, batch.nodes, axes, weights))
        return out

    def axes(self, batch: BatchRates) -> Functions | None:
        """Of a batch, with the changes of the half axes."""
        if batch.boxes is None or not np.any(self.before["F"]):
            return None
        d = batch.layout.dim
        dF = self.before["F"][batch.batch.rows, :d, :d]
        changed = np.einsum("pij,pkj->pki", dF, batch.boxes._half_axes0)
        return Functions(batch.batch, batch.nodes, changed)

    def patches(self, batch: BatchRates, cells: np.ndarray, interpolation: Interpolation) -> np.ndarray:
        """Changes of the functions of a batch's patches. Collective."""
        p, r, dx = self.problem, interpolation.reference, self.before["x"]

        def places(x: np.ndarray) -> np.ndarray:
            return patches_of_bodies(interpolation.grid, p.basis, p.points, x, cells)[1]

        moved = 0.5 * (places(r.x + dx) - places(r.x - dx))  # linear
        assert batch.patches is not None
        return batch.patches.moved(moved[batch.batch.rows])

    def turn(self, batch: BatchRates, r: Any) -> np.ndarray | None:
        """Changes of what turns a batch's stiff scalars, at a state r; None where nothing does."""
        form, rows = batch.form, batch.batch.rows
        if batch.turn is None or not isinstance(form, ProjectedForm):
            return None
        return along(form.frames, [r.q[rows]], [self.before["q"][rows]])

    def state(self, batch: BatchRates, r: Any, stabilisation: float) -> np.ndarray:
        """Changes (n, packed size) of a batch's packed state, before a step, where that of what holds points
        to their patches is given; `r`: the state from which increments count."""
        rows, form = batch.batch.rows, batch.form
        names = ("F", "q", "wryness")
        at = [getattr(r, name)[rows] for name in names]
        change = [self.before[name][rows] for name in names]
        if form.material.plastic:
            at += list(self.problem.points.plastic_state(rows))
            change += [self.now[name][rows] for name in ("plastic_F", "plastic_wryness", "hardening")]
        if not batch.layout.axial:
            packed = along(lambda F, q, w, *plastic: form.pack(F, q, w, plastic), at, change)
        else:
            X = self.problem.points.X[rows, 0]

            def pack(x: np.ndarray, F: np.ndarray, q: np.ndarray, w: np.ndarray, *plastic: np.ndarray) -> Any:
                return form.pack(F, q, w, plastic, radii=np.stack([X, x], axis=1))

            packed = along(pack, [r.x[rows, 0], *at], [self.before["x"][rows, 0], *change])
        out = np.zeros((len(rows), form.packed_size))
        out[:, : packed.shape[1]] = packed
        if isinstance(form, ProjectedForm):
            out[:, -1] = stabilisation
        return out

    # after a step -----------------------------------------------------------------------------------------
    def move(
        self,
        batch: BatchRates,
        at: At,
        change: Change,
        nodal: tuple[np.ndarray, np.ndarray],
        reference: Any,
        motion: MotionAlong,
        done: dict[str, np.ndarray],
    ) -> None:
        """Put the changes after a step, at increments and their changes (nodes, block), into `done`."""
        rows, layout, (x, dx) = batch.batch.rows, batch.layout, nodal
        d = layout.dim
        value = batch.functions.values(dx)
        dg = batch.functions.gather(dx)[0]
        for functions in change.functions:
            value += functions.values(x)
            dg += functions.gather(x)[0]
        done["x"][rows] = self.before["x"][rows] + value[:, :d]
        names = ("F", "q", "wryness") if layout.rotations else ("F",)
        before = [getattr(reference, name)[rows] for name in names]
        g = at.g
        if layout.axial:
            radius, change_of_it = reference.x[rows, 0], self.before["x"][rows, 0]
            if motion.by_reference:  # gradients are those by R, which stays
                radius, change_of_it = self.problem.points.X[rows, 0], np.zeros(len(rows))
            g = np.column_stack([g, 1.0 / radius])
            dg = np.column_stack([dg, -change_of_it / radius**2])
        changed = motion(before, [self.before[name][rows] for name in names], g, dg)
        for name, rate in zip(names, changed, strict=True):
            done[name][rows] = rate
        if isinstance(batch.form, ProjectedForm):
            done["F"][rows] = self._projected(batch, at, change, reference)

    def _projected(self, batch: BatchRates, at: At, change: Change, reference: Any) -> np.ndarray:
        form, rows = batch.form, batch.batch.rows
        assert isinstance(form, ProjectedForm)
        n, dframed = len(rows), change.given["z"]
        numbers = [np.tile(a, (n, 1)) for a in (batch.numbers, change.parameters)]
        inputs = at.z, dframed, at.state, change.given["state"], *numbers
        dF = batch.along.moved(*inputs).reshape(n, 3, 3)
        if not (form.rotated and form.material.micropolar):
            return dF
        kernels = form.compile_scalars(batch.along.comm)
        F = kernels.moved(at.z, at.state, numbers[0]).reshape(n, 3, 3)
        q, dq = reference.q[rows], self.before["q"][rows]
        turned = along(lambda q: F @ rotations.to_tensor(q), [q], [dq])
        changed: np.ndarray = dF @ rotations.to_tensor(q) + turned
        return changed

    def flow(
        self,
        batch: BatchRates,
        at: At,
        change: Change,
        reference: Any,
        mapping: Any,
        done: dict[str, np.ndarray],
    ) -> None:
        """Of the plastic state of a batch's points that have yielded, when all else has been moved."""
        y, points = at.yielding, self.problem.points
        if y is None:
            return
        rows, form, X = batch.batch.rows[y.rows], mapping.form, change.given["X"]

        def flowed(
            X: np.ndarray, base: np.ndarray, q: np.ndarray, F: np.ndarray, w: np.ndarray
        ) -> np.ndarray:
            found = mapping.flowed(X, base, q, F, w)
            return np.stack([a for a in found if a is not None], axis=1)

        at_ = [y.X, reference.q[rows], points.q[rows], points.F[rows], points.wryness[rows]]
        changed = [X, self.before["q"][rows], *(done[name][rows] for name in ("q", "F", "wryness"))]
        found = along(flowed, at_, changed)
        done["plastic_F"][rows] = found[:, 0]
        if found.shape[1] > 1:
            done["plastic_wryness"][rows] = found[:, 1]
        done["hardening"][rows] = X[:, form.hardening_column]
