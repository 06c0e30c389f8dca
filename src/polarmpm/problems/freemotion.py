"""Rigid motions of a body, or of parts of it, that nothing holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.parts import Parts
from ..assembly.system import NodalSystem
from ..conditions.supports import component_names
from ..errors import Finding
from ..solvers.rigidmotions import rigid_motions
from ..terms.base import Piece
from ..terms.ghost import Ghost
from ..terms.surfaces import Pressure, SurfaceSupport, Traction
from .wording import counted, own_ids, place

_HELD = 1e-9  # mean square of a motion at prescribed unknowns, or stiffness relative to the body's: it's free
_UNBALANCED = 1e-8  # share of the forces that push along a motion
_NO_BODY = 1e-9  # of the largest volume at a node: what is prescribed there holds nothing
_ROUND = 1e-6


@dataclass(frozen=True)
class Free:
    """A part that is free to move.

    Attributes:
        number: of the part.
        translations: orthonormal directions (k, d) along which it can move.
        turns: axes (k, 3) about which it can turn; their length is one.
        through: a point (d,) of each axis.
        pushed: forces work on such a motion.
        held: names of the supports that hold some of it, with what they hold.
    """

    number: int
    translations: np.ndarray
    turns: np.ndarray
    through: np.ndarray
    pushed: bool
    held: list[str]


def holds(piece: Piece) -> bool:
    """Whether a term's stiffness may hold a body: loads and ghost penalties don't."""
    return not isinstance(piece.of, Traction | Pressure | Ghost)


def free_parts(system: NodalSystem, parts: Parts, forces: np.ndarray, diagonal: np.ndarray) -> list[Free]:
    """Parts that can move as rigid bodies. Collective.

    Args:
        forces: out-of-balance ones (nodes, block), complete on owned rows.
        diagonal: of the tangent (owned nodes, block).
    """
    layout, comm, own = system.layout, system.comm, slice(0, system.nodes.owned)
    modes = _modes(system, parts)
    label = parts.nodes[own]
    known = label >= 0
    volume = system.node_volumes()[own]
    real = known & (volume > _NO_BODY * comm.allreduce(float(volume.max(initial=0.0)), op=MPI.MAX))
    number, k = len(parts.count), len(modes)
    gram = np.zeros((number, k, k))
    as_length = _as_length(system, parts)[own]
    for column in range(layout.block):
        rows = np.flatnonzero(real & system.prescribed.fixed[own, column])
        b = modes[:, rows, column] * (as_length[rows] if column >= layout.dim else 1.0)
        np.add.at(gram, label[rows], np.einsum("in,jn->nij", b, b))
    gram += _of_ties(system, parts, modes, real)
    gram += _of_terms(system, parts, modes, diagonal, real)
    push = np.zeros((number, k))
    size = np.zeros(number)
    r = system.on_free(forces)[own]
    np.add.at(push, label[known], np.einsum("inb,nb->ni", modes[:, own], r)[known])
    np.add.at(size, label[known], np.abs(r * system.as_force).sum(axis=1)[known])
    gram, push, size = comm.allreduce(gram), comm.allreduce(push), comm.allreduce(size)
    if layout.axial:  # the hoop holds all but the motion along the axis
        gram += np.diag([1.0, 0.0, 1.0])
    held = _held(system, parts, real)
    found = []
    for part in range(number):
        values, vectors = np.linalg.eigh(gram[part])
        limit = max(_HELD, 1e-13 * float(values.max(initial=0.0)))
        null = vectors[:, values < limit].T
        if len(null):
            pushed = bool(np.linalg.norm(null @ push[part]) > _UNBALANCED * size[part])
            length = float(_sizes(system, parts)[part])
            found.append(_describe(layout.dim, parts, part, null, length, pushed, held[part]))
    return found


def _of_ties(system: NodalSystem, parts: Parts, modes: np.ndarray, real: np.ndarray) -> np.ndarray:
    """What slope and symmetry supports prevent of motions (parts, k, k), on this rank."""
    ties, k = system.prescribed.ties, len(modes)
    out = np.zeros((len(parts.count), k, k))
    if ties is None:
        return out
    rows, columns = np.nonzero(ties.tied[: system.nodes.owned] & real[:, None])
    leads = ties.factor[rows, columns] * modes[:, ties.master[rows, columns], columns]
    b = (modes[:, rows, columns] - leads) * _sizes(system, parts)[parts.nodes[rows]] / system.length.min()
    np.add.at(out, parts.nodes[rows], np.einsum("in,jn->nij", b, b))
    return out


def _sizes(system: NodalSystem, parts: Parts) -> np.ndarray:
    """Length (m) of each part that scales its turns."""
    sizes: np.ndarray = np.maximum(parts.size, float(system.length.min()))
    return sizes


def _as_length(system: NodalSystem, parts: Parts) -> np.ndarray:
    lengths: np.ndarray = _sizes(system, parts)[np.maximum(parts.nodes, 0)]
    return lengths


def _modes(system: NodalSystem, parts: Parts) -> np.ndarray:
    """Rigid motions of each part about its centre, (k, nodes, block); a turn moves by about one."""
    d = system.layout.dim
    arm = system.positions() - parts.centre[np.maximum(parts.nodes, 0)]
    modes = rigid_motions(arm, system.x[:, d:], system.comm, np.zeros(d))
    modes[d:] /= _as_length(system, parts)[:, None]
    modes[:, parts.nodes < 0] = 0.0
    return modes


def _of_terms(
    system: NodalSystem, parts: Parts, modes: np.ndarray, diagonal: np.ndarray, real: np.ndarray
) -> np.ndarray:
    """Stiffness of terms on the motions (parts, k, k), relative to the body's. On this rank."""
    d, k = system.layout.dim, len(modes)
    out = np.zeros((len(parts.count), k, k))
    if not any(holds(piece) for piece in system.terms.pieces):
        return out
    moved = np.stack([system.terms.products(system.x, mode, holds) for mode in modes])
    at = np.flatnonzero(parts.nodes >= 0)
    np.add.at(out, parts.nodes[at], np.einsum("inb,jnb->nij", modes[:, at], moved[:, at]))
    stiff = np.abs(diagonal[real][:, :d])
    sums = system.comm.allreduce(np.array([stiff.sum(), stiff.size, 0.0]))
    mean = sums[0] / max(1.0, sums[1])
    return 1e3 * out / mean if mean > 0 else out


