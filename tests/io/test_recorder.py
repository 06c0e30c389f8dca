"""ParaView files and tables: what is read back is what the problem has."""

import csv
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.io import Recorder, Table, read_table
from polarmpm.io.files import replace_file
from polarmpm.kinematics import rotations
from tests.helpers.ranks import PATH

meshio = pytest.importorskip("meshio")

COMM = MPI.COMM_WORLD
MICROPOLAR = pm.MicropolarElastic(lam=1e6, mu=1e6, kappa=2e5, alpha=0.0, gamma=1e4, beta=0.0)  # Pa, N


def cantilever():
    """Half a metre high and two metres long, clamped on the left, loaded at its end."""
    grid = pm.Grid.box((0, -1), (3, 1), 0.25)
    points = pm.seed(grid, bounds=((0, 0), (2, 0.5)), material=MICROPOLAR, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, **pm.PUBLISHED)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0)), force=(0, -2000.0))
    return problem


def solid():
    """A block in three dimensions with a made-up state; nothing is solved."""
    grid = pm.Grid.box((0, 0, 0), (2, 1, 1), 0.5)
    points = pm.seed(grid, bounds=((0, 0, 0), (1, 1, 0.5)), material=MICROPOLAR)
    n = points.id[:, None, None]
    points.F = np.eye(3) + 0.002 * n * np.array([[0.3, 0.1, 0.0], [0.0, -0.2, 0.05], [0.2, 0.0, 0.1]])
    points.wryness = 0.01 * n + np.arange(9.0).reshape(3, 3)
    points.q = rotations.from_vector(np.array([0.1, -0.2, 0.3]) * points.id[:, None] / 50)
    points.x = points.X + np.array([0.4, 0.0, 0.1])
    return pm.QuasiStatic(grid, points, **pm.PUBLISHED)


def gathered(points, values):
    """Values of all ranks in the order of the ids."""
    ids = np.concatenate(COMM.allgather(points.id))
    return np.concatenate(COMM.allgather(np.asarray(values)))[np.argsort(ids)]


def read_collection(path):
    """(time, parts, pieces) of every step of a .pvd file."""
    steps = {}
    for entry in ET.parse(path).getroot().iter("DataSet"):
        parts, meshes = steps.setdefault(float(entry.get("timestep")), ([], []))
        parts.append(int(entry.get("part")))
        meshes.append(meshio.read(Path(path).parent / entry.get("file")))
    return [(time, parts, meshes) for time, (parts, meshes) in steps.items()]


def cell_values(meshes, name):
    """Cell data of all pieces in the order of the ids."""
    ids = np.concatenate([m.cell_data["id"][0] for m in meshes])
    return np.concatenate([m.cell_data[name][0] for m in meshes])[np.argsort(ids)]


def cell_corners(meshes):
    """Vertices of each cell (cells, corners, 3) in the order of the ids."""
    ids = np.concatenate([m.cell_data["id"][0] for m in meshes])
    return np.concatenate([m.points[m.cells[0].data] for m in meshes])[np.argsort(ids)]


# ParaView -------------------------------------------------------------------------------------------
def test_domains_and_fields_are_read_back(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)  # .vtu files don't need it
    problem = cantilever()
    points = problem.points
    fields = ("displacement", "rotation", "stress", "couple_stress", "energy", "volume", "id", "material")
    with Recorder(folder / "new" / "beam.pvd", problem, fields=fields) as recorder:
        for step in problem.march(2):
            recorder.record(step)
    steps = read_collection(folder / "new" / "beam.pvd")
    assert [time for time, _, _ in steps] == [0.0, 0.5, 1.0]
    assert sorted(p.name for p in (folder / "new").iterdir()) == ["beam", "beam.pvd"]

    first, last = steps[0][2], steps[-1][2]
    assert np.all(cell_values(first, "displacement") == 0)
    assert last[0].cells[0].type == "quad"
    assert set(last[0].cell_data) == set(fields)
    np.testing.assert_array_equal(cell_values(last, "id"), np.arange(points.total))
    displacement = cell_values(last, "displacement")
    np.testing.assert_array_equal(displacement[:, :2], gathered(points, points.displacement))
    assert np.abs(displacement[:, 1]).max() > 0.01
    assert np.all(displacement[:, 2] == 0)
    now = problem.fields()
    for name in ("stress", "couple_stress"):
        expected = gathered(points, getattr(now, name)).reshape(-1, 9)
        assert np.abs(expected).max() > 1.0
        np.testing.assert_array_equal(cell_values(last, name), expected)
    np.testing.assert_array_equal(cell_values(last, "energy"), gathered(points, now.energy))
    np.testing.assert_array_equal(cell_values(last, "rotation"), gathered(points, points.rotation_vector))
    np.testing.assert_array_equal(cell_values(last, "volume"), gathered(points, points.volume))

    corners, half = cell_corners(last), gathered(points, points.half_length)
    np.testing.assert_allclose(corners[..., :2].mean(axis=1), gathered(points, points.x), rtol=1e-13)
    assert np.all(corners[..., 2] == 0)
    # the shoelace formula: right only if the corners go round
    a, b = corners[..., :2], np.roll(corners[..., :2], -1, axis=1)
    area = 0.5 * np.sum(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], axis=1)
    np.testing.assert_allclose(area, np.prod(2 * half, axis=1), rtol=1e-11)


