"""Compiled kernels on disc: damaged, foreign and unfinished ones are never loaded."""

from __future__ import annotations

import ctypes
import logging
import os
import shutil
import subprocess
import sys
import time

from mpi4py import MPI

import pytest

from polarmpm import KernelError
from polarmpm.kernels import jit
from polarmpm.tools import cache

SELF = MPI.COMM_SELF  # each rank has its own folder of a test
ROOT = os.geteuid() == 0


def source(number: int) -> str:
    return f"double answer(void) {{ return {number}; }}"


def answer(key: str, number: int, comm: MPI.Comm = SELF) -> float:
    """What a process that starts afresh would get."""
    jit._loaded.pop(key, None)
    library = jit.library(key, lambda: source(number), comm)
    library.answer.restype = ctypes.c_double
    return library.answer()


def kept(place, key: str, number: int) -> list:
    """What is compiled, without a look into this process' memory; it isn't loaded, as it will be damaged."""
    made = []

    def build(work):
        made.append(number)
        return jit._build(source(number), work), None

    assert cache.obtain(key, f"{key}.so", lambda p: p, build) == (place, place / f"{key}.so")
    return made


@pytest.fixture
def key(request) -> str:
    """A key that no other test has: libraries stay loaded."""
    return jit.digest(request.node.nodeid, str(time.time_ns()), str(os.getpid()))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty cache, nothing said yet and no temporary one."""
    monkeypatch.setenv("POLARMPM_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(cache, "_private", {})
    cache.say_once.cache_clear()
    return tmp_path / "cache"


def entries(place) -> list[str]:
    return sorted(p.name for p in place.iterdir() if p.name != ".polarmpm.lock")


def test_a_library_is_compiled_once_and_has_a_digest(place, key):
    assert answer(key, 1) == 1
    assert entries(place) == [f"{key}.sha256", f"{key}.so"]
    done = subprocess.run(["sha256sum", "-c", f"{key}.sha256"], cwd=place, capture_output=True, check=False)
    assert done.returncode == 0
    before = (place / f"{key}.so").stat()
    assert answer(key, 2) == 1  # another source under the same key isn't looked at
    assert (place / f"{key}.so").stat() == before


def damages():
    def folder(file):
        file.unlink()
        (file / "inside").mkdir(parents=True)

    def link(file):
        file.rename(file.with_suffix(".other"))
        file.symlink_to(file.with_suffix(".other"))

    def pipe(file):
        file.unlink()
        os.mkfifo(file)

    def flip(file):
        data = bytearray(file.read_bytes())
        data[len(data) // 2] ^= 4
        file.write_bytes(data)

    def digest(change):
        return lambda file: change(file.with_suffix(".sha256"))

    yield "empty", lambda f: os.truncate(f, 0)
    yield "half", lambda f: os.truncate(f, f.stat().st_size // 2)
    yield "last byte", lambda f: os.truncate(f, f.stat().st_size - 1)
    yield "longer", lambda f: f.write_bytes(f.read_bytes() + b"\0")
    yield "flipped bit", flip
    yield "text", lambda f: f.write_text("no library")
    yield "folder", folder
    yield "link", link
    yield "dangling link", lambda f: (f.unlink(), f.symlink_to("nowhere"))
    yield "pipe", pipe
    yield "missing", lambda f: f.unlink()
    yield "everybody may write", lambda f: f.chmod(0o777)
    yield "no digest", digest(lambda f: f.unlink())
    yield "empty digest", digest(lambda f: f.write_text(""))
    yield "digest is no text", digest(lambda f: f.write_bytes(b"\xff\xfe\0"))
    yield "digest is a folder", digest(lambda f: (f.unlink(), f.mkdir()))


@pytest.mark.parametrize("change", [pytest.param(c, id=n) for n, c in damages()])
def test_damaged_libraries_are_compiled_again(place, key, change):
    assert kept(place, key, 1) == [1]
    change(place / f"{key}.so")
    assert not cache.holds(place, key, f"{key}.so")
    assert kept(place, key, 2) == [2]
    assert cache.holds(place, key, f"{key}.so")
    assert not [name for name in entries(place) if name.startswith(".polarmpm-work")]


def test_a_library_of_another_key_is_not_taken(place, key):
    other = jit.digest(key)
    assert answer(other, 2) == 2
    shutil.copy(place / f"{other}.so", place / f"{key}.so")
    shutil.copy(place / f"{other}.sha256", place / f"{key}.sha256")
    assert answer(key, 1) == 1


@pytest.mark.parametrize("mode", [0o777, 0o757])
def test_a_cache_that_everybody_may_write_to_is_refused(place, key, mode, capfd):
    assert answer(key, 1) == 1
    place.chmod(mode)
    assert answer(key, 3) == 3
    said = capfd.readouterr().err
    if MPI.COMM_WORLD.rank == 0:
        assert "everybody may write to it (chmod go-w)" in said
        assert "POLARMPM_CACHE" in said


@pytest.mark.skipif(not ROOT, reason="needs another user's folder")
def test_another_users_cache_is_refused(place, key):
    assert answer(key, 1) == 1
    os.chown(place, 65534, 65534)
    assert answer(key, 3) == 3


@pytest.mark.skipif(not ROOT, reason="needs another user's file")
def test_another_users_library_is_refused(place, key):
    assert kept(place, key, 1) == [1]
    for name in (f"{key}.so", f"{key}.sha256"):
        os.chown(place / name, 65534, 65534)
        assert not cache.holds(place, key, f"{key}.so")
        os.chown(place / name, 0, 0)
    assert cache.holds(place, key, f"{key}.so")


def test_groups(monkeypatch, tmp_path):
    """A private group may write, as with umask 002 on Debian; one that others are in may not."""
    tmp_path.chmod(0o775)
    monkeypatch.setattr(cache, "_private_group", lambda group: True)
    assert cache.distrust(tmp_path.stat()) == ""
    monkeypatch.setattr(cache, "_private_group", lambda group: False)
    assert "group" in cache.distrust(tmp_path.stat())
    tmp_path.chmod(0o755)
    assert cache.distrust(tmp_path.stat()) == ""


@pytest.mark.parametrize("mask", [0o000, 0o002, 0o077])
def test_the_mask_of_the_process_does_not_matter(place, key, mask):
    old = os.umask(mask)
    try:
        assert answer(key, 1) == 1
    finally:
        os.umask(old)
    assert cache.holds(place, key, f"{key}.so")


def broken_places(base):
    (base / "file").write_text("")
    (base / "link").symlink_to(base / "nowhere" / "at all")
    return [base / "file", base / "file" / "cache", base / "link", "/proc/nocache", base / ("x" * 300)]


def test_a_temporary_cache_stands_in_for_one_that_fails(place, tmp_path, key, monkeypatch, capfd):
    for number, broken in enumerate(broken_places(tmp_path)):
        monkeypatch.setenv("POLARMPM_CACHE", str(broken))
        assert answer(jit.digest(key, str(number)), number) == number
        assert answer(jit.digest(key, str(number)), -1) == number  # it is kept until the process ends
        said = capfd.readouterr().err
        if MPI.COMM_WORLD.rank == 0:
            assert len([line for line in said.splitlines() if "POLARMPM_CACHE" in line]) == 1
    (temporary,) = cache._private.values()
    assert temporary.stat().st_mode & 0o777 == 0o700
    cache._remove_private(os.getpid(), temporary)
    assert not temporary.exists()


def test_no_place_at_all(place, tmp_path, key, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("POLARMPM_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(cache, "_temporary", lambda: [str(tmp_path / "none")])
    with pytest.raises(KernelError, match="POLARMPM_CACHE"):
        answer(key, 1)


def test_a_full_disc_in_mid_compile(place, key, monkeypatch):
    """The compiler fails, and so does the probe of the disc: the temporary folder is taken."""
    build, made = jit._build, []

    def full(text, work):
        if work.is_relative_to(place):
            (work / "probe").mkdir()  # nothing can be written there
            raise KernelError("no space left")
        made.append(work)
        return build(text, work)

    monkeypatch.setattr(jit, "_build", full)
    assert answer(key, 1) == 1
    assert made
    assert entries(place) == []


def test_folders_are_absolute(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("POLARMPM_CACHE", "some/where")
    assert jit.cache_directory() == tmp_path / "some/where"
    (tmp_path / "below").mkdir()
    monkeypatch.chdir(tmp_path / "below")
    assert cache.directory() == tmp_path / "some/where"
    monkeypatch.setenv("POLARMPM_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.directory() == tmp_path / "polarmpm"


def test_no_home(place, key, monkeypatch):
    monkeypatch.delenv("POLARMPM_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(cache.Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert answer(key, 1) == 1


COMPILERS = {
    "missing": ("/nonexistent/cc", "no C compiler found .*install gcc, or set CC"),
    "fails": ("false", "status 1.*set CC"),
    "may not be run": ("/etc/passwd", "can't be run.*set CC"),
    "does nothing": ("true", "wrote no library.*set CC"),
    "no command": ('gcc "', "CC = .* is no command.*set CC"),
    "killed": ("sh -c 'kill -9 $$'", "ended by SIGKILL"),
    "writes rubbish": (  # into the last but one of its arguments
        """sh -c 'for a; do library=$next; next=$a; done; echo x > "$library"'""",
        "can't be kept or loaded",
    ),
}


@pytest.mark.parametrize("name", COMPILERS)
def test_compilers_that_fail(place, key, monkeypatch, name):
    command, message = COMPILERS[name]
    monkeypatch.setenv("CC", command)
    with pytest.raises(KernelError, match=message):
        answer(key, 1)
    assert not [e for e in entries(place) if e.startswith(".polarmpm-work")]
    monkeypatch.setenv("CC", " ")
    assert answer(key, 1) == 1


def test_compilers_that_fail_do_so_on_all_ranks(key, monkeypatch, folder):
    monkeypatch.setenv("POLARMPM_CACHE", str(folder))
    monkeypatch.setenv("CC", "/nonexistent/cc")
    with pytest.raises(KernelError, match="no C compiler"):
        jit.library(MPI.COMM_WORLD.bcast(key), lambda: source(1), MPI.COMM_WORLD)


def test_ranks_with_discs_of_their_own(key, monkeypatch, tmp_path):
    """Others can't see what the first rank has compiled; their failures are everybody's."""
    comm = MPI.COMM_WORLD
    key = comm.bcast(key)
    monkeypatch.setenv("POLARMPM_CACHE", str(tmp_path / f"of rank {comm.rank}"))
    monkeypatch.setattr(cache, "holds", lambda *_: False)
    if comm.rank == comm.size - 1:
        monkeypatch.setenv("CC", "/nonexistent/cc")
    with pytest.raises(KernelError, match="no C compiler"):
        jit.library(key, lambda: source(1), comm)


def test_what_killed_processes_leave_is_removed(place, key):
    assert answer(key, 1) == 1
    (place / f".polarmpm-work-{key}-abcdefgh").mkdir()
    (place / ".polarmpm-work-dolfinx-0123-abcdefgh").mkdir()
    (place / "tmpabcdefgh").mkdir()  # as earlier versions named them
    (place / "tmpabcdefgh" / "kernel.c").write_text("")
    kept = [".polarmpm-unlocked-new", "tmp_mine", "tmpinpput123", "work-of-mine-abcdefgh"]
    for name in kept:  # a script may have its own things there
        (place / name).mkdir()
        (place / name / "result").write_text("")
    for path in place.iterdir():
        if path.name != kept[0]:
            os.utime(path, (0, 0))
    assert answer(jit.digest(key), 1) == 1
    assert [e for e in entries(place) if not e.endswith((".so", ".sha256"))] == kept


HOLDER = """
import sys, time
from pathlib import Path
from polarmpm.tools import cache
def build(work):
    (work / "made").write_text("x")
    print("building", flush=True)
    time.sleep(float(sys.argv[3]))
    return work / "made", "x"
