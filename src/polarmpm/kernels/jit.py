"""Compiles generated C code once per machine and keeps it in a cache on disc."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path

from mpi4py import MPI

from ..errors import KernelError

_FLAGS = [
    "-O2",
    "-march=native",
    "-std=gnu11",
    "-fPIC",
    "-shared",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-w",
]


def cache_directory() -> Path:
    """Folder of compiled kernels: $POLARMPM_CACHE, else the user's cache folder."""
    base = os.environ.get("POLARMPM_CACHE")
    if base:
        return Path(base)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "polarmpm"


@lru_cache(maxsize=1)
def _machine() -> str:
    """What -march=native depends on; a cache may be shared by different machines."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        flags = next((l for l in lines if l.startswith(("flags", "Features"))), "")
    except OSError:
        flags = ""
    return platform.machine() + flags


def digest(*parts: str) -> str:
    """Name of a kernel in the cache."""
    return hashlib.sha256("\0".join([*parts, _machine(), *_FLAGS]).encode()).hexdigest()[:24]


def _build(source: str, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        code, library = Path(folder) / "kernel.c", Path(folder) / "kernel.so"
        code.write_text(source)
        command = [*shlex.split(os.environ.get("CC", "cc")), *_FLAGS, str(code), "-o", str(library), "-lm"]
        try:
            run = subprocess.run(command, capture_output=True, text=True, check=False)
        except FileNotFoundError as e:
            raise KernelError(f"no C compiler found ({command[0]}); install gcc or set CC") from e
        if run.returncode:
            raise KernelError(f"the C compiler failed on a generated kernel:\n{run.stderr[:2000]}")
        os.replace(library, target)  # atomic: another process sees all of it or nothing


@cache
def _load(path: str) -> ctypes.CDLL:
    return ctypes.CDLL(path)


def library(key: str, source: Callable[[], str], comm: MPI.Comm) -> ctypes.CDLL:
    """The compiled library `key`; `source` is only called where the cache doesn't have it.

    Collective: one rank compiles, the others wait; an error is raised on every rank.

    Raises:
        KernelError: UFL or the compiler refused the code.
    """
    target = cache_directory() / f"{key}.so"
    error: Exception | None = None
    if comm.rank == 0 and not target.exists():
        try:
            _build(source(), target)
        except (KernelError, OSError) as e:
            error = e
    error = comm.bcast(error, root=0)
    if error is not None:
        raise KernelError(str(error)) from error
    if not target.exists():  # ranks of other machines have a disc of their own
        _build(source(), target)
    return _load(str(target))