def _held(system: NodalSystem, parts: Parts, real: np.ndarray) -> list[list[str]]:
    """What supports hold of each part, by name. Collective."""
    own, names = slice(0, system.nodes.owned), component_names(system.layout)
    out: list[list[str]] = [[] for _ in parts.count]
    for support, mask in zip(system.prescribed.supports, system.prescribed.masks, strict=True):
        rows = np.flatnonzero(mask[own] & real)
        counts = system.comm.allreduce(np.bincount(parts.nodes[rows], minlength=len(out)))
        for part in np.flatnonzero(counts):
            slopes = [] if support.mirror is None else ["slopes"]
            slopes += ["slopes"] if support.on_facets else []
            held = [*(names[c] for c in sorted(support.columns)), *slopes]
            out[part].append(f"{support.name}: {', '.join(held)}")
    for piece, rows in zip(system.terms.pieces, system.terms.rows, strict=True):
        if isinstance(piece.of, SurfaceSupport):
            numbers = parts.nodes[rows.ravel()]
            counts = np.bincount(numbers[numbers >= 0], minlength=len(out))
            for part in np.flatnonzero(system.comm.allreduce(counts)):
                out[part].append(f"{piece.name}: springs")
    return out


def _describe(
    d: int, parts: Parts, part: int, null: np.ndarray, length: float, pushed: bool, held: list[str]
) -> Free:
    """Directions and axes of a part's free motions, of their coefficients (f, k), turns over a length (m)."""
    spins = null[:, d:]
    values, vectors = np.linalg.eigh(spins @ spins.T)
    still = vectors[:, values < _ROUND].T @ null  # without a turn
    translations = _tidy(still[:, :d]) if len(still) else np.zeros((0, d))
    turning = vectors[:, values >= _ROUND].T @ null
    turning = _reduced(turning, d)
    axes, through = [], []
    for row in turning:
        size = np.linalg.norm(row[d:])
        axis = np.pad(row[d:], (2, 0)) / size if d == 2 else row[d:] / size
        along = np.pad(row[:d], (0, 3 - d)) * length / size
        arm = np.cross(axis, along)  # where the motion vanishes, but for a part along the axis
        axes.append(axis)
        through.append(parts.centre[part] + arm[:d])
    turns = np.array(axes).reshape(-1, 3), np.array(through).reshape(-1, d)
    return Free(part, translations, *turns, pushed, held)


