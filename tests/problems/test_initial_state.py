"""Stresses that a body has before its first load step, and displacements that count from a later state."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.errors import InputError
from tests.conftest import COMM, assert_repeated, by_id
from tests.helpers.bodies import box

HENCKY = pm.Hencky(lam=6e6, mu=4e6)
STIFF = pm.Hencky(lam=200e6, mu=4e6)  # its locking is cured
MICROPOLAR = pm.MicropolarElastic.bounded_stiffness(lam=6e6, mu=4e6, kappa=4e6, l_b=0.2)
SOIL = pm.MohrCoulomb(HENCKY, phi=0.5, psi=0.1, c=2e3)
COSSERAT = pm.DruckerPrager(MICROPOLAR, phi=0.5, psi=0.1, c=2e3, cone="plane strain", l_p=0.2)
CLAY = pm.CamClay(pm.Houlsby(p_0=20e3, swelling=0.02, mu=4e6), M=1.0, compression=0.1, p_c=100e3)
WEIGHT = 18e3  # N/m^3


def largest(values: np.ndarray) -> float:
    return float(max(COMM.allgather(np.abs(values).max(initial=0.0))))


def on_rollers(problem: Any, dim: int, width: float) -> Any:
    for axis in "xyz"[: dim - 1]:
        for at in (0.0, width):
            problem.fix(pm.plane(**{axis: at}), **{f"u{axis}": 0.0})
    problem.fix(pm.plane(**{"xyz"[dim - 1]: 0.0}), u=0.0)
    return problem


def on_points(material: Any, height: float = 3.0, *, dim: int = 2, rows: int = 5, **options: Any) -> Any:
    grid = pm.Grid((0,) * dim, (1.0,) * dim, (2,) * (dim - 1) + (rows,), comm=COMM)
    width = 2.0
    points = pm.seed(grid, bounds=((0,) * dim, (*(width,) * (dim - 1), height)), material=material)
    return on_rollers(pm.QuasiStatic(grid, points, **options), dim, width)


def on_elements(
    material: Any, height: float = 3.0, *, cell: str = "quadrilateral", degree: int = 1, **o: Any
) -> Any:
    dim = 3 if cell in ("hexahedron", "tetrahedron") else 2
    made = box(cell, (2,) * (dim - 1) + (3,), (*(2.0,) * (dim - 1), height))
    return on_rollers(pm.QuasiStaticFEM(pm.Elements(made, material=material, degree=degree), **o), dim, 2.0)


def at_rest(problem: Any, height: float = 3.0, **options: Any) -> pm.K0:
    """Give the ground its stress and its weight."""
    ground = pm.K0(weight=WEIGHT, K0=0.6, surface=height)
    problem.initial_stress(ground, **options)
    problem.body_load(force=ground.force)
    return ground


def run(problem: Any, steps: int, to: float = 1.0) -> None:
    for _ in problem.march(steps, to=to, progress=False):
        pass


# at rest ----------------------------------------------------------------------------------------------
POINTS = [
    (HENCKY, {"basis": "mpm"}),
    (HENCKY, {"basis": "gimpm", "balanced_reset": False}),
    (STIFF, {"basis": "bspline3"}),
    (STIFF, {"basis": "mpm"}),
    (SOIL, {"basis": "bspline"}),
    (SOIL, {"basis": "bspline-averaged"}),
    (SOIL, {"basis": "mpm", "assembly": "projection"}),
    (COSSERAT, {"basis": "bspline"}),
    (MICROPOLAR, {"basis": "gimpm"}),
]


@pytest.mark.parametrize("height", [3.0, 2.63])
@pytest.mark.parametrize(("material", "options"), POINTS)
def test_points_at_rest_do_not_move(material: Any, options: Any, height: float) -> None:
    problem = on_points(material, height, **{"reset": 2, **options})
    ground = at_rest(problem, height)
    stays(problem, ground, height, 2.0 * height * WEIGHT)


@pytest.mark.slow  # where its kernels in space aren't compiled yet
def test_points_in_space_at_rest_do_not_move() -> None:
    problem = on_points(HENCKY, 2.63, dim=3)
    stays(problem, at_rest(problem, 2.63), 2.63, 4.0 * 2.63 * WEIGHT)


@pytest.mark.parametrize(
    ("material", "options"),
    [
        (HENCKY, {}),
        (SOIL, {"degree": 2, "cell": "triangle", "locking": "always"}),
        (STIFF, {"assembly": "dolfinx"}),
        (COSSERAT, {}),
        (HENCKY, {"cell": "hexahedron"}),
    ],
)
def test_elements_at_rest_do_not_move(material: Any, options: Any) -> None:
    problem = on_elements(material, **options)
    area = 2.0 ** (problem.layout.dim - 1)
    stays(problem, at_rest(problem), 3.0, area * 3.0 * WEIGHT)


def stays(problem: Any, ground: pm.K0, height: float, weight: float) -> None:
    before = problem.fields("stress").stress.copy()
    size = largest(before)
    assert largest(before - ground.stress(problem.points.X)) < 1e-9 * size
    run(problem, 3)
    assert largest(problem.points.displacement) < 1e-10 * height
    assert largest(problem.fields("stress").stress - before) < 1e-9 * size
    assert all(len(step.history) == 1 for step in problem.steps)
    below = problem.reaction(problem.supports[-1]).force
    np.testing.assert_allclose(below[-1], weight, rtol=1e-9)
    balance = problem.balance()
    assert np.abs(balance.force).max() < 1e-9 * weight
    energies = problem.energies()
    assert abs(energies["residue"]) < 1e-9 * energies["stored"]


def test_layers_and_a_surcharge_are_at_rest() -> None:
    problem = on_points(SOIL, 3.0, basis="bspline", reset=1)
    ground = pm.K0(weight=(16e3, 20e3), K0=(0.5, 0.6), surface=(3.0, 1.0), surcharge=10e3)
    X = np.array([[0.5, 3.0], [0.5, 1.0], [0.5, 0.999999], [0.5, 0.0]])
    np.testing.assert_allclose(ground.stress(X)[:, 1, 1], [-10e3, -42e3, -42e3, -62e3], rtol=1e-5)
    np.testing.assert_allclose(ground.stress(X)[:, 0, 0], [-5e3, -21e3, -25.2e3, -37.2e3], rtol=1e-5)
    np.testing.assert_array_equal(ground.force(0.3, X)[:, 1], [-16e3, -16e3, -20e3, -20e3])
    problem.initial_stress(ground)
    problem.body_load(force=ground.force)
    problem.traction(pm.Surface.line((2.0, 3.0), (0.0, 3.0), 16), force=lambda f: (0.0, -10e3))
    run(problem, 2)
    assert largest(problem.points.displacement) < 1e-10 * 3.0


# going on ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("make", [on_points, on_elements])
def test_an_oedometer_goes_on_from_rest(make: Any) -> None:
    """Logarithmic strains of one axis add up: tau = tau0 + (lam + 2 mu) ln(stretch)."""
    problem = make(HENCKY, **({"rows": 3} if make is on_points else {}))
    sigma = np.diag([-40e3, -70e3, -50e3])
    problem.initial_stress(sigma, balanced=False)
    problem.fix(pm.plane(y=3.0), uy=-0.3)
    run(problem, 3)
    ln = math.log(0.9)
    expected = (sigma + np.diag([6e6, 14e6, 6e6]) * ln) / 0.9
    found = problem.fields("stress").stress
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-9, atol=1e-3)


@pytest.mark.parametrize("kind", ["mpm", "bspline", "elements"])
@pytest.mark.parametrize("material", [HENCKY, SOIL, MICROPOLAR])
def test_ground_around_an_axis_rests_and_goes_on(kind: str, material: pm.Material) -> None:
    """A body of revolution: at rest under its weight; then an oedometer of small strain."""
    if kind == "elements":
        made = box("quadrilateral", (2, 3), (2.0, 3.0))
        elements = pm.Elements(made, material=material, axisymmetric=True)
        problem: Any = pm.QuasiStaticFEM(elements)
    else:
        grid = pm.Grid.box((0, 0), (2, 4), 1.0)
        points = pm.seed(grid, bounds=((0, 0), (2, 3)), material=material, axisymmetric=True)
        problem = pm.QuasiStatic(grid, points, basis=kind, reset=1)
    problem.fix(pm.plane(x=2.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    ground = at_rest(problem)
    run(problem, 2)
    assert largest(problem.points.displacement) < 1e-10 * 3
    stress = problem.fields("stress").stress
    np.testing.assert_allclose(stress, ground.stress(problem.points.X), rtol=0, atol=1e-8 * 54e3)
    top = pm.plane(y=3.0) if kind == "elements" else pm.Surface.line((2, 3), (0, 3), 8)
    problem.pressure(top, lambda f: 10.0 * max(f - 1.0, 0.0))
    run(problem, 1, to=2.0)
    found = problem.points.mean_displacement(problem.points.farthest((0, 1)))[1]
    height = problem.points.X[:, 1].max(initial=0.0)
    height = max(COMM.allgather(height))
    assert found == pytest.approx(-10.0 * height / 14e6, rel=0.02)


@pytest.mark.slow  # where its kernels in space aren't compiled yet
@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_clay_is_compressed_along_its_lines(ratio: float) -> None:
    """Isotropic: swelling up to the pressure of consolidation, then compression."""
    made = pm.Elements(box("hexahedron", (1, 1, 1)), material=CLAY)
    problem = pm.QuasiStaticFEM(made)
    problem.initial_stress(-50e3 * np.eye(3), overconsolidation=ratio, balanced=False)
    final = 200e3
    volume = -0.02 * math.log(ratio) - 0.1 * math.log(final / (50e3 * ratio))
    problem.fix(lambda x: np.ones(len(x), bool), u=lambda f, x: (math.exp(f * volume / 3) - 1) * x)
    run(problem, 8)
    tau = problem.fields("stress").stress * math.exp(volume)
    np.testing.assert_allclose(tau, np.broadcast_to(-final * np.eye(3), tau.shape), rtol=1e-8, atol=1e-3)


def test_a_slope_finds_its_equilibrium_in_the_first_step() -> None:
    def height(x: np.ndarray) -> np.ndarray:
        return 2.0 + 0.25 * x[:, 0]

    grid = pm.Grid((0, 0), (0.5, 0.5), (8, 8), comm=COMM)

    def begin(balanced: bool) -> Any:
        points = pm.seed(grid, lambda x: x[:, 1] < height(x), material=SOIL)
        problem = pm.QuasiStatic(grid, points)
        for x in (0.0, 4.0):
            problem.fix(pm.plane(x=x), ux=0.0)
        problem.fix(pm.plane(y=0.0), u=0.0)
        ground = pm.K0(weight=WEIGHT, K0=0.6, surface=height)
        problem.initial_stress(ground, balanced=balanced)
        problem.body_load(force=ground.force)
        return problem

    with pytest.raises(InputError, match="isn't in equilibrium"):
        begin(True).attempt(0.1)
    problem = begin(False)
    points = problem.points
    run(problem, 1, 0.1)
    moved = largest(points.displacement)
    assert 1e-5 < moved < 0.02
    problem.zero_displacements()
    run(problem, 2, 0.3)
    assert largest(points.displacement) < 1e-2 * moved


@pytest.mark.parametrize(
    ("make", "material", "options"),
    [
        (on_points, SOIL, {"reset": 2}),
        (on_points, MICROPOLAR, {"reset": None, "basis": "gimpm"}),
        (on_elements, SOIL, {"locking": "always", "cell": "triangle", "degree": 2}),
    ],
)
def test_restart_goes_on_from_rest(make: Any, material: Any, options: Any, tmp_path: Path) -> None:
    def begin() -> Any:
        problem = make(material, **options)
        at_rest(problem)
        return problem

    def push(problem: Any) -> None:
        problem.body_load(force=(2e3, -4e3))

    path = COMM.bcast(tmp_path) / "state.h5"
    problem = begin()
    push(problem)
    run(problem, 3, 0.6)
    problem.zero_displacements()
    run(problem, 1, 0.8)
    assert largest(problem.points.displacement) > 1e-6
    pm.save_restart(problem, path)
    again = begin()
    push(again)
    pm.load_restart(again, path)
    assert_repeated(
        by_id(again.points, again.points.displacement), by_id(problem.points, problem.points.displacement)
    )
    for one in (problem, again):
        run(one, 2, 1.2)
    assert_repeated(
        by_id(again.points, again.points.displacement), by_id(problem.points, problem.points.displacement)
    )
    assert_repeated(
        by_id(again.points, again.fields("stress").stress),
        by_id(problem.points, problem.fields("stress").stress),
    )
    if make is on_elements:
        assert_repeated(again.elements.displacement, problem.elements.displacement)


# displacements that count from later ------------------------------------------------------------------
@pytest.mark.parametrize("make", [on_points, on_elements])
def test_displacements_count_from_a_state(make: Any) -> None:
    problem = make(HENCKY)
    problem.body_load(force=(3e3, -WEIGHT))
    run(problem, 1, 0.5)
    first, stress = problem.points.displacement, problem.fields("stress").stress
    assert largest(first) > 1e-4
    x = problem.points.x
    problem.zero_displacements()
    assert largest(problem.points.displacement) == 0.0
    np.testing.assert_array_equal(problem.fields("stress").stress, stress)
    run(problem, 1, 1.0)
    np.testing.assert_allclose(problem.points.displacement, problem.points.x - x, rtol=0, atol=1e-15)
    if make is on_elements:
        top = problem.elements.facets(pm.plane(y=3.0))
        assert (
            abs(problem.elements.mean_displacement(top)[1]) < 0.75 * abs(problem.elements.moved[:, 1]).max()
        )
    held = problem.fix(pm.plane(y=3.0) if make is on_elements else pm.plane(x=2.0), ux=0.0, counts="total")
    run(problem, 1, 1.1)
    assert held.total
    near = problem.points.X[:, 1] > 2.7 if make is on_elements else problem.points.X[:, 0] > 1.7
    assert largest(problem.points.displacement[near, 0]) < 0.3 * largest(first)


# refused ----------------------------------------------------------------------------------------------
def test_what_is_no_initial_stress_is_refused() -> None:
    problem = on_points(SOIL)
    out = np.zeros((3, 3))
    out[0, 2] = out[2, 0] = 1e3
    for message, stress in [
        ("shape", np.zeros((2, 2))),
        ("symmetric", np.array([[0.0, 1e3, 0], [0, 0, 0], [0, 0, 0]])),
        ("out of the plane", out),
        ("finite", np.full((3, 3), np.nan)),
        ("outside of the yield surface .MohrCoulomb.", np.diag([0.0, -90e3, 0.0])),
        (
            r"point \d+ at .*6 point|point \d+",
            lambda x: np.einsum("n,ij->nij", -1e5 * x[:, 1], np.diag([0.1, 1, 0.1])),
        ),
        ("can't be evaluated|numbers", lambda x: None),
    ]:
        with pytest.raises(InputError, match=message):
            problem.initial_stress(stress)
    assert not problem.at_rest
    with pytest.raises(InputError, match="overconsolidation"):
        problem.initial_stress(np.zeros((3, 3)), overconsolidation=0.5)
    for wrong in ({"weight": -1.0}, {"K0": (0.5, 0.6)}, {"surface": (1.0, 2.0)}, {"surcharge": math.nan}):
        with pytest.raises(InputError):
            pm.K0(**{"weight": 18e3, "K0": 0.5, "surface": 1.0, **wrong})
    ground = at_rest(problem)
    run(problem, 1, 0.1)
    with pytest.raises(InputError, match="before the first"):
        problem.initial_stress(ground)
    consistent = on_elements(HENCKY)
    consistent.fix(pm.plane(y=3.0), method="nitsche", ux=0.0)
    with pytest.raises(InputError, match="takes up the stress"):
        consistent.initial_stress(ground)
    clay = on_points(CLAY)
    with pytest.raises(InputError, match=r"elastic law|tension"):
        clay.initial_stress(np.diag([1e3, 1e3, 1e3]), overconsolidation=None)
    ramped = on_points(HENCKY)
    ramped.initial_stress(ground)
    ramped.body_load(force=(0.0, -WEIGHT))
    with pytest.raises(InputError, match="isn't in equilibrium: forces out of balance are"):
        ramped.attempt(0.1)


def test_a_body_at_rest_changes_its_materials() -> None:
    problem = on_points(HENCKY, basis="mpm")
    at_rest(problem)
    problem.change(HENCKY, mu=2e6)
    run(problem, 1)
    assert largest(problem.points.displacement) > 1e-5
    assert problem.points.materials[0].elastic == pm.Hencky(lam=6e6, mu=2e6)
