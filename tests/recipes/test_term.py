"""The term of the recipe on points, by projection and on a mesh: exact for a rigid block on springs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN
from tests.helpers.bodies import box
from tests.helpers.ranks import on_ranks, report
from tests.recipes.term import Winkler

STIFF = pm.NeoHookean(lam=1e10, mu=1e10)  # Pa: gives way by 1.5e-7 of what the springs do
WIDTH, HEIGHT, K, LOAD = 2.0, 1.0, 4000.0, 300.0  # m, m, Pa/m, N
METHODS = ("mpm", "bspline", "projection", "elements 1", "elements 2")


def foundation(method: str, material: pm.Material, force: tuple[float, float] = (0.0, -LOAD)) -> Any:
    """A block whose foot stands on springs, under a load on its head: its problem, and a function that gives
    the mean displacement of the head."""
    theta = {"theta": 0} if material.micropolar else {}
    if method.startswith("elements"):
        elements = pm.Elements(
            box("quadrilateral", (8, 4), (WIDTH, HEIGHT)), material=material, degree=int(method[-1])
        )
        problem: Any = pm.QuasiStaticFEM(elements)
        foot = elements.surface(pm.plane(y=0.0))
        problem.load(pm.plane(y=HEIGHT), force=force)

        def head() -> np.ndarray:
            return elements.mean_displacement(elements.facets(pm.plane(y=HEIGHT)))
    else:
        grid = pm.Grid.box((0.0, -1.0), (WIDTH, 2.0), 0.25)
        points = pm.seed(grid, material=material, points_per_cell=3, bounds=((0.0, 0.0), (WIDTH, HEIGHT)))
        options = {"basis": "mpm", "assembly": "projection"} if method == "projection" else {"basis": method}
        problem = pm.QuasiStatic(grid, points, **options)
        foot = pm.Surface.line((0.0, 0.0), (WIDTH, 0.0), 24)
        problem.load(pm.Surface.line((WIDTH, HEIGHT), (0.0, HEIGHT), 24), force=force)
        carried = problem.surfaces[0]

        def head() -> np.ndarray:
            return np.average(carried.u, axis=0, weights=carried.surface.area)

    problem.fix(pm.plane(x=0.0), ux=0, **theta)
    problem.add(Winkler("foundation", foot, {"k": K}))
    return problem, head


@pytest.mark.parametrize("method", METHODS)
def test_a_rigid_block_sinks_as_springs_say(method):
    """Exactly the load over the stiffness of all springs, and their force is the load."""
    problem, head = foundation(method, STIFF)
    list(problem.march(2, progress=False))
    sunk = -LOAD / (K * WIDTH)
    np.testing.assert_allclose(head()[1], sunk, rtol=5e-7)
    term = problem.surfaces[-1]
    np.testing.assert_allclose(term.u[:, 1], sunk, rtol=5e-7)
    energies = problem.energies()
    assert energies["external"] == pytest.approx(0.0, abs=1e-6 * LOAD)  # the foundation counts as a support


@pytest.mark.parametrize("material", [NEO_HOOKEAN, MICROPOLAR], ids=["classical", "micropolar"])
def test_all_methods_agree_within_the_discretisation_error(material):
    found = {}
    for method in METHODS:
        problem, head = foundation(method, material, (60.0, -LOAD))
        list(problem.march(4, progress=False))
        found[method] = head()
    best = found["elements 2"]
    assert np.linalg.norm(best) > 0.05
    for method, u in found.items():
        assert np.linalg.norm(u - best) < 0.02 * np.linalg.norm(best), (method, found)
    assert np.linalg.norm(found["projection"] - found["mpm"]) < 1e-9 * np.linalg.norm(best)


@pytest.mark.parametrize("method", METHODS)
def test_the_tangent_is_the_derivative_of_the_residual(method):
    problem, _ = foundation(method, NEO_HOOKEAN, (60.0, -LOAD))
    list(problem.march(1, to=0.5, progress=False))
    system = problem.system_at(1.0)
    rng = np.random.default_rng(5)
    x, direction = (rng.uniform(-1, 1, system.x.shape) for _ in range(2))
    for nodal in (x, direction):
        system.nodes.update_ghosts(nodal)
    x *= 1e-3
    direction[system.prescribed.fixed] = 0.0
    residuals = []
    for sign in (1.0, -1.0):
        system.jump(x + sign * 1e-6 * direction)
        residuals.append(system.terms.forces(system.x, lambda piece: True))
    difference = (residuals[0] - residuals[1]) / 2e-6
    exact = system.terms.products(x, direction)
    scale = COMM.allreduce(float(np.abs(exact).max(initial=0.0)))
    assert scale > 0
    assert np.abs(difference - exact).max(initial=0.0) < 1e-6 * scale


def run(method: str) -> dict[str, Any]:
    problem, head = foundation(method, MICROPOLAR, (60.0, -LOAD))
    list(problem.march(3, progress=False))
    return {"head": head().tolist()}


@pytest.mark.mpi
@pytest.mark.parametrize("method", ["bspline", "projection", "elements 2"])
def test_two_ranks_agree_with_one(method):
    expected = run(method)["head"]
    for found in on_ranks(2, method, __file__):
        np.testing.assert_allclose(found["head"], expected, rtol=1e-9)


def test_restart_goes_on_to_the_same_digits(folder, strict):
    whole, head = foundation("bspline", NEO_HOOKEAN, (60.0, -LOAD))
    list(whole.march(4, progress=False))
    first, _ = foundation("bspline", NEO_HOOKEAN, (60.0, -LOAD))
    list(first.march(2, to=0.5, progress=False))
    pm.save_restart(first, folder / "half.h5")
    second, other = foundation("bspline", NEO_HOOKEAN, (60.0, -LOAD))
    pm.load_restart(second, folder / "half.h5")
    list(second.march(2, progress=False))
    np.testing.assert_allclose(other(), head(), rtol=1e-12 if COMM.size == 1 else 1e-9)


def test_arc_length_takes_it():
    problem, head = foundation("mpm", STIFF)
    list(problem.march_arc_length(0.01, to=1.0, progress=False))
    np.testing.assert_allclose(head()[1], -LOAD / (K * WIDTH), rtol=1e-6)


class Nothing(pm.SurfaceTerm):
    """Neither an energy nor a virtual work."""


class Vector(pm.SurfaceTerm):
    def energy(self, at: Any, p: Any) -> Any:
        return at.u


FOOT = pm.Surface.line((0.0, 0.0), (WIDTH, 0.0), 4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: 3, "term = 3 is not a Term"),
        (
            lambda: Winkler("foot", "bottom", {"k": 1.0}),
            "foot: surface = 'bottom': a polarmpm.Surface is needed",
        ),
        (lambda: Winkler("foot", FOOT, {"k": "stiff"}), "foot: k = 'stiff': numbers are needed"),
        (lambda: Winkler("foot", FOOT, {"k": [1.0, 2.0]}), r"foot: k = .*its shape is \(2,\)"),
        (lambda: Winkler("foot", FOOT, {"k": np.nan}), "finite"),
        (lambda: Nothing("foot", FOOT), "foot: Nothing needs one of energy and virtual_work"),
        (lambda: Vector("foot", FOOT), "a scalar is needed"),
    ],
)
def test_terms_that_cannot_be(make, message):
    problem, _ = foundation("mpm", NEO_HOOKEAN)
    before = problem.terms
    with pytest.raises(pm.InputError, match=message):
        problem.add(make())
    assert problem.terms == before
    for other in (problem, foundation("mpm", NEO_HOOKEAN)[0]):
        with pytest.raises(pm.InputError, match="has been added to a problem already"):
            other.add(before[0])


if __name__ == "__main__":
    report(run)