def test_hexahedra_have_the_domains_volume(folder):
    problem = solid()
    points = problem.points
    fields = ("F", "stretch", "wryness", "rotation", "id")
    with Recorder(folder / "block.pvd", problem, fields=fields):
        pass
    ((_, _, meshes),) = read_collection(folder / "block.pvd")
    assert meshes[0].cells[0].type == "hexahedron"
    corners = cell_corners(meshes)
    edges = [corners[:, k] - corners[:, 0] for k in (1, 3, 4)]  # VTK's order of corners
    volume = np.einsum("ij,ij->i", edges[0], np.cross(edges[1], edges[2]))
    half = gathered(points, points.half_length)
    assert np.ptp(half[:, 0]) > 1e-3  # the domains differ
    np.testing.assert_allclose(volume, np.prod(2 * half, axis=1), rtol=1e-11)
    np.testing.assert_allclose(corners[:, 6] - corners[:, 0], 2 * half, rtol=1e-11)
    for name in ("F", "stretch", "wryness"):
        expected = gathered(points, getattr(points, name)).reshape(-1, 9)
        np.testing.assert_array_equal(cell_values(meshes, name), expected)
    np.testing.assert_array_equal(cell_values(meshes, "rotation"), gathered(points, points.rotation_vector))


def test_points_as_vertices(folder):
    problem = solid()
    with Recorder(folder / "block.pvd", problem, fields=("displacement", "id"), domains=False):
        pass
    ((_, _, meshes),) = read_collection(folder / "block.pvd")
    assert all(m.cells[0].type == "vertex" for m in meshes)
    order = np.argsort(np.concatenate([m.point_data["id"] for m in meshes]))
    x = np.concatenate([m.points for m in meshes])[order]
    np.testing.assert_array_equal(x, gathered(problem.points, problem.points.x))
    u = np.concatenate([m.point_data["displacement"] for m in meshes])[order]
    np.testing.assert_allclose(u, np.tile([0.4, 0.0, 0.1], (len(u), 1)), rtol=1e-13)


def test_nothing_is_computed_unasked(folder, monkeypatch):
    problem = solid()
    monkeypatch.setattr(problem, "fields", lambda: pytest.fail("stresses were computed"))
    with Recorder(folder / "block.pvd", problem, fields="volume"):
        pass
    ((_, _, meshes),) = read_collection(folder / "block.pvd")
    assert set(meshes[0].cell_data) == {"volume"}


@pytest.mark.parametrize("reset", [1, None])
def test_grid_shows_the_increments_since_the_last_reset(folder, reset):
    grid = pm.Grid.box((0, 0), (2, 1), 0.25)
    # the points' domains reach their cells' faces, so that the body's cells are known
    points = pm.seed(grid, bounds=((0.5, 0.25), (1.5, 0.75)), material=MICROPOLAR)
    problem = pm.QuasiStatic(grid, points, reset=reset, basis="gimpm", balanced_reset=False)
    problem.fix(lambda x: np.full(len(x), True), ux=0.02, uy=-0.01, theta=0.3)
    with Recorder(folder / "move.pvd", problem, fields=("id",), grid=True) as recorder:
        for step in problem.march(2):
            recorder.record(step)
    steps = read_collection(folder / "move_grid.pvd")
    assert [time for time, _, _ in steps] == [0.0, 0.5, 1.0]
    share = [0.0, 0.5, 0.5] if reset else [0.0, 0.5, 1.0]
    for (_, _, meshes), part in zip(steps, share, strict=True):
        cells = np.concatenate([m.points[m.cells[0].data] for m in meshes])
        np.testing.assert_allclose(np.ptp(cells, axis=1), np.tile([0.25, 0.25, 0.0], (len(cells), 1)))
        centres = cells.mean(axis=1)[:, :2]
        assert len(np.unique(centres.round(6), axis=0)) == len(cells)
        u = np.concatenate([m.point_data["displacement_increment"] for m in meshes])
        np.testing.assert_allclose(u, np.tile(part * np.array([0.02, -0.01, 0.0]), (len(u), 1)), atol=1e-12)
        rotation = np.concatenate([m.point_data["rotation_increment"] for m in meshes])
        np.testing.assert_allclose(rotation, np.tile([0.0, 0.0, 0.3 * part], (len(u), 1)), atol=1e-12)
    first = np.concatenate([m.points[m.cells[0].data] for m in steps[0][2]]).mean(axis=1)
    assert len(first) == 4 * 2
    np.testing.assert_allclose([first.min(axis=0), first.max(axis=0)], [[0.625, 0.375, 0], [1.375, 0.625, 0]])


