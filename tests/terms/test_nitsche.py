"""Supports on surfaces by the material's own tractions."""

from __future__ import annotations

import json
import re
import sys
import warnings
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.kernels.kernel import compile_expressions
from polarmpm.kinematics import rotations
from polarmpm.problems import behind
from polarmpm.tools import compat
from tests.assembly.test_system import residual_at, tangent_at
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, beam, by_id, derivative_error, rotation
from tests.helpers.bodies import box
from tests.helpers.ranks import on_ranks
from tests.terms.test_surfaces import block, face

E_MODULUS, NU = 1e6, 0.3
LAME = {"lam": E_MODULUS * NU / (1 + NU) / (1 - 2 * NU), "mu": E_MODULUS / 2 / (1 + NU)}
METHODS = ("nitsche", "nitsche-unsymmetric")


def saint_venant(F: Any, p: Any) -> Any:
    strain = (ufl.dot(ufl.transpose(F), F) - ufl.Identity(3)) / 2
    return p.lam / 2 * ufl.tr(strain) ** 2 + p.mu * ufl.inner(strain, strain)


SVK = pm.UserEnergy(saint_venant, LAME, micropolar=False)
SOLID = pm.NeoHookean(**LAME)
POLAR = pm.MicropolarElastic(
    kappa=LAME["mu"], alpha=0.0, beta=0.01 * LAME["mu"], gamma=0.01 * LAME["mu"], **LAME
)


# elements -----------------------------------------------------------------------------------------
@cache
def cantilever(method: str, stiffness: float | None, degree: int = 2, steps: int = 10) -> tuple[float, float]:
    """Deflection of the tip of 10 x 1 under a dead force of 500, and the gap in the norm L2; "nodes": held
    there."""
    mesh = box("quadrilateral", (20, 2), (10.0, 1.0))
    elements = pm.Elements(mesh, material=SVK, degree=degree, quadrature_degree=6 if degree == 2 else None)
    problem, gap = pm.QuasiStaticFEM(elements), 0.0
    if method == "nodes":
        problem.fix(pm.plane(x=0.0), u=0)
    else:
        support = problem.fix(pm.plane(x=0.0), u=0, method=method, stiffness=stiffness)
    problem.load(pm.plane(x=10.0), force=(0.0, -500.0))
    list(problem.march(steps, progress=False))
    if method != "nodes":
        gap = float(np.sqrt(support.surface.area @ support.gap**2))
        assert max(problem.balance().residue) < 1e-9
        np.testing.assert_allclose(problem.reaction(support).force, (0.0, 500.0), atol=1e-6)
    return -float(elements.mean(elements.displacement, elements.facets(pm.plane(x=10.0)))[1]), gap


@pytest.mark.parametrize(
    ("method", "stiffness", "tip", "gap"),
    [
        ("nodes", None, 1.768293, 0.0),
        ("nitsche", 0, 1.786316, 4.4e-3),
        ("nitsche", 1e4, 1.786036, 4.3e-3),
        ("nitsche", 1e6, 1.774745, 1.5e-3),
        ("nitsche", 1e8, 1.768708, 4.5e-5),
        ("nitsche", 1e10, 1.768297, 4.8e-7),
        ("nitsche", 1e12, 1.768293, 4.8e-9),
        ("penalty", 1e6, 2.3209, 1.7e-2),
        ("penalty", 1e7, 1.827545, 1.7e-3),
        ("penalty", 1e8, 1.774572, 1.8e-4),
        ("penalty", 1e10, 1.768357, 1.8e-6),
        ("penalty", 1e12, 1.768294, 1.8e-8),
    ],
)
def test_cantilever(method, stiffness, tip, gap):
    """The table of an independent code."""
    found = cantilever(method, stiffness)
    assert found[0] == pytest.approx(tip, abs=1e-6 if tip < 2 else 5e-5)
    assert found[1] == pytest.approx(gap, rel=0.03)


def test_default_stiffness_is_better_than_springs_alone():
    """20 (lam + 2 mu) / h; its error is a fraction of that of springs of the same stiffness."""
    strong, default = cantilever("nodes", None)[0], cantilever("nitsche", None)[0]
    same = 20 * (LAME["lam"] + 2 * LAME["mu"]) / 0.5
    assert cantilever("nitsche", same)[0] == pytest.approx(default, rel=1e-9)
    assert abs(default - strong) < 0.1 * abs(cantilever("penalty", same)[0] - strong)


