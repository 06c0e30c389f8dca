"""The container of restart files: HDF5 with a checksum over every byte.

HDF5's library crashes when a disc is full, so it never writes to one: it lays the file out in memory, where
the arrays take no room, and what it has laid out goes to the disc together with the arrays' rows, in order,
by ordinary writing. Rank 0 writes; the other ranks send it their rows in pieces, so that no rank ever has
all of them.

The first bytes, which HDF5 leaves to its users, name the format, the length and a digest of all other bytes.
They are checked before HDF5 sees the file, as damaged ones may crash it, too.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np

from ..errors import InputError
from ..tools.parallel import raise_on_all_ranks
from .files import Replacement, not_written, reason

_HEAD = 512  # bytes; the least that HDF5 leaves free
_MAGIC = b"polarmpm restart file\n"
_PAGE = 4096
_PIECE = 1 << 25  # bytes that are sent and written at once
_TAG = 7362
_HDF5 = b"\x89HDF\r\n\x1a\n"


class _Memory:
    """A file in memory that has only those pages to which something was written."""

    def __init__(self) -> None:
        self.pages: dict[int, bytearray] = {}
        self.at = self.end = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self.at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self.at, os.SEEK_END: self.end}[whence]
        return self.at

    def tell(self) -> int:
        return self.at

    def truncate(self, size: int | None = None) -> int:
        self.end = self.at if size is None else size
        return self.end

    def flush(self) -> None:
        pass

    def _parts(self, length: int) -> Iterator[tuple[int, slice, slice]]:
        """Number of a page, the part of it, and that of what is moved."""
        done = 0
        while done < length:
            page, start = divmod(self.at, _PAGE)
            n = min(length - done, _PAGE - start)
            yield page, slice(start, start + n), slice(done, done + n)
            done, self.at = done + n, self.at + n

    def write(self, content: Any) -> int:
        view = memoryview(content).cast("B")
        for page, here, there in self._parts(len(view)):
            self.pages.setdefault(page, bytearray(_PAGE))[here] = view[there]
        self.end = max(self.end, self.at)
        return len(view)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        for page, here, there in self._parts(len(view)):
            view[there] = self.pages[page][here] if page in self.pages else bytes(here.stop - here.start)
        return len(view)

    def read(self, length: int) -> bytes:
        out = bytearray(length)
        self.readinto(out)
        return bytes(out)


@dataclass
class Part:
    """An array of the file: rows of all ranks, one rank after the other.

    Attributes:
        rows: this rank's.
        counts: number of rows of each rank.
    """

    rows: np.ndarray
    counts: list[int]


def agree(comm: MPI.Comm, arrays: Mapping[str, np.ndarray]) -> dict[str, Part]:
    """Arrays of which each rank has rows, with the ranks' numbers of them. Collective.

    Raises:
        InputError: the ranks have other arrays, or they aren't numbers; on every rank alike.
    """
    own = {name: (a.dtype.str, a.shape[1:], len(a), a.dtype.kind in "biuf") for name, a in arrays.items()}
    every = comm.allgather(own)
    first = {name: spec[:2] for name, spec in every[0].items()}
    for rank, other in enumerate(every):
        for name in [*first, *other]:
            if not (name in first and name in other and other[name][:2] == first[name]):
                has = [of[name][:2] if name in of else "no such array" for of in (first, other)]
                raise InputError(
                    f"{name}: rank 0 has {has[0]} (type and shape of a row), rank {rank} has {has[1]}"
                )
            if not other[name][3]:
                raise InputError(f"{name}: an array of the type {arrays[name].dtype}; numbers are needed")
    return {
        name: Part(np.ascontiguousarray(a), [other[name][2] for other in every]) for name, a in arrays.items()
    }


# writing ----------------------------------------------------------------------------------------------
def _laid_out(
    parts: Mapping[str, Part], attributes: Mapping[str, Any]
) -> tuple[_Memory, list[tuple[int, str]]]:
    """The file without the arrays' rows, and where each array begins, in this order."""
    memory, places = _Memory(), []
    layout, link = h5py.h5p.create(h5py.h5p.DATASET_CREATE), h5py.h5p.create(h5py.h5p.LINK_CREATE)
    layout.set_layout(h5py.h5d.CONTIGUOUS)
    layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    link.set_create_intermediate_group(True)
    with h5py.File(memory, "w", userblock_size=_HEAD) as file:
        file.attrs.update(attributes)
        for name, part in parts.items():
            file[f"counts/{name}"] = np.array(part.counts, dtype=np.int64)
            kind = h5py.h5t.py_create(part.rows.dtype, logical=True)
            space = h5py.h5s.create_simple((sum(part.counts), *part.rows.shape[1:]))
            made = h5py.h5d.create(file.id, name.encode(), kind, space, dcpl=layout, lcpl=link)
            if made.get_storage_size():
                places.append((made.get_offset(), name))
    places.sort()
    ends = [place + sum(parts[name].counts) * _width(parts[name]) for place, name in places]
    starts = [place for place, _ in places[1:]] + [memory.end]
    if any(end > start for end, start in zip(ends, starts, strict=True)):
        raise RuntimeError("HDF5 has laid arrays out one over the other")
    return memory, places


