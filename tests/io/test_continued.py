"""Tables and ParaView files of a run that goes on from a restart file; full discs; two writers."""

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.io import read_table
from polarmpm.io.files import Replacement, replace_file
from tests.conftest import COMM, MICROPOLAR
from tests.helpers.ranks import PATH, ROOT

FIELDS = ("displacement", "stress")


def strip(**options: Any) -> pm.QuasiStatic:
    grid = pm.Grid.box((0, -2), (5, 2), 0.5, COMM)
    points = pm.seed(grid, bounds=((0, 0), (3, 1)), material=MICROPOLAR)
    problem = pm.QuasiStatic(grid, points, **{"reset": 2, **options})
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0.0, -3.0))
    return problem


def columns(problem: pm.QuasiStatic) -> dict[str, Any]:
    wall = problem.supports[0]
    return {"wall": lambda: problem.reaction(wall), "e": problem.energies}


def run(problem: pm.QuasiStatic, folder: Path, steps: int, to: float = 1.0, **options: Any) -> None:
    """A script's run, with all of its files."""
    recorder = pm.Recorder(folder / "a.pvd", problem, fields=FIELDS, grid=True, **options)
    with recorder, pm.Table(folder / "a.csv", comm=COMM, **columns(problem)) as table:
        for step in problem.march(steps, to=to, progress=False):
            recorder.record(step)
            table.record(step)


def contents(folder: Path) -> dict[str, bytes]:
    COMM.barrier()
    files = (f for f in sorted(folder.rglob("*")) if f.is_file() and f.suffix != ".h5")
    return {str(f.relative_to(folder)): f.read_bytes() for f in files}


def times(file: Path) -> list[float]:
    COMM.barrier()
    return list(dict.fromkeys(float(one.get("timestep")) for one in ET.parse(file).iter("DataSet")))


@pytest.mark.parametrize("initial", [True, False])
def test_files_are_gone_on_with(initial, folder):
    """As if the run had never been interrupted, also by one that had gone further than its last file."""
    whole, first, second = strip(), strip(), strip()
    run(whole, folder / "whole", 6)
    run(first, folder / "parts", 3, 0.5)
    pm.save_restart(first, folder / "parts" / "a.h5")
    recorder = pm.Recorder(folder / "parts" / "a.pvd", first, fields=FIELDS, grid=True)
    run(first, folder / "parts", 1, 0.9)
    with pytest.raises(pm.InputError, match="a Recorder or Table that was made later"):
        recorder.record()
    if COMM.rank == 0:  # what a kill leaves
        for name in ("a.csv.part", "a.pvd.part", "a/a_0003_p0.vtu.part", "a/a_0009_p0.vtu"):
            (folder / "parts" / name).write_text("half")
    run(strip(), folder / "parts", 3, 0.5)  # another process has begun afresh in between
    pm.load_restart(second, folder / "parts" / "a.h5")
    run(second, folder / "parts", 3, initial=initial)
    expected, found = contents(folder / "whole"), contents(folder / "parts")
    if COMM.size == 1:
        assert found == expected
    else:
        assert list(found) == list(expected)
        assert times(folder / "parts" / "a.pvd") == times(folder / "whole" / "a.pvd")
        assert read_table(folder / "parts" / "a.csv")["step"].tolist() == [1, 2, 3, 4, 5, 6]


def test_later_rows_and_steps_are_written_again(folder):
    """A run is put back in the same process, with recorder and table that are open."""
    problem, whole = strip(), strip()
    run(whole, folder / "whole", 4)
    recorder = pm.Recorder(folder / "a.pvd", problem, fields=FIELDS, grid=True)
    with recorder, pm.Table(folder / "a.csv", comm=COMM, **columns(problem)) as table:
        for step in problem.march(4, progress=False):
            recorder.record(step)
            table.record(step)
            if step.number == 2:
                pm.save_restart(problem, folder / "a.h5")
        pm.load_restart(problem, folder / "a.h5")
        for step in problem.march(2, progress=False):
            recorder.record(step)
            table.record(step)
    if COMM.size == 1:
        expected = contents(folder / "whole")
        assert {n: c for n, c in contents(folder).items() if not n.startswith("whole")} == expected
    assert read_table(folder / "a.csv")["step"].tolist() == [1, 2, 3, 4]
    assert times(folder / "a.pvd") == [0.0, 0.25, 0.5, 0.75, 1.0]


