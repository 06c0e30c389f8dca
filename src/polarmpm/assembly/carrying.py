"""Balanced resets: what the new basis can't balance is carried as an initial stress of the points.

The out-of-balance forces r of the points' stresses in the new basis are given to a field of initial
stresses a : grad w, where w solves K w = -r and K sums the material part a of the points' tangents. They
balance in force and in moment for whatever the body does until the next reset (`forms.initialstress`). What
no stress can balance stays a dead force on the nodes, which forces on prescribed unknowns close
(docs/theory.md).
"""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from ..kinematics.layout import Layout
from ..solvers.linear import SingularTangent
from .loadedpoints import LoadedPoints
from .system import NodalSystem

_SOFTEST = 1e-8  # stiffness of directions that the material has none in (turns), over that of the others
_SOLUTIONS = 2  # the shift leaves 1e-8 of r after the first one, an iterative solver its accuracy
_THIN = 1e-7  # shift of the matrix over its largest diagonal, where nodes are reached by too little
_SINGULAR = 1e-3  # of the forces left after a solution without a shift: there are motions that no point feels
_RANK = 1e-10  # of the equations for closing forces


# the material part of the tangents --------------------------------------------------------------------
class Moduli:
    """Material part a = A - A_geo of the tangents of a batch's points at z = 0, in their frames.

    A_geo is the tangent of initial stresses as large as the material's. Of plastic points a is the elastic
    one with frozen flow.

    Attributes:
        blocks: no residual, then a with a small shift: (n, nz (1 + nz)).
        shift: of the diagonal (n, nz).
    """

    def __init__(self, system: LoadedPoints, k: int):
        self._batch = batch = system.interpolation.batches[k]
        self._layout = layout = batch.form.layout
        n, nz = len(batch.rows), layout.unknowns
        still, of_material = np.zeros((n, nz)), system.elastic_blocks(k)
        assert system.initial is not None
        kernels, frame = system.initial.kernels[k], batch.batch.frames
        stress = self.stresses(of_material[:, :nz])
        geometric = kernels.blocks(still, frame, kernels.form.pack(stress, frame, batch.grown))
        self.blocks: np.ndarray = np.zeros((n, nz + nz * nz))
        a, upper = self._matrices, np.triu_indices(nz)
        a[:, upper[0], upper[1]] = a[:, upper[1], upper[0]] = (of_material - geometric)[:, nz:]
        diagonal = np.einsum("nii->ni", a)
        self.shift = shift_of(layout, diagonal)
        diagonal += self.shift

    @property
    def _matrices(self) -> np.ndarray:
        n, nz = len(self.blocks), self._layout.unknowns
        a: np.ndarray = self.blocks[:, nz:].reshape(n, nz, nz)
        return a

    def stresses(self, work: np.ndarray) -> np.ndarray:
        """Stresses (n, b, d), with second gradients (n, d, d + m), that do the work (n, nz) on variations
        of z in the points' frames."""
        rows, frame = (
            [self._layout.part(work, field, 1) for field in ("displacement", "rotation")],
            self._frames,
        )
        stresses: np.ndarray = np.concatenate(rows, axis=1) @ np.swapaxes(frame, 1, 2)
        grown = self._batch.grown
        if grown is None:
            return stresses
        j, k = self._layout.pairs
        second = self._layout.part(work, "displacement", 2)
        t = self._layout.symmetric(np.where(j == k, 1.0, 0.5) * second)
        moved = np.einsum("nijk,naj,nbk->niab", t, frame, frame, optimize=True)[:, :, j, k]
        stresses = stresses + second @ np.swapaxes(grown, 1, 2)
        return np.concatenate([stresses, np.where(j == k, 1.0, 2.0) * moved], axis=2)

    @property
    def _frames(self) -> np.ndarray:
        return self._batch.batch.frames

    def work(self, z: np.ndarray) -> np.ndarray:
        """What a z does on variations of z, with the shift: (n, nz) of z (n, nz)."""
        return np.ascontiguousarray(np.einsum("nij,nj->ni", self._matrices, z))

    def times(self, z: np.ndarray) -> np.ndarray:
        """Stresses a z (n, b, d) of z (n, nz)."""
        return self.stresses(np.einsum("nij,nj->ni", self._matrices, z) - self.shift * z)


def shift_of(layout: Layout, diagonal: np.ndarray) -> np.ndarray:
    """What is added to the diagonal (n, nz) of moduli, so that nothing is without stiffness."""
    shift: np.ndarray = _SOFTEST * np.abs(diagonal)
    of_gradient = layout.where("displacement", 1)
    shift[:, of_gradient] = shift[:, of_gradient].mean(axis=1, keepdims=True)
    return shift


# resets -----------------------------------------------------------------------------------------------
def carry_stress(system: LoadedPoints) -> None:
    """Take the present state, at a reset, as an equilibrium: carry what is out of balance in it as initial
    stresses, and the rest as forces. Collective."""
    initial, i = system.initial, system.interpolation
    assert initial is not None
    initial.replace(np.zeros_like(i.reference.initial_stress))
    left = system.imbalance()
    size, shifts = _norm(system, left), (_THIN,) if i.basis.thin_reach else (0.0, _THIN)
    if size == 0.0:
        system.carried = left + closing(system, left)
        return
    moduli = [Moduli(system, k) for k in range(len(i.batches))]
    for shift in shifts:
        initial.replace(np.zeros_like(i.reference.initial_stress))
        system.carried_by = []
        try:
            rest = _carry(system, left, moduli, shift)
        except SingularTangent:  # a body in parts that nothing holds, or motions that no point feels
            continue
        if shift or _norm(system, rest) <= _SINGULAR * size:  # or else rounding has chosen the stresses
            system.carried = rest + closing(system, rest)
            return
    system.carried_by = []
    carry_forces(system)


