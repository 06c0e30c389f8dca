"""Output files on several ranks: checked before a run, replaced as a whole."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from mpi4py import MPI

from ..errors import InputError
from ..tools.parallel import raise_on_all_ranks


def check_output(comm: MPI.Comm, path: str | os.PathLike[str], suffix: str = "") -> Path:
    """Make the folder of an output file and try to write in it. Collective.

    Args:
        suffix: that the file's name must have; "" allows all.

    Raises:
        InputError: on every rank alike, naming the path.
    """
    file = Path(path)
    if suffix and file.suffix != suffix:
        raise InputError(f"path = {os.fspath(path)!r}: the name of a {suffix} file is needed")
    error = None
    if comm.rank == 0:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            if file.is_dir():
                raise IsADirectoryError(None, "Is a directory")
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


def _refused(file: Path, error: OSError) -> InputError:
    return InputError(f"path = {str(file)!r} can't be written: {error.strerror}")


def replace_file(path: Path, content: bytes) -> None:
    """Write a file as a whole: a reader, or a killed run, sees the old content or the new one."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        # mkstemp's files are private; the result gets what the user's umask allows
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise
