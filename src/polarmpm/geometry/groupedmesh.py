"""Cells with physical groups, checked before dolfinx sees them: what it takes for granted crashes it, or
hangs it on several ranks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..tools import compat
from .cells import unit_corners
from .mshfile import KINDS, Block, Listed, NotAMesh

_USABLE = (2, 3, 4, 5, 9, 10, 11, 12)  # gmsh's types of degree 1 and 2 with all of their nodes
_ENTITIES = ("point", "curve", "surface", "volume")
_FACETS = {
    "triangle": "line",
    "quadrilateral": "line",
    "tetrahedron": "triangle",
    "hexahedron": "quadrilateral",
}
_SAME = 1e-9  # of the body's size: nodes that are nearer than that are at the same place


@dataclass
class GroupedMesh:
    """Cells of one type with groups of cells and facets.

    Attributes:
        kind, degree: name of the type, degree of the geometry.
        x: nodes (n, d) (m), each of some cell.
        cells: their nodes (m, k), in dolfinx' order.
        tags: physical group of each cell (m,).
        facets, facet_tags: corners (f, c), ascending, of the facets in groups; the groups' tags (f,).
        names: {(dimension, name): tag}.
    """

    kind: str
    degree: int
    x: np.ndarray
    cells: np.ndarray
    tags: np.ndarray
    facets: np.ndarray
    facet_tags: np.ndarray
    names: dict[tuple[int, str], int]


def grouped(listed: Listed) -> GroupedMesh:
    """The body among what a file or a model lists: its cells of the highest dimension in a physical group.

    Raises:
        NotAMesh: they can't be used.
    """
    dim = max((d for d, _ in listed.names), default=0)
    if dim < 2:
        raise NotAMesh("it has no cells of two or three dimensions in a physical group")
    names = _by_name(listed, dim)
    blocks = _blocks(listed, dim)
    kind = _one_kind(blocks)
    cell, _, degree, _ = KINDS[kind]
    tags, order = _of_blocks(blocks), np.argsort(listed.tags, kind="stable")
    table = _rows(listed, order, np.concatenate([b.nodes for b in blocks]), "cells")
    used = np.unique(table)
    number = np.full(len(listed.tags), len(used))  # those of no cell are dropped
    number[used] = np.arange(len(used))
    x = _checked_nodes(listed.x[used], listed.tags[used], dim)
    cells = number[table][:, compat.gmsh_order(cell, table.shape[1])]
    _check_cells(cells, x, cell, degree, tags, {tag: name for (d, name), tag in names.items() if d == dim})
    sides = _facets(listed, dim, cell)
    wide = len(compat.facet_corners(cell)[0])
    corners, middle = np.zeros((0, wide), dtype=np.int64), np.zeros((0, dim))
    if sides:
        corners = np.concatenate([b.nodes[:, :wide] for b in sides])
        rows = _rows(listed, order, corners, "facets")
        middle, corners = listed.x[rows].mean(axis=1)[:, :dim], np.sort(number[rows], axis=1)
    side_tags = _of_blocks(sides)
    named = {tag: name for (d, name), tag in names.items() if d == dim - 1}
    _check_facets(cells, x, cell, corners, middle, side_tags, named)
    return GroupedMesh(cell, degree, x, cells, tags, corners, side_tags, names)


def _at(x: np.ndarray) -> str:
    return str(tuple(float(f"{c:.9g}") + 0.0 for c in x))


# groups and types -------------------------------------------------------------------------------------
def _by_name(listed: Listed, dim: int) -> dict[tuple[int, str], int]:
    found: dict[tuple[int, str], int] = {}
    for (d, tag), name in sorted(listed.names.items()):
        other = found.setdefault((d, name), tag)
        if other != tag and d >= dim - 1:
            raise NotAMesh(
                f"two physical groups of {d} dimensions, {other} and {tag}, have the name {name!r}"
            )
    return found


def _blocks(listed: Listed, dim: int) -> list[Block]:
    """The blocks of a dimension in a group; of one each."""
    found = [b for b in listed.blocks if KINDS[b.kind][1] == dim and b.groups and len(b.nodes)]
    for b in found:
        if len(set(b.groups)) > 1:
            both = " and ".join(repr(_name(listed, dim, t)) for t in b.groups[:2])
            raise NotAMesh(
                f"the physical groups {both} share the {_ENTITIES[dim]} {b.entity}; "
                "one group can be given to each"
            )
    return found


def _name(listed: Listed, dim: int, tag: int) -> str | int:
    return listed.names.get((dim, tag), tag)


def _of_blocks(blocks: list[Block]) -> np.ndarray:
    """The group of each cell."""
    return np.repeat([b.groups[0] for b in blocks], [len(b.nodes) for b in blocks]).astype(np.int32)


def _one_kind(blocks: list[Block]) -> int:
    kinds = sorted({b.kind for b in blocks})
    if not kinds:
        raise NotAMesh("its physical groups have no cells; generate the mesh first")
    if len(kinds) > 1 or kinds[0] not in _USABLE:
        titles = [f"{KINDS[k][0].capitalize()} {KINDS[k][3]}" for k in kinds]
        raise NotAMesh(
            f"its cells are {' and '.join(titles)}; one of triangles, quadrilaterals, tetrahedra and "
            "hexahedra, of degree 1 or 2 with all nodes of their degree, is allowed"
        )
    return kinds[0]


def _facets(listed: Listed, dim: int, cell: str) -> list[Block]:
    found = _blocks(listed, dim - 1)
    for b in found:
        if KINDS[b.kind][0] != _FACETS[cell]:
            group, kind = _name(listed, dim - 1, b.groups[0]), KINDS[b.kind][0]
            raise NotAMesh(
                f"the physical group {group!r} has cells of the type {kind}, which aren't facets of a {cell}"
            )
    return found


# nodes ------------------------------------------------------------------------------------------------
def _rows(listed: Listed, order: np.ndarray, tags: np.ndarray, what: str) -> np.ndarray:
    """Rows of the nodes with these tags, which needn't be 1, 2, 3, ..."""
    known = listed.tags[order]
    if not len(known):
        raise NotAMesh("it has no nodes")
    at = np.minimum(np.searchsorted(known, tags), len(known) - 1)
    missing = np.unique(tags[known[at] != tags])
    if len(missing):
        raise NotAMesh(f"{what} have {len(missing)} nodes that it doesn't list: {_few(missing)}")
    twice = np.intersect1d(known[1:][known[1:] == known[:-1]], tags)
    if len(twice):
        raise NotAMesh(f"it lists {len(twice)} nodes more than once: {_few(twice)}")
    rows: np.ndarray = order[at]
    return rows


