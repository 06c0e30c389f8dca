"""The tangent-linear run and twins: two ways to the same derivatives, each the other's test."""

from __future__ import annotations

import warnings
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.assembly import carrying
from polarmpm.sensitivity.differences import along
from tests.conftest import COMM
from tests.helpers.bodies import box
from tests.sensitivity import scenes
from tests.sensitivity.scenes import BEAM, SOIL, differences, digits, rates


def agreement(build: Any, values: dict[str, float], names: list[str], march: Any) -> float:
    """Digits to which both agree."""
    exact = rates(build, values, names, march, method="exact")
    return digits(rates(build, values, names, march), exact)


def marches(steps: int) -> Any:
    return lambda run: run.march(steps=steps)


@pytest.mark.parametrize(
    ("build", "values"), [(scenes.column, SOIL), (scenes.elements, SOIL), (scenes.cantilever, BEAM)]
)
def test_moduli_multiply_as_kernels_do(build: Any, values: dict[str, float]) -> None:
    rng = np.random.default_rng(COMM.rank)
    with pm.Sensitivity(build, values, list(values)[:1], method="exact") as run:
        list(run.march(steps=2))
        assert run._linear is not None
        batch, at = run._linear.batches[0], run._linear.at[0]
        assert at.moduli is not None
        dz = rng.standard_normal(at.z.shape)
        dzk = None if at.zk is None else rng.standard_normal(at.zk.shape)
        own = batch.respond(at, dz, dzk, None)
        kernels = batch.respond(replace(at, make_moduli=None), dz, dzk, None)
        for a, b in zip(own, kernels, strict=True):
            if a is not None and b is not None:
                np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(b).max(initial=0.0))


@pytest.mark.parametrize(
    "options",
    [
        {"basis": "bspline"},
        {"reset": pm.WhenDistorted(0.1)},
        {"basis": "bspline", "balanced_reset": False},
        {"basis": "mpm"},
        {"basis": "gimpm", "ghost": "light"},
        {"locking": "always"},
    ],
)
@pytest.mark.filterwarnings("ignore:balanced_reset")
def test_cantilever(options):
    assert agreement(partial(scenes.cantilever, **options), BEAM, ["E", "l"], marches(3)) >= 6


@pytest.mark.parametrize(
    "options", [{}, pytest.param({"reset": pm.WhenDistorted(0.2)}, marks=pytest.mark.slow)]
)
def test_flow_under_a_platen(options):
    """Scalars that are averaged over patches, boxes, points that yield, a grid that follows a platen."""
    scene = partial(scenes.column, **options)
    assert agreement(scene, SOIL, ["c", "kappa", "H"], marches(3)) >= 6


def test_classical_points():
    """Loads and what is prescribed depend on parameters, too."""

    def build(p: dict[str, float]) -> Any:
        grid = pm.Grid.box((0, -3), (6, 3), 1.0)
        points = pm.seed(
            grid, bounds=((0, 0.13), (4.7, 1.21)), material=pm.NeoHookean(lam=p["lam"], mu=p["mu"])
        )
        problem = pm.QuasiStatic(grid, points, reset=1)
        problem.fix(lambda x: x[:, 0] < 0.1, ux=p["pushed"], uy=0)
        tip = points.farthest((1, 0))
        problem.load(tip, force=(0, -p["force"]))
        problem.load(points.where(lambda x: x[:, 0] > 2), force=lambda t: (t**2 * p["force"], 0))
        return problem, {
            "tip": lambda: points.mean_displacement(tip) / p["pushed"],
            "stress": lambda: points.mean(problem.fields("stress").stress[:, 0]),
        }

    values = {"lam": 3e5, "mu": 2e5, "pushed": 0.1, "force": 1e3}
    assert agreement(build, values, list(values), marches(3)) >= 6


@pytest.mark.parametrize("options", [{}, {"basis": "mpm"}])
def test_along_the_path(options):
    scene, values = partial(scenes.arch, **options), {**BEAM, "l": 0.1}
    assert agreement(scene, values, ["E", "l"], lambda run: run.march_arc_length(0.2, steps=4)) >= 6