def test_files_of_another_run_are_overwritten(folder):
    first = strip()
    run(first, folder, 3, 0.5)
    pm.save_restart(first, folder / "a.h5")
    run(strip(reset=None), folder, 5)  # in the same files
    again = strip()
    pm.load_restart(again, folder / "a.h5")
    run(again, folder, 2, initial=False)
    assert read_table(folder / "a.csv")["step"].tolist() == [4, 5]
    assert times(folder / "a.pvd") == [0.75, 1.0]
    run(again, folder, 1, 1.5)  # a second table of this run doesn't go on with its first
    assert read_table(folder / "a.csv")["step"].tolist() == [6]
    assert times(folder / "a.pvd") == [1.0, 1.5]


def test_other_columns_are_refused(folder):
    first, again = strip(), strip()
    run(first, folder, 2, 0.5)
    pm.save_restart(first, folder / "a.h5")
    pm.load_restart(again, folder / "a.h5")
    before = contents(folder)
    with (
        pm.Table(folder / "a.csv", comm=COMM, one=lambda: 1.0) as table,
        pytest.raises(pm.InputError, match=r"a\.csv has step, factor, .* from before the restart.*one"),
    ):
        table.record(next(again.march(1, progress=False)))
    assert contents(folder) == before


def test_every_other_step(folder):
    """A table needn't have all steps."""
    for stops in ([5], [3, 5]):
        problem = strip()
        for k, stop in enumerate(stops):
            if k:
                problem = strip()
                pm.load_restart(problem, folder / "a.h5")
            with pm.Table(folder / f"{len(stops)}.csv", comm=COMM) as table:
                left = stop - problem.progress.step
                for step in problem.march(left, to=stop / 5, progress=False):
                    if step.number % 2:
                        table.record(step)
            pm.save_restart(problem, folder / "a.h5")
    assert [read_table(folder / f"{n}.csv")["step"].tolist() for n in (1, 2)] == [[1, 3, 5], [1, 3, 5]]


def test_a_step_that_was_not_recorded(folder):
    """It was saved first, and the run killed before its row was written."""
    first, again = strip(), strip()
    with pm.Table(folder / "a.csv", comm=COMM) as table:
        for step in first.march(3, to=0.5, progress=False):
            if step.number < 3:
                table.record(step)
    pm.save_restart(first, folder / "a.h5")
    pm.load_restart(again, folder / "a.h5")
    with pm.Table(folder / "a.csv", comm=COMM) as table:
        step = next(again.march(1, progress=False))
        if COMM.rank == 0:
            with pytest.warns(UserWarning, match="no row of step 3, which was saved before it was recorded"):
                table.record(step)
        else:
            table.record(step)
    assert read_table(folder / "a.csv")["step"].tolist() == [1, 2, 4]


def test_paths_stay_where_they_were(folder, monkeypatch):
    problem, other = strip(), COMM.bcast(folder / "other")
    if COMM.rank == 0:
        other.mkdir()
    COMM.barrier()
    monkeypatch.chdir(folder)
    recorder = pm.Recorder("a.pvd", problem)
    with pm.Table("a.csv", comm=COMM) as table:
        monkeypatch.chdir(other)
        for step in problem.march(2, progress=False):
            recorder.record(step)
            table.record(step)
    assert times(folder / "a.pvd") == [0.5, 1.0]
    assert len(read_table(folder / "a.csv")["step"]) == 2
    assert not list(other.iterdir())


