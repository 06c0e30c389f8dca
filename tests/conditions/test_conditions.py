"""Supports and loads: functions of the load factor, and errors that name the culprit."""

from __future__ import annotations

import functools

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.conditions.amplitudes import Amplitude
from polarmpm.conditions.loads import point_loads
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, beam, by_id
from tests.helpers.bodies import box


def tip_of(problem: pm.QuasiStatic) -> pm.Selection:
    return problem.points.farthest((1.0, 0.0, 0.0)[: problem.grid.dim])


# bad input ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("component", ["uz", "theta_x", "v", "U", "x"])
def test_unknown_component(component):
    """The name and the names that exist here are in the message."""
    problem = beam(2)
    with pytest.raises(pm.InputError, match=f"unknown component '{component}'.*ux, uy, theta"):
        problem.fix(pm.plane(y=0.0), **{component: 0.0})
    assert len(problem.supports) == 1  # nothing has been changed


def test_rotations_and_couples_need_a_micropolar_material():
    """Both messages tell that the material has no microrotation."""
    problem = beam(3, NEO_HOOKEAN)
    for component in ("theta", "theta_z"):
        with pytest.raises(pm.InputError, match=f"'{component}'.*no microrotation"):
            problem.fix(pm.plane(x=0.0), **{component: 0.0})
    with pytest.raises(pm.InputError, match=r"couple = .*no microrotation"):
        problem.load(tip_of(problem), couple=(0, 0, 1.0))
    with pytest.raises(pm.InputError, match=r"couple = .*no microrotation"):
        problem.body_load(couple=(0, 0, 1.0))


def test_no_component_and_component_given_twice():
    """A support without a component, and one that names ux alone and within u."""
    problem = beam(2)
    with pytest.raises(pm.InputError, match="no component"):
        problem.fix(pm.plane(x=0.0))
    with pytest.raises(pm.InputError, match="'ux' is given twice"):
        problem.fix(pm.plane(x=0.0), u=0, ux=0)


def test_contradictory_supports_name_the_node():
    """Two values for one unknown: both supports, the component, the node and the values are named."""
    problem = beam(2)
    problem.fix(lambda x: (x[:, 0] < 0.5) & (abs(x[:, 1] - 1.0) < 1e-9), uy=0.25)
    with pytest.raises(
        pm.InputError, match=r"support 2 .*contradicts support 1 \(x = 0\).*uy.*\(0\.0, 1\.0\).*0\.25 and 0"
    ):
        list(problem.march(1))
    assert problem.progress.step == 0


def test_equal_values_are_no_contradiction():
    """Supports may overlap where they agree."""
    problem = beam(2)
    problem.fix(pm.plane(y=0.0), uy=0.0)
    problem.fix(lambda x: x[:, 0] < 0.5, ux=0.0)
    problem.load(tip_of(problem), force=(5.0, 0.0))
    assert len(list(problem.march(1))) == 1


def test_supports_that_agree_to_rounding():
    """A half sine ends at 1.2e-16 times its size, not at zero; a real contradiction of that size is one."""
    for small, agree in ((0.0, True), (1e-6, False)):
        problem = beam(2)
        problem.fix(lambda x: x[:, 0] < 0.5, uy=small)
        problem.fix(lambda x: x[:, 1] > 1.5, uy=lambda t, x: 0.02 * t * np.sin(np.pi * (1.0 + x[:, 0])))
        if agree:
            list(problem.march(1))
        else:
            with pytest.raises(pm.InputError, match=r"support 2 .* contradicts support 1"):
                list(problem.march(1))


