"""Probes, recovered values, and the fields and names of components that go with them."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.bodies.recovery import stencil
from polarmpm.io import field_values, read_table
from polarmpm.io.naming import component_names
from tests.conftest import COMM, MICROPOLAR, beam
from tests.helpers.bodies import box
from tests.helpers.plasticity import ELASTIC, cylinder


def by_points(dim: int = 2):
    problem = beam(dim, MICROPOLAR)
    problem.fix(pm.plane(x=3.0), u=(0.02, -0.2, 0.1)[:dim])
    return problem


def by_elements(degree: int = 2):
    body = pm.Elements(box("quadrilateral", (4, 2), (3.0, 1.0)), material=MICROPOLAR, degree=degree)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.fix(pm.plane(x=3.0), u=(0.02, -0.2))
    return problem


# recovery -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("dim", [2, 3])
def test_polynomials_of_degree_2_are_met(dim):
    points = beam(dim, MICROPOLAR, per_cell=3).points
    scale = np.arange(1, dim + 1)

    def f(x):
        return 2.0 + x @ scale + (x @ scale[::-1]) ** 2

    low = points.comm.allreduce(points.X.min(0), op=_lowest)
    high = points.comm.allreduce(points.X.max(0), op=_highest)
    places = np.array([low, high, 0.7 * low + 0.3 * high, 0.5 * (low + high)])
    around = stencil(points, places)
    np.testing.assert_allclose(around.apply(points, f(points.X)), f(places), rtol=1e-11)
    np.testing.assert_allclose(around.weights.sum(axis=1), 1.0, rtol=1e-12)


def _lowest(a, b):
    return np.minimum(a, b)


def _highest(a, b):
    return np.maximum(a, b)


@pytest.mark.parametrize("rows", [1, 2])
def test_thin_bodies_have_fewer_functions(rows):
    """One or two rows of points don't tell a slope across, or a curvature, from a constant."""
    x = np.array([(0.1 * i, 0.1 * j) for i in range(20) for j in range(rows)]) + 7.0
    mine = np.arange(len(x)) % COMM.size == COMM.rank
    n = int(mine.sum())
    points = pm.Points(x[mine], np.ones(n), np.full((n, 2), 0.05), MICROPOLAR, COMM)
    place = np.array([[7.52, 7.0 + 0.05 * (rows - 1)]])
    around = stencil(points, place)
    value = 3.0 + (points.X[:, 0] - 7.0) ** 2
    assert around.apply(points, value)[0] == pytest.approx(3.0 + 0.52**2, rel=1e-12)


def test_few_points_and_no_places():
    """One point tells its own value; a rank may have no place to ask for."""
    here = int(COMM.rank == 0)
    points = pm.Points(np.full((here, 2), 0.5), np.ones(here), np.full((here, 2), 0.5), MICROPOLAR, COMM)
    values = np.full(here, 7.0)
    assert stencil(points, np.array([[0.7, 0.4]])).apply(points, values) == pytest.approx([7.0])
    assert stencil(points, np.zeros((0, 2))).apply(points, values).shape == (0,)


def test_one_material_counts(folder):
    """Stresses jump from one material to the next; a place belongs to that of the nearest point."""
    points = by_points().points
    points.put_materials((*points.materials, ELASTIC), (points.X[:, 0] > 1.5).astype(int))
    values = np.where(points.material == 1, 5.0, -1.0) + points.X[:, 1]
    around = stencil(points, np.array([[1.4, 0.5], [1.6, 0.5]]))
    np.testing.assert_allclose(around.apply(points, values), [-0.5, 5.5], rtol=1e-11)


def test_values_on_nodes_of_a_mesh():
    problem = by_elements()
    list(problem.march(1, progress=False))
    found = problem.recover("displacement")
    assert found.shape == problem.elements.displacement.shape
    assert np.abs(found - problem.elements.displacement).max() < 2e-3  # of 0.2


def test_a_stress_at_a_place():
    """The middle of a body under uniform stress, and a value among those of the points around it."""
    problem = by_points()
    list(problem.march(1, progress=False))
    assert problem.recover("stress", (1.5, 0.5)).shape == (3, 3)
    several = problem.recover("displacement", [(0.5, 0.5), (1.5, 0.8)])
    assert several.shape == (2, 2)
    near = problem.points.nearest((1.5, 0.8), 4)
    assert several[1] == pytest.approx(problem.points.mean_displacement(near), rel=0.05)


def test_files_with_values_at_nodes(folder):
    """A stress that is linear over the mesh is so at its nodes, too."""
    problem = by_elements()
    linear = pm.Field("linear", lambda p: 2.0 + p.X[:, 0] - 3 * p.X[:, 1])
    with pm.Recorder(folder / "a.pvd", problem, fields=(linear, "stress", "material"), smooth=True):
        pass
    COMM.barrier()
    if COMM.rank == 0:
        import meshio

        for file in (folder / "a").glob("*.vtu"):
            piece = meshio.read(file)
            expected = 2.0 + piece.points[:, 0] - 3 * piece.points[:, 1]
            np.testing.assert_allclose(piece.point_data["linear"], expected, rtol=1e-10, atol=1e-10)
            assert piece.point_data["stress"].shape == (len(expected), 9)
            assert set(piece.cell_data) == {"material"}
    with pytest.raises(pm.InputError, match="smooth = True"):
        pm.Recorder(folder / "b.pvd", by_points(), smooth=True)


