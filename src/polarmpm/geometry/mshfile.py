"""Mesh files of gmsh, formats 2.2 and 4.1, in text and binary.

gmsh itself takes a file without a mesh's header for a script and runs it, shell commands included; and it has
one session a process, which may be the caller's. meshio keeps one physical group an entity and one a name,
and takes the last node for one that doesn't exist. So the files are read here: nothing in them is executed,
and what doesn't add up is an error.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

_SCRIPTS = (".geo", ".geo_unrolled", ".pro", ".opt", ".brep", ".step", ".stp", ".iges", ".igs")

# gmsh's number of a cell type: (name, dimension, degree, nodes)
KINDS = {
    1: ("line", 1, 1, 2),
    2: ("triangle", 2, 1, 3),
    3: ("quadrilateral", 2, 1, 4),
    4: ("tetrahedron", 3, 1, 4),
    5: ("hexahedron", 3, 1, 8),
    6: ("prism", 3, 1, 6),
    7: ("pyramid", 3, 1, 5),
    8: ("line", 1, 2, 3),
    9: ("triangle", 2, 2, 6),
    10: ("quadrilateral", 2, 2, 9),
    11: ("tetrahedron", 3, 2, 10),
    12: ("hexahedron", 3, 2, 27),
    13: ("prism", 3, 2, 18),
    14: ("pyramid", 3, 2, 14),
    15: ("point", 0, 1, 1),
    16: ("quadrilateral", 2, 2, 8),
    17: ("hexahedron", 3, 2, 20),
    18: ("prism", 3, 2, 15),
    19: ("pyramid", 3, 2, 13),
    20: ("triangle", 2, 3, 9),
    21: ("triangle", 2, 3, 10),
    22: ("triangle", 2, 4, 12),
    23: ("triangle", 2, 4, 15),
    24: ("triangle", 2, 5, 15),
    25: ("triangle", 2, 5, 21),
    26: ("line", 1, 3, 4),
    27: ("line", 1, 4, 5),
    28: ("line", 1, 5, 6),
    29: ("tetrahedron", 3, 3, 20),
    30: ("tetrahedron", 3, 4, 35),
    31: ("tetrahedron", 3, 5, 56),
    36: ("quadrilateral", 2, 3, 16),
    37: ("quadrilateral", 2, 4, 25),
    38: ("quadrilateral", 2, 5, 36),
    39: ("quadrilateral", 2, 3, 12),
    92: ("hexahedron", 3, 3, 64),
    93: ("hexahedron", 3, 4, 125),
}


class NotAMesh(Exception):
    """Why a file or model can't be used; told to the caller with the file's name."""


@dataclass
class Block:
    """Cells of one type on one entity of the geometry.

    Attributes:
        kind: gmsh's number of the type.
        entity: its number among those of its dimension.
        groups: tags of its physical groups.
        nodes: tags (m, k) of the cells' nodes.
    """

    kind: int
    entity: int
    groups: tuple[int, ...]
    nodes: np.ndarray


@dataclass
class Listed:
    """What a file or a model lists: nodes with tags (n,) at x (n, 3), cells, and its physical groups with
    their names {(dimension, tag): name}; of those without a name their number."""

    tags: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    x: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    blocks: list[Block] = field(default_factory=list)
    names: dict[tuple[int, int], str] = field(default_factory=dict)


def read_msh(path: str) -> Listed:
    """The mesh of a file; this rank alone.

    Raises:
        NotAMesh: something else, another format, or damaged.
        OSError: the file can't be read.
    """
    if path.lower().endswith(_SCRIPTS):
        raise NotAMesh(
            "it is a geometry or a script, no mesh, and isn't run; mesh it first: gmsh -3 (in the plane -2) "
            "-format msh41 -o body.msh"
        )
    if os.path.exists(path) and not os.path.isfile(path):
        raise NotAMesh("it is a directory or a device, no file")
    with open(path, "rb") as file:
        data = file.read()
    version, binary = _header(data)
    read = _sections_4 if version == "4.1" else _sections_2
    try:
        found = read(_Sections(data, binary))
    except (ValueError, IndexError, OverflowError, MemoryError) as e:
        raise NotAMesh(f"it is damaged: {e}") from None
    return found


def _header(data: bytes) -> tuple[str, bool]:
    """Version, and whether numbers are binary."""
    found = re.match(
        rb"\$MeshFormat\r?\n[ \t]*(\d[\d.]*)[ \t]+(\d+)[ \t]+(\d+)[ \t]*\r?\n", _uncommented(data)
    )
    if not data.strip():
        raise NotAMesh("it is empty")
    if not found:
        raise NotAMesh(
            "it is no gmsh mesh, which begins with $MeshFormat, version, type and size; a file of another "
            "kind is never run as a script"
        )
    version, kind, size = (part.decode(errors="replace") for part in found.groups())
    if version not in ("2", "2.0", "2.1", "2.2", "4.1"):
        raise NotAMesh(
            f"it has the format {version}; save it in 4.1 or 2.2: gmsh body.msh -save -format msh41"
        )
    if kind not in ("0", "1") or size != "8":
        raise NotAMesh(f"its type {kind} and size {size} are no text or binary numbers of 8 bytes")
    one = _uncommented(data)[found.end() : found.end() + 4]
    if kind == "1" and one != np.int32(1).tobytes():
        raise NotAMesh("its binary numbers are those of a machine of another byte order")
    return version, kind == "1"


def _uncommented(data: bytes) -> bytes:
    while data.startswith(b"$Comments"):
        end = data.find(b"$EndComments")
        data = data[end + len(b"$EndComments") :].lstrip() if end >= 0 else b""
    return data


class _Sections:
    """The sections $Name ... $EndName of a file."""

    def __init__(self, data: bytes, binary: bool):
        self.data, self.binary = data, binary

    def __iter__(self) -> Iterator[tuple[str, bytes]]:
        at = 0
        while found := _NEXT.search(self.data, at):
            name = found.group(1)
            end = self.data.find(b"$End" + name, found.end())
            if end < 0:
                raise ValueError(f"its section ${name.decode()} has no end")
            yield name.decode(), self.data[found.end() : end]
            at = end + 4 + len(name)
            if self.data[at:].strip() and not _NEXT.match(self.data[at:].lstrip()[:80]):
                raise ValueError(f"there is something after $End{name.decode()} that is no section")

    def numbers(self, section: str, body: bytes) -> _Numbers:
        return _Numbers(section, body, self.binary)


_NEXT = re.compile(rb"\$(?!End)([A-Za-z]\w*)[ \t]*\r?\n")


class _Numbers:
    """Numbers of a section, one after the other."""

    def __init__(self, section: str, body: bytes, binary: bool):
        self.section, self.body, self.binary, self.at = section, body, binary, 0
        try:
            self.listed = np.zeros(0) if binary else np.array(body.split(), dtype=float)
        except ValueError:
            raise ValueError(f"${section} has something that is no number") from None

    def _take(self, count: int, kind: type) -> np.ndarray:
        width = np.dtype(kind).itemsize if self.binary else 1
        there = len(self.body) if self.binary else len(self.listed)
        if count < 0 or self.at + count * width > there:
            raise ValueError(f"${self.section} ends before the numbers that it announces")
        start, self.at = self.at, self.at + count * width
        if self.binary:
            return np.frombuffer(self.body, dtype=kind, count=count, offset=start)
        return self.listed[start : self.at]

    def whole(self, count: int, kind: type = np.int64) -> np.ndarray:
        """Whole numbers; those of `kind` in binary files."""
        return self.checked(self._take(count, kind))

    def checked(self, found: np.ndarray) -> np.ndarray:
        """The same as integers, if they are whole."""
        if found.dtype.kind == "f" and not (np.abs(found) < 2**53).all():
            raise ValueError(f"${self.section} has a number that is too large or none")
        out: np.ndarray = found.astype(np.int64)
        if np.any(out != found):
            raise ValueError(f"${self.section} has fractions where there should be whole numbers")
        return out

    def ints(self, count: int) -> list[int]:
        return self.whole(count, np.int32).tolist()  # type: ignore[no-any-return]

    def sizes(self, count: int) -> list[int]:
        return self.whole(count).tolist()  # type: ignore[no-any-return]

    def real(self, count: int) -> np.ndarray:
        return self._take(count, np.float64)

    def finish(self) -> None:
        """Raise ValueError if numbers are left over."""
        left = self.body[self.at :].strip() if self.binary else self.listed[self.at :]
        if len(left):
            raise ValueError(f"${self.section} goes on after the numbers that it announces")


def _names(body: bytes) -> dict[tuple[int, int], str]:
    lines = [line for line in body.decode("utf-8", errors="replace").splitlines() if line.strip()]
    if not lines or _count("PhysicalNames", lines[0]) != len(lines) - 1:
        raise ValueError("$PhysicalNames has another number of names than it announces")
    found = {}
    for line in lines[1:]:
        row = re.fullmatch(r'\s*(\d+)\s+(-?\d+)\s+(?:"(.*)"|(\S+))\s*', line)
        if not row:
            raise ValueError(f"$PhysicalNames has a line that isn't dimension, tag, name: {line[:40]!r}")
        found[int(row[1]), int(row[2])] = row[3] or row[4] or row[2]
    return found


def _count(section: str, line: str | bytes) -> int:
    try:
        return int(line)
    except ValueError:
        raise ValueError(f"${section} doesn't begin with a number") from None


def _kind(number: int) -> tuple[str, int, int, int]:
    if number not in KINDS:
        raise NotAMesh(f"it has cells of gmsh's type {number}, which can't be used")
    return KINDS[number]


# version 4.1 ------------------------------------------------------------------------------------------
def _sections_4(sections: _Sections) -> Listed:
    found, groups = Listed(), dict[tuple[int, int], tuple[int, ...]]()
    seen = set()
    for name, body in sections:
        if name == "PartitionedEntities":
            raise NotAMesh("it is partitioned; save the whole mesh, dolfinx distributes it")
        if name == "PhysicalNames":
            found.names = _names(body)
        elif name == "Entities":
            groups = _entities_4(sections.numbers(name, body))
        elif name == "Nodes":
            found.tags, found.x = _nodes_4(sections.numbers(name, body))
        elif name == "Elements":
            found.blocks = _elements_4(sections.numbers(name, body), groups)
        seen.add(name)
    return _complete(found, seen)


def _complete(found: Listed, seen: set[str]) -> Listed:
    for name in ("Nodes", "Elements"):
        if name not in seen:
            raise ValueError(f"it has no section ${name}")
    for block in found.blocks:
        for tag in block.groups:
            found.names.setdefault((KINDS[block.kind][1], tag), f"{tag}")
    return found


def _entities_4(numbers: _Numbers) -> dict[tuple[int, int], tuple[int, ...]]:
    groups = {}
    for dim, count in enumerate(numbers.sizes(4)):
        for _ in range(count):
            (tag,) = numbers.ints(1)
            numbers.real(3 if dim == 0 else 6)
            # a negative tag tells the entity's direction
            groups[dim, tag] = tuple(abs(t) for t in numbers.ints(*numbers.sizes(1)))
            if dim > 0:
                numbers.ints(*numbers.sizes(1))
    numbers.finish()
    return groups


def _nodes_4(numbers: _Numbers) -> tuple[np.ndarray, np.ndarray]:
    blocks, total, *_ = numbers.sizes(4)
    tags: list[np.ndarray] = [np.zeros(0, dtype=np.int64)]
    x: list[np.ndarray] = [np.zeros((0, 3))]
    for _ in range(blocks):
        dim, _, parametric = numbers.ints(3)
        (count,) = numbers.sizes(1)
        tags.append(numbers.whole(count))
        width = 3 + (dim if parametric else 0)
        x.append(numbers.real(count * width).reshape(count, width)[:, :3])
    numbers.finish()
    if sum(map(len, tags)) != total:
        raise ValueError(f"$Nodes announces {total} nodes and has {sum(map(len, tags))}")
    return np.concatenate(tags), np.concatenate(x)


def _elements_4(numbers: _Numbers, groups: dict[tuple[int, int], tuple[int, ...]]) -> list[Block]:
    count_blocks, total, *_ = numbers.sizes(4)
    blocks, here = [], 0
    for _ in range(count_blocks):
        dim, entity, kind = numbers.ints(3)
        (count,) = numbers.sizes(1)
        _, of_kind, _, nodes = _kind(kind)
        if of_kind != dim:
            raise ValueError(f"$Elements has cells of {of_kind} dimensions on an entity of {dim}")
        rows = numbers.whole(count * (1 + nodes)).reshape(count, 1 + nodes)
        blocks.append(Block(kind, entity, groups.get((dim, entity), ()), rows[:, 1:]))
        here += count
    numbers.finish()
    if here != total:
        raise ValueError(f"$Elements announces {total} cells and has {here}")
    return blocks


# version 2.2 ------------------------------------------------------------------------------------------
def _sections_2(sections: _Sections) -> Listed:
    found, seen = Listed(), set()
    for name, body in sections:
        if name == "PhysicalNames":
            found.names = _names(body)
        elif name in ("Nodes", "Elements"):
            # the count stands in a line of text in binary files, too
            first, _, rest = body.lstrip().partition(b"\n")
            count, numbers = _count(name, first), sections.numbers(name, rest)
            if name == "Nodes":
                found.tags, found.x = _nodes_2(numbers, count)
            else:
                found.blocks = _elements_2(numbers, count)
        seen.add(name)
    return _complete(found, seen)


def _nodes_2(numbers: _Numbers, count: int) -> tuple[np.ndarray, np.ndarray]:
    if count < 0:
        raise ValueError(f"$Nodes announces {count} nodes")
    if numbers.binary:
        row = np.dtype([("tag", np.int32), ("x", float, 3)])
        rows = np.frombuffer(numbers._take(count * row.itemsize, np.uint8).tobytes(), dtype=row)
        numbers.finish()
        return rows["tag"].astype(np.int64), rows["x"].copy()
    flat = numbers.real(4 * count).reshape(count, 4)
    numbers.finish()
    return numbers.checked(flat[:, 0]), flat[:, 1:].copy()


def _elements_2(numbers: _Numbers, count: int) -> list[Block]:
    """Rows `tag type tags... nodes...`; in binary files, rows of the same type follow one header."""
    read = _binary_rows_2 if numbers.binary else _text_rows_2
    rows: dict[tuple[int, int, int], list[np.ndarray]] = {}
    for kind, tags, nodes in read(numbers, count):
        # tags: physical group (0: none), entity, partitions
        pair: np.ndarray = np.zeros((len(nodes), 2), dtype=np.int64)
        pair[:, : min(tags.shape[1], 2)] = tags[:, :2]
        for group, entity in np.unique(pair, axis=0).tolist():
            at = np.all(pair == (group, entity), axis=1)
            rows.setdefault((kind, group, entity), []).append(nodes[at])
    numbers.finish()
    return [
        Block(kind, entity, (abs(group),) if group else (), np.concatenate(parts))
        for (kind, group, entity), parts in rows.items()
    ]


Rows = Iterator[tuple[int, np.ndarray, np.ndarray]]  # cells of a type: their tags, their nodes


def _binary_rows_2(numbers: _Numbers, count: int) -> Rows:
    done = 0
    while done < count:
        kind, here, tags = numbers.ints(3)
        if here < 1 or tags < 0:
            raise ValueError("$Elements has a header that can't be right")
        width = 1 + tags + _kind(kind)[3]
        table = numbers.whole(here * width, np.int32).reshape(here, width)
        yield kind, table[:, 1 : 1 + tags], table[:, 1 + tags :]
        done += here


def _text_rows_2(numbers: _Numbers, count: int) -> Rows:
    flat = numbers.whole(len(numbers.listed))
    listed, at, starts = flat.tolist(), 0, dict[tuple[int, int], list[int]]()
    try:
        for _ in range(count):
            kind, tags = listed[at + 1], listed[at + 2]
            starts.setdefault((kind, tags), []).append(at + 3)
            at += 3 + tags + _kind(kind)[3]
            if tags < 0:
                raise IndexError
    except IndexError:
        at = -1
    if at != len(listed):
        raise ValueError(f"$Elements announces {count} cells and has more or fewer numbers than they take")
    for (kind, tags), first in starts.items():
        table = flat[np.array(first)[:, None] + np.arange(tags + _kind(kind)[3])]
        yield kind, table[:, :tags], table[:, tags:]
