"""Compiles generated C code once per machine; `tools.cache` keeps it on disc."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

from mpi4py import MPI

from ..errors import KernelError
from ..tools import cache

_FLAGS = [
    "-O2",
    "-march=native",
    "-std=gnu11",
    "-fPIC",
    "-shared",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-w",
    # How far gcc looks for registers in functions of thousands of vectors. Its default takes nine tenths of
    # the time where a processor has 16 of them, for code of the same size (a plastic point: 110 s, now 22).
    "--param=lra-max-considered-reload-pseudos=20",
]
_LONG = (
    4000,
    40_000,
)  # lines of code for few rows that aren't optimised; beyond, that would take a large stack
cache_directory = cache.directory  # for scripts that ask where kernels are
_loaded: dict[str, tuple[Path, ctypes.CDLL]] = {}  # by key: checked once a process


def digest(*parts: str) -> str:
    """Name of a kernel in the cache."""
    return hashlib.sha256("\0".join([*parts, cache.machine(), *_FLAGS]).encode()).hexdigest()[:24]


def _compiler() -> list[str]:
    """The command of the C compiler.

    Raises:
        KernelError: CC is no command.
    """
    told = os.environ.get("CC", "")
    try:
        command = shlex.split(told)
    except ValueError as e:
        raise KernelError(f"CC = {told!r} is no command ({e}); {cache.NO_COMPILER}") from None
    return command or [shutil.which("cc") or shutil.which("gcc") or "cc"]


def _build(source: str, work: Path) -> Path:
    """Compile a library in a folder."""
    code, library = work / "kernel.c", work / "kernel.so"
    code.write_text(source)
    compiler = _compiler()
    command = [*compiler, *_FLAGS, str(code), "-o", str(library), "-lm"]
    shown = f"the C compiler ({shlex.join(compiler)})"
    try:
        run = subprocess.run(
            command, capture_output=True, stdin=subprocess.DEVNULL, text=True, errors="replace", check=False
        )
    except FileNotFoundError as e:
        raise KernelError(f"no C compiler found ({shlex.join(compiler)}); {cache.NO_COMPILER}") from e
    except OSError as e:
        raise KernelError(f"{shown} can't be run: {e.strerror}; {cache.NO_COMPILER}") from e
    if run.returncode < 0:
        name = signal.Signals(-run.returncode).name
        raise KernelError(
            f"{shown} was ended by {name}, such as for lack of memory; let fewer processes run beside it, or "
            "set CC to another compiler's command"
        )
    if run.returncode or not library.is_file():
        ended = f"ended with status {run.returncode}" if run.returncode else "wrote no library"
        raise KernelError(f"{shown} {ended} on a generated kernel; {cache.NO_COMPILER}\n{run.stderr[:2000]}")
    return library


def library(key: str, source: Callable[[], str], comm: MPI.Comm, *, few_rows: bool = False) -> ctypes.CDLL:
    """The compiled library `key`; `source` is only called where the cache doesn't have it. Long code for
    `few_rows` isn't optimised, which would take longer than it saves.

    Collective: one rank compiles, the others wait; an error is raised on every rank.

    Raises:
        KernelError: UFL or the compiler refused the code, or there's no place to keep it.
    """

    def build(work: Path) -> tuple[Path, None]:
        text = source()
        if few_rows and _LONG[0] < text.count("\n") < _LONG[1]:
            text = '#pragma GCC optimize ("O0")\n' + text
        return _build(text, work), None

    def get(near: Path | None, announced: bool) -> tuple[Path, ctypes.CDLL]:
        if key not in _loaded:
            name = f"{key}.so"
            _loaded[key] = cache.obtain(key, name, lambda p: ctypes.CDLL(str(p)), build, near, announced)
        return _loaded[key]

    return cache.on_all_ranks(comm, get)