print(cache.obtain(sys.argv[2], "entry", lambda p: p.read_text(), build)[1], flush=True)
"""


def holder(key: str, seconds: float) -> subprocess.Popen:
    """A process that takes its time to make an entry."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_", "PRTE_"))}
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, "", key, str(seconds)],
        env=kept,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "building\n"
    return process


@pytest.mark.timeout(60)
def test_another_process_is_waited_for_while_it_lives(place):
    """Its work folder stays while it's at work; when it's killed, the next one goes on at once."""
    first = holder("some-key", 0.5)
    assert cache.obtain("other", "other", lambda p: p, lambda w: _text(w))[0] == place
    assert [e for e in entries(place) if e.startswith(".polarmpm-work-some-key-")]
    found = cache.obtain("some-key", "entry", lambda p: p.read_text(), lambda w: pytest.fail("made twice"))
    assert found == (place, "x")
    first.wait()
    second = holder("next-key", 1000.0)
    second.kill()
    second.wait()
    assert [e for e in entries(place) if e.startswith(".polarmpm-work-next-key-")]
    begin = time.monotonic()
    assert cache.obtain("next-key", "entry2", lambda p: p, lambda w: _text(w))[0] == place
    assert time.monotonic() - begin < 5.0
    assert not [e for e in entries(place) if e.startswith(".polarmpm-work")]