# bad calls ----------------------------------------------------------------------------------------
def test_arguments_are_checked(folder):
    problem = strip()
    for path in (None, 5, "", "a\0.pvd", b"a.pvd"):
        with pytest.raises(pm.InputError, match=r"path = .*: the name of a"):
            pm.Recorder(path, problem)
        with pytest.raises(pm.InputError, match=r"path = .*: the name of a"):
            pm.Table(path)
    with pytest.raises(pm.InputError, match="problem = None"):
        pm.Recorder(folder / "a.pvd", None)
    for fields in (5, None, [3]):
        with pytest.raises(pm.InputError, match="neither a name nor a Field"):
            pm.Recorder(folder / "a.pvd", problem, fields=fields)
    recorder = pm.Recorder(folder / "a.pvd", problem)
    for time in (float("nan"), "x", float("inf")):
        with pytest.raises(pm.InputError, match=r"time = .*: a finite number"):
            recorder.record(time=time)
    with pytest.raises(pm.InputError, match="step = 'last': a step of march"):
        recorder.record("last")
    with pytest.raises(pm.InputError, match="comm = None"):
        pm.Table(folder / "a.csv", comm=None)
    for name in ("a<b", ""):
        with pytest.raises(pm.InputError, match=r"name"):
            pm.Recorder(folder / "a.pvd", problem, fields=pm.Field(name, lambda p: p.volume))
    for value in (lambda p: None, lambda p: np.array(["x"] * len(p)), lambda p: np.zeros((len(p), 0))):
        with pytest.raises(pm.InputError, match="field 'mine': "):
            pm.Recorder(folder / "a.pvd", problem, fields=pm.Field("mine", value)).record()
    assert not (folder / "a.pvd").exists()


@pytest.mark.parametrize("value", [None, np.ones(0), 1j, {}, "3", [1.0, None]])
def test_columns_without_numbers(value, folder):
    step = pm.Step(number=1, factor=1.0, history=((1.0, 1.0),), cuts=0)
    with pm.Table(folder / "a.csv", comm=COMM, a=lambda: value) as table:
        with pytest.raises(pm.InputError, match=r"column 'a': .* is neither a number nor a vector"):
            table.record(step)
        with pytest.raises(pm.InputError, match="step = None: a step of march"):
            table.record(None)
        with pytest.raises(pm.InputError, match="entered already"):
            table.__enter__()
    assert not (folder / "a.csv").exists()


def test_two_columns_of_one_name(folder):
    step = pm.Step(number=1, factor=1.0, history=((1.0, 1.0),), cuts=0)
    columns = {"tip": lambda: (1.0, 2.0), "tip_x": lambda: 3.0}
    with (
        pm.Table(folder / "a.csv", comm=COMM, **columns) as table,
        pytest.raises(pm.InputError, match="column 'tip_x': there are two of this name"),
    ):
        table.record(step)
    with pm.Table(folder / "b.csv", comm=COMM, a=lambda: float("nan")) as table:
        table.record(step)  # a number like others
    assert np.isnan(read_table(folder / "b.csv")["a"][0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "can't be read: No such file"),
        ("", "is empty"),
        ("a,b\n1,2\n3\n", "row 2 has 1 of 2 columns"),
        ("a,b\n1,x\n", "something else than numbers"),
    ],
)
def test_what_is_no_table(text, message, folder):
    if text is not None and COMM.rank == 0:
        (folder / "a.csv").write_text(text)
    COMM.barrier()
    with pytest.raises(pm.InputError, match=rf"table .*a\.csv.*{message}"):
        read_table(folder / "a.csv")


# discs --------------------------------------------------------------------------------------------
LIMITED = """
import resource, signal, sys
from pathlib import Path
import polarmpm as pm
from tests.io.test_continued import contents, run, strip, columns, FIELDS
folder, problem = Path(sys.argv[1]), strip()
file, found = folder / "a.h5", []
recorder = pm.Recorder(folder / "a.pvd", problem, fields=FIELDS)
with recorder, pm.Table(folder / "a.csv", **columns(problem)) as table:
    step = next(problem.march(4, progress=False))
    recorder.record(step), table.record(step), pm.save_restart(problem, file)
    step = next(problem.march(3, progress=False))
    before, saved = contents(folder), file.read_bytes()
    row = len(before["a.csv"]) + 10
    for size in (0, row, 5000, len(saved) // 2):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
        actions = [lambda: pm.save_restart(problem, file)]
        actions += [lambda: recorder.record(step), lambda: table.record(step)] if size <= row else []
        for action in actions:
            try:
                action()
            except pm.OutputError as e:
                found.append(str(e))
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        assert contents(folder) == before and file.read_bytes() == saved, "something has changed"
        assert sorted(f.name for f in folder.iterdir()) == ["a", "a.csv", "a.h5", "a.pvd"]
    assert len(found) == 8 and all("can't be written: File too large" in text for text in found), found
    recorder.record(step), table.record(step), pm.save_restart(problem, file)
again = strip()
pm.load_restart(again, file)
assert again.progress.step == 2 and len(contents(folder)) == 5
print("good")
"""


