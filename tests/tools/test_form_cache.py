"""Forms that dolfinx compiles: kept in our cache, and nothing of its compiler on the terminal."""

from __future__ import annotations

import logging
import os
import shutil

from mpi4py import MPI

import dolfinx.mesh
import numpy as np
import pytest
import ufl
from dolfinx import fem, jit

from polarmpm import KernelError
from polarmpm.tools import cache, compat, quiet

COMM, SELF = MPI.COMM_WORLD, MPI.COMM_SELF


def form(number: float, comm=SELF):
    mesh = dolfinx.mesh.create_unit_square(comm, 2, 2)
    return ufl.as_ufl(number) * ufl.dx(domain=mesh)


def integral(number: float, comm=SELF) -> float:
    """Of a number over the unit square, by a form that is compiled as if the process had just begun."""
    compat._compiled.clear()
    value = fem.assemble_scalar(compat.compile_form(form(number, comm)))
    return comm.allreduce(float(np.real(value)))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty cache of this rank's, nothing said yet."""
    monkeypatch.setenv("POLARMPM_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(cache, "_private", {})
    monkeypatch.setattr(compat, "_compiled", {})
    cache.say_once.cache_clear()
    return tmp_path / "cache"


def folders(place):
    return sorted(p for p in place.iterdir() if p.is_dir())


def test_forms_are_compiled_once_into_our_cache(place):
    own = jit.ffcx_jit
    assert integral(1.5) == pytest.approx(1.5)
    assert jit.ffcx_jit is own
    (entry,) = folders(place)
    assert entry.name.startswith("dolfinx-")
    assert cache.holds(place, entry.name, entry.name)
    (library,) = entry.glob("*.so")
    before = library.stat()
    assert integral(1.5) == pytest.approx(1.5)
    assert library.stat() == before
    assert folders(place) == [entry]


def cut(entry, size: int) -> None:
    """A shorter file in its place: this process has loaded the library, and would die of its end."""
    (library,) = entry.glob("*.so")
    data = library.read_bytes()[:size]
    library.unlink()
    library.write_bytes(data)


DAMAGES = {
    "empty": lambda entry: cut(entry, 0),
    "half": lambda entry: cut(entry, 5000),
    "no library": lambda entry: next(entry.glob("*.so")).unlink(),
    "a lock": lambda entry: next(entry.glob("*.cached")).unlink(),
    "a lock without a digest": lambda entry: (
        next(entry.glob("*.cached")).unlink(),
        entry.with_suffix(".sha256").unlink(),
    ),
    "no source": lambda entry: next(entry.glob("*.c")).unlink(),
    "no folder": shutil.rmtree,
    "a file": lambda entry: (shutil.rmtree(entry), entry.write_text("")),
    "everybody may write": lambda entry: entry.chmod(0o777),
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_forms_are_compiled_again(place, name):
    assert integral(2.5) == pytest.approx(2.5)
    (entry,) = folders(place)
    DAMAGES[name](entry)
    assert not cache.holds(place, entry.name, entry.name)
    assert integral(2.5) == pytest.approx(2.5)
    assert cache.holds(place, entry.name, entry.name)


@pytest.mark.timeout(60)
def test_locks_in_the_cache_of_dolfinx_do_not_matter(place, tmp_path, monkeypatch):
    """Of whoever has been killed there."""
    monkeypatch.chdir(tmp_path)
    given = {}

    def own(comm, thing, **options):
        given.update(next(v for k, v in options.items() if k.startswith("jit_")))
        return compile_(comm, thing, **options)

    compile_ = jit.ffcx_jit
    monkeypatch.setattr(jit, "ffcx_jit", own)
    assert integral(3.5) == pytest.approx(3.5)
    assert given["cache_dir"].startswith(str(place))


@pytest.mark.parametrize("command", ["false", "/nonexistent/cc", "sh -c 'echo some words >&2; exit 3'"])
def test_a_compiler_that_fails(place, monkeypatch, command, capfd):
    monkeypatch.setenv("CC", command)
    handlers, level = list(logging.getLogger().handlers), logging.getLogger().level
    with pytest.raises(KernelError, match="set CC") as caught:
        integral(4.5)
    assert ("some words" in command) == ("some words" in str(caught.value))
    assert (logging.getLogger().handlers, logging.getLogger().level) == (handlers, level)
    out, err = capfd.readouterr()
    assert (out, err.replace(f"polarmpm: {cache.COMPILING}\n", "")) == ("", "")
    assert os.environ["CC"] == command
    monkeypatch.setenv("CC", "")
    assert integral(4.5) == pytest.approx(4.5)
    assert len(folders(place)) == 1


def test_the_compiler_keeps_quiet(place, capfd, monkeypatch):
    """Though the script logs everything itself."""
    root = logging.getLogger()
    records = []
    handler = logging.Handler()
    handler.emit = records.append
    monkeypatch.setattr(root, "handlers", [handler])
    monkeypatch.setattr(root, "level", logging.DEBUG)
    assert integral(5.5) == pytest.approx(5.5)
    out, err = capfd.readouterr()
    assert (out, err) == ("", f"polarmpm: {cache.COMPILING}\n" if COMM.rank == 0 else "")
    assert root.handlers == [handler]
    assert root.level == logging.DEBUG
    assert not [r for r in records if r.name == "root"]


def test_nothing_is_left_of_what_is_interrupted(place, monkeypatch):
    def interrupted(comm, thing, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(jit, "ffcx_jit", interrupted)
        with pytest.raises(KeyboardInterrupt):
            integral(6.5)
        assert jit.ffcx_jit is interrupted
    assert folders(place) == []
    assert integral(6.5) == pytest.approx(6.5)


def test_any_path_will_do(place, monkeypatch, tmp_path):
    monkeypatch.setenv("POLARMPM_CACHE", str(tmp_path / "a 'b\" $c;\n\u00e9 -o"))
    assert integral(1.25) == pytest.approx(1.25)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("POLARMPM_CACHE", "forms/here")
    assert integral(1.25) == pytest.approx(1.25)
    assert len(folders(tmp_path / "forms/here")) == 1


def test_on_all_ranks(place, monkeypatch, folder):
    """One folder for all, and one for each."""
    assert integral(7.5, COMM) == pytest.approx(7.5)
    monkeypatch.setenv("POLARMPM_CACHE", str(folder / "shared"))
    assert integral(8.5, COMM) == pytest.approx(8.5)
    assert len(folders(folder / "shared")) == 1


def test_a_failure_on_one_rank_is_raised_on_all(place, monkeypatch):
    monkeypatch.setattr(cache, "holds", lambda *_: False)  # no rank sees another's disc
    if COMM.rank == COMM.size - 1:
        monkeypatch.setenv("CC", "false")
    with pytest.raises(KernelError, match="set CC"):
        integral(9.5, COMM)


def test_other_errors_are_told_in_our_words():
    message = "dolfinx could not compile a form: ValueError: no such thing"
    with pytest.raises(KernelError, match=message), quiet.compiler():
        raise ValueError("no such thing")
    with pytest.raises(OSError, match="No space"), quiet.compiler():  # the cache takes another disc
        raise OSError(28, "No space left on device")


def test_signatures_do_not_depend_on_the_process(place, monkeypatch):
    """Options in another order, and those of waiting, don't matter; the others do."""
    keys = []
    monkeypatch.setattr(cache, "obtain", lambda key, *_: keys.append(key) or (place, None))
    thing = form(1.0)
    for options in (
        {"timeout": 3, "cffi_libraries": ["m"]},
        {"cffi_libraries": ["m"], "timeout": 4, "cache_dir": "x"},
        {"cffi_libraries": ["n"]},
    ):
        kind = "jit_options" if hasattr(jit, "get_options") else "jit_params"
        monkeypatch.setattr(compat, "_compiled", {})
        compat._compile(jit.ffcx_jit, SELF, thing, **{kind: options})
    assert keys[0] == keys[1] != keys[2]