@pytest.mark.slow
def test_couples_in_space():
    assert agreement(scenes.shaft, BEAM, ["E", "l"], marches(2)) >= 6


def test_surfaces():
    """Held by the material's own tractions, under a pressure that turns with the body."""
    assert agreement(scenes.held_on_surfaces, BEAM, ["E", "l", "n"], marches(3)) >= 6


def two_bodies(p: dict[str, float], **options: Any) -> Any:
    """Two cantilevers that lie on each other and share cells, but no nodes."""
    grid = pm.Grid.box((0, -3), (6, 4), 1.0)
    points = pm.seed(grid, bounds=((0, 0.13), (4.7, 2.53)), material=scenes.elastic(p), points_per_cell=3)
    points.separate(points.where(lambda x: x[:, 1] > 1.31))
    problem = pm.QuasiStatic(grid, points, reset=1, **options)
    root = problem.fix(pm.plane(x=0.0), u=0, theta=0)
    upper = points.nearest((4.7, 2.5))
    problem.load(upper, force=(0, 6e4 * p["n"]))
    problem.load(points.nearest((4.7, 0.2)), force=(0, -4e4))
    return problem, {
        "tip": lambda: points.mean_displacement(upper),
        "squares": lambda: points.mean(points.x**2),
        "root": lambda: problem.reaction(root).couple[0],
    }


@pytest.mark.parametrize("options", [{}, {"basis": "gimpm", "locking": "always"}])
def test_several_bodies(options):
    scene = partial(two_bodies, **options)
    assert agreement(scene, BEAM, ["E", "l", "n"], marches(3)) >= 6
    found = rates(scene, BEAM, ["l"], marches(3), method="exact")
    assert digits(found, differences(scene, BEAM, ["l"], marches(3), 1e-6)) >= 6


def revolution(p: dict[str, float], **options: Any) -> Any:
    """A thick ring that is stretched along the axis and loaded across it."""
    grid = pm.Grid.box((0, 0), (4, 4), 0.5)
    points = pm.seed(grid, bounds=((1.13, 0), (2.62, 2.0)), material=scenes.elastic(p), axisymmetric=True)
    problem = pm.QuasiStatic(grid, points, reset=1, boxes=False, **options)
    problem.fix(pm.plane(y=0.0), uy=0, theta=0)
    top = points.farthest((0, 1))
    problem.load(top, force=(5e6 * p["n"], 1e7))
    return problem, {
        "places": lambda: points.mean(points.x**2),
        "top": lambda: points.mean_displacement(top),
        "hoop": lambda: points.mean(points.F[:, 2, 2] ** 2),
    }


@pytest.mark.parametrize(
    "options", [{}, {"basis": "gimpm"}, pytest.param({"basis": "mpm"}, marks=pytest.mark.slow)]
)
def test_bodies_of_revolution(options):
    scene = partial(revolution, **options)
    assert agreement(scene, BEAM, ["E", "l", "n"], marches(3)) >= 6
    found = rates(scene, BEAM, ["l"], marches(3), method="exact")
    assert digits(found, differences(scene, BEAM, ["l"], marches(3), 1e-6)) >= 6


def ground(p: dict[str, float], *, plastic: bool = False, **options: Any) -> Any:
    """A block of ground at rest under its weight, on whose top a footing stands then."""
    grid = pm.Grid.box((0, 0), (5, 5), 1.0)
    material = scenes.elastic(p)
    if plastic:
        material = pm.DruckerPrager(material, cone="compression", phi=0.5, psi=0.1, c=2e4, H=0.0, l_p=0.1)
    points = pm.seed(grid, bounds=((0, 0), (5, 3.4)), material=material)
    problem = pm.QuasiStatic(grid, points, **{"reset": 1, **options})
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(x=5.0), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    rest = pm.K0(weight=2e4, K0=0.5, surface=3.4)
    problem.body_load(force=rest.force)
    problem.initial_stress(rest)
    top = points.where(lambda x: (x[:, 1] > 3.0) & (x[:, 0] < 2.0))
    problem.load(top, force=(0, -8e4))
    return problem, {
        "top": lambda: points.mean_displacement(top),
        "shear": lambda: points.mean(problem.fields("stress").stress[:, 0, 1] ** 2),
    }