@pytest.mark.parametrize("basis", ["mpm", "bspline"])
def test_a_support_on_nothing(basis):
    """Named when the first step begins, with the places where nodes are; also of nodes without any weight."""
    for nowhere in (
        lambda x: np.zeros(len(x), dtype=bool),
        lambda x: abs(x[:, 0] - 1.1) < 1e-6,
        lambda x: x[:, 1] < -2.0,
    ):
        grid = pm.Grid.box((0, -3), (6, 3), 1.0)
        points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0, 0), (3, 1)))
        problem = pm.QuasiStatic(grid, points, basis=basis)
        problem.fix(pm.plane(x=0.0), u=0)
        lost = problem.fix(nowhere, u=0)
        with pytest.raises(pm.InputError, match=r"support 2 \(<lambda>\) holds nothing.*x = .*0.*; y = "):
            list(problem.march(1))
        problem.release(lost)
        problem.load(tip_of(problem), force=(1.0, 0.0))
        assert len(list(problem.march(1))) == 1
        problem.fix(nowhere, u=0)  # in mid-run too
        with pytest.raises(pm.InputError, match="holds nothing"):
            list(problem.march(1, to=2.0))
    solid = pm.QuasiStaticFEM(pm.Elements(box("quadrilateral", (4, 1), (4.0, 1.0)), material=MICROPOLAR))
    with pytest.raises(pm.InputError, match="holds nothing"):  # at once: a mesh knows its nodes
        solid.fix(lambda x: x[:, 0] > 5.0, u=0)
    assert solid.supports == ()


def test_nodes_that_no_point_weights_hold_nothing():
    """Points on a plane of the grid touch the nodes of both cells, without weight at the far ones."""
    grid = pm.Grid.box((0, 0), (4, 2), 1.0)
    points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0, 0), (2, 1)), points_per_cell=1)
    points.x = points.X = points.x + np.array([0.5, 0.0]) * (points.x > [1.0, 9.0])
    problem = pm.QuasiStatic(grid, points, basis="mpm")
    problem.fix(pm.plane(x=0.0), u=0)
    problem.fix(pm.plane(x=3.0), ux=0)
    with pytest.raises(pm.InputError, match=r"support 2 \(x = 3\) holds nothing"):
        list(problem.march(1))


def test_one_number_for_a_vector():
    """Only zero may stand for all components; the message shows how to write what is meant."""
    problem = beam(2)
    tip, line = tip_of(problem), pm.Surface.line((3.5, 0.3), (3.5, 1.3), 4)
    for act, hint in (
        (lambda: problem.load(tip, force=-1e4), r"force=\(-10000.0, 0\)"),
        (lambda: problem.body_load(force=9.81), r"force=\(9.81, 0\)"),
        (lambda: problem.fix(pm.plane(y=0.0), u=0.1), r"u=\(0.1, 0\)"),
        (lambda: problem.traction(line, force=2.0), r"force=\(2.0, 0\)"),
        (lambda: problem.load(line, force=lambda t: 3.0), r"force=\(3.0, 0\)"),
        (lambda: problem.fix(pm.plane(y=0.0), u=lambda t: 0.1 * t), r"u=\(0.1, 0\)"),
    ):
        with pytest.raises(pm.InputError, match=f"one number .*for 2 components; write {hint}"):
            act()
    assert (len(problem.supports), len(problem.loads), len(problem.terms)) == (1, 0, 0)
    space = beam(3)
    with pytest.raises(pm.InputError, match=r"couple=\(5.0, 0, 0\)"):
        space.load(tip_of(space), couple=5.0)
    with pytest.raises(pm.InputError, match=r"theta=\(0.1, 0, 0\)"):
        space.fix(pm.plane(y=0.0), theta=0.1)
    problem.fix(pm.plane(x=0.0), u=0.0)  # zero is zero
    problem.load(tip, force=lambda t: 0.0)
    problem.body_load(force=lambda t, X: t * X[:, 0])
    with pytest.raises(pm.InputError, match=r"body load 2, force returned one number .* for each position"):
        list(problem.march(1))


