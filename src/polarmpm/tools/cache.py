"""Compiled code on disc: where it is kept, who may write there, and whether it is still what was compiled.

An entry is a library, or a folder of files, under a key. `KEY.sha256` beside it, in the format of sha256sum,
has the digest of each of its files. Entries are made in a work folder and renamed when they are complete: a
process that is killed meanwhile leaves nothing that another one could load or would wait for.
"""

from __future__ import annotations

import atexit
import fcntl
import hashlib
import logging
import os
import platform
import re
import shutil
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import TypeVar

from mpi4py import MPI

from ..errors import KernelError
from .parallel import errors_on_all_ranks
from .saying import say_once

T = TypeVar("T")
VARIABLE = "POLARMPM_CACHE"
NO_COMPILER = "install gcc, or set CC to a C compiler's command"
COMPILING = "compiling … (first time, about a minute)"
_WAIT = 90.0  # seconds for which another process's compiler is waited for; then the work is done twice
_PROBE = 1 << 18  # bytes that a disc must take for a compiler's failure to be the compiler's
_OLD = 86400.0  # seconds after which a work folder that nobody locks is given up
_WORK, _UNLOCKED = ".polarmpm-work-", ".polarmpm-unlocked-"  # work folders: with the key's lock, or without
_EARLIER = re.compile("tmp[a-z0-9_]{8}")  # work folders of earlier versions
_compiler = threading.RLock()  # locks on files are the process'


# folders ------------------------------------------------------------------------------------------
@lru_cache(maxsize=1)
def machine() -> str:
    """What -march=native depends on; a cache may be shared by different machines."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        flags = next((l for l in lines if l.startswith(("flags", "Features"))), "")
    except OSError:
        flags = ""
    return platform.machine() + flags


@cache
def _absolute(path: str) -> Path:
    """As seen from the folder in which the process was when it first asked."""
    return Path(os.path.abspath(os.path.expanduser(path)))


def directory() -> Path:
    """Folder of compiled code: $POLARMPM_CACHE, else the user's cache folder.

    Raises:
        OSError: the user has no home.
    """
    base = os.environ.get(VARIABLE)
    if base:
        return _absolute(base)
    base = os.environ.get("XDG_CACHE_HOME")
    if base:
        return _absolute(base) / "polarmpm"
    try:
        return _absolute(str(Path.home())) / ".cache" / "polarmpm"
    except RuntimeError:
        raise OSError("the user has no home") from None


@cache
def _private_group(group: int) -> bool:
    """Whether only this user is in a group, as Debian makes one for each."""
    import grp
    import pwd

    user = os.geteuid()
    try:
        name = pwd.getpwuid(user).pw_name
    except KeyError:
        name = ""
    try:
        entry = grp.getgrgid(group)
    except KeyError:
        return group == user
    return entry.gr_name == name and set(entry.gr_mem) <= {name}


def distrust(status: os.stat_result) -> str:
    """Why others may have put code into a file or folder; nothing if they can't."""
    if status.st_uid not in (os.geteuid(), 0):
        return "it belongs to another user"
    if status.st_mode & stat.S_IWOTH:
        return "everybody may write to it"
    if status.st_mode & stat.S_IWGRP and not _private_group(status.st_gid):
        return "its group may write to it"
    return ""


def _checked(root: Path) -> Path:
    """The folder, made if there's none.

    Raises:
        OSError: it can't be made, others may write to it, or libraries can't be loaded from it.
    """
    root.mkdir(mode=0o700, parents=True, exist_ok=True)
    reason = distrust(root.stat())
    if reason:
        raise PermissionError(f"{reason} (chmod go-w)" if "may write" in reason else reason)
    if os.statvfs(root).f_flag & os.ST_NOEXEC:
        raise PermissionError("its file system is mounted noexec")
    return root


_private: dict[int, Path] = {}  # by process, as a fork has its own