@pytest.mark.parametrize(
    "options", [{}, {"basis": "mpm"}, pytest.param({"plastic": True}, marks=pytest.mark.slow)]
)
def test_initial_stresses(options):
    """Whose elastic deformation depends on the moduli, and what the basis can't balance of them. Stresses
    hardly depend on E, and of their differences 1e-14 in the elastic law's inverse leave five digits."""
    scene, values = partial(ground, **options), {**BEAM, "E": 2e7}
    exact = rates(scene, values, ["E", "l", "n"], marches(3), method="exact")
    twins = rates(scene, values, ["l", "n"], marches(3))
    assert digits(exact, twins) >= 6
    whole = differences(scene, values, ["E"], marches(3), 1e-4)
    assert digits(exact, {"top": whole["top"]}) >= 6


class Winkler(pm.SurfaceTerm):
    def energy(self, at: Any, p: Any) -> Any:
        return p.k / 2 * ufl.dot(at.u, at.normal) ** 2


@pytest.mark.slow
def test_springs_and_tractions():
    """What holds the body is carried by resets; numbers of a term of one's own, and of a traction that
    follows, depend on a parameter."""

    def build(p: dict[str, float]) -> Any:
        problem, _ = scenes.cantilever(p, force=1e4)
        x = 0.13 + 0.135 * (np.arange(8) + 0.5)
        sides = [(0.0, (-1.0, 0.0)), (4.7, (1.0, 0.0))]
        left, right = (scenes._side(np.full(8, at), x, 0.135, normal) for at, normal in sides)
        held = problem.fix(left, ux=0, method="penalty", stiffness=1e8 * p["n"], augment=True)
        problem.traction(right, force=(3e4, -1e5 * p["l"]), couple=1e3, follows=True)
        problem.add(Winkler("bed", right, {"k": 1e6 * p["l"]}))
        points = problem.points
        return problem, {
            "places": lambda: points.mean(points.x**2),
            "moment": lambda: problem.reaction(held).moment,
        }

    assert agreement(build, BEAM, ["l", "n"], marches(3)) >= 6


def test_elements_that_flow():
    """Scalars that are averaged over elements, points that yield."""
    assert agreement(scenes.elements, SOIL, ["c", "kappa", "H"], marches(3)) >= 6


def of_elements(p: dict[str, float], *, axisymmetric: bool = False, along: bool = False) -> Any:
    """Loads on facets that depend on parameters, dead or turning with the body; observables of its nodes."""
    body = pm.Elements(
        box("quadrilateral", (6, 2), (4.7, 1.1)),
        material=scenes.elastic(p),
        degree=1,
        axisymmetric=axisymmetric,
    )
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(y=0.0) if axisymmetric else pm.plane(x=0.0), u=0)
    problem.load(pm.plane(x=4.7), force=(-1e6 * p["l"], -5e4))
    if not along:
        problem.pressure(pm.plane(y=1.1), (4e6 if axisymmetric else 1e5) * p["l"])
    e, points = problem.elements, problem.points
    own = slice(0, e.nodes.owned)
    return problem, {
        "ends": lambda: e.comm.allreduce(
            np.hstack([e.displacement[own] ** 2, e.q[own, 1:] ** 2]).sum(axis=0)
        ),
        "stress": lambda: points.mean(problem.fields("stress").stress[:, 0, 0]),
        "factor": lambda: problem.progress.factor + p["n"],
    }