# probes ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("make", [by_points, by_elements])
def test_a_probe_follows_a_place_into_the_table(folder, make):
    problem = make()
    end = problem.probe("end", (3.0, 0.5), ("displacement", "principal_stress"))
    mean = problem.probe("mean", problem.points.where(lambda x: x[:, 0] > 0), "rotation")
    assert len(end) == 1
    with pm.Table(folder / "a.csv", problem, twice=lambda: 2 * end.now()["displacement"][1]) as table:
        for step in problem.march(3, progress=False):
            table.record(step)
    COMM.barrier()
    assert list(end.factor) == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert end["displacement"].shape == (4, 2)
    assert end["displacement"][-1] == pytest.approx([0.02, -0.2], abs=0.01)
    assert mean["rotation"].shape == (4, 3)
    found = read_table(folder / "a.csv")
    np.testing.assert_array_equal(found["end_displacement_y"], end["displacement"][1:, 1])
    np.testing.assert_array_equal(found["end_principal_stress_1"], end["principal_stress"][1:, 0])
    np.testing.assert_array_equal(found["mean_rotation_z"], mean["rotation"][1:, 2])
    np.testing.assert_array_equal(found["twice"], 2 * end["displacement"][1:, 1])
    assert set(problem.probes) == {"end", "mean"}


def test_places_when_points_are_split_or_taken_out(folder):
    """Probes and places of measurements go on with the points that there are; nan, or an error, where the
    body is gone."""

    def make():
        grid = pm.Grid.box((0, -1), (5, 2), 0.5, COMM)
        points = pm.seed(grid, bounds=((0, 0), (4, 1)), material=pm.NeoHookean(lam=1e6, mu=5e5))
        finer = pm.Grid.box((0, -1), (5, 2), 0.25, COMM)

        def regrid(problem):
            return finer if problem.progress.step == 1 else None

        problem = pm.QuasiStatic(grid, points, reset=1, regrid=regrid)
        problem.fix(pm.plane(x=0.0), u=0)
        problem.body_load(force=lambda f: (0, -1e3))
        at = problem.probe("at", (2.9, 0.4), "displacement")
        mean = problem.probe("mean", points.where(lambda x: x[:, 0] > 3.5), "displacement")
        return problem, at, mean, pm.Places(points, [(2.9, 0.4)]), problem.probe("gone", (3.9, 0.4))

    problem, at, mean, places, gone = make()
    for step in problem.march(3, progress=False):
        if step.number == 2:
            pm.save_restart(problem, folder / "split.h5")
    assert len(problem.regrids) == 1
    for found in (at["displacement"], mean["displacement"]):
        assert np.abs(found[2:] / found[1] - 1.0).max() < 0.02
    assert places.displacement()[0] == pytest.approx(at["displacement"][-1], rel=1e-2)
    again, other, *_ = make()
    pm.load_restart(again, folder / "split.h5")
    list(again.march(1, progress=False))
    np.testing.assert_allclose(other["displacement"], at["displacement"], rtol=1e-9)
    problem.remove(problem.points.where(lambda x: x[:, 0] > 3.0))
    list(problem.march(1, to=2.0, progress=False))
    assert np.all(np.isfinite(at["displacement"]))
    assert np.all(np.isnan(gone["displacement"][-1]))
    assert abs(at["displacement"][-1, 1]) < abs(at["displacement"][-2, 1])
    assert places.displacement()[0] == pytest.approx(at["displacement"][-1], rel=1e-2)
    with pytest.raises(pm.InputError, match=r"X: \(3\.9, 0\.4\) lies outside the undeformed body"):
        pm.Places(problem.points, [(3.9, 0.4)])


def test_a_step_that_fails_leaves_no_row():
    class Fails(pm.Observer):
        def after_commit(self, problem, rebased):
            if len(problem.steps) == 1:
                raise ArithmeticError("on purpose")

    problem = by_points()
    probe = problem.probe("end", (3.0, 0.5))
    problem.observers.append(Fails())
    with pytest.raises(ArithmeticError):
        list(problem.march(2, progress=False))
    assert list(probe.factor) == [0.0, 0.5]
    assert probe.now()["displacement"] == pytest.approx(probe["displacement"][-1])


def test_a_history_goes_on_after_a_restart(folder):
    problem = by_points()
    probe = problem.probe("end", (3.0, 0.5), ("displacement", "stress"))
    for step in problem.march(2, progress=False):
        if step.number == 1:
            pm.save_restart(problem, folder / "a.h5")
    again = by_points()
    other = again.probe("end", (3.0, 0.5), ("displacement", "stress"))
    new = again.probe("new", (1.0, 0.5))
    pm.load_restart(again, folder / "a.h5")
    assert len(other) == 2
    assert list(new.factor) == [0.5]
    list(again.march(1, progress=False))
    np.testing.assert_allclose(other["stress"], probe["stress"], rtol=1e-9, atol=1e-3)
    assert other.factor.tolist() == probe.factor.tolist()