def _carry(system: LoadedPoints, left: np.ndarray, moduli: Sequence[Moduli], shift: float) -> np.ndarray:
    """Carry forces (nodes, block) as initial stresses, by moduli with a shift of their matrix; what is left
    of them. Collective."""
    initial, i, size = system.initial, system.interpolation, _norm(system, left)
    assert initial is not None
    system.assemble_moduli([m.blocks for m in moduli], shift)
    for k in range(1 if shift else _SOLUTIONS):
        w, before = system.carrying_motion(left, k, moduli), i.reference.initial_stress.copy()
        initial.replace(before + _stresses(system, moduli, w))
        now = system.imbalance()
        if not _norm(system, now) < size:  # rounding is reached
            initial.replace(before)
            break
        system.carried_by = [*system.carried_by[:k], w]
        system.unresisted = system.unresisted if k else _unresisted(system, moduli, w)
        left, size = now, _norm(system, now)
    return left


def _unresisted(system: LoadedPoints, moduli: Sequence[Moduli], w: np.ndarray) -> float:
    """Share of the work of a motion w (nodes, block) that the shift of the moduli has done. Collective."""
    sums, i = np.zeros(2), system.interpolation
    for b, a in zip(i.batches, moduli, strict=True):
        z = i.kernel_inputs(b, w)[:, : b.form.layout.unknowns]
        weighted = b.batch.kept["volume"][:, None] * z
        sums += np.sum(weighted * a.shift * z), np.sum(weighted * a.work(z))
    of_shift, whole = system.comm.allreduce(sums)
    return float(of_shift / whole) if whole > 0.0 else 0.0


def carry_forces(system: LoadedPoints) -> None:
    """The same with forces alone. Collective."""
    if system.initial is not None:
        system.initial.replace(np.zeros_like(system.interpolation.reference.initial_stress))
    left = system.imbalance()
    system.carried = left + closing(system, left)


def _stresses(system: LoadedPoints, moduli: Sequence[Moduli], w: np.ndarray) -> np.ndarray:
    """What nodal displacements and rotations w (nodes, block) make of stresses at the points, (np, b, d)."""
    i = system.interpolation
    out = np.zeros_like(i.reference.initial_stress)
    for b, a in zip(i.batches, moduli, strict=True):
        found = a.times(i.kernel_inputs(b, w)[:, : b.form.layout.unknowns])
        out[b.rows, :, : found.shape[2]] = found
    return out


def _norm(system: LoadedPoints, forces: np.ndarray) -> float:
    """Of forces (nodes, block), complete on owned rows; couples count as forces. Collective."""
    own = np.sum((forces[: system.owned] * system.as_force) ** 2)
    return float(np.sqrt(system.comm.allreduce(own)))


def close_again(system: LoadedPoints) -> None:
    """Close the carried forces at the present positions: dead forces come to have a moment as the body turns.
    The equilibrium stays, as forces on prescribed unknowns move nothing; the reactions of the last evaluation
    follow. Collective."""
    before, fixed = system.carried, system.prescribed.fixed
    if system.comm.allreduce(bool(np.any(before)), op=MPI.LOR):
        free = np.where(fixed, 0.0, before)
        system.carried = free + closing(system, free)
        system.residual = system.residual + before - system.carried


def closing(system: NodalSystem, forces: np.ndarray) -> np.ndarray:
    """The smallest forces (nodes, block) on prescribed unknowns that leave forces without a sum and without a
    moment, as far as they can. Collective.

    They are weighted by the nodes' volumes: nodes that hardly belong to the body get hardly any.
    """
    return closing_at(system, system.positions(), system.node_volumes(), forces)


def closing_at(
    system: NodalSystem, positions: np.ndarray, volumes: np.ndarray, forces: np.ndarray
) -> np.ndarray:
    """The same where nodes have these positions (nodes, d) and volumes (nodes,). Collective."""
    own, comm = system.owned, system.comm
    sums = _sums(system, positions)
    held = system.prescribed.fixed[:own]
    weight = np.where(held, volumes[:own, None] / system.as_force**2, 0.0)
    given = np.einsum("knb,nb->k", sums, forces[:own])
    matrix = np.einsum("knb,nb,lnb->kl", sums, weight, sums)
    given, matrix = comm.allreduce(given), comm.allreduce(matrix)
    out = np.zeros_like(forces)
    out[:own] = -weight * np.einsum("knb,k->nb", sums, np.linalg.pinv(matrix, _RANK, hermitian=True) @ given)
    return out


def _sums(system: NodalSystem, positions: np.ndarray) -> np.ndarray:
    """By what forces (owned nodes, block) are multiplied to sum up to a force and, about the body's middle
    and over its size, a moment: (components, owned nodes, block). Collective."""
    own, d, r = system.owned, system.layout.dim, system.layout.rotations
    x = positions[:own]
    x = x - system.comm.allreduce(x.sum(axis=0)) / system.nodes.total
    size = float(np.sqrt(system.comm.allreduce(np.sum(x**2)) / system.nodes.total)) or 1.0
    axes = [(0, 1, 0)] if d == 2 else [(1, 2, 0), (2, 0, 1), (0, 1, 2)]
    out = np.zeros((d + len(axes), own, d + r))
    for i in range(d):
        out[i, :, i] = 1.0
    if system.layout.axial:  # what is across the axis balances over a turn
        return out[1:2]
    for row, (i, j, k) in enumerate(axes, d):
        out[row, :, j], out[row, :, i] = x[:, i] / size, -x[:, j] / size
        if r:
            out[row, :, d + k] = 1.0 / size
    return out