class _Stream:
    """Rank 0's new file; after an error it takes what comes and forgets it, so that no rank waits."""

    def __init__(self, path: Path):
        self.digest, self.length = hashlib.blake2b(digest_size=32), 0
        self.error: Exception | None = None
        self.new: Replacement | None = None
        with self._noting():
            if not path.parent.exists():
                path.parent.mkdir(parents=True)
            self.new = Replacement(path).__enter__()
            self.new.write(bytes(_HEAD))

    @contextmanager
    def _noting(self) -> Iterator[None]:
        try:
            yield
        except Exception as e:
            self.error = self.error or e

    def write(self, content: Any) -> None:
        with self._noting():
            if self.error is None and self.new is not None:
                self.new.write(content)
                self.digest.update(content)
                self.length += len(content)

    def finish(self, kind: str) -> None:
        with self._noting():
            if self.error is None and self.new is not None:
                self.new.finish(_head(self.digest.hexdigest(), self.length, kind))

    def close(self) -> None:
        if self.new is not None:
            self.new.__exit__()


def _head(digest: str, length: int, kind: str) -> bytes:
    text = _MAGIC + f"{kind}\nblake2b of the {length} bytes after the first {_HEAD}:\n{digest}\n".encode()
    return text.ljust(_HEAD, b"\0")


def write(
    comm: MPI.Comm, path: Path, kind: str, parts: Mapping[str, Part], attributes: Mapping[str, Any]
) -> None:
    """Put a new file in the place of the old one. Collective.

    Args:
        kind: of the file, such as "format 8", on one line.
        parts: as from `agree`.
        attributes: numbers, texts and arrays of rank 0.

    Raises:
        OutputError: it can't be written; the old file stays as it was.
    """
    error: Exception | None = None
    memory = _Memory()
    places: list[tuple[int, str]] = []
    if comm.rank == 0:
        try:
            memory, places = _laid_out(parts, attributes)
        except Exception as e:
            error = e
    raise_on_all_ranks(comm, error)
    order = comm.bcast([name for _, name in places])
    if comm.rank == 0:
        stream = _Stream(path)
        try:
            _write_all(comm, stream, parts, memory, places)
            stream.finish(kind)
        finally:
            stream.close()
        error = stream.error
        if isinstance(error, OSError):
            error = not_written("restart file", path, error)
    else:
        for name in order:
            for piece in _pieces(parts[name].rows):
                comm.Send(piece, 0, _TAG)
    raise_on_all_ranks(comm, error)


def _write_all(
    comm: MPI.Comm,
    stream: _Stream,
    parts: Mapping[str, Part],
    memory: _Memory,
    places: list[tuple[int, str]],
) -> None:
    memory.seek(_HEAD)
    for place, name in places:
        stream.write(memory.read(place - memory.at))
        for content in _received(comm, parts[name]):
            stream.write(content)
            memory.at += len(content)
    stream.write(memory.read(memory.end - memory.at))


def _pieces(rows: np.ndarray) -> Iterator[np.ndarray]:
    """The bytes of an array."""
    flat = rows.reshape(-1).view(np.uint8)
    for start in range(0, len(flat), _PIECE):
        yield flat[start : start + _PIECE]


def _width(part: Part) -> int:
    """Bytes of a row."""
    return int(part.rows.dtype.itemsize * np.prod(part.rows.shape[1:], dtype=int))


def _received(comm: MPI.Comm, part: Part) -> Iterator[np.ndarray]:
    """Bytes of the rows of all ranks, on rank 0."""
    yield from _pieces(part.rows)
    for rank, count in enumerate(part.counts):
        if rank:
            length = count * _width(part)
            for start in range(0, length, _PIECE):
                content = np.empty(min(_PIECE, length - start), dtype=np.uint8)
                comm.Recv(content, rank, _TAG)
                yield content


# reading ----------------------------------------------------------------------------------------------
def check(comm: MPI.Comm, path: Path, kind: str) -> None:
    """Check every byte of a file before something of it is used. Collective.

    Raises:
        InputError: it can't be read, isn't such a file or has been damaged; on every rank alike.
    """
    error: Exception | None = None
    head = b""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
            error = _mistake(path, head, kind)
            if error is None and comm.rank == 0 and not _is_whole(file, head, kind):
                error = InputError(
                    f"restart file {path} is damaged: its checksum doesn't fit, as bytes have been lost or "
                    "changed since it was written"
                )
    except OSError as e:
        error = InputError(f"restart file {path} can't be read: {reason(e)}")
    raise_on_all_ranks(comm, error)
    if comm.bcast(head) != head:
        error = InputError(f"restart file {path}: rank {comm.rank} sees another file than rank 0")
    raise_on_all_ranks(comm, error)


def _mistake(path: Path, head: bytes, kind: str) -> InputError | None:
    lines = head.split(b"\n", 2)
    if head.startswith(_MAGIC) and len(lines) > 2 and lines[1] == kind.encode():
        return None
    if head.startswith(_MAGIC) and len(head) == _HEAD and lines[1][:7] == b"format ":
        found = lines[1][:40].decode("ascii", "replace")
        return InputError(f"restart file {path}: it is of {found}, this version of polarmpm reads {kind}")
    if head.startswith(_HDF5):
        return InputError(
            f"restart file {path} has no checksum: it is of an earlier version of polarmpm than {kind}, "
            "or no restart file"
        )
    return InputError(f"restart file {path} is damaged, or no restart file: it doesn't begin like one")


def _is_whole(file: Any, head: bytes, kind: str) -> bool:
    digest, length = hashlib.blake2b(digest_size=32), 0
    while piece := file.read(_PIECE):
        digest.update(piece)
        length += len(piece)
    return head == _head(digest.hexdigest(), length, kind)
