"""ParaView's files: pieces of unstructured grids (.vtu), and collections of them (.pvd)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from mpi4py import MPI

import numpy as np

from ..geometry.cells import unit_corners
from ..tools.parallel import raise_on_all_ranks
from .files import check_output, replace_file

# dolfinx' nodes in VTK's order, by meshio's name of the cell: corners (in dolfinx with the first axis
# running fastest), then edges, faces and the middle
_VTK_ORDER = {
    "vertex": [0],
    "triangle": [0, 1, 2],
    "quad": [0, 1, 3, 2],
    "tetra": [0, 1, 2, 3],
    "hexahedron": [0, 1, 3, 2, 4, 5, 7, 6],
    "triangle6": [0, 1, 2, 5, 3, 4],
    "quad9": [0, 1, 3, 2, 4, 6, 7, 5, 8],
    "tetra10": [0, 1, 2, 3, 9, 6, 8, 7, 5, 4],
    "hexahedron27": [
        *(0, 1, 3, 2, 4, 5, 7, 6),
        *(8, 11, 13, 9, 16, 18, 19, 17, 10, 12, 15, 14),
        *(22, 23, 21, 24, 20, 25, 26),
    ],
}
_BOXES = {1: "vertex", 4: "quad", 8: "hexahedron"}


def padded(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, d) with three components (n, 3); what is missing is zero."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


def box_corners(centre: np.ndarray, half_length: np.ndarray) -> np.ndarray:
    """Corners (n, 2^d, d) of boxes, the first axis running fastest."""
    sign = 2 * unit_corners(centre.shape[1]) - 1
    corners: np.ndarray = centre[:, None] + sign * half_length[:, None]
    return corners


def write_vtu(
    path: Path,
    x: np.ndarray,
    cells: np.ndarray,
    point_data: dict[str, np.ndarray] | None = None,
    cell_data: dict[str, np.ndarray] | None = None,
    kind: str | None = None,
) -> None:
    """Write one piece, compressed.

    Args:
        x: vertices (n, d) (m).
        cells: nodes of each cell (m, k) in dolfinx' order.
        kind: meshio's name of the cells; by default boxes of 2^d corners, or vertices.
        point_data, cell_data: arrays (n, ...) and (m, ...); tensors become rows of 9 numbers.
    """
    import meshio  # lazy import: it takes a third of a second

    kind = kind or _BOXES[cells.shape[1]]
    mesh = meshio.Mesh(
        padded(x),
        [(kind, cells[:, _VTK_ORDER[kind]])],
        point_data={name: _rows(a) for name, a in (point_data or {}).items()},
        cell_data={name: [_rows(a)] for name, a in (cell_data or {}).items()},
    )
    meshio.write(path, mesh, file_format="vtu", binary=True, compression="zlib")


def _rows(values: np.ndarray) -> np.ndarray:
    return values if values.ndim == 1 else values.reshape(len(values), int(np.prod(values.shape[1:])))


class Collection:
    """A .pvd file and the pieces, one for each step and rank, in the folder of the same name. Collective.

    Raises:
        InputError: the files can't be written; on every rank alike.
    """

    def __init__(self, path: Path, folder: Path, comm: MPI.Comm):
        self.path, self.folder, self.comm = path, folder, comm
        check_output(comm, path, ".pvd")
        check_output(comm, folder / path.name)
        self._entries: dict[int, tuple[float, list[int]]] = {}

    def add(
        self,
        number: int,
        time: float,
        x: np.ndarray,
        cells: np.ndarray,
        point_data: dict[str, np.ndarray] | None = None,
        cell_data: dict[str, np.ndarray] | None = None,
        kind: str | None = None,
    ) -> None:
        """Write a step's pieces, then the collection; a step of the same number is replaced."""
        error = None
        if len(cells):
            try:
                write_vtu(self._piece(number, self.comm.rank), x, cells, point_data, cell_data, kind)
            except OSError as e:
                error = e
        raise_on_all_ranks(self.comm, error)
        has = self.comm.allgather(bool(len(cells)))
        self._entries[number] = time, [rank for rank, there in enumerate(has) if there]
        if self.comm.rank == 0:
            try:
                replace_file(self.path, self._xml())
            except OSError as e:
                error = e
        raise_on_all_ranks(self.comm, error)

    def _piece(self, number: int, rank: int) -> Path:
        return self.folder / f"{self.path.stem}_{number:04d}_p{rank}.vtu"

    def _xml(self) -> bytes:
        root = ET.Element("VTKFile", type="Collection", version="0.1")
        sets = ET.SubElement(root, "Collection")
        for number, (time, ranks) in self._entries.items():
            for rank in ranks:
                file = self._piece(number, rank).relative_to(self.path.parent).as_posix()
                ET.SubElement(sets, "DataSet", timestep=repr(time), part=str(rank), file=file)
        ET.indent(root)
        text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
        return text + b"\n"