@pytest.mark.parametrize(
    ("stiffness", "tip"), [(0, 1.6025), (1e4, 1.6021), (1e6, 1.5817), (1e7, 1.5603), (3e7, 1.5561)]
)
def test_unsymmetric_method_needs_no_stiffness(stiffness, tip):
    assert cantilever("nodes", None, degree=1)[0] == pytest.approx(1.5539, abs=5e-5)
    assert cantilever("nitsche-unsymmetric", stiffness, degree=1)[0] == pytest.approx(tip, abs=6e-5)


def test_symmetric_method_near_its_threshold():
    """Below it a mode of linear elements crosses zero: 16 % off."""
    assert cantilever("nitsche", 1e6, degree=1)[0] == pytest.approx(1.8012, abs=1e-4)


@pytest.mark.parametrize("material", [SOLID, pytest.param(POLAR, marks=pytest.mark.slow)])
def test_elements_in_space(material):
    """Held nearly as by nodes, rotations too; forces and moments balance."""
    tips = []
    for method in ("nodes", None, *METHODS):
        mesh = box("hexahedron", (4, 2, 2), (2.0, 1.0, 1.0))
        problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=material, degree=1))
        values = {"u": 0, "theta": 0} if material.micropolar else {"u": 0}
        at = pm.plane(x=0.0) if method == "nodes" else problem.elements.surface(pm.plane(x=0.0))
        support = problem.fix(at, **values, **({} if method == "nodes" else {"method": method}))
        problem.traction(pm.plane(x=2.0), force=(0.0, 3e3, 2e3))
        list(problem.march(2, progress=False))
        tips.append(problem.elements.mean_displacement(problem.elements.facets(pm.plane(x=2.0))))
        # nodes' spins are no rigid motion of interpolated rotation vectors, by nodes held either
        assert max(problem.balance().residue) < (1e-8 if material.micropolar else 1e-9)
        np.testing.assert_allclose(problem.reaction(support).force, (0, -3e3, -2e3), atol=1e-5)
    assert np.linalg.norm(tips[0]) > 0.05
    np.testing.assert_allclose(tips[1], tips[3], rtol=1e-9)  # the default
    for tip in tips[1:]:
        np.testing.assert_allclose(tip, tips[0], atol=0.03 * np.linalg.norm(tips[0]))


# points -------------------------------------------------------------------------------------------
def clamped(
    method: str | None,
    material: pm.Material = SOLID,
    *,
    turn: float = 0.0,
    offset: tuple[float, float] = (0.3, 0.1),
    h: float = 0.5,
    force: float = -2e3,
    support: dict[str, Any] | None = None,
    grid_turns: bool = False,
    **options: Any,
) -> tuple[pm.QuasiStatic, Any, Any]:
    """A strip of 3 x 1 that is turned in its grid, clamped at one end and pulled across at the other."""
    R = rotation((0, 0, turn))[:2, :2] if turn else np.eye(2)
    low = -4.0 - np.array(offset) * h
    grid = pm.Grid.box(tuple(low), tuple(low + 8.0), h)

    def inside(x: np.ndarray) -> np.ndarray:
        y = x @ R
        return (y[:, 0] > 0) & (y[:, 0] < 3) & (y[:, 1] > 0) & (y[:, 1] < 1)

    points = pm.seed(grid, inside, material=material)
    problem = pm.QuasiStatic(grid, points, **options)

    def line(a: tuple[float, float], b: tuple[float, float]) -> pm.Surface:
        return pm.Surface.line(R @ a, R @ b, round(4 / h))

    values = support or ({"u": 0, "theta": 0} if material.micropolar else {"u": 0})
    held = problem.fix(line((0, 1), (0, 0)), method=method, **values)
    pulled = problem.traction(line((3, 0), (3, 1)), force=R @ (0.0, force))
    return problem, held, pulled


