"""ParaView's files: pieces of unstructured grids (.vtu), and collections of them (.pvd)."""

from __future__ import annotations

import glob
import re
import xml.etree.ElementTree as ET
import zlib
from dataclasses import dataclass
from pathlib import Path

from mpi4py import MPI

import numpy as np

from ..errors import OutputError
from ..geometry.cells import unit_corners
from ..solvers.stepping import Restored, Step
from ..tools.parallel import raise_on_all_ranks
from .files import (
    Replacement,
    begin_writing,
    check_output,
    check_writer,
    not_written,
    remove_files,
    replace_file,
)
from .naming import component_names

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
    """Write one piece, compressed, in the place of an old one.

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
    fields = {**(point_data or {}), **(cell_data or {})}
    with Replacement(path) as new:
        meshio.write(new.part, mesh, file_format="vtu", binary=True, compression="zlib")
        _name_components(new.part, {name: component_names(name, a.shape[1:]) for name, a in fields.items()})
        new.finish()


def _name_components(path: Path, names: dict[str, list[str]]) -> None:
    """Name the components of tensors and principal values in a file that meshio has written, which knows no
    names: "xx" in the place of "0". ParaView names those of vectors itself."""
    told = {name: ends for name, ends in names.items() if len(ends) > 1 and ends != ["x", "y", "z"]}
    if not told:
        return
    content = Path(path).read_bytes()
    for name, ends in told.items():
        mark = f' Name="{name}"'.encode()
        named = "".join(f' ComponentName{k}="{end}"' for k, end in enumerate(ends)).encode()
        content = content.replace(mark, mark + named, 1)
    Path(path).write_bytes(content)


def _rows(values: np.ndarray) -> np.ndarray:
    return values if values.ndim == 1 else values.reshape(len(values), int(np.prod(values.shape[1:])))


@dataclass(frozen=True)
class _Entry:
    """A step in a collection: its time, the ranks that have pieces of it, and a mark of the step; "" if it
    isn't known."""

    time: float
    ranks: tuple[int, ...]
    mark: str = ""


def mark_of(step: Step | None) -> str:
    """A few letters that tell a step from the same step of another run."""
    if step is None:
        return ""
    numbers = [float(step.factor), *(float(n) for measures in step.history for n in measures)]
    return f"{zlib.crc32(repr(numbers).encode()):08x}"


