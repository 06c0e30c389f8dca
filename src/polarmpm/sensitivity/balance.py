"""Derivatives of balanced resets: of the initial stresses and forces that they carry (`assembly.carrying`).

Each of the motions w of which initial stresses are made solves K w = -r, so that its derivative solves
K dw = -(dr + dK w), with the factor that the reset has left: dK is the change of the material part of the
tangents, and of the weighting functions, times w. That of the shift that keeps the tangents regular is left
out: what it does is less than rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..assembly.batchrates import BatchRates
from ..assembly.carrying import Moduli, closing_at
from ..assembly.pointfunctions import framed
from ..assembly.ratestate import At, Change
from ..forms.directional import FormAlong, InitialAlong
from ..forms.projected import ProjectedForm
from ..solvers.linear import SingularTangent
from ..tools.rows import flat
from .differences import along


class CarriedModuli:
    """The material part of a batch's tangents at a reset, and its changes.

    Args:
        along: of the batch's form.
    """

    def __init__(self, system: Any, k: int, batch: BatchRates, own: FormAlong, initial: InitialAlong):
        form = batch.form
        self.batch, self.layout, self.initial = batch, batch.layout, initial
        self.form = system.initial.kernels[k].form
        self._moduli = Moduli(system, k)
        self._along = own
        if isinstance(form, ProjectedForm):
            self._along = FormAlong(form.plain, own.comm)
        self._size = form.state_size
        self._rows = system.elastic_blocks(k)[:, : self.layout.unknowns]

    def work(self, z: np.ndarray) -> np.ndarray:
        """What a z (n, nz) does work on, with the shift."""
        return self._moduli.work(z)

    def plain(self, z: np.ndarray) -> np.ndarray:
        """The same without the shift."""
        found: np.ndarray = self._moduli.work(z) - self._moduli.shift * z
        return found

    def stresses(self, work: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """(n, b, d) that do work (n, nz)."""
        layout = self.layout
        rows = [layout.part(work, field, 1) for field in ("displacement", "rotation")]
        found: np.ndarray = np.concatenate(rows, axis=1) @ np.swapaxes(frames, 1, 2)
        return found

    def packed(self, work: np.ndarray) -> np.ndarray | None:
        """What `pack` gives of `stresses`, of micropolar materials: frames drop out of it. None of others."""
        layout = self.layout
        if not layout.rotations:
            return None
        rows = [layout.part(work, field, 1) for field in ("displacement", "rotation")]
        return flat(np.concatenate(rows, axis=1))

    def change(self, z: np.ndarray, state: np.ndarray, change: Change) -> np.ndarray:
        """Of `work` at constant z, as the state (n, packed size) and the material's numbers change."""
        still, d = np.zeros_like(z), self.layout.dim**2
        state, dstate = state[:, : self._size], change.state[:, : self._size]
        numbers = [np.tile(a, (len(z), 1)) for a in (self.batch.numbers, change.parameters)]
        of_material = self._along.moduli(still, z, state, dstate, *numbers)
        rows = self._along.residual(still, still, state, dstate, *numbers)
        frames, turned = self.batch.frames(state), self.batch.frames(dstate)

        def packed(work: np.ndarray, frames: np.ndarray) -> np.ndarray:
            found: np.ndarray = self.form.pack(self.stresses(work, frames), frames)
            return found

        stress, dstress = self.packed(self._rows), self.packed(rows)
        if stress is None or dstress is None:
            stress = packed(self._rows, frames)
            dstress = along(packed, [self._rows, frames], [rows, turned])
        geometric = self.initial.moduli(still, z, state[:, :d], dstate[:, :d], stress, dstress)
        found: np.ndarray = of_material - geometric
        return found


def closing_change(
    system: Any, forces: np.ndarray, change: np.ndarray, moved: np.ndarray, volumes: np.ndarray
) -> np.ndarray:
    """Changes of the forces (nodes, block) that close carried ones, which change by so much while nodes move
    (nodes, d) and the body's shares change (nodes,). Collective."""
    at = [system.positions(), system.node_volumes(), forces]

    def close(*given: np.ndarray) -> np.ndarray:
        return closing_at(system, *given)

    return along(close, at, [moved, volumes, change], comm=system.comm)