def _text(work):
    (work / "made").write_text("y")
    return work / "made", work


def test_what_loads_no_more_is_compiled_again(place, key):
    """A cache shared with a machine that has another C library."""
    cache.obtain(key, key, lambda p: p.read_text(), lambda w: _text(w))
    tries = []

    def load(path):
        tries.append(path)
        if len(tries) == 1:
            raise OSError("version GLIBC_9.99 not found")
        return path.read_text()

    def build(work):
        (work / "made").write_text("new")
        return work / "made", None

    assert cache.obtain(key, key, load, build) == (place, "new")


@pytest.mark.skipif(MPI.COMM_WORLD.rank > 0, reason="the first rank tells")
def test_one_line_tells_of_the_first_compilation(place, key, capfd, monkeypatch):
    for i in range(2):
        answer(jit.digest(key, str(i)), i)
    assert capfd.readouterr() == ("", f"polarmpm: {cache.COMPILING}\n")
    cache.say_once.cache_clear()
    answer(jit.digest(key, "0"), 0)  # nothing is compiled
    assert capfd.readouterr() == ("", "")
    logger = logging.getLogger("polarmpm")
    monkeypatch.setattr(logger, "level", logger.level)
    logger.setLevel(logging.WARNING)
    answer(jit.digest(key, "quiet"), 0)
    assert capfd.readouterr() == ("", "")
