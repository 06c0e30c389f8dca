"""Keeps what other programs and libraries write off the terminal, and says in our words what it means."""

from __future__ import annotations

import logging
import os
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from ..errors import KernelError
from .cache import NO_COMPILER

# packages whose errors are of compiling, and what errors of the compiler are called
_COMPILING = ("builtins", "cffi", "distutils", "setuptools", "ffcx", "dolfinx", "basix", "ufl", "numpy")
_OF_COMPILER = ("VerificationError", "CompileError", "LinkError", "DistutilsExecError")


@contextmanager
def compiler() -> Iterator[None]:
    """dolfinx' compiler at work: what it writes is kept for the message of its error. Not collective inside.

    Raises:
        KernelError: instead of whatever else has been raised, but for errors of discs.
    """
    with _captured() as written, _unlogged(), _usable_command():
        error: Exception | None = None
        try:
            yield
        except OSError as e:
            if e.errno is not None and not isinstance(e, FileNotFoundError | PermissionError | TimeoutError):
                raise
            error = e
        except Exception as e:
            known = type(e).__module__.split(".")[0] in _COMPILING or type(e).__name__ in _OF_COMPILER
            if not known:  # from outside, such as an alarm's
                raise
            error = e
        text = written()
    if error is None:
        return
    if type(error).__name__ in _OF_COMPILER:
        command = os.environ.get("CC") or "gcc"
        said = f"the C compiler ({command}) failed on a form: {error}; {NO_COMPILER}\n{text[:2000]}"
    else:
        said = f"dolfinx could not compile a form: {type(error).__name__}: {error}"
    raise KernelError(said.strip()) from error


@contextmanager
def ufl() -> Iterator[None]:
    """UFL's errors are raised only; it would print them, too, and the root logger's handler once more."""
    logger, thread = logging.getLogger("UFL"), threading.get_ident()

    def others(record: logging.LogRecord) -> bool:
        return record.thread != thread or record.levelno < logging.ERROR

    logger.addFilter(others)
    try:
        yield
    finally:
        logger.removeFilter(others)


@contextmanager
def _captured() -> Iterator:
    """Standard error of this process and of those it starts goes into memory."""
    with suppress(Exception):
        sys.stderr.flush()
    kept: list[int] = []
    try:
        kept = [os.dup(2), os.memfd_create("stderr")]
        os.dup2(kept[1], 2)
    except (OSError, AttributeError):  # no standard error, no more descriptors, or another system
        for descriptor in kept:
            os.close(descriptor)
        yield lambda: ""
        return

    def written() -> str:
        os.lseek(kept[1], 0, os.SEEK_SET)
        return os.read(kept[1], 1 << 16).decode(errors="replace")

    try:
        yield written
    finally:
        with suppress(Exception):
            sys.stderr.flush()
        os.dup2(kept[0], 2)
        for descriptor in kept:
            os.close(descriptor)


class _FormCompiler(MetaPathFinder):
    """Watches the import of the form compiler, by whomever: it gives the root logger a handler and turns
    warnings into log records. Both are left as the script has them."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """What the other finders find, with an `exec_module` that cleans up."""
        if name != "ffcx":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                root, show = logging.getLogger(), warnings.showwarning
                handlers, level = list(root.handlers), root.level
                execute(module)
                if warnings.showwarning is not show:
                    logging.captureWarnings(False)
                root.handlers[:] = handlers
                root.setLevel(level)

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def watch_imports() -> None:
    """From now on, for imports of the form compiler."""
    if "ffcx" not in sys.modules and not any(isinstance(f, _FormCompiler) for f in sys.meta_path):
        sys.meta_path.insert(0, _FormCompiler())


@contextmanager
def _unlogged() -> Iterator[None]:
    """The root logger is left as it was: cffi logs to it, sets its level and gives it handlers."""
    root, thread = logging.getLogger(), threading.get_ident()
    handlers, level, empty = root.handlers, root.level, logging.NullHandler()

    def others(record: logging.LogRecord) -> bool:
        return record.thread != thread

    if not handlers:
        root.addHandler(empty)  # or the first line would add one
    root.addFilter(others)
    try:
        yield
    finally:
        root.removeFilter(others)
        root.handlers = handlers
        root.removeHandler(empty)
        root.setLevel(level)


@contextmanager
def _usable_command() -> Iterator[None]:
    """A blank CC stands for none."""
    blank = os.environ.get("CC")
    if blank is not None and not blank.strip():
        del os.environ["CC"]
    try:
        yield
    finally:
        if blank is not None:
            os.environ["CC"] = blank
