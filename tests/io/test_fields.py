"""Output fields: the package's table, a new field in one line, and a user's own."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.forms.stresses import FieldForm
from polarmpm.io import field_values, read_table
from polarmpm.io.fields import OF_MATERIALS, OF_POINTS, choose, field_arrays
from tests.conftest import COMM, MICROPOLAR, beam
from tests.helpers.bodies import box
from tests.helpers.plasticity import ELASTIC, cylinder
from tests.recipes.field import DEPTH, MISES

meshio = pytest.importorskip("meshio")

from tests.io.test_recorder import gathered, read_collection  # noqa: E402  (needs meshio)


def by_points() -> Any:
    return _bent(beam(2, MICROPOLAR), pm.plane(x=3.0))


def by_elements() -> Any:
    problem = pm.QuasiStaticFEM(pm.Elements(box("quadrilateral", (4, 2), (3.0, 1.0)), material=MICROPOLAR))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    return _bent(problem, pm.plane(x=3.0))


def _bent(problem: Any, end: Any) -> Any:
    problem.fix(end, u=(0.02, -0.2))
    list(problem.march(1, progress=False))
    return problem


def mises(stress: np.ndarray) -> np.ndarray:
    s = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return np.sqrt(1.5 * np.einsum("nij,nij->n", s, s))


def written(path: Any, problem: Any, fields: Any, **options: Any) -> dict[str, np.ndarray]:
    """What is read back of a state, in the order of the ids."""
    with pm.Recorder(path, problem, fields=(*fields, "id"), **options):
        pass
    ((_, _, meshes),) = read_collection(path)
    data = [{**m.point_data, **{k: v[0] for k, v in m.cell_data.items()}} for m in meshes]
    order = np.argsort(np.concatenate([d["id"] for d in data]))
    return {name: np.concatenate([d[name] for d in data])[order] for name in data[0] if name != "id"}


# a field in one line --------------------------------------------------------------------------------
@pytest.mark.parametrize("domains", [True, False])
def test_a_field_in_one_line(folder, monkeypatch, domains):
    """In the table of what needs the material, or in that of what the points know."""
    monkeypatch.setitem(OF_MATERIALS, "mises", MISES)
    monkeypatch.setitem(OF_POINTS, "depth", DEPTH)
    problem = by_points()
    found = written(folder / "a.pvd", problem, ("stress", "mises", "depth"), domains=domains)
    assert set(found) == {"stress", "mises", "depth"}
    expected = gathered(problem.points, mises(problem.fields().stress))
    assert np.ptp(expected) > 1.0
    np.testing.assert_allclose(found["mises"], expected, rtol=1e-12)
    np.testing.assert_array_equal(found["depth"], -gathered(problem.points, problem.points.x)[:, 1])
    np.testing.assert_array_equal(problem.fields("mises")["mises"], field_values(problem, "mises"))


def test_a_field_in_one_line_on_elements(folder, monkeypatch):
    """The cells' means, and at the quadrature points."""
    monkeypatch.setitem(OF_MATERIALS, "mises", MISES)
    problem = by_elements()
    body = problem.elements
    expected = body.cell_mean(mises(problem.fields().stress))
    cells = np.concatenate(COMM.allgather(body.body.original_cells))
    order = np.argsort(cells)
    found = written(folder / "a.pvd", problem, ("mises", "displacement"))["mises"]
    np.testing.assert_allclose(found, np.concatenate(COMM.allgather(expected))[order], rtol=1e-12)
    found = written(folder / "b.pvd", problem, ("mises",), domains=False)["mises"]
    np.testing.assert_allclose(found, gathered(problem.points, mises(problem.fields().stress)), rtol=1e-12)


def test_a_users_own_fields(folder):
    """Without a table: functions of the points, and of the state in UFL."""
    problem = by_points()
    jump = pm.Field("away", lambda p: p.x - 1.0)
    forces = pm.MaterialField("normal", lambda s: s.stress[0, :])
    found = written(folder / "a.pvd", problem, (MISES, DEPTH, jump, forces, "displacement"))
    stress = gathered(problem.points, problem.fields().stress)
    np.testing.assert_allclose(found["mises"], mises(stress), rtol=1e-12)
    np.testing.assert_allclose(found["normal"], stress[:, 0], rtol=1e-12)
    assert np.all(found["away"][:, 2] == 0)
    np.testing.assert_array_equal(found["away"][:, :2], gathered(problem.points, problem.points.x) - 1.0)


def test_mean_pressure_and_tables(folder):
    problem = by_points()
    points, trace = problem.points, np.trace(problem.fields().stress, axis1=1, axis2=2)
    np.testing.assert_allclose(field_values(problem, "mean_pressure"), -trace / 3, rtol=0, atol=1e-9)
    with pm.Table(folder / "a.csv", p=lambda: points.mean(field_values(problem, "mean_pressure"))) as table:
        table.record(problem.steps[-1])
    assert read_table(folder / "a.csv")["p"][0] == pytest.approx(points.mean(-trace / 3), rel=1e-12)