def tip(pulled: Any) -> np.ndarray:
    return pulled.u.mean(axis=0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("dim", "material", "basis"),
    [
        (2, MICROPOLAR, "bspline"),
        (2, NEO_HOOKEAN, "mpm"),
        (2, pm.Hencky(lam=3e3, mu=2e3), "bspline3"),
        (3, NEO_HOOKEAN, "gimpm"),
        (3, MICROPOLAR, "mpm"),
    ],
)
def test_tangent_is_the_derivative_of_the_residual(method, dim, material, basis):
    problem = block((0.0, 0.3, 0.2)[:dim], (3.5, 1.3, 1.2)[:dim], material, basis=basis)
    rng = np.random.default_rng(1)
    theta = {"theta": 0.05 if dim == 2 else (0.05, 0.02, -0.03)} if material.micropolar else {}
    surface = face((0.0, 0.3, 0.2)[:dim], (3.5, 1.3, 1.2)[:dim], 0, 0)
    support = problem.fix(surface, u=(0.03, 0.01, -0.02)[:dim], method=method, **theta)
    n = len(surface)
    support.F = support.F + 0.1 * np.arange(dim * dim).reshape(dim, dim)
    if material.micropolar and dim == 3:
        support.q = rotations.from_vector(rng.uniform(-0.3, 0.3, (n, 3)))
        support.wryness = rng.uniform(-0.1, 0.1, (n, 3, 3))
    system = problem.system_at(1.0)
    size = system.nodes.total * system.layout.block
    x = np.random.default_rng(5).uniform(-0.05, 0.05, size)
    some = np.random.default_rng(6).choice(size, 12, replace=False)
    directions = np.zeros((size, 12))
    directions[some, range(12)] = 1.0
    k = tangent_at(system, x)
    unsymmetric = abs(k - k.T).max() > 1e-9 * abs(k).max()
    assert unsymmetric == (method == "nitsche-unsymmetric") != system.pattern.symmetric
    error = derivative_error(
        lambda t: residual_at(system, x + directions @ t[0])[None],
        lambda t: (tangent_at(system, x + directions @ t[0]) @ directions)[None],
        np.zeros((1, 12)),
    )
    assert error < 1e-7


@pytest.mark.parametrize("material", [SOLID, SVK, POLAR])
def test_what_a_method_is_by_default(material):
    """On a grid the one that cuts don't disturb; springs where a stiffness is given."""
    made = {}
    for method in (None, *METHODS, "penalty"):
        problem, support, pulled = clamped(method, material)
        list(problem.march(2, progress=False))
        made[method] = tip(pulled), support
    np.testing.assert_allclose(made[None][0], made["nitsche-unsymmetric"][0], rtol=1e-9)
    for found, _ in made.values():
        np.testing.assert_allclose(found, made[None][0], rtol=5e-3, atol=1e-4)
    _, springs, _ = clamped(None, material, support={"u": 0, "stiffness": 1e9})
    assert type(springs) is type(made["penalty"][1]) is not type(made[None][1])


@pytest.mark.parametrize("offset", [0.01, 0.5, 0.8, 0.9, 0.97, 0.999])
@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_any_place_in_the_grid(offset, turn):
    """Whatever is left of the cells that the surface cuts: convergence, and 1 % of deflection."""
    problem, support, pulled = clamped(None, turn=turn, offset=(offset, 0.37 * offset))
    assert sum(step.iterations for step in problem.march(2, progress=False)) <= 10
    R = rotation((0, 0, turn))[:2, :2] if turn else np.eye(2)
    deflection = (R.T @ tip(pulled))[1]
    assert deflection == pytest.approx(exact_tip(), rel=0.01)
    assert np.abs(support.gap).max() < 0.01 * abs(deflection)


@cache
def exact_tip() -> float:
    elements = pm.Elements(box("quadrilateral", (36, 12), (3.0, 1.0)), material=SOLID, degree=2)
    problem = pm.QuasiStaticFEM(elements)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.traction(pm.plane(x=3.0), force=(0.0, -2e3))
    list(problem.march(2, progress=False))
    return float(elements.mean_displacement(elements.facets(pm.plane(x=3.0)))[1])


@pytest.mark.parametrize("material", [SOLID, POLAR])
@pytest.mark.parametrize("method", METHODS)
def test_resets_and_balance(method, material):
    """Reactions are the whole traction: they balance the loads, with their moment, after resets too; those
    hardly move the body."""
    tips = []
    for reset in (None, 1):
        problem, support, pulled = clamped(method, material, turn=0.5, reset=reset, force=-1e4)
        list(problem.march(5, progress=False))
        reaction, balance = problem.reaction(support), problem.balance()
        (share,) = [part for part in balance.parts if part.name == support.name]
        np.testing.assert_allclose(reaction.force, -rotation((0, 0, 0.5))[:2, 1] * -1e4, atol=1e-4)
        np.testing.assert_allclose(reaction.force, share.force, atol=1e-6)
        np.testing.assert_allclose(reaction.moment, share.moment, atol=1e-6)
        if reset is None:
            assert max(balance.residue) < 1e-9
        energies = problem.energies()
        assert abs(energies["residue"]) < 2e-3 * energies["stored"]
        tips.append(tip(pulled))
    np.testing.assert_allclose(tips[0], tips[1], atol=0.01 * np.linalg.norm(tips[0]))