def _reduced(rows: np.ndarray, first: int) -> np.ndarray:
    """The same span, so that the columns from `first` on have as many zeros as possible."""
    rows, done = rows.copy(), 0
    for column in range(first, rows.shape[1]):
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) < 1e-3:
            continue
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        others = np.arange(len(rows)) != done
        rows[others] -= rows[others, column][:, None] * rows[done]
        done += 1
    return rows


def _tidy(directions: np.ndarray) -> np.ndarray:
    """Orthonormal vectors of the same span, along the axes where that is possible."""
    reduced = _reduced(directions, 0)
    q, _ = np.linalg.qr(reduced.T)
    tidy: np.ndarray = q.T * np.where(q.T.sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return np.where(np.abs(tidy) < _ROUND, 0.0, tidy)


# words ----------------------------------------------------------------------------------------------------
def findings(problem: Any, system: NodalSystem, parts: Parts, free: list[Free]) -> list[Finding]:
    """Free motions in words, at most three. Collective."""
    free = sorted(free, key=lambda f: not f.pushed)
    out = [_finding(system, parts, one, problem) for one in free[:3]]
    if len(free) > 3:
        rest = len(free) - 3
        last = out[-1]
        text = f"{last.text}; {rest} more part(s) of the body are free, too"
        out[-1] = Finding(last.kind, text, last.places, last.ids, last.unknowns, last.direction)
    return out


def _finding(system: NodalSystem, parts: Parts, one: Free, problem: Any) -> Finding:
    d = system.layout.dim
    centre = tuple(float(c) for c in parts.centre[one.number])
    what = "the body"
    if len(parts.count) > 1:
        what = f"the part of {counted(problem, parts.count[one.number])} around {place(centre)} m"
    motions = _motions(one, d, system.length.min() * 1e-6)
    if one.held:
        why = f"of it the supports hold no more than {'; '.join(one.held[:4])}"
    else:
        why = "no support holds it"
        if system.prescribed.supports and len(parts.count) > 1:
            why = "no support has any of its nodes"
    push = "the load pushes it that way" if one.pushed else "the load on it is in balance"
    text = f"{what} can {motions}: {why}, and {push}; fix it, or hold a Surface by springs"
    first = one.translations[0] if len(one.translations) else one.turns[0]
    of_part = own_ids(problem)[parts.points == one.number]
    ids = np.unique(np.concatenate(system.comm.allgather(np.unique(of_part)[:5])))[:5]
    direction = tuple(float(c) for c in first)
    return Finding("free rigid motion", text, (centre,), tuple(map(int, ids)), direction=direction)


def _motions(one: Free, dim: int, rounding: float) -> str:
    said = []
    if len(one.translations) == dim:
        said.append("move in all directions")
    elif len(one.translations):
        said.append("move along " + " and ".join(axis_name(v) for v in one.translations))
    if len(one.turns) == (1 if dim == 2 else 3):
        said.append("turn")
    elif len(one.turns):
        said.append("turn about " + " and ".join(f"the axis along {axis_name(v)}" for v in one.turns))
    if said[-1].startswith("turn") and len(one.turns) == 1 and not len(one.translations):
        through = np.where(np.abs(one.through[0]) < rounding, 0.0, one.through[0])
        said[-1] += f" {'about' if dim == 2 else 'through'} {place(through)} m"
    return " and ".join(said)


def axis_name(direction: np.ndarray) -> str:
    """ "x", "y", "z", or the numbers."""
    for name, value in zip("xyz", direction, strict=False):
        if abs(abs(value) - 1.0) < _ROUND:
            return name
    return place(direction)
