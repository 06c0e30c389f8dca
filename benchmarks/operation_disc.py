"""Discs that are full, read-only or gone while a run writes restart files, ParaView files and tables.

Discs of a limited size are mounted where that is allowed; elsewhere a limit on the size of files stands in.
"""

import contextlib
import os
import resource
import shutil
import signal
import subprocess
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from operation_cases import Case, forked
from operation_files import state, strip

import polarmpm as pm

SIZE = 16 << 20  # bytes of the disc
REASONS = ("No space left", "File too large", "No such file", "Read-only", "removed", "gone", "changed")


@contextlib.contextmanager
def disc(folder):
    """A disc of its own at a folder; yields whether there is one."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(folder)]
    mounted = (
        shutil.which("mount") is not None and subprocess.run(command, capture_output=True).returncode == 0
    )
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], capture_output=True)


def fill(folder, room):
    """Leave so many bytes on the disc."""
    ballast = folder / "ballast"
    free = os.statvfs(folder).f_bavail * os.statvfs(folder).f_frsize
    with ballast.open("wb") as file:
        if free > room:
            os.posix_fallocate(file.fileno(), 0, free - room)


def limit(size):
    """No file may grow beyond so many bytes."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def left_over(folder):
    """Files that are no result."""
    return [f.name for f in folder.rglob("*") if f.name.startswith(".") or f.name.endswith(".part")]


def judge(folder, problem, action, name, again, intact=lambda: "", fits=None):
    """Do what can't succeed; then the run has to go on, and the next try with room to succeed.

    `fits`: what is wrong with the file if there was room all the same.
    """
    before = state(problem)
    try:
        action()
    except pm.PolarMPMError as e:
        text = str(e)
        if not (name in text and any(r in text for r in REASONS)):
            return "unclear", text
    else:
        wrong = "no error" if fits is None else fits()
        return ("silent", wrong) if wrong else ("right", "there was room")
    if not np.array_equal(state(problem), before):
        return "silent", "the state has changed"
    if left_over(folder):
        return "silent", f"left behind: {left_over(folder)}"
    wrong = intact()
    if wrong:
        return "silent", wrong
    step = next(problem.march(2, progress=False))
    wrong = again(step)
    return ("silent", wrong) if wrong else ("clear", text)


def make_room(folder):
    limit(resource.RLIM_INFINITY)
    (folder / "ballast").unlink(missing_ok=True)


def saving(folder, problem, fill_up, old):
    """A restart file; `old`: over one that is there."""
    file = folder / "r.h5"
    if old:
        pm.save_restart(problem, file)
        content = file.read_bytes()
        next(problem.march(2, progress=False))

    def intact():
        there = file.read_bytes() if file.exists() else b""
        return "" if there == (content if old else b"") else "the old file isn't what it was"

    def fits():
        other = strip(0.25, 4)
        pm.load_restart(other, file)
        return "" if np.array_equal(state(other), state(problem)) else "another state was saved"

    def again(step):
        make_room(folder)
        pm.save_restart(problem, file)
        return fits()

    fill_up()
    return judge(folder, problem, lambda: pm.save_restart(problem, file), "r.h5", again, intact, fits)


def listed(folder):
    """Files that a collection lists; raises when it or one of them can't be read."""
    import meshio

    sets = list(ET.parse(folder / "a.pvd").getroot().iter("DataSet"))
    for one in sets:
        meshio.read(folder / one.get("file"))
    return len(sets)


def recording(folder, problem, fill_up):
    """ParaView's files, after one step of which has been written."""
    recorder = pm.Recorder(folder / "a.pvd", problem, fields=("displacement", "stress", "F"))
    recorder.record()
    content = (folder / "a.pvd").read_bytes()
    step = next(problem.march(2, progress=False))

    def intact():
        listed(folder)
        return "" if (folder / "a.pvd").read_bytes() == content else "the collection isn't what it was"

    def again(step):
        make_room(folder)
        recorder.record(step)
        return "" if listed(folder) == 2 else "steps are missing"

    fill_up()
    return judge(folder, problem, lambda: recorder.record(step), "a", again, intact)


