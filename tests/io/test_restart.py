"""Restart files: whole or refused, with what differs named; a run goes on as if never interrupted."""

import pickle
import sys
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
import pytest
import ufl
from dolfinx import mesh as dmesh

import polarmpm as pm
from polarmpm.io import container, restart
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, assert_repeated
from tests.helpers.ranks import on_ranks, report

VON_MISES = pm.VonMises(MICROPOLAR, k=60.0, H=200.0, l_p=0.5)
STIFFER = pm.MicropolarElastic(lam=3e3, mu=4e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=17.0)


def strip(material: pm.Material = MICROPOLAR, **options: Any) -> pm.QuasiStatic:
    """A cantilever in the plane under its weight."""
    per_cell, length, lift = (options.pop(k, d) for k, d in (("per_cell", 2), ("length", 3.0), ("lift", 0.0)))
    grid = pm.Grid.box((0, -2), (5, 2), options.pop("cell", 0.5), COMM)
    points = pm.seed(grid, bounds=((0, 0), (length, 1)), material=material, points_per_cell=per_cell)
    points.X = points.x = points.X + np.array([0.0, lift])
    problem = pm.QuasiStatic(grid, points, **options)
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    problem.body_load(force=(0.0, -3.0))
    return problem


def plate(material: pm.Material = MICROPOLAR) -> pm.QuasiStaticFEM:
    cells = dmesh.create_rectangle(COMM, [np.zeros(2), np.array([3.0, 1.0])], (6, 2))
    problem = pm.QuasiStaticFEM(pm.Elements(cells, material=material))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(pm.plane(x=3.0), force=(0.0, -5.0))
    return problem


def on_springs() -> pm.QuasiStatic:
    """Held by a surface's springs."""
    grid = pm.Grid.box((-1, -2), (5, 2), 0.5, COMM)
    points = pm.seed(grid, bounds=((0.0, 0.0), (3.0, 1.0)), material=MICROPOLAR)
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=2)
    y = np.arange(0.125, 1.0, 0.25)
    x, normal = np.column_stack([np.full(4, 0.01), y]), np.tile([-1.0, 0.0], (4, 1))
    problem.fix(pm.Surface(x, np.full(4, 0.25), normal), u=0, theta=0)
    problem.body_load(force=(0.0, -3.0))
    return problem


def march(problem: Any, steps: int, to: float = 1.0) -> list[pm.Step]:
    return list(problem.march(steps, to=to, progress=False))


def answers(problem: Any) -> dict[str, np.ndarray]:
    """What a problem says of its last converged step."""
    support = next(g.condition for g in problem.given if "support" in g.name)
    reaction, balance, fields = problem.reaction(support), problem.balance(), problem.fields()
    out = {"force": reaction.force, "couple": reaction.couple, "moment": reaction.moment}
    out |= {f"balance {part.name}": np.append(part.force, part.moment) for part in balance.parts}
    out |= {name: fields[name] for name in fields} | {"x": problem.points.x}
    return out | {"energies": np.array(list(problem.energies().values()))}


PROBLEMS = {
    "default": strip,
    "reset every step": lambda: strip(reset=1, basis="mpm", ghost="thesis"),
    "never reset": lambda: strip(reset=None),
    "plastic": lambda: strip(VON_MISES, reset=2),
    "projection": lambda: strip(basis="mpm", assembly="projection"),
    "elements": plate,
    "springs": on_springs,
}


@pytest.mark.parametrize("kind", PROBLEMS)
def test_all_answers_are_there_at_once(kind, folder):
    whole, again = PROBLEMS[kind](), PROBLEMS[kind]()
    march(whole, 3, 0.75)
    pm.save_restart(whole, folder / "run.h5")
    pm.load_restart(again, folder / "run.h5")
    found = answers(again)
    for name, expected in answers(whole).items():
        assert_repeated(found[name], expected, name)
    assert again.steps == whole.steps
    if isinstance(whole, pm.QuasiStatic):
        assert again.trust() == whole.trust()
    march(whole, 1), march(again, 1)
    assert_repeated(again.points.x, whole.points.x)


def along(problem: Any) -> list[pm.Step]:
    return list(problem.march_arc_length(0.05, steps=2, progress=False))


def test_elements_go_on_along_their_path(folder):
    whole, again = plate(), plate()
    along(whole)
    pm.save_restart(whole, folder / "run.h5")
    pm.load_restart(again, folder / "run.h5")
    for first, second in zip(along(whole), along(again), strict=True):
        assert second.factor == pytest.approx(first.factor, rel=1e-9)


