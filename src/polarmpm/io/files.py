"""Output files: checked before a run, written as a whole, each by one writer.

What is to be seen of a file is complete at any time: new content is written under the name with `.part`,
brought to the disc, and then put in the place of the old one. A part that a killed run has left is
overwritten by the next writer of the same file.
"""

from __future__ import annotations

import errno
import fcntl
import itertools
import os
import stat
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from mpi4py import MPI

from ..errors import InputError, OutputError
from ..tools import checks
from ..tools.parallel import raise_on_all_ranks

# of the disc, not of the name that was given
_OF_DISC = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.ENODEV, errno.ENXIO, errno.ESTALE)
_NO_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EROFS, errno.EBADF)  # of pipes, devices and some file systems


def check_output(comm: MPI.Comm, path: str | os.PathLike[str], suffix: str = "") -> Path:
    """Make the folder of an output file and try to write in it. Collective.

    Args:
        suffix: that the file's name must have; "" allows all.

    Returns:
        The absolute path, which stays the same wherever the process goes.

    Raises:
        InputError: no name of a file, or one where nothing can be written; on every rank alike, naming it.
        OutputError: the disc is full.
    """
    file = checks.path("path", path)
    if suffix and file.suffix != suffix:
        raise InputError(f"path = {os.fspath(path)!r}: the name of a {suffix} file is needed")
    error: Exception | None = None
    if comm.rank == 0:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            if file.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        except OSError as e:
            error = _refused(file, e)
    raise_on_all_ranks(comm, error)
    # ranks may run on different machines, so that each has to try
    try:
        with tempfile.TemporaryFile(dir=file.parent):
            pass
    except OSError as e:
        error = _refused(file, e)
    raise_on_all_ranks(comm, error)
    return file


def reason(error: OSError) -> str:
    """What the system says."""
    return error.strerror or str(error)


def _refused(file: Path, error: OSError) -> Exception:
    kind = OutputError if error.errno in _OF_DISC else InputError
    return kind(f"path = {str(file)!r} can't be written: {reason(error)}")


def not_written(what: str, path: Path, error: OSError) -> OutputError:
    """The error that tells a run that a file couldn't be written: `what` is "restart file" and so on."""
    return OutputError(f"{what} {path} can't be written: {reason(error)}")


# writing ----------------------------------------------------------------------------------------------
def bring_to_disc(handle: int) -> None:
    """Wait until an open file is on the disc: some discs tell only then that they are full."""
    try:
        os.fsync(handle)
    except OSError as e:
        if e.errno not in _NO_SYNC:
            raise


class Replacement:
    """New content of a file, which is put in its place by `finish`, and forgotten without it.

        with Replacement(path) as new:
            new.write(content)
            new.finish()

    Raises:
        OSError: the new content can't be written; the old one stays as it was, and nothing else is left.
    """

    def __init__(self, path: Path):
        self.path = Path(os.path.realpath(path))  # of a link the file that it leads to
        if self.path.exists() and not stat.S_ISREG(self.path.stat().st_mode):
            number = errno.EISDIR if self.path.is_dir() else errno.EINVAL
            text = os.strerror(number) if self.path.is_dir() else "not an ordinary file"
            raise OSError(number, text, str(self.path))
        self.part, self.done = self.path.with_name(self.path.name + ".part"), False

    def __enter__(self) -> Replacement:
        handle = os.open(self.part, os.O_WRONLY | os.O_CREAT, 0o666)
        try:
            self._lock(handle)
            os.ftruncate(handle, 0)
        except OSError:
            os.close(handle)
            raise
        self.file = os.fdopen(handle, "wb")
        return self

    def _lock(self, handle: int) -> None:
        """Keep other processes from writing the same part; a lock ends with its process, even if killed."""
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OSError(errno.EBUSY, "another process is writing it") from None
        except OSError:  # a file system without locks
            return
        if not (self.part.exists() and os.path.samestat(self.part.stat(), os.fstat(handle))):
            raise OSError(errno.EBUSY, "another process has just written it")

    def write(self, content: Any) -> None:
        self.file.write(content)

    def finish(self, at_start: bytes = b"") -> None:
        """Put the new content in place, with other bytes at its start than were written."""
        if at_start:
            self.file.seek(0)
            self.file.write(at_start)
        self.file.flush()
        bring_to_disc(self.file.fileno())
        os.replace(self.part, self.path)  # before it is closed, which ends the lock
        self.done = True
        with suppress(OSError):  # the name, too; the content is safe anyway
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    def __exit__(self, *error: object) -> None:
        if not self.done:
            self._remove()
        with suppress(OSError):  # what it still had to write doesn't matter any more
            self.file.close()

    def _remove(self) -> None:
        with suppress(OSError):  # the disc has gone
            self.part.unlink(missing_ok=True)


def replace_file(path: Path, *content: bytes) -> None:
    """Write a file as a whole: a reader, or a killed run, sees the old content or the new one.

    Raises:
        OSError: the old content is still there.
    """
    with Replacement(path) as new:
        for part in content:
            new.write(part)
        new.finish()


# writers ----------------------------------------------------------------------------------------------
_writers: dict[Path, int] = {}  # the number of the last one
_numbers = itertools.count()


def begin_writing(path: Path) -> int:
    """Number of a new writer of a file; earlier ones of this process must not write it any more."""
    _writers[path] = next(_numbers)
    return _writers[path]


def check_writer(path: Path, number: int) -> None:
    """Raise InputError if another writer of this process has begun with the file since."""
    if _writers[path] != number:
        raise InputError(
            f"path = {str(path)!r}: a Recorder or Table that was made later writes this file now; take "
            "another name, or go on with that one"
        )


def remove_files(files: Iterable[Path]) -> None:
    """Remove what isn't valid any more, as far as that is possible."""
    for file in files:
        with suppress(OSError):
            file.unlink(missing_ok=True)