class Carried:
    """What a reset carries, as all parameters need it. Collective.

    Attributes:
        at: the points of each batch, at no increments and without initial stresses.
    """

    def __init__(self, run: Any):
        self.run, system = run, run.system
        self._x = np.zeros_like(system.x)
        self._motions: dict[tuple[int, int], tuple[np.ndarray, ...]] = {}
        self.at = [
            batch.at(self._x, batch.batch.batch.kept["state"], system.kernels[k], None)
            for k, batch in enumerate(run.batches)
        ]
        run.put_couples(self.at, run.carried_loads[1])
        self.moduli: list[CarriedModuli] = []
        if system.carried_by:
            for k, (batch, own) in enumerate(zip(run.batches, run.along, strict=True)):
                run.take_initial(k)
                assert batch.initial is not None
                self.moduli.append(CarriedModuli(system, k, batch, own, batch.initial[1]))

    def rates(self, changes: list[Change], external: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the carried forces (nodes, block) where initial stresses stay zero, and where they
        change with all else: then those of the packed stresses are put into `changes`.

        Args:
            external: changes of the loads' forces (nodes, block).
        """
        run, system = self.run, self.run.system
        shift = self._shift_change(changes)
        left = [system.on_free(run.forces(self.at, self._x, None, changes) - external)]
        stress = [np.zeros(0)] * len(self.at)
        dstress = list(stress)
        for number, w in enumerate(system.carried_by):
            more, of_stress = np.zeros_like(w), np.zeros_like(w)
            parts = list(zip(run.batches, self.moduli, self.at, changes, strict=True))
            found = [self._first(number, *part, w, more) for part in parts]
            system.nodes.add_to_owners(more)
            more[: system.owned] += shift * w[: system.owned]
            dw = -self._solved(left[-1] + system.on_free(more))
            for k, (batch, moduli, here, change) in enumerate(parts):
                work, dwork = found[k]
                frames, turned = batch.frames(here.state), batch.frames(change.state)
                dz = framed(batch.layout, batch.functions.gather(dw)[0], frames)
                dwork = dwork + moduli.plain(dz)
                s, ds = moduli.packed(work), moduli.packed(dwork)
                if s is None or ds is None:
                    s, ds = moduli.stresses(work, frames), moduli.stresses(dwork, frames)
                    ds = ds + moduli.stresses(work, turned)
                first = not stress[k].size
                stress[k] = packed = s if first else stress[k] + s
                dstress[k] = change.initial = ds if first else dstress[k] + ds
                if not batch.layout.rotations:
                    pack = moduli.form.pack
                    change.initial = along(pack, [stress[k], frames], [dstress[k], turned])
                    packed = np.ascontiguousarray(pack(stress[k], frames))
                of_stress += batch.forces_of_initial(here, packed, change)
            system.nodes.add_to_owners(of_stress)
            left.append(left[0] + system.on_free(of_stress))
        return left[0], left[-1]

    def _solved(self, forces: np.ndarray) -> np.ndarray:
        """Increments (nodes, block) by which the factor makes up for forces. Where nothing holds the body but
        springs, which a reset carries, it has motions without stiffness, on which there is rounding alone:
        the factor's answer is taken as it is. Collective."""
        system, own = self.run.system, self.run.system.owned
        try:
            found: np.ndarray = self.run.precondition(forces)
        except SingularTangent:
            found = np.zeros_like(forces)
            right = system.on_free(forces)[:own].ravel()
            found[:own] = system.solver.precondition(right).reshape(found[:own].shape)
            system.complete(found)
            found[system.prescribed.fixed] = 0.0
        return found

    def _shift_change(self, changes: list[Change]) -> Any:
        """Of what has been added to the matrix' diagonal (owned nodes, block), a share of the largest
        entries."""
        system = self.run.system
        shift = system.moduli_shift
        if not self.moduli or shift.share is None or shift.most is None:
            return 0.0
        most = np.zeros_like(shift.most)
        for c in range(len(most)):
            unit, more = np.zeros_like(self._x), np.zeros_like(self._x)
            at = np.flatnonzero(system.unshifted[:, c] >= shift.most[c] * (1.0 - 1e-12))[:1]
            unit[at, c] = 1.0
            system.nodes.update_ghosts(unit)
            for part in zip(self.run.batches, self.moduli, self.at, changes, strict=True):
                self._first(None, *part, unit, more)
            system.nodes.add_to_owners(more)
            largest = np.argmax(np.abs(more[at, c])) if len(at) else None
            found = 0.0 if largest is None else float(more[at, c][largest] / shift.share[at, 0][largest])
            everywhere = system.comm.allgather((len(at) > 0, found))
            most[c] = next((value for there, value in everywhere if there), 0.0)
        return shift.factor * shift.share * most

    def _of_motion(
        self, number: int | None, batch: BatchRates, moduli: CarriedModuli, at: At, w: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Of a motion w, which has a number if more parameters ask for it: its unknowns in the lattice's axes
        and in the frames, and what they do work on, with the shift and without."""
        key = None if number is None else (number, id(batch))
        if key is not None and key in self._motions:
            return self._motions[key]
        g = batch.functions.gather(w)[0]
        z = framed(batch.layout, g, batch.frames(at.state))
        found = g, z, moduli.work(z), moduli.plain(z)
        if key is not None:
            self._motions[key] = found
        return found

    def _first(
        self,
        number: int | None,
        batch: BatchRates,
        moduli: CarriedModuli,
        at: At,
        change: Change,
        w: np.ndarray,
        out: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """What a motion w does work on without the shift, and the change of this while w stays; that of the
        forces is added to `out` (nodes, block)."""
        layout, frames, turned = batch.layout, batch.frames(at.state), batch.frames(change.state)
        g, z, work, plain = self._of_motion(number, batch, moduli, at, w)
        dg = sum((f.gather(w)[0] for f in change.functions), np.zeros_like(g))
        dz = framed(layout, dg, frames) + framed(layout, g, turned, values=False)
        bent = moduli.change(z, at.state, change)
        dwork = bent + moduli.work(dz)
        back, back_turned = np.swapaxes(frames, 1, 2), np.swapaxes(turned, 1, 2)
        raw = framed(layout, dwork, back) + framed(layout, work, back_turned, values=False)
        out += batch.functions.spread(raw, None)
        for functions in change.functions:
            out += functions.spread(framed(layout, work, back), None)
        return plain, bent + moduli.plain(dz)