@pytest.mark.parametrize("arc_length", [False, True])
def test_step_sizes_go_on(arc_length, folder):
    """Of marches whose steps have grown, called with the same arguments."""

    def go(problem: pm.QuasiStatic, stop: int = 100) -> list[float]:
        adaptive = {"steps": 8, "adaptive": True, "largest": 0.4, "progress": False}
        if arc_length:
            steps = problem.march_arc_length(0.002, largest=0.01, to=1.0, progress=False)
        else:
            steps = problem.march(**adaptive)
        for step in steps:
            pm.save_restart(problem, folder / f"{stop}.h5")
            if step.number == stop:
                break
        return [step.factor for step in problem.steps]

    whole, first, again, other = (strip() for _ in range(4))
    expected = go(whole)
    assert not np.allclose(np.diff(expected), expected[0])
    go(first, 2)
    pm.load_restart(again, folder / "2.h5")
    np.testing.assert_allclose(go(again), expected, rtol=1e-9)
    pm.load_restart(other, folder / "2.h5")
    step = next(other.march(5, adaptive=True, progress=False))  # called in another way
    assert step.factor == pytest.approx(expected[1] + (1 - expected[1]) / 5)


# files that don't fit -----------------------------------------------------------------------------
def user(coefficient: float) -> pm.UserEnergy:
    return pm.UserEnergy(
        lambda E, G, p: coefficient * p.a * ufl.inner(E, E) + p.b * ufl.inner(G, G), {"a": 3e3, "b": 20.0}
    )


def energy_of(coefficient: float) -> pm.QuasiStatic:
    return strip(user(coefficient))


def with_other_order() -> pm.QuasiStatic:
    """Points of the same number and volume whose materials are elsewhere."""
    problem = strip()
    problem.points.X = problem.points.X[:, ::-1] * np.array([3.0, 1.0 / 3.0])
    return problem


OTHERS = [
    (
        strip,
        lambda: strip(STIFFER),
        r"\[0\]\.mu is 2000, this problem has 4000.*allow={'materials'}",
    ),
    (strip, lambda: strip(NEO_HOOKEAN), r"unknowns of a node is 3, this problem has 2"),
    (
        strip,
        lambda: strip(VON_MISES),
        r"\[0\]\.class is MicropolarElastic, this problem has VonMises",
    ),
    (lambda: strip(VON_MISES), strip, r"materials\[0\]\.class is VonMises, this problem has Micropolar"),
    (
        lambda: energy_of(1.0),
        lambda: energy_of(2.0),
        r"\[0\]\.energy at the sample is .*, this problem",
    ),
    (strip, lambda: strip(per_cell=3), "number of points is 48, this problem has 108"),
    (strip, lambda: strip(length=2.0), "number of points is 48, this problem has 32"),
    (
        strip,
        lambda: strip(lift=1e-3),
        r"another body: point \d+ was seeded at \(.*\), this problem has",
    ),
    (strip, lambda: strip(cell=0.25, per_cell=1), "cell is .*, this problem has"),
    (strip, lambda: strip(basis="bspline3"), "basis is bspline, this problem has bspline3"),
    (strip, lambda: strip(boxes=False), "boxes is True, this problem has False"),
    (strip, plate, "its state is of material points, this problem's of finite elements"),
    (plate, lambda: plate(STIFFER), r"materials\[0\]\.mu is 2000, this problem has 4000"),
    (lambda: strip(basis="mpm", ghost="thesis"), lambda: strip(basis="mpm"), "the saved state has ghost"),
]


@pytest.mark.parametrize(("saved", "other", "message"), OTHERS)
def test_another_problem_is_refused_and_left_alone(saved, other, message, folder):
    problem, here = saved(), other()
    march(problem, 2, 0.5)
    pm.save_restart(problem, folder / "run.h5")
    before = {name: a.copy() for name, a in here.points.arrays().items()}
    with pytest.raises(pm.InputError, match=rf"(?s)run\.h5: .*{message}"):
        pm.load_restart(here, folder / "run.h5")
    assert (here.progress.step, here.steps, here.restored) == (0, [], None)
    for name, a in here.points.arrays().items():
        np.testing.assert_array_equal(a, before[name])
    march(here, 2)  # as if nothing had been tried