def test_collection_is_whole_after_every_record(folder):
    problem = solid()
    path = folder / "block.pvd"
    recorder = Recorder(path, problem, fields=("id",), initial=False)
    assert not path.exists()
    recorder.record()
    assert [time for time, _, _ in read_collection(path)] == [0.0]
    COMM.barrier()
    problem.progress.step, problem.progress.factor = 1, 0.25
    recorder.record()
    assert [time for time, _, _ in read_collection(path)] == [0.0, 0.25]
    COMM.barrier()
    recorder.record(time=7.0)  # the same step again: replaced
    assert [time for time, _, _ in read_collection(path)] == [0.0, 7.0]


def test_a_file_is_replaced_as_a_whole(folder):
    if COMM.rank == 0:
        path = folder / "a.txt"
        replace_file(path, b"old")
        replace_file(path, b"new")
        assert path.read_bytes() == b"new"
        assert [p.name for p in folder.iterdir()] == ["a.txt"]
        (folder / "taken").mkdir()
        with pytest.raises(OSError, match="taken"):
            replace_file(folder / "taken", b"new")
        assert sorted(p.name for p in folder.iterdir()) == ["a.txt", "taken"]


def test_record_refuses_a_step_that_is_gone(folder):
    problem = solid()
    old = pm.Step(number=3, factor=0.3, history=((1.0, 1.0),), cuts=0)
    with (
        Recorder(folder / "block.pvd", problem) as recorder,
        pytest.raises(pm.InputError, match=r"step 3 .* at step 0"),
    ):
        recorder.record(old)


def test_unknown_field(folder):
    problem = solid()
    with pytest.raises(pm.InputError, match=r"'strain' is unknown; allowed are displacement, .*energy"):
        Recorder(folder / "out" / "block.pvd", problem, fields=("stress", "strain"))
    assert not (folder / "out").exists()


def test_output_that_cannot_be_written(folder):
    problem = solid()
    if COMM.rank == 0:
        (folder / "file").write_text("in the way")
        (folder / "taken.pvd").mkdir()
    COMM.barrier()
    # a folder below a file: refused to root too
    with pytest.raises(pm.InputError, match=r"file/block\.pvd' can't be written: "):
        Recorder(folder / "file" / "block.pvd", problem)
    with pytest.raises(pm.InputError, match=r"file/deep/run\.csv' can't be written: "):
        Table(folder / "file" / "deep" / "run.csv")
    with pytest.raises(pm.InputError, match=r"taken\.pvd' can't be written: Is a directory"):
        Recorder(folder / "taken.pvd", problem)
    with pytest.raises(pm.InputError, match=r"block\.vtk': the name of a \.pvd file is needed"):
        Recorder(folder / "block.vtk", problem)


def run(path):
    """A whole run with its files."""
    problem = cantilever()
    with Recorder(path, problem, fields=("displacement", "stress", "id"), grid=True) as recorder:
        for step in problem.march(2):
            recorder.record(step)


@pytest.mark.mpi
def test_two_ranks_write_what_one_writes(tmp_path):
    paths = [tmp_path / f"on{n}.pvd" for n in (1, 2)]
    run(paths[0])
    code = "import sys; from tests.io.test_recorder import run; run(sys.argv[1])"
    command = ["mpirun", "-n", "2", sys.executable, "-c", code, str(paths[1])]
    # os.environ is as Python found it, without what this process' own MPI has put there since
    done = subprocess.run(
        command, timeout=120, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": PATH}
    )
    assert done.returncode == 0, done.stderr[-2000:]
    one, two = (read_collection(path) for path in paths)
    for (time1, parts1, serial), (time2, parts2, parallel) in zip(one, two, strict=True):
        assert (time1, parts1, time2, parts2) == (time2, [0], time1, [0, 1])
        ids = cell_values(parallel, "id")
        np.testing.assert_array_equal(ids, np.arange(len(ids)))
        np.testing.assert_array_equal(ids, cell_values(serial, "id"))
        np.testing.assert_allclose(cell_corners(parallel), cell_corners(serial), rtol=1e-9, atol=1e-9)
        for name in ("displacement", "stress"):
            expected = cell_values(serial, name)
            scale = np.abs(expected).max()
            np.testing.assert_allclose(cell_values(parallel, name), expected, rtol=0, atol=1e-8 * scale)
    for (_, _, serial), (_, _, parallel) in zip(*(read_collection(_grid(p)) for p in paths), strict=True):
        tables = [_nodal_table(meshes) for meshes in (serial, parallel)]
        assert tables[0].keys() == tables[1].keys()
        a, b = (np.array([t[key] for key in tables[0]]) for t in tables)
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-8 * max(np.abs(a).max(), 1e-3))
        assert sum(len(m.cells[0].data) for m in parallel) == len(serial[0].cells[0].data)