@pytest.mark.parametrize(
    ("options", "march"),
    [
        ({}, marches(3)),
        pytest.param({"axisymmetric": True}, marches(2), marks=pytest.mark.slow),
        ({"along": True}, lambda run: run.march_arc_length(0.2, steps=3)),
    ],
)
def test_elements_under_loads_on_facets(options, march):
    assert agreement(partial(of_elements, **options), BEAM, ["n", "l"], march) >= 6


@pytest.mark.slow
def test_elements_in_space():
    """Couples on facets, whose work depends on the rotation; relative rotations that are averaged."""

    def build(p: dict[str, float]) -> Any:
        body = pm.Elements(box("hexahedron", (2, 2, 3), (1.7, 1.7, 3.0)), material=scenes.elastic(p))
        problem = pm.QuasiStaticFEM(body)
        problem.fix(pm.plane(z=0.0), u=0, theta=0)
        problem.load(pm.plane(z=3.0), couple=(3e5, 0, 1e6 * p["n"]), force=(1e5, 0, 0))
        points = problem.points
        return problem, {"places": lambda: points.mean(points.x**2)}

    assert agreement(build, BEAM, ["E", "n", "l"], marches(2)) >= 6


def test_numbers_that_dont_matter():
    values = {**BEAM, "unused": 3.0}
    found = rates(scenes.cantilever, values, ["E", "unused"], marches(2), method="exact")
    assert np.all(found["tip"]["unused"] == 0.0)


@pytest.mark.parametrize("scene", [scenes.cantilever, scenes.column])
def test_the_run_is_the_same_to_the_last_bit(scene):
    values = BEAM if scene is scenes.cantilever else SOIL
    alone, _ = scene(values)
    expected = [step.history for step in alone.march(2)]
    with pm.Sensitivity(scene, values, list(values)[:1], method="exact") as run:
        for step, history in zip(run.march(2), expected, strict=True):
            if COMM.size == 1:  # else factors aren't the same to the last bit, run by run
                assert step.history == history
        for name in ("x", "F", "q", "wryness"):
            found, once = getattr(run.problem.points, name), getattr(alone.points, name)
            np.testing.assert_allclose(found, once, rtol=0, atol=0 if COMM.size == 1 else 1e-9)


@pytest.mark.mpi
@pytest.mark.timeout(300)
def test_two_ranks_whose_points_move():
    scenes.assert_two_ranks_agree("exact", 1e-8)


def test_differences_far_from_rounding():
    x, dx = np.linspace(0.5, 2.0, 7), np.linspace(-1.0, 3.0, 7)
    np.testing.assert_allclose(along(np.exp, [x], [dx]), np.exp(x) * dx, rtol=1e-11, atol=1e-11)
    assert np.all(along(np.exp, [x], [np.zeros(7)]) == 0.0)


def half_a_cell_thick(p: dict[str, float]) -> Any:
    """Points feel nothing of some motions: a shift chooses what a reset carries."""
    grid = pm.Grid.box((0, -6), (12, 3), 1.0)
    points = pm.seed(grid, bounds=((0, 0), (10, 0.5)), material=scenes.elastic(p), points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, reset=1)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0)), force=(0, -2e4))
    return problem, {"x": lambda: points.mean(points.x)}


def test_a_reset_with_motions_that_no_point_feels():
    assert agreement(half_a_cell_thick, BEAM, ["E"], marches(4)) >= 6


@pytest.mark.parametrize("method", ["twins", "exact"])
def test_a_reset_that_is_ill_determined(method, monkeypatch):
    """Answers are noise where the material hardly resists what a reset moves; the run says so, once."""
    monkeypatch.setattr(carrying, "_unresisted", lambda *of_motion: 0.3)
    with pm.Sensitivity(half_a_cell_thick, BEAM, ["E"], method=method) as run:
        march = run.march(4)
        next(march)
        told = pytest.warns(pm.TrustWarning, match="resisted by nothing") if COMM.rank == 0 else nullcontext()
        with pytest.raises(pm.NotDifferentiable, match="resisted by nothing"), told:
            next(march)
    alone, _ = half_a_cell_thick(BEAM)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(alone.march(4, progress=False))
    assert sum("resisted by nothing" in str(w.message) for w in caught) == int(COMM.rank == 0)
    assert "in doubt" in alone.trust()