def private() -> Path:
    """A temporary folder of this process, removed when it ends.

    Raises:
        OSError: there's no place for one.
    """
    found = _private.get(os.getpid())
    if found is not None and found.is_dir():
        return found
    error: OSError = OSError("no temporary folder")
    for base in dict.fromkeys(_temporary()):
        try:
            _sweep_private(base)
            root = Path(tempfile.mkdtemp(prefix="polarmpm-", dir=base))
        except OSError as e:
            error = e
            continue
        try:
            _checked(root)
            (root / "probe").write_bytes(bytes(_PROBE))
            alive = os.open(root / ".alive", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            with suppress(OSError):
                fcntl.flock(alive, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until the process ends
        except OSError as e:
            error = e
            shutil.rmtree(root, ignore_errors=True)
            continue
        _private[os.getpid()] = root
        atexit.register(_remove_private, os.getpid(), root)
        return root
    raise error


def _temporary() -> list[str]:
    try:
        return [tempfile.gettempdir(), "/var/tmp", "/dev/shm"]
    except OSError:
        return ["/var/tmp", "/dev/shm"]


def _remove_private(process: int, root: Path) -> None:
    if os.getpid() == process:
        shutil.rmtree(root, ignore_errors=True)


def _sweep_private(base: str) -> None:
    """Remove what killed processes have left."""
    for folder in Path(base).glob("polarmpm-*/.alive"):
        with suppress(OSError), open(folder, "rb") as file:
            status = os.fstat(file.fileno())
            if status.st_uid == os.geteuid() and time.time() - status.st_mtime > 60.0:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder.parent, ignore_errors=True)


# entries ------------------------------------------------------------------------------------------
def _read(path: Path) -> bytes:
    """A file's bytes.

    Raises:
        OSError: it can't be read, is none, or others may have written it.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    with open(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        reason = distrust(status) if stat.S_ISREG(status.st_mode) else "it is no file"
        if reason:
            raise PermissionError(reason)
        return file.read()


def holds(root: Path, key: str, name: str) -> bool:
    """Whether a folder has a whole and trusted entry: all files that were compiled, as they were."""
    try:
        if distrust(root.stat()) or ((root / name).is_dir() and distrust((root / name).lstat())):
            return False
        lines = _read(root / f"{key}.sha256").decode().splitlines()
        for line in lines:
            digest, _, file = line.partition("  ")
            inside = file == name or (file.startswith(f"{name}/") and file.count("/") == 1)
            if not inside or hashlib.sha256(_read(root / file)).hexdigest() != digest:
                return False
    except (OSError, ValueError):
        return False
    return bool(lines)


def _put(root: Path, work: Path, key: str, made: Path, name: str) -> None:
    """Move what was made into its place, after its digest."""
    files = sorted(made.iterdir()) if made.is_dir() else [made]
    lines = []
    for file in files:
        file.chmod(stat.S_IMODE(file.stat().st_mode) & ~0o022)
        shown = f"{name}/{file.name}" if made.is_dir() else name
        lines.append(f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {shown}\n")
    if made.is_dir():
        made.chmod(0o755)
    digest = work / "digest"
    digest.write_text("".join(lines))
    digest.chmod(0o644)
    for new, place in ((digest, root / f"{key}.sha256"), (made, root / name)):
        if place.is_dir() or (made.is_dir() and os.path.lexists(place)):
            os.replace(place, work / f"damaged {place.name}")  # a folder isn't replaced by another thing
        os.replace(new, place)


@contextmanager
def _locked(root: Path, key: str) -> Iterator[int | None]:
    """No other process compiles what has the key, as far as the file system can tell: its file, or None.

    The lock is on one byte of a file, and ends with the process that holds it, however it ends.
    """
    try:
        file = os.open(root / ".polarmpm.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError:
        yield None
        return
    try:
        end, held = time.monotonic() + _WAIT, _try_lock(file, key)
        while held is False and time.monotonic() < end:
            time.sleep(0.05)
            held = _try_lock(file, key)
        yield file if held else None
    finally:
        os.close(file)


def _place(key: str) -> int:
    return int(hashlib.sha256(key.encode()).hexdigest()[:15], 16)


def _try_lock(file: int, key: str) -> bool | None:
    """None: the file system has no locks."""
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _place(key))
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None
    return True


def _sweep(root: Path, file: int | None, key: str) -> None:
    """Remove work folders of processes that have been killed: nobody holds the lock of what they made."""
    for folder in root.iterdir():
        name, dead = folder.name, False
        if name.startswith(_WORK) and file is not None:
            other = name.removeprefix(_WORK).rpartition("-")[0]
            if other == key or _try_lock(file, other):
                shutil.rmtree(folder, ignore_errors=True)
            if other != key:
                fcntl.lockf(file, fcntl.LOCK_UN, 1, _place(other))
        elif name.startswith(_UNLOCKED):
            dead = time.time() - folder.lstat().st_mtime > _OLD
        elif _EARLIER.fullmatch(name) and folder.is_dir():
            inside = {f.name for f in folder.iterdir()}
            dead = inside <= {"kernel.c", "kernel.so"} and time.time() - folder.stat().st_mtime > _OLD
        if dead:
            shutil.rmtree(folder, ignore_errors=True)


def _make(
    root: Path, key: str, name: str, build: Callable[[Path], tuple[Path, T | None]], anew: bool
) -> T | None:
    """Make an entry; None where it has to be loaded, such as when another process has made it meanwhile.

    Raises:
        OSError: the folder can't be written.
        KernelError: the compiler failed.
    """
    with _compiler, _locked(root, key) as file:
        if not anew and holds(root, key, name):
            return None
        with suppress(OSError):
            _sweep(root, file, key)
        prefix = f"{_WORK}{key}-" if file is not None else _UNLOCKED
        work = Path(tempfile.mkdtemp(prefix=prefix, dir=root))
        try:
            try:
                made, built = build(work)
            except KernelError:
                (work / "probe").write_bytes(bytes(_PROBE))  # is the disc full?
                raise
            _put(root, work, key, made, name)
        finally:
            shutil.rmtree(work, ignore_errors=True)
        return built


def obtain(
    key: str,
    name: str,
    load: Callable[[Path], T],
    build: Callable[[Path], tuple[Path, T | None]],
    near: Path | None = None,
    announced: bool = False,
) -> tuple[Path, T]:
    """The folder that has an entry, and what is loaded from it; it is made where there's none.

    Args:
        name: of the entry's file or folder.
        load: (its path) -> what is loaded; OSError if it can't be.
        build: (a folder to work in) -> the path in it that becomes the entry, and what is loaded, or None.
        near: folder to look into first.
        announced: say that it takes time.

    Raises:
        KernelError: it can't be compiled, loaded or kept.
    """
    unfit = False
    for root in filter(None, (near, _known(), _private.get(os.getpid()))):
        if holds(root, key, name):
            try:
                return root, load(root / name)
            except OSError:  # it is whole, but from a machine with another C library
                unfit = True
    trouble = []
    for folder in (directory, private):
        where = "the cache of compiled code"
        try:
            root = folder()
            where = str(root)
            _checked(root)
            if announced:
                say_once(logging.INFO, COMPILING)
            built = _make(root, key, name, build, unfit)
            return root, load(root / name) if built is None else built
        except OSError as e:
            trouble.append(f"{where}: {_reason(e)}")
            if folder is directory:
                _warn(where, e)
    raise KernelError(
        f"compiled code can't be kept or loaded ({'; '.join(trouble)}); {_way_out()}, or CC to another "
        "compiler's command"
    )


def _known() -> Path | None:
    try:
        return directory()
    except OSError:
        return None


def _reason(error: OSError) -> str:
    return error.strerror or str(error)


def _way_out() -> str:
    return f"set {VARIABLE} to a folder that only you can write to"


def _warn(where: str, error: OSError) -> None:
    if MPI.COMM_WORLD.rank == 0:
        say_once(
            logging.WARNING,
            f"{where} isn't used: {_reason(error)}. Compiled code is kept in a temporary folder until the "
            f"run ends, and compiled again by the next one; {_way_out()}.",
        )


def on_all_ranks(comm: MPI.Comm, get: Callable[[Path | None, bool], tuple[Path, T]]) -> T:
    """What each rank loads by `obtain(..., near, announced)`: one compiles, and the others load it, from its
    folder if they see it; an error is raised on every rank. Collective."""
    found: list[tuple[Path, T]] = []
    with errors_on_all_ranks(comm):
        if comm.rank == 0:
            found.append(get(None, MPI.COMM_WORLD.rank == 0))
    if comm.size > 1:
        near = comm.bcast(found[0][0] if found else None)
        with errors_on_all_ranks(comm):
            if comm.rank > 0:
                found.append(get(near, False))
    return found[0][1]