def test_turned_with_its_grid():
    """A quarter turn of body and grid turns the answer, to rounding."""
    answers = []
    for turned in (False, True):
        R = np.array([[0.0, -1.0], [1.0, 0.0]]) if turned else np.eye(2)
        grid = pm.Grid.box((-3.2, -3.2), (3.2, 3.2), 0.4)
        points = pm.seed(
            grid,
            lambda x, R=R: ((x @ R)[:, 0] > -0.1) & ((x @ R)[:, 0] < 2.0) & (np.abs((x @ R)[:, 1]) < 0.5),
            material=POLAR,
        )
        problem = pm.QuasiStatic(grid, points)
        problem.fix(pm.Surface.line(R @ (-0.1, 0.5), R @ (-0.1, -0.5), 9), u=0, theta=0)
        pulled = problem.traction(pm.Surface.line(R @ (2, -0.5), R @ (2, 0.5), 9), force=R @ (0, 5e3))
        list(problem.march(2, progress=False))
        answers.append(tip(pulled) @ R)
    np.testing.assert_allclose(answers[1], answers[0], rtol=1e-8, atol=1e-9)


def test_moving_components_and_rollers():
    """A face is pulled along by a function of place and factor, with the other component free; a slider holds
    the displacement along its normal only. Uniaxial stretch, exactly."""
    low, high = (0.3, 0.2), (2.6, 1.7)
    problem = block(low, high, NEO_HOOKEAN, basis="mpm")
    problem.fix(face(low, high, 0, 0), normal=0, method="nitsche-unsymmetric")
    problem.fix(face(low, high, 1, 0), normal=0, method="nitsche-unsymmetric")
    far = problem.fix(
        face(low, high, 0, 1), ux=lambda f, x: 0.1 * f * (x[:, 0] - 0.3), method="nitsche-unsymmetric"
    )
    list(problem.march(1, progress=False))
    F = problem.points.F[:, :2, :2]
    assert np.abs(F[:, 0, 0] - 1.1).max(initial=0.0) < 1e-7
    assert (
        np.abs(F - np.diag([1.1, 0.0]) - F[:, 1, 1][:, None, None] * np.diag([0.0, 1.0])).max(initial=0)
        < 1e-7
    )
    assert np.abs(far.gap).max() < 1e-8
    assert abs(problem.reaction(far).force[1]) < 1e-6
    assert problem.reaction(far).force[0] > 10.0


def test_bodies_of_two_materials():
    """Each point of a surface has the tractions of the material behind it: a bar in tension of a soft and a
    stiff half, held across both, takes its uniform stretch exactly."""
    low, high = (0.3, 0.2), (2.6, 1.7)
    grid = pm.Grid.box((-1, -1), (5, 5), 1.0)
    soft, stiff = pm.NeoHookean(lam=0.0, mu=2e3), pm.NeoHookean(lam=0.0, mu=2e6)
    points = block(low, high, soft).points
    points.assign(points.where(lambda x: x[:, 1] > 1.0), stiff)
    problem = pm.QuasiStatic(grid, points, basis="mpm")
    near = problem.fix(face(low, high, 0, 0), ux=0, method="nitsche")
    problem.fix(face(low, high, 1, 0), normal=0)
    problem.fix(face(low, high, 0, 1), ux=0.01, method="nitsche")
    list(problem.march(1, progress=False))
    assert np.abs(problem.points.F[:, 0, 0] - 1 - 0.01 / 2.3).max(initial=0.0) < 1e-7
    assert np.abs(near.gap).max() < 1e-8


def test_elements_of_two_materials():
    """The same of a mesh, whose facets know their elements."""
    from dolfinx import mesh as dmesh

    mesh = box("quadrilateral", (3, 4), (2.3, 1.5))
    number = mesh.topology.index_map(2).size_local + mesh.topology.index_map(2).num_ghosts
    cells = np.arange(number, dtype=np.int32)
    middle = dmesh.compute_midpoints(mesh, 2, cells)
    tags = dmesh.meshtags(mesh, 2, cells, (1 + (middle[:, 1] > 0.75)).astype(np.int32))
    soft, stiff = pm.NeoHookean(lam=0.0, mu=2e3), pm.NeoHookean(lam=0.0, mu=2e6)
    elements = pm.Elements(mesh, material={1: soft, 2: stiff}, cells=tags, degree=1)
    problem = pm.QuasiStaticFEM(elements)
    near = problem.fix(pm.plane(x=0.0), ux=0, method="nitsche")
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(elements.surface(pm.plane(x=2.3)), ux=0.01)
    list(problem.march(1, progress=False))
    assert np.abs(elements.points.F[:, 0, 0] - 1 - 0.01 / 2.3).max(initial=0.0) < 1e-7
    assert np.abs(near.gap).max() < 1e-8


