"""Mesh files of gmsh written by hand, so that they need no gmsh; each can be spoilt in many ways."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.conftest import COMM

NODES = {1: 2, 2: 3, 3: 4, 4: 4, 5: 8, 6: 6, 8: 3, 9: 6, 10: 9, 15: 1, 16: 8, 21: 10}
DIMENSION = {1: 1, 2: 2, 3: 2, 4: 3, 5: 3, 6: 3, 8: 1, 9: 2, 10: 2, 15: 0, 16: 2, 21: 2}


@dataclass
class Msh:
    """What a file lists: {tag: position}; [kind, group (0: none), rows of node tags]; {(dim, tag): name}."""

    nodes: dict[int, tuple[float, ...]]
    blocks: list[tuple[int, int, list[list[int]]]]
    names: dict[tuple[int, int], str] = field(default_factory=dict)

    def text(self, version: str = "4.1") -> str:
        """The file."""
        names = "".join(f'{d} {t} "{n}"\n' for (d, t), n in self.names.items())
        head = f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n"
        if self.names:
            head += f"$PhysicalNames\n{len(self.names)}\n{names}$EndPhysicalNames\n"
        return head + (self._body_4() if version == "4.1" else self._body_2())

    def _body_4(self) -> str:
        counts, entities = [0, 0, 0, 0], [""] * 4
        elements, number = "", 1
        for entity, (kind, group, rows) in enumerate(self.blocks, 1):
            dim = DIMENSION[kind]
            counts[dim] += 1
            box = "0 0 0 " if dim == 0 else "0 0 0 0 0 0 "
            entities[dim] += f"{entity} {box}{f'1 {group}' if group else '0'}{' 0' if dim else ''}\n"
            elements += f"{dim} {entity} {kind} {len(rows)}\n"
            for row in rows:
                elements += f"{number} {' '.join(map(str, row))}\n"
                number += 1
        total, n = number - 1, len(self.nodes)
        tags = "".join(f"{t}\n" for t in self.nodes)
        x = "".join(" ".join(f"{c!r}" for c in map(float, p)) + "\n" for p in self.nodes.values())
        return (
            f"$Entities\n{' '.join(map(str, counts))}\n{''.join(entities)}$EndEntities\n"
            f"$Nodes\n1 {n} 1 {n}\n2 1 0 {n}\n{tags}{x}$EndNodes\n"
            f"$Elements\n{len(self.blocks)} {total} 1 {total}\n{elements}$EndElements\n"
        )

    def _body_2(self) -> str:
        x = "".join(f"{t} {' '.join(f'{float(c)!r}' for c in p)}\n" for t, p in self.nodes.items())
        rows = [
            f"{kind} 2 {group} {entity} {' '.join(map(str, row))}"
            for entity, (kind, group, table) in enumerate(self.blocks, 1)
            for row in table
        ]
        elements = "".join(f"{k} {row}\n" for k, row in enumerate(rows, 1))
        return f"$Nodes\n{len(self.nodes)}\n{x}$EndNodes\n$Elements\n{len(rows)}\n{elements}$EndElements\n"

    def write(self, path: Path, version: str = "4.1") -> Path:
        """Write it on rank 0. Collective."""
        return put(path, self.text(version))


def put(path: Path, content: str | bytes) -> Path:
    """A file that rank 0 writes. Collective."""
    if COMM.rank == 0:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    COMM.Barrier()
    return path


def strip(kind: int = 3, nx: int = 4, ny: int = 2, size: tuple[float, float] = (2.0, 1.0)) -> Msh:
    """A rectangle of quadrilaterals (3) or triangles (2): regions "soft" (1) and "stiff" (2), its left and
    right halves; the ends "left" (1) and "far right" (2), and "top" (3)."""
    tag = lambda i, j: 1 + i + (nx + 1) * j  # noqa: E731
    nodes = {
        tag(i, j): (size[0] * i / nx, size[1] * j / ny, 0.0) for j in range(ny + 1) for i in range(nx + 1)
    }
    halves: list[list[list[int]]] = [[], []]
    for j in range(ny):
        for i in range(nx):
            a, b, c, d = tag(i, j), tag(i + 1, j), tag(i + 1, j + 1), tag(i, j + 1)
            halves[2 * i >= nx] += [[a, b, c, d]] if kind == 3 else [[a, b, c], [a, c, d]]
    ends = [[[tag(i, j), tag(i, j + 1)] for j in range(ny)] for i in (0, nx)]
    top = [[tag(i, ny), tag(i + 1, ny)] for i in range(nx)]
    blocks = [(1, 1, ends[0]), (1, 2, ends[1]), (1, 3, top), (kind, 1, halves[0]), (kind, 2, halves[1])]
    names = {(1, 1): "left", (1, 2): "far right", (1, 3): "top", (2, 1): "soft", (2, 2): "stiff"}
    return Msh(nodes, blocks, names)


def block(n: int = 2) -> Msh:
    """A cube of n^3 hexahedra, region "all" (1), with its face z = 0, "foot" (5)."""
    tag = lambda i, j, k: 1 + i + (n + 1) * (j + (n + 1) * k)  # noqa: E731
    steps = range(n + 1)
    nodes = {tag(i, j, k): (i / n, j / n, k / n) for k in steps for j in steps for i in steps}
    cells, foot = [], []
    for k, j, i in np.ndindex(n, n, n):
        low = [tag(i, j, k), tag(i + 1, j, k), tag(i + 1, j + 1, k), tag(i, j + 1, k)]
        cells.append([*low, *(t + (n + 1) ** 2 for t in low)])
        if k == 0:
            foot.append(low)
    return Msh(nodes, [(3, 5, foot), (5, 1, cells)], {(2, 5): "foot", (3, 1): "all"})