def _few(numbers: np.ndarray) -> str:
    return ", ".join(map(str, numbers[:5].tolist())) + (", ..." if len(numbers) > 5 else "")


def _checked_nodes(x: np.ndarray, tags: np.ndarray, dim: int) -> np.ndarray:
    """Positions (n, d)."""
    bad = ~np.isfinite(x).all(axis=1)
    if bad.any():
        raise NotAMesh(f"{bad.sum()} of its nodes have coordinates that aren't finite: {_few(tags[bad])}")
    if dim == 2 and np.ptp(x[:, 2]) > 1e-6 * np.ptp(x, axis=0).max():
        raise NotAMesh("its surface is not a plane z = constant; a body in space needs volumes")
    return np.ascontiguousarray(x[:, :dim])


def places(x: np.ndarray) -> np.ndarray:
    """Numbers (n,) of the places of nodes x (n, d): the same for nodes at the same place."""
    near = _SAME * float(np.ptp(x, axis=0).max()) if len(x) else 0.0
    columns = []
    for c in x.T:
        order = np.argsort(c, kind="stable")
        step = np.concatenate([[0], np.cumsum(np.diff(c[order]) > near)]).astype(np.int64)
        columns.append(np.empty_like(step))
        columns[-1][order] = step[: len(c)]
    return labels(np.stack(columns, axis=1))


def labels(table: np.ndarray) -> np.ndarray:
    """Numbers (m,) of the rows of whole numbers (m, k), none negative: the same for the same rows."""
    found: np.ndarray = table[:, 0].astype(np.int64)
    for column in table.T[1:]:
        found = found * (int(column.max(initial=0)) + 1) + column
        found = np.unique(found, return_inverse=True)[1].reshape(-1)
    return found


# shapes -----------------------------------------------------------------------------------------------
def reference_corners(cell: str) -> np.ndarray:
    """Corners of the reference cell (n, d), in dolfinx' order."""
    dim = 2 if cell in ("triangle", "quadrilateral") else 3
    if cell in ("triangle", "tetrahedron"):
        return np.vstack([np.zeros(dim), np.eye(dim)])
    return unit_corners(dim).astype(float)