def test_differences_that_are_meant(folder):
    problem = strip()
    march(problem, 2, 0.5)
    pm.save_restart(problem, folder / "run.h5")
    for other, allow in (
        (strip(STIFFER), {"materials"}),
        (strip(VON_MISES), ["materials"]),
        (strip(basis="bspline3"), "basis"),
        (strip(cell=0.25, per_cell=1), {"grid", "points"}),
        (strip(per_cell=3), {"points"}),
    ):
        pm.load_restart(other, folder / "run.h5", allow=allow)
        assert other.progress.step == 2
        assert other.points.total == problem.points.total
        march(other, 1, 0.75)
    for allow in ("moduli", {"materials", "seed"}, None, 3, {"materials": 1}):
        with pytest.raises(pm.InputError, match=r"allow = .*: a set of some of 'materials', 'points'"):
            pm.load_restart(strip(), folder / "run.h5", allow=allow)
    outside = pm.Grid.box((0, -2), (2, 2), 0.5, COMM)
    points = pm.seed(outside, bounds=((0, 0), (1, 1)), material=MICROPOLAR)
    narrow = pm.QuasiStatic(outside, points)
    with pytest.raises(pm.InputError, match="outside of this problem's grid"):
        pm.load_restart(narrow, folder / "run.h5", allow={"points", "grid", "conditions"})


def test_conditions_that_are_left_out(folder):
    problem, fewer = strip(), strip()
    problem.load(problem.points.farthest((1, 0)), force=(0.0, -1.0))
    march(problem, 2, 0.5)
    pm.save_restart(problem, folder / "run.h5")
    with pytest.raises(pm.InputError, match=r"run\.h5: the saved state has load 2, which .* hasn't given"):
        pm.load_restart(fewer, folder / "run.h5")
    pm.load_restart(fewer, folder / "run.h5", allow={"conditions"})
    assert len(fewer.loads) == 1
    march(fewer, 1)


def test_a_state_that_is_not_finite_is_not_saved(folder):
    problem = strip()
    march(problem, 1)
    pm.save_restart(problem, folder / "run.h5")
    problem.points.F[:] = np.nan
    with pytest.raises(pm.InputError, match="points/F isn't finite"):
        pm.save_restart(problem, folder / "run.h5")
    pm.load_restart(problem, folder / "run.h5")
    assert np.all(np.isfinite(problem.points.F))


# damaged files ------------------------------------------------------------------------------------
@pytest.fixture
def saved(folder):
    problem = strip(cell=1.0)
    march(problem, 1)
    pm.save_restart(problem, folder / "run.h5")
    COMM.barrier()
    return folder / "run.h5"


def refuse(file: Path, content: bytes, problem: Any, match: str) -> None:
    COMM.barrier()
    if COMM.rank == 0:
        file.write_bytes(content)
    COMM.barrier()
    with pytest.raises(pm.InputError, match=match):
        pm.load_restart(problem, file)