# what is refused --------------------------------------------------------------------------------
def of_energies(p: dict[str, float], **options: Any) -> Any:
    problem, _ = scenes.cantilever(p, **options)
    return problem, {"work": lambda: sum(problem.energies().values())}


def ring_with_boxes(p: dict[str, float]) -> Any:
    """A body of revolution whose points have boxes."""
    _, observables = scenes.held_on_surfaces(p)
    ring = pm.Grid.box((0, 0), (4, 4), 1.0)
    points = pm.seed(ring, bounds=((1, 0), (3, 2)), material=scenes.elastic(p), axisymmetric=True)
    return pm.QuasiStatic(ring, points), observables


def elements_at_rest(p: dict[str, float]) -> Any:
    problem, observables = of_elements(p)
    problem.initial_stress(np.zeros((3, 3)))
    return problem, observables


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            ring_with_boxes,
            r'the boxes of points of a body of revolution.* aren\'t carried; take method="twins"',
        ),
        (elements_at_rest, "initial stresses of elements aren't carried"),
    ],
)
def test_what_isnt_carried(build, message):
    with pytest.raises(pm.InputError, match=message):
        pm.Sensitivity(build, BEAM, method="exact")


def test_surfaces_along_the_path():
    with (
        pm.Sensitivity(scenes.held_on_surfaces, BEAM, ["E"], method="exact") as run,
        pytest.raises(pm.InputError, match="conditions on surfaces along the path aren't carried"),
    ):
        run.march_arc_length(0.1, steps=2)


def dilating(p: dict[str, float], **options: Any) -> Any:
    """A classical block that dilates as it shears, clamped below and pushed aside."""
    grid = pm.Grid.box((0, 0), (2, 1), 0.5)
    elastic = pm.Hencky.from_engineering(E=1e4, nu=0.3)
    soil = pm.MohrCoulomb(elastic, phi=0.4, psi=0.4, c=p["c"], edges="sharp")
    points = pm.seed(grid, material=soil, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=None, **options)
    problem.fix(pm.plane(y=0.0), u=0)
    top = problem.fix(pm.plane(y=1.0), ux=0.002, uy=0)
    return problem, {"force": lambda: problem.reaction(top).force[0]}


def test_shared_volumes_are_refused():
    """Never a wrong number: patches whose points share their volume out have derivatives of their own."""
    with (
        pm.Sensitivity(dilating, {"c": 1.0}, method="exact") as run,
        pytest.raises(pm.InputError, match="dilates and shares the volumes of cells out"),
    ):
        list(run.march(2))
    scene = partial(dilating, locking=None)
    assert agreement(scene, {"c": 1.0}, ["c"], marches(2)) >= 6


def test_observables_of_what_isnt_carried():
    """Never a wrong number."""
    with (
        pm.Sensitivity(of_energies, BEAM, ["E"], method="exact") as run,
        pytest.raises(pm.InputError, match="observables: work depends on what"),
    ):
        next(run.march(2))


def test_a_platen_whose_way_is_the_parameter():
    def build(p: dict[str, float]) -> Any:
        return scenes.column(SOIL, pressed=p["pressed"])

    with (
        pm.Sensitivity(build, {"pressed": 0.002}, method="exact") as run,
        pytest.raises(pm.InputError, match="pressed: the grid's lines move with it"),
    ):
        list(run.march(2))


def test_a_new_base_of_the_rotations():
    def build(p: dict[str, float]) -> Any:
        problem, observables = scenes.cantilever(p, reset=None)
        problem.rotation_limit = 1e-3
        return problem, observables

    with (
        pm.Sensitivity(build, BEAM, ["E"], method="exact") as run,
        pytest.raises(pm.InputError, match="new base"),
    ):
        next(run.march(2))