def test_release_and_mid_run():
    """A support that is added to a loaded body holds it where it is, when the load is gone, too; released
    over load factors, the body goes back."""
    problem, support, pulled = clamped(None, POLAR, turn=0.3)
    list(problem.march(2, to=0.5, progress=False))
    held, before = tip(pulled).copy(), by_id(problem.points, problem.points.x)
    n, normal = len(pulled.surface), np.einsum("nji,nj->ni", np.linalg.inv(pulled.F), pulled.surface.normal)
    size = np.linalg.norm(normal, axis=1) * np.linalg.det(pulled.F)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    now = pm.Surface(pulled.surface.x + pulled.u, pulled.surface.area * size, normal)
    second = problem.fix(now, u=0, theta=0, method="nitsche-unsymmetric")
    problem.release(pulled)
    list(problem.march(1, to=0.6, progress=False))
    assert np.abs(by_id(problem.points, problem.points.x) - before).max() < 0.02 * np.linalg.norm(held)
    assert problem.reaction(second).force == pytest.approx(-problem.reaction(support).force, abs=1e-6)
    assert np.linalg.norm(problem.reaction(second).force) == pytest.approx(1000.0, rel=0.05)
    problem.release(second, until=0.7)
    list(problem.march(4, progress=False))
    assert np.linalg.norm(problem.reaction(support).force) < 1e-5
    p = problem.points
    assert np.abs(by_id(p, p.x) - by_id(p, p.X)).max() < 0.02 * np.linalg.norm(held)
    assert n > 1


@pytest.mark.parametrize("material", [SOLID, POLAR])
@pytest.mark.parametrize("reset", [None, 2])
def test_restart(tmp_path, reset, material):
    folder = COMM.bcast(tmp_path)
    whole, _, _ = clamped(None, material, turn=0.5, reset=reset)
    list(whole.march(4, progress=False))
    first, _, _ = clamped(None, material, turn=0.5, reset=reset)
    list(first.march(3, to=0.75, progress=False))
    pm.save_restart(first, folder / "held.h5")
    second, support, _ = clamped(None, material, turn=0.5, reset=reset)
    pm.load_restart(second, folder / "held.h5")
    list(second.march(1, progress=False))
    a, b = by_id(whole.points, whole.points.x), by_id(second.points, second.points.x)
    assert np.abs(a - b).max() < 1e-9
    np.testing.assert_allclose(
        second.reaction(support).force, whole.reaction(whole.surfaces[0]).force, atol=1e-5
    )


def test_restart_of_what_is_added_in_mid_run(tmp_path):
    """It goes on with the state of the body that it had met; a support by another method is refused."""
    folder = COMM.bcast(tmp_path)

    def run(problem: pm.QuasiStatic, pulled: Any, saved: str = "", method: str | None = None) -> np.ndarray:
        now = pm.Surface([[2.9, 0.2], [2.9, 0.8]], [0.5, 0.5], [[1.0, 0.0], [1.0, 0.0]])
        if not saved:
            list(problem.march(1, to=0.5, progress=False))
        problem.fix(now, u=0, theta=0, method=method or "nitsche-unsymmetric")
        if saved:
            pm.load_restart(problem, saved)
        else:
            list(problem.march(1, to=0.75, progress=False))
            pm.save_restart(problem, folder / "late.h5")
        list(problem.march(1, progress=False))
        return by_id(problem.points, problem.points.x)

    problem, _, pulled = clamped(None, POLAR)
    whole = run(problem, pulled)
    problem, _, pulled = clamped(None, POLAR)
    assert np.abs(run(problem, pulled, folder / "late.h5") - whole).max() < 1e-9
    problem, _, pulled = clamped(None, POLAR)
    with pytest.raises(pm.InputError, match="method = 'nitsche', in the saved run 'nitsche-unsymmetric'"):
        run(problem, pulled, folder / "late.h5", "nitsche")


def test_arc_length():
    """It takes a support that holds still, and refuses one that moves."""
    problem, _, pulled = clamped(None, turn=0.2)
    list(problem.march_arc_length(0.5, to=1.0, progress=False))
    other, _, same = clamped(None, turn=0.2)
    list(other.march(2, progress=False))
    np.testing.assert_allclose(tip(pulled), tip(same), rtol=1e-6)
    moving, _, _ = clamped(None, support={"u": (0.1, 0.0)})
    with pytest.raises(pm.InputError, match="surface support 1: the arc-length method takes terms only"):
        list(moving.march_arc_length(0.5, to=1.0, progress=False))