class Collection:
    """A .pvd file and the pieces, one for each step and rank, in the folder of the same name. Collective.

    A run that goes on from a restart file goes on with the collection: it keeps the steps up to the saved
    state and takes away those that came after it.

    Raises:
        InputError: the files can't be written; on every rank alike.
        OutputError: the disc is full.
    """

    def __init__(self, path: Path, folder: Path, comm: MPI.Comm):
        self.comm = comm
        self.path = check_output(comm, path, ".pvd")
        self.folder = check_output(comm, folder / path.name).parent
        self._writer = begin_writing(self.path)
        self._entries: dict[int, _Entry] = {}
        self._found: dict[int, _Entry] | None = None  # what another run, or this one before, has left
        self._run: Restored | None = None

    def add(
        self,
        number: int,
        time: float,
        x: np.ndarray,
        cells: np.ndarray,
        point_data: dict[str, np.ndarray] | None = None,
        cell_data: dict[str, np.ndarray] | None = None,
        kind: str | None = None,
        *,
        mark: str = "",
        run: Restored | None = None,
    ) -> None:
        """Write a step's pieces, then the collection; a step of the same number is replaced.

        Args:
            mark: of the step, from `mark_of`.
            run: of a run that goes on from a restart file.

        Raises:
            OutputError: something can't be written; the collection is as it was before the step.
        """
        check_writer(self.path, self._writer)
        self._go_on(run)
        piece, error = self._piece(number, self.comm.rank), None
        new = number not in self._entries
        has = self.comm.allgather(bool(len(cells)))
        ranks = tuple(rank for rank, there in enumerate(has) if there)
        entries = {**self._entries, number: _Entry(time, ranks, mark)}
        try:
            try:
                if len(cells):
                    write_vtu(piece, x, cells, point_data, cell_data, kind)
            except OSError as e:
                error = not_written("ParaView file", piece, e)
            raise_on_all_ranks(self.comm, error)
            try:
                if self.comm.rank == 0:
                    replace_file(self.path, self._xml(entries))
            except OSError as e:
                error = not_written("ParaView file", self.path, e)
            raise_on_all_ranks(self.comm, error)
        except OutputError:
            remove_files([piece] if new else [])
            raise
        self._entries = entries

    def has(self, number: int, run: Restored | None) -> bool:
        """Whether it goes on with a collection that has the step."""
        self._go_on(run)
        return number in self._entries

    def _piece(self, number: int, rank: int) -> Path:
        return self.folder / f"{self.path.stem}_{number:04d}_p{rank}.vtu"

    def _xml(self, entries: dict[int, _Entry]) -> bytes:
        root = ET.Element("VTKFile", type="Collection", version="0.1")
        sets = ET.SubElement(root, "Collection")
        for number, entry in entries.items():
            for rank in entry.ranks:
                file = self._piece(number, rank).relative_to(self.path.parent).as_posix()
                ET.SubElement(sets, "DataSet", timestep=repr(entry.time), part=str(rank), file=file)
        marks = " ".join(f"{number}={entry.mark}" for number, entry in entries.items() if entry.mark)
        sets.append(ET.Comment(f" steps {marks} "))
        ET.indent(root)
        text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
        return text + b"\n"

    # going on ---------------------------------------------------------------------------------------
    def _go_on(self, run: Restored | None) -> None:
        if self._found is None:
            self._found = self.comm.bcast(self._listed() if self.comm.rank == 0 else None)
        if run is None or run is self._run:
            return
        first, self._run = self.path not in run.continued, run
        run.continued.add(self.path)
        if not first and not self._entries:  # a new collection of this run under the same name
            return
        old = {n: e for n, e in {**self._found, **self._entries}.items() if n <= run.number}
        alien = any(e.mark and n in run.steps and e.mark != mark_of(run.steps[n]) for n, e in old.items())
        self._entries = {} if alien else dict(sorted(old.items()))
        if self.comm.rank == 0 and not alien:
            remove_files(self._later(run.number))
        self.comm.Barrier()

    def _listed(self) -> dict[int, _Entry]:
        """The steps of the file as it is, as far as all of their pieces are there; on rank 0."""
        try:
            text = self.path.read_text(encoding="utf-8")
            sets = list(ET.fromstring(text).iter("DataSet"))
            marks = dict(re.findall(r"(\d+)=(\w+)", "".join(re.findall(r"<!-- steps (.*?) -->", text))))
            found: dict[int, tuple[float, list[int]]] = {}
            for one in sets:
                name = re.fullmatch(r".*_(\d+)_p(\d+)\.vtu", one.get("file", ""))
                if name and (self.path.parent / one.get("file", "")).is_file():
                    at = found.setdefault(int(name[1]), (float(one.get("timestep", "nan")), []))
                    at[1].append(int(name[2]))
        except (OSError, ValueError, ET.ParseError):
            return {}
        listed = {n: _Entry(time, tuple(ranks), marks.get(str(n), "")) for n, (time, ranks) in found.items()}
        return {n: e for n, e in listed.items() if np.isfinite(e.time)}

    def _later(self, number: int) -> list[Path]:
        """Pieces of later steps, and parts of files that were being written."""
        out = [self.path.with_name(self.path.name + ".part")]
        for file in self.folder.glob(f"{glob.escape(self.path.stem)}_*_p*.vtu*"):
            name = re.fullmatch(r"(.*)_(\d+)_p\d+\.vtu(\.part)?", file.name)
            if name and name[1] == self.path.stem and (int(name[2]) > number or name[3]):
                out.append(file)
        return out