@pytest.mark.skipif(COMM.size > 1, reason="starts a process of its own")
@pytest.mark.timeout(120)
def test_files_that_may_not_grow(tmp_path):
    """As on a full disc: an error that says so, nothing lost, nothing left behind; with room all is well."""
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(tmp_path)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": PATH},
        timeout=100,
        check=False,
    )
    assert done.stdout == "good\n", done.stderr[-3000:]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.skipif(not os.access("/dev", os.W_OK), reason="devices can't be written")
def test_a_device_that_is_full():
    step = pm.Step(number=1, factor=1.0, history=((1.0, 1.0),), cuts=0)
    with (
        pm.Table("/dev/full", comm=COMM) as table,
        pytest.raises(pm.OutputError, match="table /dev/full can't be written: No space left"),
    ):
        table.record(step)


def test_a_folder_that_goes(folder):
    problem, inner = strip(), folder / "inner"
    recorder = pm.Recorder(inner / "a.pvd", problem)
    with pm.Table(inner / "a.csv", comm=COMM) as table:
        step = next(problem.march(2, progress=False))
        recorder.record(step), table.record(step)
        COMM.barrier()
        if COMM.rank == 0:
            inner.rename(folder / "elsewhere")
        COMM.barrier()
        step = next(problem.march(1, progress=False))
        for action in (lambda: recorder.record(step), lambda: table.record(step)):
            with pytest.raises(pm.OutputError, match=r"inner/a.* can't be written: No such file"):
                action()
        COMM.barrier()
        if COMM.rank == 0:
            (folder / "elsewhere").rename(inner)
        COMM.barrier()
        recorder.record(step), table.record(step)
    assert times(inner / "a.pvd") == [0.5, 1.0]
    assert read_table(inner / "a.csv")["step"].tolist() == [1, 2]


# kills --------------------------------------------------------------------------------------------
KILLS = """
import sys
sys.path.insert(0, sys.argv[1])
import operation_kills
for case in operation_kills.cases(quick=True, seed=int(sys.argv[2])):
    assert case.verdict == "right", case
print("good")
"""


@pytest.mark.skipif(COMM.size > 1, reason="starts a process of its own")
@pytest.mark.timeout(200)
def test_killed_runs_end_like_others():
    """Digits and files; the first scenes of the operational tests."""
    done = subprocess.run(
        [sys.executable, "-c", KILLS, str(Path(ROOT, "benchmarks")), "5"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": PATH},
        timeout=180,
        check=False,
    )
    assert done.stdout == "good\n", done.stderr[-3000:]


@pytest.mark.skipif(COMM.size > 1, reason="writes on one rank")
def test_two_processes_that_write_one_file(tmp_path):
    with Replacement(tmp_path / "a.txt") as first:
        first.write(b"first")
        with pytest.raises(OSError, match="another process is writing it"), Replacement(tmp_path / "a.txt"):
            pass
        first.finish()
    assert [f.name for f in tmp_path.iterdir()] == ["a.txt"]
    replace_file(tmp_path / "a.txt", b"sec", b"ond")
    (tmp_path / "link.txt").symlink_to("a.txt")
    (tmp_path / "a.txt.part").write_bytes(b"left by a killed run, and longer")
    replace_file(tmp_path / "link.txt", b"third")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "a.txt").read_bytes() == b"third"
    assert sorted(f.name for f in tmp_path.iterdir()) == ["a.txt", "link.txt"]