def test_selections_that_are_none_of_the_body():
    """Of another seeding, unsorted, repeated, with ids that don't exist."""
    problem = beam(2)
    points, grid = problem.points, problem.grid
    other = pm.seed(grid, material=MICROPOLAR, points_per_cell=4, bounds=((0, 0), (3.5, 1.0)))
    same = beam(2).points
    for ids in ([3, 1], [1, 1], [[1, 2]], [0.5, 1.5]):
        with pytest.raises(pm.InputError, match="Selection: ids"):
            pm.Selection(np.array(ids))
    strange = other.farthest((1, 0)), pm.Selection(np.array([1, 10**6]))
    for selection, message in zip(strange, ("of another body", "1 of its 2 ids"), strict=True):
        for act in (
            lambda s=selection: problem.load(s, force=(1.0, 0.0)),
            lambda s=selection: problem.body_load(force=(1.0, 0.0), on=s),
            lambda s=selection: points.mean_displacement(s),
            lambda s=selection: points.assign(s, MICROPOLAR),
        ):
            with pytest.raises(pm.InputError, match=message):
                act()
    assert problem.loads == ()
    problem.load(pm.Selection(np.array([1, 2, 3])), force=(1.0, 0.0))  # by hand
    problem.load(same.farthest((1, 0)), force=(1.0, 0.0))  # the very same points, made again
    list(problem.march(2))


def test_selections_stay_valid():
    """While points move, between ranks too, get another material, and are joined by others."""
    grid = pm.Grid.box((0, 0), (8, 2), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, bounds=((0, 0), (2, 1)))
    more = pm.seed(grid, material=MICROPOLAR, bounds=((2, 0), (4, 1)))
    mine, theirs = points.farthest((1, 0)), more.farthest((1, 0))
    x = points.mean(points.X, mine)
    points.join(more)
    np.testing.assert_allclose(points.mean(points.X, mine), x)
    with pytest.raises(pm.InputError, match="another body"):
        points.mean(points.X, theirs)  # its ids are others now
    every = points.where(lambda x: x[:, 0] > 3.0)
    points.assign(every, pm.MicropolarElastic(lam=3e3, mu=2e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=18.0))
    points.migrate((np.arange(len(points)) + COMM.rank) % COMM.size)
    np.testing.assert_allclose(points.mean(points.X, mine), x)
    assert points.mean(points.X, every)[0] == pytest.approx(3.5)


def test_facets_of_another_mesh():
    coarse, fine = (
        pm.Elements(box("quadrilateral", n, (4.0, 1.0)), material=MICROPOLAR) for n in ((4, 1), (8, 2))
    )
    problem = pm.QuasiStaticFEM(coarse)
    for act in (
        lambda: problem.load(fine.farthest((1, 0)), force=(1.0, 0.0)),
        lambda: problem.fix(fine.farthest((1, 0)), u=0),
        lambda: coarse.mean_displacement(fine.farthest((1, 0))),
    ):
        with pytest.raises(pm.InputError, match="of another body"):
            act()


@pytest.mark.parametrize("bad", [np.nan, np.inf, (0.0, np.nan)])
def test_constant_that_is_not_finite(bad):
    """Refused at once, with the name of the condition."""
    problem = beam(2)
    with pytest.raises(pm.InputError, match=r"load 1, force is (nan|inf) "):
        problem.load(tip_of(problem), force=bad)
    with pytest.raises(pm.InputError, match=r"support 2 .*, u is (nan|inf) "):
        problem.fix(pm.plane(y=0.0), u=bad)


def test_nan_in_a_load_function_names_load_and_factor():
    """A function that breaks at a later factor: the message has load and factor, the state is intact."""
    problem = beam(2)
    problem.load(tip_of(problem), force=(1.0, 0.0))
    problem.load(tip_of(problem), force=lambda t: (0.0, np.nan if 0.3 < t < 0.7 else 1.0))
    march = problem.march(4)
    next(march)
    before = problem.points.x.copy()
    with pytest.raises(pm.InputError, match=r"load 2, force is nan at load factor 0\.5"):
        next(march)
    np.testing.assert_array_equal(problem.points.x, before)
    assert problem.progress.factor == 0.25


