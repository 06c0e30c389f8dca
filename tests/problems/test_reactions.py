"""Reactions with their moments, and the balance of all that acts on a body."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from tests.conditions.test_mid_run import HEIGHT, LENGTH, bar, end_of, surface_of
from tests.conftest import COMM, HENCKY, MICROPOLAR, NEO_HOOKEAN, beam

METHODS = [
    pytest.param({"reset": None}, id="bspline"),
    pytest.param({"reset": None, "basis": "mpm"}, id="mpm"),
    pytest.param({"reset": None, "basis": "gimpm"}, id="gimpm"),
    pytest.param(None, id="elements"),
]


def total(values: np.ndarray) -> np.ndarray:
    out: np.ndarray = COMM.allreduce(np.asarray(values).sum(axis=0))
    return out


def moment_of(x: np.ndarray, forces: np.ndarray) -> np.ndarray:
    moments = np.cross(
        np.pad(x, ((0, 0), (0, 3 - x.shape[1]))), np.pad(forces, ((0, 0), (0, 3 - x.shape[1])))
    )
    return moments if x.shape[1] == 3 else moments[:, 2:]


@pytest.mark.parametrize("material", [MICROPOLAR, HENCKY], ids=["micropolar", "classical"])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("options", METHODS)
def test_moment_of_a_clamped_end(options, dim, material):
    """That of the loads, by hand, where the points are now: a body force, and couples."""
    problem = bar(options, material, dim)
    theta = {"theta": 0} if material.micropolar else {}
    wall = problem.fix(pm.plane(x=0.0), u=0, **theta)
    density = np.array([1.0, -8.0, 3.0])[:dim]
    couple = None if not material.micropolar else 2.0 if dim == 2 else (1.0, -2.0, 3.0)
    problem.body_load(force=density, couple=couple)
    list(problem.march(2, progress=False))
    p, about = problem.points, np.array([1.0, 2.0, -3.0])[:dim]
    forces = p.volume0[:, None] * density
    expected = total(moment_of(p.x - about, forces))
    if couple is not None:
        expected = expected + total(p.volume0[:, None] * np.atleast_1d(couple))
    found = problem.reaction(wall, about)
    tolerance = 1e-8 if dim == 2 or not material.micropolar else 1e-3  # couples turn with the spin
    np.testing.assert_allclose(found.force, -total(forces), rtol=1e-8)
    np.testing.assert_allclose(found.moment, -expected, rtol=tolerance, atol=tolerance * 10)
    assert np.abs(total(moment_of(p.x, forces) - moment_of(p.X, forces))).max() > 0.5  # it matters where
    shifted = problem.reaction(wall)
    by = moment_of(about[None], found.force[None])[0]
    np.testing.assert_allclose(shifted.moment, found.moment + by, rtol=1e-10, atol=1e-9)
    balance = problem.balance(about)
    assert balance.residue[0] < 1e-9
    assert balance.residue[1] < tolerance


@pytest.mark.parametrize("options", METHODS)
def test_balance_of_all_kinds(options):
    """Loads, tractions, pressure, springs and supports add up to nothing, forces and moments."""
    problem = bar(options, MICROPOLAR)
    wall = problem.fix(pm.plane(x=0.0), u=0, theta=0)
    prop = problem.fix(lambda x: x[:, 0] > 3.7, uy=0)
    springs = problem.fix(surface_of(problem), uy=0, stiffness=3.0)
    problem.load(end_of(problem), force=(20.0, 0.0), couple=10.0)
    problem.body_load(force=(0.0, -10.0))
    if options is None:
        problem.traction(pm.plane(y=HEIGHT), force=(3.0, -2.0), follows=True)
        problem.pressure(pm.plane(y=0.0), 4.0)
    else:
        problem.traction(surface_of(problem), force=(3.0, -2.0), follows=True)
        problem.pressure(pm.Surface.line((0.0, 0.0), (LENGTH, 0.0), 16), 4.0)
    list(problem.march(2, progress=False))
    balance = problem.balance((0.0, 0.5))
    assert balance.residue == pytest.approx((0.0, 0.0), abs=1e-9)
    parts = {part.name: part for part in balance.parts}
    for support in (wall, prop, springs):
        reaction = problem.reaction(support, (0.0, 0.5))
        np.testing.assert_allclose(parts[support.name].force, reaction.force, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(parts[support.name].moment, reaction.moment, rtol=1e-9, atol=1e-9)
    assert abs(problem.reaction(springs).force[1]) > 0.1
    text = str(balance)
    assert all(name in text for name in parts)
    assert "moments about (0, 0.5)" in text


@pytest.mark.parametrize("basis", ["bspline", "mpm"])
def test_what_a_balanced_reset_carries(basis):
    """Nothing that loads and reactions would miss: neither a sum nor a moment where the body is now."""
    problem = bar({"reset": 1, "basis": basis})
    problem.fix(pm.plane(x=0.0), u=0)
    problem.load(end_of(problem), force=(0.0, -30.0))
    list(problem.march(4, progress=False))
    balance = problem.balance()
    for total in (balance.force, balance.carried.force, balance.moment, balance.carried.moment):
        np.testing.assert_allclose(total, 0.0, atol=1e-6)


@pytest.mark.parametrize("options", [METHODS[1], METHODS[3]])
def test_a_corner_that_two_supports_share(options):
    """Its force is stated once, by the support that came first; the other says so."""
    problem = bar(options, below=0.0)
    first = problem.fix(pm.plane(x=0.0), u=0)
    second = problem.fix(pm.plane(y=0.0), uy=0)
    problem.body_load(force=(0.0, -10.0))
    list(problem.march(1, progress=False))
    one, two = problem.reaction(first), problem.reaction(second)
    assert one.force[1] + two.force[1] == pytest.approx(10.0 * LENGTH * HEIGHT, rel=1e-9)
    assert one.shared == {}
    assert list(two.shared) == [first.name]
    assert two.shared[first.name][0] == 0.0
    assert 0.0 < two.shared[first.name][1] <= one.force[1] + 1e-9
    assert problem.balance().residue[0] < 1e-9
    problem.release(first)  # then it belongs to the other
    problem.fix(pm.plane(x=0.0), ux=0)
    list(problem.march(1, to=1.5, progress=False))
    assert problem.reaction(second).force[1] == pytest.approx(15.0 * LENGTH * HEIGHT, rel=1e-9)
    assert problem.reaction(second).shared == {}


def test_a_reaction_unpacks(folder):
    """Force and couple as ever; a table takes all of it."""
    problem = beam(2)
    wall = problem.supports[0]
    problem.load(problem.points.farthest((1, 0)), force=(1.0, -2.0), couple=3.0)
    with pytest.raises(pm.InputError, match="no load step has been solved"):
        problem.balance()
    columns = {"wall": lambda: problem.reaction(wall), "balance": problem.balance}
    with pm.Table(folder / "run.csv", **columns) as table:
        for step in problem.march(2):
            table.record(step)
    reaction = problem.reaction(wall)
    force, couple = reaction
    assert force is reaction.force
    assert couple is reaction.couple
    np.testing.assert_allclose(np.concatenate(problem.reaction(wall)), [*force, *couple])
    from polarmpm.io.table import read_table

    rows = read_table(folder / "run.csv")
    assert rows["wall_force_y"][-1] == pytest.approx(force[1])
    assert rows["wall_moment"][-1] == pytest.approx(reaction.moment[0])
    assert rows["balance_residue_force"][-1] == pytest.approx(problem.balance().residue[0])
    again = pickle.loads(pickle.dumps(reaction))
    np.testing.assert_array_equal(again.moment, reaction.moment)
    assert "moment=" in repr(reaction)


@pytest.mark.parametrize("about", [(0.0,), (0.0, 0.0, 0.0), "origin", (0.0, np.nan)])
def test_points_that_are_none(about: Any):
    problem = beam(2)
    problem.load(problem.points.farthest((1, 0)), force=(1.0, -2.0))
    list(problem.march(1))
    for act in (lambda: problem.reaction(problem.supports[0], about), lambda: problem.balance(about)):
        with pytest.raises(pm.InputError, match=r"about = .*2 finite coordinates"):
            act()


def test_a_free_body_in_balance():
    """A body that only couples load: forces are compared with those of the nodes."""
    problem = bar({"reset": None}, MICROPOLAR)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(end_of(problem), couple=5.0)
    list(problem.march(1, progress=False))
    balance = problem.balance()
    assert balance.residue == pytest.approx((0.0, 0.0), abs=1e-8)
    assert NEO_HOOKEAN.micropolar is False