def test_every_damage_is_refused(saved, folder):
    """Whatever byte is changed, lost or added."""
    content, problem = saved.read_bytes(), strip(cell=1.0)
    rng = np.random.default_rng(1)
    head, body = range(0, 512, 5), rng.integers(512, len(content), 40)
    for at in (*head, *body, len(content) - 1):
        damaged = bytearray(content)
        damaged[at] ^= 1 << int(rng.integers(8))
        refuse(folder / "bad.h5", bytes(damaged), problem, r"restart file .*bad\.h5")
    for damaged in (content[:-1], content + b"\0", content[: len(content) // 2], content[:100], b"", b"text"):
        refuse(folder / "bad.h5", damaged, problem, r"restart file .*bad\.h5 is damaged")
    assert problem.progress.step == 0


def test_an_edited_file_is_refused(saved, folder):
    """HDF5's tools open it, but what they change is noticed."""
    content = saved.read_bytes()
    if COMM.rank == 0:
        with h5py.File(saved, "r+") as file:
            assert file.attrs["progress/step"] == 1
            assert np.all(np.isfinite(file["points/x"][:]))
            file["points/x"][...] = np.nan
    COMM.barrier()
    with pytest.raises(pm.InputError, match="its checksum doesn't fit"):
        pm.load_restart(strip(cell=1.0), saved)
    now = restart._FORMAT
    other = content.replace(b"format %d" % now, b"format %d" % (now + 1), 1)
    refuse(folder / "other.h5", other, strip(cell=1.0), f"is of format {now + 1}, .*reads format {now}$")


def test_a_file_of_an_earlier_version(folder):
    if COMM.rank == 0:
        with h5py.File(folder / "old.h5", "w") as file:
            file.attrs["format"] = 6
    COMM.barrier()
    with pytest.raises(pm.InputError, match=r"old\.h5 has no checksum: it is of an earlier version"):
        pm.load_restart(strip(), folder / "old.h5")


@pytest.mark.parametrize("path", [None, 5, "", "a\0b", b"a.h5"])
def test_no_name_of_a_file(path):
    problem = strip(cell=1.0)
    for function in (pm.save_restart, pm.load_restart):
        with pytest.raises(pm.InputError, match=r"path = .*: the name of a restart file is needed"):
            function(problem, path)
        with pytest.raises(pm.InputError, match="problem = None: a QuasiStatic or QuasiStaticFEM is needed"):
            function(None, path)


def test_where_nothing_can_be_written(saved, folder):
    problem, content = strip(cell=1.0), saved.read_bytes()
    with pytest.raises(pm.InputError, match="is a folder"):
        pm.save_restart(problem, folder)
    for path in (saved / "run.h5", "/dev/null"):
        with pytest.raises(pm.OutputError, match=rf"restart file {path} can't be written: ") as caught:
            pm.save_restart(problem, path)
        assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
        assert isinstance(caught.value, OSError)
    assert saved.read_bytes() == content
    pm.save_restart(problem, folder / "not yet" / "there" / "run.h5")  # as tables and figures do
    pm.load_restart(strip(cell=1.0), folder / "not yet" / "there" / "run.h5")


def test_rows_that_differ_between_ranks_or_are_no_numbers(folder):
    problem = strip(cell=1.0)
    problem.rows["names"] = np.array(["a"] * len(problem.points))
    with pytest.raises(pm.InputError, match=r"kept/rows\.names: .*numbers are needed"):
        pm.save_restart(problem, folder / "run.h5")
    problem.rows = {"mine": np.zeros((len(problem.points), 1 + (COMM.rank == COMM.size - 1)))}
    if COMM.size > 1:
        with pytest.raises(pm.InputError, match=r"kept/rows\.mine: rank 0 has .* rank \d has"):
            pm.save_restart(problem, folder / "run.h5")
    assert not list(folder.iterdir())


def test_arrays_are_written_in_pieces(saved, folder, monkeypatch):
    """Whatever the size of a piece, the file is the same."""
    content, problem = saved.read_bytes(), strip(cell=1.0)
    pm.load_restart(problem, saved)
    monkeypatch.setattr(container, "_PIECE", 100)
    pm.save_restart(problem, folder / "again.h5")
    COMM.barrier()
    again = (folder / "again.h5").read_bytes()
    assert abs(len(again) - len(content)) < 200
    pm.load_restart(problem, folder / "again.h5")


# on two ranks -------------------------------------------------------------------------------------
def solve(case: str) -> dict[str, Any]:
    """A file that only one rank can see, or that can't be written."""
    path, problem = Path(case), strip(reset=2)
    march(problem, 3, 0.75)
    support, found = problem.supports[0], {}
    try:
        pm.save_restart(problem, "/dev/null/run.h5")
    except pm.OutputError as e:
        found["refused"] = str(e)
    pm.save_restart(problem, path / "two.h5")
    found["force"] = problem.reaction(support).force.tolist()
    other = strip(reset=2)
    pm.load_restart(other, path / "one.h5")
    found["of one"] = other.reaction(other.supports[0]).force.tolist()
    found["balance"] = other.balance().residue[0]
    try:
        pm.load_restart(problem, path / ("one.h5" if MPI.COMM_WORLD.rank else "none.h5"))
    except pm.InputError as e:
        found["missing"] = str(e)
    return found


@pytest.mark.mpi
@pytest.mark.timeout(300)
def test_one_rank_and_two(tmp_path):
    problem = strip(reset=2)
    march(problem, 3, 0.75)
    pm.save_restart(problem, tmp_path / "one.h5")
    expected = problem.reaction(problem.supports[0]).force
    for found in on_ranks(2, str(tmp_path), __file__):
        assert "/dev/null/run.h5 can't be written: Not a directory" in found["refused"]
        assert "none.h5 can't be read: No such file" in found["missing"]
        np.testing.assert_allclose(found["of one"], expected, atol=1e-9)
        np.testing.assert_allclose(found["force"], expected, atol=1e-7)
        assert found["balance"] < 1e-9
    again = strip(reset=2)
    pm.load_restart(again, tmp_path / "two.h5")
    np.testing.assert_allclose(again.reaction(again.supports[0]).force, expected, atol=1e-7)
    assert again.steps[0].number == 1


if __name__ == "__main__":
    report(solve)
    sys.exit()