def test_what_holds_twice():
    """Tractions work once: what holds the same components of the same surface once more holds by springs,
    other components have their own tractions."""
    problem = beam(2, NEO_HOOKEAN)
    first = problem.fix(END, ux=0, method="nitsche")
    kinds = [type(problem.fix(END, **values)).__name__ for values in ({"uy": 0}, {"u": 0}, {"normal": 0})]
    assert kinds == ["ConsistentSupport", "SurfaceSupport", "SurfaceSupport"]
    with pytest.raises(pm.InputError, match="surface support 1 does the work of the tractions there already"):
        problem.fix(END, ux=0, method="nitsche-unsymmetric")
    problem.release(first)


@pytest.mark.parametrize("kind", ["plastic", "second gradient"])
def test_materials_without_known_tractions(kind):
    """They are held by springs, and told so where something else is asked for."""
    if kind == "plastic":
        material, why = (
            pm.VonMises(NEO_HOOKEAN, k=50.0),
            "stress at the surface of a plastic body",
        )
    else:
        energy = lambda F, H, p: p.mu * (ufl.inner(F, F) + ufl.inner(H, H))  # noqa: E731
        material = pm.UserEnergy(energy, {"lam": 1.0, "mu": 1.0}, micropolar=False, second_gradient=True)
        why = "has derivatives of the double stresses in it"
    found = behind.find_behind(body_of(material), END)
    assert why in found.no_stress


def body_of(material: pm.Material) -> Any:
    problem = beam(2, NEO_HOOKEAN)
    points = problem.points
    points.materials = (material,)
    return problem


@pytest.mark.parametrize("material", [SOLID, POLAR])
def test_points_in_space(material):
    """A bar that is turned in its grid, bent both ways, with a reset: reactions are those of the balance."""
    R = rotation((0.3, -0.2, 0.4))
    grid = pm.Grid.box((-0.6, -0.7, -0.8), (2.15, 1.8, 1.7), 0.25)
    points = pm.seed(
        grid, lambda x: np.all((x @ R > 0) & (x @ R < (1.2, 0.6, 0.6)), axis=1), material=material
    )
    problem = pm.QuasiStatic(grid, points, reset=1)
    near = pm.Surface.rectangle((0, 0, 0), R @ (0, 0, 0.6), R @ (0, 0.6, 0), 5)
    far = pm.Surface.rectangle(R @ (1.2, 0, 0), R @ (0, 0.6, 0), R @ (0, 0, 0.6), 5)
    support = problem.fix(near, **({"u": 0, "theta": 0} if material.micropolar else {"u": 0}))
    pulled = problem.traction(far, force=R @ (0, 8e3, -5e3))
    list(problem.march(2, progress=False))
    reaction, balance = problem.reaction(support), problem.balance()
    (share,) = [part for part in balance.parts if part.name == support.name]
    np.testing.assert_allclose(reaction.force, R @ (0, -2880, 1800), atol=1e-4)
    np.testing.assert_allclose(reaction.moment, share.moment, atol=1e-4 * np.abs(share.moment).max())
    assert balance.residue[0] < 1e-9
    assert np.abs(tip(pulled)).max() > 0.02
    assert np.abs(support.gap).max() < 0.05 * np.abs(tip(pulled)).max()


# convergence --------------------------------------------------------------------------------------
def field(X: Any) -> Any:
    return ufl.as_vector([ufl.sin(2 * X[0] + X[1]) / 20, ufl.cos(X[0] - 2 * X[1]) / 25 + X[0] * X[1] / 30])


@cache
def manufactured() -> Any:
    """Kernel of displacement and body force (N/m^3) at positions in the plane."""
    domain = compat.point_domain()
    space = ufl.FunctionSpace(domain, compat.quadrature_element("interval", 2))
    point = ufl.Coefficient(space)
    X = ufl.variable(ufl.as_vector([point[0], point[1]]))
    u = field(X)
    g = ufl.diff(u, X)
    F = ufl.variable(ufl.as_tensor([[1 + g[0, 0], g[0, 1], 0], [g[1, 0], 1 + g[1, 1], 0], [0, 0, 1]]))
    P = ufl.diff(saint_venant(F, SimpleNamespace(**LAME)), F)
    f = ufl.as_vector([-sum(ufl.diff(P[i, j], X)[j] for j in range(2)) for i in range(2)])
    return compile_expressions([u, f], {point: 0}, 2, domain, COMM)