def test_nan_in_a_field_names_load_and_factor():
    """Functions of position are checked for every point."""
    problem = beam(2)
    problem.body_load(force=lambda t, X: np.stack([X[:, 0] * np.nan, X[:, 1]], axis=1))
    with pytest.raises(pm.InputError, match=r"body load 1, force is nan at load factor 1"):
        list(problem.march(1))


@pytest.mark.parametrize("bad", ["heavy", (1.0, 2.0, 3.0), [[1.0, 2.0]], None])
def test_wrong_kind_of_value(bad):
    """Not a number, or the wrong number of components."""
    problem = beam(2)
    with pytest.raises(pm.InputError, match="force"):
        problem.load(tip_of(problem), force=bad)
    assert not problem.loads


def test_function_that_returns_the_wrong_size():
    """Found before anything is solved; the message shows what came back."""
    problem = beam(2)
    with pytest.raises(pm.InputError, match=r"force returned \(1, 2, 3\).*2 number"):
        problem.load(tip_of(problem), force=lambda t: (1, 2, 3))


def test_load_on_nothing():
    """An empty selection, something that is no selection, and a load without a value."""
    problem = beam(2)
    nothing = problem.points.where(lambda x: x[:, 0] > 100.0)
    assert len(nothing) == 0
    with pytest.raises(pm.InputError, match="load 1: the selection contains no point"):
        problem.load(nothing, force=(1.0, 0.0))
    with pytest.raises(pm.InputError, match="selection = "):
        problem.load([1, 2], force=(1.0, 0.0))
    with pytest.raises(pm.InputError, match="neither force nor couple"):
        problem.load(tip_of(problem))


def test_plane_that_is_not_on_the_grid():
    """Between two planes, outside the box, along an axis that isn't there; the grid's planes are named."""
    problem = beam(2)
    for value in (0.5, 7.0, -2.0):
        with pytest.raises(
            pm.InputError, match=rf"plane x = {value:g} is not a plane of the grid.*-1 \+ k 1 up to 6"
        ):
            problem.fix(pm.plane(x=value), u=0)
    with pytest.raises(pm.InputError, match="plane z: the grid has 2 dimensions"):
        problem.fix(pm.plane(z=0.0), u=0)
    for wrong in ({}, {"x": 0.0, "y": 0.0}, {"r": 1.0}):
        with pytest.raises(pm.InputError, match="exactly one of x, y, z"):
            pm.plane(**wrong)
    with pytest.raises(pm.InputError, match="beyond = 'left'"):
        pm.plane(x=0.0, beyond="left")


def test_predicate_that_returns_no_bool():
    """What it returned is shown."""
    problem = beam(2)
    problem.fix(lambda x: x[:, 0], u=0)
    with pytest.raises(pm.InputError, match=r"support 2 .*float64"):
        list(problem.march(1))
    with pytest.raises(pm.InputError, match="where = 3"):
        problem.fix(3, u=0)


# what conditions do -------------------------------------------------------------------------------
def values_at(problem: pm.QuasiStatic, factor: float) -> tuple[np.ndarray, np.ndarray]:
    forces, couples = point_loads(problem.loads, problem.points, problem.layout, factor)
    return by_id(problem.points, forces), by_id(problem.points, couples)


def test_numbers_are_ramped_and_functions_are_not():
    """Totals at factor 0.25, shared by the selected points, here of equal volumes."""
    problem = beam(2)
    tip = tip_of(problem)
    problem.load(tip, force=(8.0, -4.0), couple=2.0)
    problem.load(tip, force=lambda t: (0.0, 100 * t**2))
    forces, couples = values_at(problem, 0.25)
    np.testing.assert_allclose(forces.sum(axis=0), (2.0, -1.0 + 6.25))
    assert couples.sum() == pytest.approx(0.5)
    loaded = np.flatnonzero(np.any(forces != 0.0, axis=1))
    np.testing.assert_array_equal(loaded, tip.ids)
    np.testing.assert_allclose(forces[tip.ids], np.tile(forces[tip.ids[0]], (len(tip), 1)))