def tabling(folder, problem, fill_up):
    """A table with long rows."""
    columns = {f"column{k}": (lambda: 1 / 3) for k in range(400)}
    with pm.Table(folder / "t.csv", **columns) as table:
        table.record(next(problem.march(2, progress=False)))
        content = (folder / "t.csv").read_bytes()
        step = next(problem.march(2, progress=False))

        def intact():
            same = (folder / "t.csv").read_bytes() == content
            return "" if same else "the rows of before aren't what they were"

        def again(later):
            make_room(folder)
            table.record(later)
            rows = (folder / "t.csv").read_text().splitlines()
            whole = len({row.count(",") for row in rows}) == 1
            return "" if whole and len(rows) == 3 else "rows are missing or cut"

        fill_up()

        def write():
            for _ in range(3):  # a page has room for one more row
                table.record(step)

        return judge(folder, problem, write, "t.csv", again, intact)


def vanishing(folder, problem, fill_up, what):
    """The folder goes while the run writes."""
    inner = folder / "inner"
    inner.mkdir()
    recorder = pm.Recorder(inner / "a.pvd", problem)
    with pm.Table(inner / "t.csv", one=lambda: 1.0) as table:
        step = next(problem.march(2, progress=False))
        recorder.record(step), table.record(step)
        pm.save_restart(problem, inner / "r.h5")
        step = next(problem.march(2, progress=False))
        shutil.rmtree(inner)
        actions = {
            "restart": lambda: pm.save_restart(problem, inner / "r.h5"),
            "ParaView": lambda: recorder.record(step),
            "table": lambda: table.record(step),
        }

        def again(later):
            pm.save_restart(problem, folder / "elsewhere.h5")
            return ""

        return judge(folder, problem, actions[what], "inner", again)


KINDS = {
    "restart": lambda *a: saving(*a, old=False),
    "restart over an old one": lambda *a: saving(*a, old=True),
    "ParaView": recording,
    "table": tabling,
}


def scenes(quick, size):
    """Name, function of (folder, problem, fill_up), bytes of room, and how the room is limited."""
    most = size // 1024
    rooms = {
        "restart": [0, 4, 20, 64, *range(100, 800, 100), most - 20, most - 4],
        "restart over an old one": [0, 64, 300, most - 20],
        "ParaView": [0, 4, 8, 12],
        "table": [0],
    }
    for what, function in KINDS.items():
        for room in rooms[what][1:2] if quick and what != "table" else rooms[what]:
            yield f"{what}, {room} kB left", function, room << 10, "disc"
        if not quick or what == "table":
            largest = {"ParaView": 4096, "table": 9000}.get(what, 50000)
            yield f"{what}, files limited", function, largest, "file"
    for what in ("restart",) if quick else ("restart", "ParaView", "table"):
        yield f"{what}, folder removed", lambda *a, what=what: vanishing(*a, what), 0, "none"


def one(problem, function, room, how):
    """A case in a process of its own, on a disc of its own."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with disc(folder) if how == "disc" else contextlib.nullcontext(True) as mounted:
            if not mounted:
                return "right", "no disc can be mounted here"
            fill_up = {"disc": lambda: fill(folder, room), "file": lambda: limit(room)}.get(how)
            return forked(lambda: function(folder, problem, fill_up))


def cases(quick, seed):
    """A run that is about to write its files; all of them with every seed."""
    problem = strip(0.25, 4)
    next(problem.march(4, progress=False))
    with tempfile.TemporaryDirectory() as folder:
        pm.save_restart(problem, Path(folder, "r.h5"))
        size = Path(folder, "r.h5").stat().st_size
    for name, function, room, how in scenes(quick, size):
        yield Case("disc", name, *one(problem, function, room, how))