def error_of(problem: Any) -> float:
    p = problem.points
    miss = p.displacement[:, :2] - (manufactured()(p.X)[:, :2] if len(p.X) else np.zeros((0, 2)))
    return float(np.sqrt(COMM.allreduce(float(p.volume0 @ np.sum(miss**2, axis=1)))))


def drive(problem: Any, surfaces: list[Any], **options: Any) -> float:
    exact = manufactured()
    for surface in surfaces:
        problem.fix(surface, u=lambda f, x: f * exact(x)[:, :2], **options)
    problem.body_load(force=lambda f, x: f * (exact(x)[:, 2:] if len(x) else np.zeros((0, 2))))
    list(problem.march(1, progress=False))
    return error_of(problem)


@pytest.mark.parametrize(("degree", "method"), [(1, "nitsche"), (2, "nitsche"), (1, "nitsche-unsymmetric")])
def test_order_of_elements(degree, method):
    """In L2, order 2 of linear and 3 of quadratic elements."""
    errors = []
    for n in (4, 8):
        elements = pm.Elements(
            box("quadrilateral", (n, n), (1.0, 1.0)), material=SVK, degree=degree, quadrature_degree=6
        )
        whole = [elements.surface(lambda x: np.ones(len(x), dtype=bool))]
        errors.append(drive(pm.QuasiStaticFEM(elements), whole, method=method))
    assert np.log2(errors[0] / errors[1]) > degree + 0.8


def test_order_of_points():
    """Splines, the boundary at odd places of the grid: between 2 and 3, as the points integrate cut cells
    with the boxes' second moments."""
    errors = []
    for n in (5, 10):
        h = 1 / n
        low = np.array((-0.63, -0.41)) * h - 2 * h
        grid = pm.Grid.box(tuple(low), tuple(low + (n + 4) * h), h)
        points = pm.seed(grid, lambda x: np.all((x > 0) & (x < 1), axis=1), material=SVK, points_per_cell=3)
        corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
        lines = [pm.Surface.line(corners[k], corners[(k + 1) % 4], 8 * n) for k in range(4)]
        errors.append(drive(pm.QuasiStatic(grid, points, reset=None), lines))
    assert np.log2(errors[0] / errors[1]) > 1.9


# input --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda p: p.fix(MIDDLE, u=0, method="nitsche"), "the body is on the side of the normals, too"),
        (
            lambda p: p.fix(END, u=0, method="lagrange"),
            "method = 'lagrange': one of 'penalty', 'nitsche', ",
        ),
        (lambda p: p.fix(END, u=0, method="nitsche", augment=True), "augment belongs to method='penalty'"),
        (lambda p: p.fix(END, u=0, method="nitsche", stiffness=-1.0), "stiffness = -1.0: "),
        (lambda p: p.fix(END, u=0, method="penalty", stiffness=0), "stiffness = 0: a positive finite"),
        (lambda p: p.fix(pm.plane(x=0.0), u=0, method="nitsche"), "fix: method belongs to springs on a Surf"),
    ],
)
def test_bad_input(act, message):
    problem = beam(2)
    with pytest.raises(pm.InputError, match=message):
        act(problem)
    assert not problem.surfaces


END = pm.Surface.line((0.0, 1.3), (0.0, 0.3), 3)
MIDDLE = pm.Surface.line((0.5, 0.8), (2.5, 0.8), 4)


def test_inside_of_a_body_springs_hold():
    """The tractions are those of a boundary: elsewhere springs hold by default."""
    kinds = [type(beam(2).fix(surface, u=0)).__name__ for surface in (MIDDLE, END, inverted(END))]
    assert kinds == ["SurfaceSupport", "ConsistentSupport", "ConsistentSupport"]


@pytest.mark.parametrize("thickness", [1.0, 0.25, 0.06])
@pytest.mark.parametrize("share", [1.0, 0.3])
def test_normals_that_point_into_the_body(thickness, share):
    """Which way they point doesn't matter where displacements are held, on thin bodies and on a part of the
    surface too; along them nothing is held, nor pressed."""
    found, grid = [], pm.Grid.box((0.0, -2.0), (6.0, 3.0), 0.5, COMM)
    end = pm.Surface.line((0.3, thickness), (0.3, 0.0), 8)
    turned = np.where(np.arange(8) < 8 * share, -1.0, 1.0)[:, None] * end.normal
    for surface in (end, wrong := pm.Surface(end.x, end.area, turned)):
        points = pm.seed(grid, bounds=((0.3, 0.0), (4.0, thickness)), material=SOLID)
        problem = pm.QuasiStatic(grid, points)
        support = problem.fix(surface, u=0)
        problem.body_load(force=(0.0, -10.0 * thickness**2))
        list(problem.march(1, progress=False))
        found.append([*points.mean_displacement(), *problem.reaction(support).force])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-9 * np.abs(found[0]).max())
    for act in (lambda: problem.fix(wrong, normal=0.0), lambda: problem.pressure(wrong, 1.0)):
        with pytest.raises(pm.InputError, match="the surface's normals point into the body, such as at "):
            act()