def test_totals_act_in_the_middle_of_what_is_selected():
    """Of points that the body's edges cut: force and couple are shared by volume, and a mean over them is the
    one over the layer, also of parts of points."""
    grid = pm.Grid.box((-1.0, -1.0), (4.0, 3.0), 0.5, COMM)
    points = pm.seed(grid, bounds=((0.0, 0.07), (2.9, 1.3)), material=MICROPOLAR)
    problem = pm.QuasiStatic(grid, points)
    tip = points.where(lambda x: x[:, 0] > 2.7)  # (2.75, 2.9) by (0.07, 1.3), cut on three sides
    assert points.volume_of(tip) == pytest.approx(0.15 * 1.23, rel=1e-12)
    middle = (0.5 * (2.75 + 2.9), 0.5 * (0.07 + 1.3))
    problem.load(tip, force=(3.0, -8.0), couple=2.0)
    forces, couples = values_at(problem, 1.0)
    X, volume = by_id(points, points.X), by_id(points, points.volume0)
    np.testing.assert_allclose(forces.sum(axis=0), (3.0, -8.0), rtol=1e-13)
    np.testing.assert_allclose(couples.sum(), 2.0, rtol=1e-13)
    turning = X[:, 0] * forces[:, 1] - X[:, 1] * forces[:, 0]
    assert turning.sum() == pytest.approx(middle[0] * -8.0 - middle[1] * 3.0, rel=1e-12)
    np.testing.assert_allclose(forces[tip.ids, 1] / volume[tip.ids], -8.0 / (0.15 * 1.23), rtol=1e-12)
    np.testing.assert_allclose(points.mean(points.X, tip), middle, rtol=1e-12)
    np.testing.assert_allclose(points.mean(points.X), (1.45, 0.5 * 1.37), rtol=1e-12)


def test_body_loads_are_densities_of_reference_volume():
    """Constants, functions of the factor, and functions of factor and initial position."""
    problem = beam(2)
    points = problem.points
    problem.body_load(force=(0.0, -3.0))
    problem.body_load(
        force=lambda t, X: np.stack([t * X[:, 0], 0 * X[:, 0]], axis=1), couple=lambda t: 5.0 * t
    )
    points.x = points.x + 0.1  # positions since the start don't matter
    forces, couples = values_at(problem, 0.5)
    X, volume = by_id(points, points.X), by_id(points, points.volume0)
    np.testing.assert_allclose(
        forces, np.stack([0.5 * X[:, 0], np.full(len(X), -1.5)], axis=1) * volume[:, None]
    )
    np.testing.assert_allclose(couples[:, 0], 2.5 * volume)


def test_a_scalar_field_fills_one_component():
    """A function of (t, X) may return one number a point where one is needed."""
    problem = beam(2)
    problem.body_load(couple=lambda t, X: t * X[:, 0])
    _, couples = values_at(problem, 1.0)
    X, volume = by_id(problem.points, problem.points.X), by_id(problem.points, problem.points.volume0)
    np.testing.assert_allclose(couples[:, 0], X[:, 0] * volume)


def test_callables_of_every_kind():
    """Defaults don't count as arguments; partials, ufuncs and objects are functions of the factor."""

    class Ramp:
        def __call__(self, t):
            return 2 * t

    for function in (
        lambda t, rate=2: rate * t,
        functools.partial(lambda a, t: a * t, 2),
        Ramp(),
        lambda t: 2 * t,
    ):
        assert Amplitude("a", function, 1).at(0.25, np.zeros((3, 2))).tolist() == [[0.5]] * 3
    assert Amplitude("a", np.sqrt, 1).at(0.25, np.zeros((1, 2)))[0, 0] == 0.5