def test_probes_are_checked():
    problem = by_points()
    problem.probe("end", (3.0, 0.5))
    with pytest.raises(pm.InputError, match="there is a probe of this name"):
        problem.probe("end", (3.0, 0.5))
    with pytest.raises(pm.InputError, match=r"at: \(9, 0\.5\) lies outside the undeformed body"):
        problem.probe("far", (9.0, 0.5))
    with pytest.raises(pm.InputError, match="at"):
        problem.probe("solid", (3.0, 0.5, 0.0))
    with pytest.raises(pm.InputError, match="'strain' is unknown"):
        problem.probe("strain", (3.0, 0.5), "strain")
    with pytest.raises(pm.InputError, match="material points have no nodes"):
        problem.recover("stress")
    (step,) = problem.march(1, progress=False)
    table = pm.Table("unused.csv", problem, end=lambda: 1.0)
    with table, pytest.raises(pm.InputError, match="column 'end'"):
        table.record(step)
    assert set(problem.probes) == {"end"}


# fields ---------------------------------------------------------------------------------------------
def test_stresses_by_other_names():
    problem = by_points()
    list(problem.march(1, progress=False))
    f = problem.fields("stress", "von_mises", "q", "principal_stress", "skew_stress")
    turned = f["stress"].transpose(0, 2, 1)
    np.testing.assert_array_equal(f["von_mises"], f["q"])
    np.testing.assert_allclose(f["principal_stress"], np.linalg.eigvalsh((f["stress"] + turned) / 2)[:, ::-1])
    np.testing.assert_allclose(f["skew_stress"], (f["stress"] - turned) / 2, atol=1e-9 * np.abs(turned).max())
    with pytest.raises(pm.InputError, match="none of the materials is plastic"):
        problem.fields("plastic_strain")


def test_plastic_strain():
    """Of a stretch that is plastic as a whole, the logarithm; turned along with nothing."""
    problem = beam(2, cylinder())
    points = problem.points
    points.plastic_F = np.tile(np.diag([1.2, 1 / 1.2, 1.0]), (len(points), 1, 1))
    values = field_values(problem, "plastic_strain")
    expected = np.diag([np.log(1.2), -np.log(1.2), 0.0])
    np.testing.assert_allclose(values, np.tile(expected, (len(points), 1, 1)), atol=1e-14)
    equivalent = field_values(problem, "equivalent_plastic_strain")
    np.testing.assert_allclose(equivalent, 2 / np.sqrt(3) * np.log(1.2), rtol=1e-12)


def test_what_a_field_makes_of_its_rows_is_checked():
    problem = by_points()
    wrong = pm.MaterialField("wrong", lambda s: s.stress, after=lambda rows: 1.0)
    with pytest.raises(pm.InputError, match="'wrong'"):
        problem.fields(wrong)
    with pytest.raises(pm.InputError, match="after"):
        pm.MaterialField("wrong", lambda s: s.stress, after=lambda: 1.0)


@pytest.mark.parametrize(
    ("shape", "names"),
    [((), [""]), ((2,), ["x", "y"]), ((2, 2), ["xx", "xy", "yx", "yy"]), ((4,), ["0", "1", "2", "3"])],
)
def test_names_of_components(shape, names):
    assert component_names("a", shape) == names
    assert component_names("principal_stress", (3,)) == ["1", "2", "3"]
    assert component_names("a", (27,))[5] == "xyz" == component_names("a", (3, 3, 3))[5]


def test_names_in_files(folder):
    problem = by_points()
    with pm.Recorder(folder / "a.pvd", problem, fields=("displacement", "stress", "principal_stress")):
        pass
    COMM.barrier()
    if COMM.rank == 0:
        text = next(iter(sorted((folder / "a").glob("*.vtu")))).read_bytes()
        assert b' Name="stress" ComponentName0="xx" ComponentName1="xy"' in text
        assert b' Name="principal_stress" ComponentName0="1"' in text
        assert b'Name="displacement" ComponentName' not in text


# reactions ------------------------------------------------------------------------------------------
def test_torque():
    from polarmpm.problems.reactions import Reaction

    flat = Reaction(np.zeros(2), np.zeros(1), np.array([3.0]), np.zeros(2))
    assert flat.torque() == 3.0
    with pytest.raises(pm.InputError, match="one axis"):
        flat.torque((0, 0, 1))
    solid = Reaction(np.zeros(3), np.zeros(3), np.array([1.0, 2.0, 2.0]), np.zeros(3))
    assert solid.torque((0, 0, -5)) == -2.0
    assert solid.torque((1, 2, 2)) == pytest.approx(3.0)
    with pytest.raises(pm.InputError, match="isn't zero"):
        solid.torque((0, 0, 0))