# what is computed -----------------------------------------------------------------------------------
def test_only_what_is_asked_is_compiled(monkeypatch):
    """Energy and stresses come together, every other field by itself, and each of them once."""
    made, compile_ = [], FieldForm.compile

    def counted(self: FieldForm, comm: Any) -> Any:
        made.append([field.name for field in self.fields])
        return compile_(self, comm)

    monkeypatch.setattr(FieldForm, "compile", counted)
    problem = by_points()
    problem.energy()
    assert list(problem.fields()) == ["energy", "stress", "couple_stress"]
    assert list(problem.fields("stress")) == ["stress"]
    assert made == [["energy", "stress", "couple_stress"]]
    for _ in range(2):
        assert set(problem.fields("mean_pressure", MISES)) == {"mean_pressure", "mises"}
    assert made[1:] == [["mean_pressure"], ["mises"]]
    assert problem.fields("mean_pressure").mean_pressure.shape == (len(problem.points),)
    with pytest.raises(AttributeError, match=r"p: fields\(\) was asked for stress"):
        _ = problem.fields("stress").p
    with pytest.raises(KeyError, match=r"energy: fields\(\) was asked for stress"):
        _ = problem.fields("stress").energy


def test_fields_of_plastic_materials():
    """Zero where nothing can yield; unknown to elastic bodies."""
    grid = pm.Grid.box((0.0, 0.0), (2.0, 1.0), 0.5)
    points = pm.seed(grid, material=ELASTIC)
    points.assign(points.where(lambda x: x[:, 0] > 1.0), cylinder())
    points.hardening[:] = 0.25
    problem = pm.QuasiStatic(grid, points, **pm.PUBLISHED)
    twice = pm.MaterialField("twice", lambda s: 2 * s.chi, plastic=True)
    found = field_arrays(problem, choose((twice, "hardening"), points))
    np.testing.assert_array_equal(found["twice"], np.where(points.x[:, 0] > 1.0, 0.5, 0.0))
    np.testing.assert_array_equal(found["hardening"], 0.25)
    elastic = by_points()
    for field in ("dissipation", twice):
        with pytest.raises(pm.InputError, match="but none of the materials is plastic"):
            choose(field, elastic.points)
    with pytest.raises(pm.InputError, match="'twice', but none of the materials is plastic"):
        elastic.fields(twice)


def test_stored_energy_of_any_hardening():
    """Here linear and exponential in chi; nothing else is stored in the undeformed state."""
    material = pm.UserPlasticity(
        ELASTIC,
        lambda tau, nu, chi, p: ufl.tr(tau) - p.y,
        {"y": 3.0},
        hardening=lambda chi, p: p.y * (chi + ufl.exp(-chi)),
    )
    grid = pm.Grid.box((0.0, 0.0), (2.0, 1.0), 0.5)
    points = pm.seed(grid, material=material)
    points.hardening[:] = chi = 0.1 * (1 + points.id % 7)
    energy = pm.QuasiStatic(grid, points, **pm.PUBLISHED).fields().energy
    np.testing.assert_allclose(energy, 3.0 * (chi + np.exp(-chi)), rtol=1e-14)


# what is said ---------------------------------------------------------------------------------------
def test_the_recorder_documents_all_fields():
    text = re.sub(r"\s+", " ", pm.Recorder.__doc__ or "")
    for field in (*OF_POINTS.values(), *OF_MATERIALS.values()):
        assert re.search(rf"\b{field.name}\b", text), field.name
        assert field.unit in text, field.unit


def test_mistakes_are_named():
    problem = by_points()
    for field, message in (
        ("strain", "'strain' is unknown; allowed are displacement, .*mean_pressure"),
        (3, "3 is neither a name nor a Field"),
        (("id", "id"), "'id' is there twice"),
        (pm.Field("stress", lambda p: p.F), "'stress' is the name of one of the package's fields"),
    ):
        with pytest.raises(pm.InputError, match=message):
            choose(field, problem.points)
    for field, message in (
        (
            pm.Field("short", lambda p: np.zeros(len(p) + 1)),
            r"field 'short': the shape \(\d+,\) is given; a row for each of the \d+",
        ),
        (pm.Field("gone", lambda p: p.nothing), "field 'gone' can't be evaluated: .*'nothing'"),
        (pm.Field("one", lambda p: 1.0), r"field 'one': the shape \(\) is given"),
        (pm.MaterialField("bad", lambda s: s.missing), "field 'bad' can't be evaluated: .*missing"),
        (pm.MaterialField("pair", lambda s: ufl.as_vector((1, 2))), r"field 'pair' has the shape \(2,\)"),
    ):
        with pytest.raises(pm.InputError, match=message):
            field_values(problem, field)
    with pytest.raises(pm.InputError, match=r"'volume' is unknown; allowed are energy, .*MaterialField"):
        problem.fields("volume")