def test_plane_takes_the_nodes_behind_the_wall():
    """Domains reach behind the body's own face: those nodes are held too, but none in the body."""
    grid = pm.Grid.box((-1, -1), (4, 3), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, bounds=((0, 0), (3, 2)))
    points.half_length0 = points.half_length0 + 0.1  # reach across the faces
    for beyond, expected in (("auto", {-1.0, 0.0}), ("below", {-1.0, 0.0}), ("none", {0.0})):
        problem = pm.QuasiStatic(grid, points, **pm.PUBLISHED)
        problem.fix(pm.plane(x=0.0, beyond=beyond), u=0, theta=0)
        problem.fix(pm.plane(y=2.0), uy=0)
        system = problem.system_at(0.0)
        x = system.nodes.position
        fixed = system.prescribed.fixed
        held = COMM.allgather(set(np.unique(x[fixed[:, 0], 0])))
        assert set().union(*held) == expected
        roller = fixed[:, 1] & ~fixed[:, 0]
        held = COMM.allgather(set(np.unique(x[roller, 1])))
        assert set().union(*held) == {2.0, 3.0}


def test_prescribed_functions_are_totals(strict):
    """A displacement as a function of the factor is reached at every step, however the grid is reset."""
    for reset in (1, 3, None):
        problem = beam(2, basis="mpm", reset=reset, controls=strict)
        problem.fix(
            pm.plane(x=4.0), ux=lambda t: 0.2 * np.sin(np.pi * t), uy=lambda t, x: 0.1 * t**2 + 0 * x[:, 0]
        )
        for step in problem.march(4):
            nodes = problem.system.nodes
            totals = problem.system.prescribed.totals(step.factor)
            at = abs(nodes.position[:, 0] - 4.0) < 1e-9
            np.testing.assert_allclose(totals[at, 0], 0.2 * np.sin(np.pi * step.factor), atol=1e-15)
        # the end is back where it was along x, and moved by 0.1 along y
        moved = problem.points.mean_displacement(tip_of(problem))
        assert abs(moved[0]) < 0.05
        assert 0.05 < moved[1] < 0.15


def test_roller_lets_the_body_slide():
    """Uniaxial stretch between rollers: uniform stretch, and no shear anywhere."""
    grid = pm.Grid.box((-1, -1), (5, 3), 1.0)
    points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0, 0), (4, 2)))
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(pm.plane(x=4.0), ux=0.4)
    list(problem.march(1))
    F = by_id(points, points.F)
    np.testing.assert_allclose(F[:, 0, 0], 1.1, atol=1e-9)
    assert np.all(F[:, 1, 1] < 1.0)
    np.testing.assert_allclose(F[:, [0, 1], [1, 0]], 0.0, atol=1e-9)
    np.testing.assert_allclose(problem.fields().stress[:, 1, 1], 0.0, atol=1e-6)


def test_conditions_added_between_steps(strict):
    """A load or support that comes later changes the rest of the path only, with and without resets."""
    for reset in (1, None):
        whole = beam(2, basis="mpm", reset=reset, controls=strict)
        whole.fix(pm.plane(x=3.0), ux=0.2)
        whole.load(tip_of(whole), force=lambda t: (0.0, -4.0 * max(0.0, t - 0.5)))
        list(whole.march(2))
        parts = beam(2, basis="mpm", reset=reset, controls=strict)
        parts.fix(pm.plane(x=3.0), ux=0.2)
        list(parts.march(1, to=0.5))
        parts.load(whole.loads[0].selection, force=lambda t: (0.0, -4.0 * max(0.0, t - 0.5)))
        list(parts.march(1))
        expected = by_id(whole.points, whole.points.x)
        np.testing.assert_allclose(by_id(parts.points, parts.points.x), expected, atol=1e-9)