def distorted(cell: str, degree: int, nodes: np.ndarray) -> np.ndarray:
    """Which cells (m,), given by their nodes' positions (m, k, d), have no Jacobian of one sign."""
    positions = np.vstack([compat.quadrature_positions(cell, 1 + 2 * degree), reference_corners(cell)])
    table = compat.tabulate(cell, degree, positions)[1:]
    values = np.linalg.det(np.einsum("jpn,cni->cpij", table, nodes))
    size = np.abs(values).max(axis=1, initial=0.0)
    # the sign itself tells nothing: it depends on the order in which a cell's nodes are given
    bad: np.ndarray = np.any(values * np.sign(values[:, :1]) <= 1e-10 * size[:, None], axis=1)
    return bad


def not_positive(numbers: np.ndarray, middle: np.ndarray) -> str:
    """What is told of distorted cells, by their numbers and the middle of one."""
    listed = ", ".join(map(str, np.sort(numbers)[:10].tolist()))
    return (
        f"the Jacobian of {len(numbers)} cell(s) is not positive everywhere: numbers {listed}, one at "
        f"{_at(middle)}"
    )


# cells and facets -------------------------------------------------------------------------------------
def _check_cells(
    cells: np.ndarray, x: np.ndarray, cell: str, degree: int, tags: np.ndarray, names: dict[int, str]
) -> None:
    """No cell twice, nor one upon another, nor one with a node twice."""
    ranked = np.sort(cells, axis=1)
    bad = np.any(ranked[:, 1:] == ranked[:, :-1], axis=1)
    if bad.any():
        raise NotAMesh(
            f"{bad.sum()} of its cells have a node twice, such as the one at {_at(_middle(x, cells, bad))}"
        )
    bad = distorted(cell, degree, x[cells])
    if bad.any():
        raise NotAMesh(not_positive(np.flatnonzero(bad), _middle(x, cells, bad)))
    corners = cells[:, : len(reference_corners(cell))]
    for table, what in (
        (corners, "are listed twice"),
        (places(x)[corners], "lie upon others, with nodes of their own"),
    ):
        label = labels(np.sort(table, axis=1))
        first = np.unique(label, return_index=True)[1]
        again = np.ones(len(label), dtype=bool)
        again[first] = False
        if not again.any():
            continue
        one = int(np.flatnonzero(again)[0])
        groups = np.unique(tags[label == label[one]]).tolist()
        share = (
            f", in the physical groups {' and '.join(repr(names.get(t, t)) for t in groups)}"
            if len(groups) > 1
            else ""
        )
        raise NotAMesh(
            f"{again.sum()} of its cells {what}, such as the one at {_at(_middle(x, cells, again))}{share}"
        )


def _middle(x: np.ndarray, rows: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Middle of the first of the chosen rows of nodes."""
    middle: np.ndarray = x[rows[chosen][0]].mean(axis=0)
    return middle


def _check_facets(
    cells: np.ndarray,
    x: np.ndarray,
    cell: str,
    facets: np.ndarray,
    middle: np.ndarray,
    tags: np.ndarray,
    names: dict[int, str],
) -> None:
    """A facet of the mesh has one or two cells; one of a group has one, and no other group."""
    sides = np.sort(cells[:, compat.facet_corners(cell)], axis=2)
    sides = sides.reshape(-1, sides.shape[2])
    label = labels(np.vstack([sides, facets.astype(np.int64)]))
    count = np.bincount(label[: len(sides)], minlength=label.max() + 1)
    crowded = count[label[: len(sides)]] > 2
    if crowded.any():
        number = len(np.unique(label[: len(sides)][crowded]))
        raise NotAMesh(
            f"{number} of its facets have more than two cells, such as the one at "
            f"{_at(_middle(x, sides, crowded))}: cells overlap"
        )
    of_facets = label[len(sides) :]
    lost = count[of_facets] == 0
    if lost.any():
        tag = int(tags[lost][0])
        here = lost & (tags == tag)
        raise NotAMesh(
            f"the physical group {names.get(tag, tag)!r} has {here.sum()} facets (of {np.sum(tags == tag)}) "
            f"that are on no cell of the body, such as the one at {_at(middle[here][0])}: the cells don't "
            "share their nodes (occ.fragment, or geometry with common points, joins them), or are in no "
            "physical group"
        )
    order = np.lexsort((tags, of_facets))
    both = (of_facets[order][1:] == of_facets[order][:-1]) & (tags[order][1:] != tags[order][:-1])
    if both.any():
        k = int(np.flatnonzero(both)[0])
        pair = " and ".join(repr(names.get(int(t), int(t))) for t in tags[order][[k, k + 1]])
        raise NotAMesh(f"the physical groups {pair} share {both.sum()} facets; a facet can be in one group")