def _grid(path):
    return path.with_name(path.stem + "_grid.pvd")


def _nodal_table(meshes):
    return {
        tuple(x.round(6)): u
        for m in meshes
        for x, u in zip(m.points, m.point_data["displacement_increment"], strict=True)
    }


# tables -------------------------------------------------------------------------------------------
def steps(number):
    for k in range(1, number + 1):
        history = ((1.0, 2.0), (1e-3, 1e-4), (1e-9 / k, 1e-17))
        yield pm.Step(number=k, factor=k / number, history=history, cuts=0)


def test_table_has_a_row_for_each_step(folder):
    state = {"k": 0}
    path = folder / "new" / "run.csv"
    columns = {
        "tip": lambda: np.array([0.1, 0.2, 1 / 3]) * state["k"],
        "tilt": lambda: np.array([0.5, 0.25]),
        "couple": lambda: np.array([4.0]),
        "modes": lambda: [1, 2, 3, 4],
        "work": lambda: state["k"],
        "s": lambda: np.array([[1.0, 2.0], [3.0, 4.0]]),
    }
    with Table(path, **columns) as table:
        for state["k"], step in enumerate(steps(3), start=1):
            table.record(step)
            assert len(read_table(path)["step"]) == state["k"]  # on disk at once
            COMM.barrier()
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    user = "tip_x tip_y tip_z tilt_x tilt_y couple modes_0 modes_1 modes_2 modes_3 work s_xx s_xy s_yx s_yy"
    assert header == ["step", "factor", "iterations", "newton_force", "newton_energy", *user.split()]
    assert rows[2][:3] == ["3", "1.0", "2"]
    table = read_table(path)
    np.testing.assert_array_equal(table["factor"], [1 / 3, 2 / 3, 1.0])
    np.testing.assert_array_equal(table["newton_force"], 1e-9 / np.arange(1, 4))
    np.testing.assert_array_equal(table["tip_z"], np.arange(1, 4) * (1 / 3))
    np.testing.assert_array_equal(table["modes_3"], [4, 4, 4])


def test_table_of_a_run(folder):
    problem = cantilever()
    points = problem.points
    tip = points.farthest((1, 0))
    with Table(folder / "run.csv", tip=lambda: points.mean_displacement(tip), work=problem.energy) as table:
        for step in problem.march(2):
            table(step)
    columns = read_table(folder / "run.csv")
    u = points.mean_displacement(tip)
    assert u[1] < -0.01
    assert (columns["tip_x"][-1], columns["tip_y"][-1]) == tuple(u)
    assert columns["iterations"].tolist() == [step.iterations for step in problem.steps]
    assert columns["work"][-1] == problem.energy()


def test_table_refuses(folder):
    path = folder / "run.csv"
    (step,) = steps(1)
    with pytest.raises(pm.InputError, match="column 'newton_force' is taken"):
        Table(path, newton_force=lambda: 1.0)
    with pytest.raises(pm.InputError, match=r"column 'tip' = 3: a function"):
        Table(path, tip=3)
    with pytest.raises(pm.InputError, match="with statement"):
        Table(path).record(step)
    for value, shown in ((np.ones((2, 3)), r"shape \(2, 3\)"), ("much", "'much'")):
        with (
            Table(path, F=lambda value=value: value) as table,
            pytest.raises(pm.InputError, match=rf"column 'F': .*{shown} is neither"),
        ):
            table.record(step)
    lengths = iter((2, 3))
    with Table(path, tip=lambda: np.zeros(next(lengths))) as table:
        table.record(step)
        with pytest.raises(pm.InputError, match=r"were .*tip_y and are now .*tip_z"):
            table.record(step)


def test_an_old_table_is_overwritten(folder):
    path = folder / "run.csv"
    for number in (3, 1):
        with Table(path) as table:
            for step in steps(number):
                table.record(step)
    assert read_table(path)["step"].tolist() == [1]