def told(surface: pm.Surface) -> str:
    """What is said of the trust in a surface that holds a strip of 4 x 0.5 on cells of 0.25; rank 0's."""
    grid = pm.Grid.box((-1.0, -2.0), (6.0, 3.0), 0.25, COMM)
    points = pm.seed(grid, bounds=((0.137, 0.061), (4.137, 0.561)), material=SOLID)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pm.QuasiStatic(grid, points).fix(surface, u=0)
    found: str = COMM.bcast("".join(str(w.message) for w in caught if w.category is pm.TrustWarning))
    return found


@pytest.mark.parametrize(
    ("ends", "number", "message"),
    [
        (((0.0, 0.5), (0.0, 0.0)), 8, "^$"),  # the whole end
        (((0.02, 0.5), (0.02, 0.0)), 8, "^$"),
        (((-0.05, 0.5), (-0.05, 0.0)), 8, "support 1: it lies 0.2 cells outside of the body"),
        (((0.0, 0.0), (4.0, 0.0)), 64, "^$"),
        (((0.5, 0.0), (3.55, 0.0)), 48, "^$"),
        (((0.0, 0.0), (0.25, 0.0)), 8, "support 1: it is 1 cells long, and the body goes on beside it"),
        (((1.0, 0.0), (2.0, 0.0)), 16, "support 1: it is 4 cells long, and the body goes on beside it"),
        (((0.5, 0.0), (3.4, 0.0)), 48, "support 1: it is 12 cells long, and the body goes on beside it"),
        (
            ((0.0, 0.5), (0.0, 0.0)),
            2,
            "support 1: its points are 1 cells apart: the body may be far too soft",
        ),
    ],
)
def test_surfaces_that_the_grid_does_not_resolve(ends, number, message):
    a, b = np.add(ends, (0.137, 0.061))
    assert re.search(message, told(pm.Surface.line(tuple(a), tuple(b), number)))


@pytest.mark.parametrize(("end", "message"), [(np.pi, "^$"), (0.5 * np.pi, "it is 5.. cells long")])
def test_whether_a_body_goes_on_beside_a_curved_support(end: float, message: str) -> None:
    """A half ring held on its whole inner arc ends where that ends, and goes on beside one half of it."""
    centre, angle = np.array((0.06, 0.11)), (np.arange(40) + 0.5) / 40 * end
    normal = -np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    arc = pm.Surface(centre - normal, np.full(40, end / 40), normal)
    grid = pm.Grid.box((-3.0, -3.0), (3.0, 3.0), 0.25, COMM)

    def half_ring(x: np.ndarray) -> np.ndarray:
        radius = np.linalg.norm(x - centre, axis=1)
        inside: np.ndarray = (radius >= 1.0) & (radius <= 1.8) & (x[:, 0] >= centre[0])
        return inside

    points = pm.seed(grid, half_ring, material=SOLID)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pm.QuasiStatic(grid, points).fix(arc, u=0)
    found = COMM.bcast("".join(str(w.message) for w in caught if w.category is pm.TrustWarning))
    assert re.search(message, found)


def inverted(surface: pm.Surface) -> pm.Surface:
    return pm.Surface(surface.x, surface.area, -surface.normal)


def answer() -> dict[str, Any]:
    problem, support, pulled = clamped(None, POLAR, turn=0.5, reset=2)
    list(problem.march(3, progress=False))
    reaction = problem.reaction(support)
    return {
        "x": by_id(problem.points, problem.points.x).tolist(),
        "tip": tip(pulled).tolist(),
        "reaction": [*reaction.force.tolist(), *reaction.couple.tolist(), *reaction.moment.tolist()],
    }


@pytest.mark.mpi
def test_ranks_agree():
    serial = answer()
    for found in on_ranks(2, "answer", script=__file__):
        for name, tolerance in (("x", 1e-9), ("tip", 1e-9), ("reaction", 1e-4)):
            assert np.abs(np.array(found[name]) - serial[name]).max() < tolerance


if __name__ == "__main__":
    Path(sys.argv[2], f"{COMM.rank}.json").write_text(json.dumps(answer()))
