"""Algebraic multigrid, which meshes have, on points' grids, where it can be compared: the same answers as the
direct solver's; rigid motions, units, small cuts, fallbacks; and the direct solver's factors that outlive
their tangents."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.errors import InputError
from polarmpm.solvers import choice as solvers
from polarmpm.solvers import direct as linear
from polarmpm.solvers import newton
from polarmpm.solvers.algebraic import AlgebraicSolver
from polarmpm.solvers.choice import is_large
from polarmpm.solvers.direct import DirectSolver
from polarmpm.solvers.krylov import conjugate_gradients
from polarmpm.solvers.lattice import LatticeSolver
from polarmpm.solvers.linear import SingularTangent
from polarmpm.solvers.rigidmotions import rigid_motions
from tests.conftest import COMM, HENCKY, MICROPOLAR, beam, release_supports, rotation
from tests.helpers.bodies import box, cantilever


@pytest.fixture(autouse=True)
def _algebraic(monkeypatch):
    """The solver "algebraic", which points' problems don't have otherwise."""
    monkeypatch.setitem(solvers.SOLVERS, "algebraic", solvers.Solver(solvers.algebraic, whole_rows=True))


STRICT = pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-26)
E_MODULUS, POISSON = 1e6, 0.3  # Pa, -


def material(length: float = 1.0, E: float = E_MODULUS) -> pm.MicropolarElastic:
    """Of a characteristic length (m)."""
    G = E / (2 * (1 + POISSON))
    lam = 2 * G * POISSON / (1 - 2 * POISSON)
    square = G * length**2
    return pm.MicropolarElastic(lam=lam, mu=G, kappa=0.3 * G, alpha=0.0, beta=0.5 * square, gamma=square)


def block(
    cells: int = 5,
    *,
    of: pm.Material | None = None,
    shift: Any = (0.3, 0.6, 0.0),
    turn: Any = None,
    h: float = 1.0,
    per_cell: int = 2,
    **options: Any,
) -> tuple[pm.QuasiStatic, Any]:
    """A cube, off the grid's planes by `shift` cells or turned in the grid, held below and pulled above."""
    half = 0.5 * cells
    reach = np.ceil(1.8 * half) if turn is not None else half + 1
    grid = pm.Grid.box(np.full(3, -reach * h), np.full(3, (reach + 1) * h), h, COMM)
    if turn is None:
        inside, bounds = None, (np.full(3, -half * h), np.full(3, half * h))
    else:
        frame = rotation(turn)
        extent = np.abs(frame) @ np.full(3, half)
        bounds = (-extent, extent)

        def inside(x: np.ndarray) -> np.ndarray:
            return np.all(np.abs(x @ frame) <= half, axis=1)

    points = pm.seed(grid, inside, material=of or material(h), points_per_cell=per_cell, bounds=bounds)
    points.x = points.X = points.x + h * np.asarray(shift if turn is None else (0.0, 0.0, 0.0))
    problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, **options})
    low = bounds[0][2] + 1.01 * h if turn is not None else -half * h + 1e-6 * h
    held = {"u": 0, **({"theta": 0} if points.materials[0].micropolar else {})}
    problem.fix(lambda x: x[:, 2] <= low, **held)
    top = points.farthest((0, 0, 1))
    stiffness = 5e3 if of is HENCKY else E_MODULUS
    problem.load(top, force=(cells * h) ** 2 * stiffness * np.array([0.02, 0.0, 0.03]))
    return problem, top


def solver_of(problem: Any) -> Any:
    system = problem.system
    return system.solver if hasattr(system, "solver") else system.matrix.solver


def tangent(problem: Any) -> Any:
    """The system with residual and tangent of the full load at the start. Collective."""
    system = problem.system_at(1.0)
    system.set_prescribed(system.prescribed.increments(1.0))
    system.evaluate(True)
    return system


def solved(system: Any, accuracy: float = 1e-10) -> np.ndarray:
    own = slice(0, system.nodes.owned)
    right = np.where(system.prescribed.fixed, 0.0, -system.residual)[own]
    return system.solve(right, True, accuracy)


def mean_of(problem: pm.QuasiStatic, top: Any, steps: int = 2) -> np.ndarray:
    for _ in problem.march(steps):
        pass
    return problem.points.mean_displacement(top)


# the same answer ------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("of", "options"),
    [
        (None, {"basis": "mpm"}),
        (None, {"basis": "gimpm", "reset": 1}),
        (None, {"basis": "mpm", "assembly": "projection"}),
        (HENCKY, {"basis": "gimpm"}),
        (material(1e-3), {"basis": "mpm"}),
    ],
    ids=["standard", "gimpm", "projection", "classical", "short length"],
)
def test_answers_are_the_direct_solvers(of, options):
    found = []
    for solver in ("direct", "algebraic"):
        problem, top = block(of=of, solver=solver, controls=STRICT, **options)
        found.append((mean_of(problem, top), [s.iterations for s in problem.steps]))
    assert isinstance(solver_of(problem), AlgebraicSolver)
    assert solver_of(problem).failures == 0
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=1e-9, atol=1e-10)
    assert max(np.abs(np.subtract(found[1][1], found[0][1]))) <= 1


@pytest.mark.parametrize("degree", [1, 2])
def test_finite_elements_have_the_direct_solvers_answer(degree):
    found = []
    for solver in ("direct", "multigrid"):
        mesh = box("hexahedron", (6, 4, 4) if degree == 1 else (3, 2, 2), (3.0, 2.0, 2.0))
        elements = pm.Elements(mesh, material=MICROPOLAR, degree=degree)
        problem = pm.QuasiStaticFEM(elements, solver=solver, controls=STRICT)
        problem.fix(pm.plane(x=0.0), u=0, theta=0)
        end = elements.farthest((1, 0, 0))
        problem.load(end, force=(0.0, 10.0, 20.0))
        for _ in problem.march(2):
            pass
        found.append(elements.mean_displacement(end))
    assert isinstance(solver_of(problem), AlgebraicSolver)
    assert solver_of(problem).failures == 0
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-11)


def test_unsymmetric_tangents_are_solved():
    """A dead couple in space."""
    found = []
    for solver in ("direct", "algebraic"):
        problem, top = block(4, solver=solver, controls=STRICT)
        problem.load(top, couple=(0.0, 0.0, 0.05 * E_MODULUS))
        found.append(mean_of(problem, top))
    assert not solver_of(problem).symmetric
    assert solver_of(problem).failures == 0
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-10)


def test_the_plane_is_solved_too():
    """Two translations and a rotation; prescribed displacements."""
    found = []
    for solver in ("direct", "algebraic"):
        problem = beam(2, solver=solver, controls=STRICT)
        problem.fix(pm.plane(x=4.0), uy=0.4)
        for _ in problem.march(2):
            pass
        found.append(problem.points.mean_displacement())
    assert solver_of(problem).failures == 0
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-11)


# rigid motions --------------------------------------------------------------------------------------
def free_body(dim: int, of: pm.Material) -> Any:
    """The system of a body that nothing holds, unloaded."""
    problem = beam(dim, of, solver="algebraic")
    release_supports(problem)
    problem._stale = True
    return problem.system_at(0.0)


def resistance(system: Any, motions: np.ndarray) -> np.ndarray:
    """|A v| of motions, relative to |A| |v|."""
    system.evaluate(True)
    system.pattern.put(system.solver.matrix)
    v, w = system.solver.matrix.createVecs()
    out = []
    for motion in motions:
        v.array[:] = motion.ravel()
        system.solver.matrix.mult(v, w)
        out.append(w.norm() / (system.solver.matrix.norm() * v.norm()))
    return np.array(out)


@pytest.mark.parametrize(("dim", "of"), [(2, MICROPOLAR), (3, MICROPOLAR), (2, HENCKY), (3, HENCKY)])
def test_rigid_motions_of_a_free_body_meet_no_resistance(dim, of):
    system = free_body(dim, of)
    space = system.near_null_space()
    motions, weak = space.motions, space.weak
    assert motions.shape == (3 if dim == 2 else 6, system.nodes.owned, system.layout.block)
    assert weak.shape == (system.nodes.owned,)
    assert resistance(system, motions).max() < 1e-14


def test_rigid_motions_of_a_turned_body():
    """A finite rotation since the reset, without stress. Translations are exact; what J_l^-1 leaves out after
    its linear term is a twelfth of the angle's square."""
    system, own = free_body(3, MICROPOLAR), slice(None)
    for angle in (0.1, 0.3):
        vector = angle * np.array([0.6, 0.0, 0.8])
        system.x[:, :3] = system.nodes.position @ (rotation(vector) - np.eye(3)).T
        system.x[:, 3:] = vector
        motions = rigid_motions(system.positions()[own], system.x[own, 3:], COMM)[:, : system.nodes.owned]
        found = resistance(system, motions)
        assert found[:3].max() < 1e-14
        assert found[3:].max() < angle**2 / 12.0
        exact = motions.copy()
        hat = np.array([[0, -vector[2], vector[1]], [vector[2], 0, -vector[0]], [-vector[1], vector[0], 0]])
        t = angle
        left = np.eye(3) + (1 - np.cos(t)) / t**2 * hat + (t - np.sin(t)) / t**3 * hat @ hat
        exact[3:, :, 3:] = np.linalg.solve(left, np.eye(3)).T[:, None, :]
        assert resistance(system, exact).max() < 1e-14
        assert np.abs(exact - motions).max() == pytest.approx(angle**2 / 12.0, rel=0.05)


def test_rigid_motions_stop_at_supports():
    system = tangent(block(3, solver="algebraic")[0])
    motions = system.near_null_space().motions
    assert not motions[:, system.prescribed.fixed[: system.nodes.owned]].any()


# robustness -----------------------------------------------------------------------------------------
def iterations(problem: Any) -> int:
    """Of one linear solution to 1e-8. Collective."""
    system = tangent(problem)
    solved(system, 1e-8)
    solver = solver_of(problem)
    assert solver.failures == 0
    assert solver.hierarchies == 1
    return solver.iterations


def test_iterations_hardly_grow_with_the_number_of_unknowns():
    assert iterations(block(9, solver="algebraic")[0]) <= iterations(block(4, solver="algebraic")[0]) + 8


@pytest.mark.parametrize("length", [1e-3, 1e2])
def test_iterations_hardly_depend_on_the_characteristic_length(length):
    found = iterations(block(of=material(length), solver="algebraic", basis="mpm")[0])
    # smoothers know less of a small block that many ranks share
    assert found < 30 + 3 * max(COMM.size - 3, 0)


@pytest.mark.parametrize(
    ("cells", "turn", "length"),
    [(6, (1.0, 0.4, 0.3), 100.0), (6, (-0.8, 0.3, 0.3), 1.0), (7, (-0.3, -0.7, -0.1), 1.0)],
)
def test_points_alone_in_a_cell_cost_no_iterations(cells, turn, length):
    """They leave motions that nothing resists; with rounding of the weak nodes' factor it took 26 to 61."""
    problem, _ = block(cells, of=material(length), turn=turn, solver="algebraic", basis="mpm")
    assert iterations(problem) <= 20


@pytest.mark.parametrize("h", [1e-9, 1e3])
def test_units_dont_matter(h):
    """A cell of a nanometre, of a kilometre."""
    counts, found = [], []
    for size in (1.0, h):
        problem, _ = block(h=size, solver="algebraic")
        system = tangent(problem)
        x = solved(system, 1e-10)
        equations = solver_of(problem)._equations
        equations.weight = np.zeros_like(equations.weight)  # the energy norm has no units; that of forces has
        own = slice(0, system.nodes.owned)
        right = np.where(system.prescribed.fixed, 0.0, -system.residual)[own].ravel()
        counts.append(conjugate_gradients(equations, np.zeros_like(right), right, 1e-8, 150).iterations)
        found.append(np.hstack([x[:, :3] / size, x[:, 3:]]))
    assert abs(counts[1] - counts[0]) <= 1
    np.testing.assert_allclose(found[1], found[0], atol=1e-7 * np.abs(found[0]).max())


@pytest.mark.parametrize("turn", [(0.3, 0.4, 0.5), (0.1, -0.7, 0.2)])
def test_small_cuts_are_taken_care_of(turn):
    """Points alone in a cell leave its nodes motions that nothing but their lengths of 1e-3 cells resists:
    multigrid alone takes hundreds of iterations or fails."""
    options: dict[str, Any] = {"of": material(1e-3), "turn": turn, "basis": "mpm"}
    problem, _ = block(solver="algebraic", **options)
    count = iterations(problem)
    weak = problem.system.weak_nodes()
    assert COMM.allreduce(int(weak.sum())) > 20
    assert count < 40 * COMM.size
    problem.system.weak_nodes = lambda: np.zeros_like(weak)
    solver = AlgebraicSolver(solver_of(problem).matrix, True, problem.system.near_null_space)
    solver.factor()
    own = slice(0, problem.system.nodes.owned)
    right = np.where(problem.system.prescribed.fixed, 0.0, -problem.system.residual)[own]
    solver.solve(right.ravel(), 1e-8)
    assert solver.iterations > 2 * count or solver.failures


# what fails -----------------------------------------------------------------------------------------
def shifted(share: float) -> tuple[Any, AlgebraicSolver, np.ndarray]:
    """A tangent less `share` of its diagonal, which makes it indefinite; solver and right-hand side."""
    problem, _ = block(4, shift=(0, 0, 0), solver="algebraic")
    system = tangent(problem)
    solved(system)
    solver = AlgebraicSolver(solver_of(problem).matrix.copy(), True, system.near_null_space)
    diagonal = solver.matrix.getDiagonal()
    diagonal.scale(1.0 - share)
    solver.matrix.setDiagonal(diagonal)
    own = slice(0, system.nodes.owned)
    return system, solver, np.where(system.prescribed.fixed, 0.0, -system.residual)[own].ravel()


def left(solver: Any, x: np.ndarray, right: np.ndarray) -> float:
    """Relative residual. Collective."""
    v, w = solver.matrix.createVecs()
    v.array[:] = x
    solver.matrix.mult(v, w)
    sums = COMM.allreduce(np.array([np.sum((w.array - right) ** 2), np.sum(right**2)]))
    return float(np.sqrt(sums[0] / sums[1]))


@pytest.mark.parametrize(("share", "direct"), [(0.02, False), (0.7, True)])
def test_indefinite_tangents_are_solved(share, direct):
    """By GMRES, or by the direct solver when most of the spectrum is negative."""
    _, solver, right = shifted(share)
    solver.factor()
    assert left(solver, solver.solve(right, 1e-9), right) < 1e-8
    assert (solver.failures > 0) == direct
    solver.factor()
    assert left(solver, solver.solve(right, 1e-9), right) < 1e-8
    solver.destroy()


def test_a_factor_that_takes_too_much_memory_is_refused(monkeypatch):
    """Where multigrid fails in a large problem; it would be killed with the process."""
    monkeypatch.setattr(linear, "_SMALL", 0)
    system = tangent(block(7, solver="direct")[0])
    solved(system)
    factor = DirectSolver(system.solver.matrix, True, memory=1)
    with pytest.raises(SingularTangent):
        factor.factor()
    factor = DirectSolver(system.solver.matrix, True, memory=4000)
    factor.factor()
    right = system.solver.rhs.array.copy()
    assert left(factor, factor.solve(right), right) < 1e-7


def test_an_old_hierarchy_is_replaced_when_it_is_worn():
    """The tangent changes beyond recognition, and back."""
    system = tangent(block(4, solver="algebraic")[0])
    first = solved(system)
    solver = system.solver
    system.pattern.values[:] *= 1.0 + 0.1 * np.sin(np.arange(len(system.pattern.values)))
    own = slice(0, system.nodes.owned)
    right = np.where(system.prescribed.fixed, 0.0, -system.residual)[own]
    x = system.solve(right, True, 1e-10)
    assert left(solver, x.ravel(), right.ravel()) < 1e-9
    system.evaluate(True)
    again = solved(system)
    np.testing.assert_allclose(again, first, rtol=1e-6, atol=1e-8 * np.abs(first).max())


def test_entries_that_arent_finite_are_told():
    _, solver, right = shifted(0.0)
    solver.factor()
    with pytest.raises(SingularTangent, match="residual has entries"):
        solver.solve(np.where(np.arange(len(right)) == 3, np.nan, right))
    solver.matrix.scale(np.inf)
    with pytest.raises(SingularTangent, match="tangent has entries"):
        solver.factor()
    solver.destroy()


# choice ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("solver", ["MUMPS", None, 3])
def test_unknown_solvers_are_refused(solver):
    with pytest.raises(InputError, match=r"solver = .*: allowed are auto, direct, multigrid"):
        beam(2, solver=solver)
    with pytest.raises(InputError, match=r"solver = .*: allowed are auto, direct, multigrid"):
        pm.QuasiStaticFEM(cantilever().elements, solver=solver)


def test_the_choice_goes_by_the_section(monkeypatch):
    """Many nodes in a layer across the body, in space."""
    assert not is_large(2, 1e6, 1)
    assert not is_large(3, 200.0, 1)
    assert is_large(3, 200.0, 2)
    assert is_large(3, 400.0, 1)
    assert is_large(3, 70.0, 1, True)
    assert not is_large(3, 50.0, 1, True)
    assert is_large(3, 50.0, 2, True)
    assert is_large(2, 100.0, 1, True, 40_000)
    assert not is_large(2, 100.0, 1, True, 20_000)
    assert not is_large(2, 30.0, 1, True, 40_000)
    problem, _ = block(3)
    problem.system_at(0.0)
    assert isinstance(solver_of(problem), DirectSolver)
    assert not problem.system.is_large()
    for limit in ("_ON_LATTICE", "_ON_LATTICE_ON_RANKS"):
        monkeypatch.setattr(solvers, limit, 20.0)
    problem, _ = block(3)
    problem.system_at(0.0)
    assert isinstance(solver_of(problem), LatticeSolver)
    slender = beam(3)
    slender.system_at(0.0)
    assert isinstance(solver_of(slender), DirectSolver)


# accuracy -------------------------------------------------------------------------------------------
def test_corrections_are_no_more_accurate_than_newtons_method_needs():
    controls = pm.Controls()
    assert newton._accuracy(np.inf, 1.0, controls) == 1e-3
    assert newton._accuracy(np.nan, np.inf, controls) == 1e-3
    assert newton._accuracy(1e-2, 1e-2, controls) == pytest.approx(1e-5)
    assert newton._accuracy(1e-3, 1e-6, controls) == pytest.approx(1e-4)  # the last correction
    assert newton._accuracy(1e-8, 1.0, controls) == pytest.approx(1e-10)


# old factors ----------------------------------------------------------------------------------------
def test_factors_of_earlier_tangents_lead_to_the_same_answer(monkeypatch):
    """Of a compact body; those of a slender one are cheap."""
    monkeypatch.setattr(linear, "_SMALL", 0)
    counts, found = [], []
    for keep in (np.inf, 0.0):
        monkeypatch.setattr(linear, "_KEEP", keep)
        calls = []
        original = DirectSolver._try

        def counting(self, calls=calls, original=original):
            calls.append(1)
            return original(self)

        monkeypatch.setattr(DirectSolver, "_try", counting)
        problem, top = block(6, solver="direct", controls=STRICT)
        found.append(mean_of(problem, top))
        counts.append(len(calls))
        monkeypatch.setattr(DirectSolver, "_try", original)
    assert counts[1] < counts[0] / 2
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-11)


def test_an_old_factor_of_no_use_is_replaced(monkeypatch):
    monkeypatch.setattr(linear, "_KEEP", 0.0)
    monkeypatch.setattr(linear, "_SMALL", 0)
    system = tangent(block(6, solver="direct")[0])
    first = solved(system)
    solver = system.solver
    assert solver._kept
    solver.matrix.zeroEntries()
    diagonal = solver.matrix.getDiagonal()
    diagonal.array[:] = 1.0 + np.arange(len(diagonal.array)) % 7 * 1e6
    solver.matrix.setDiagonal(diagonal)
    right = first.ravel()
    solver.factor()
    np.testing.assert_allclose(solver.solve(right, 1e-8), right / diagonal.array, rtol=1e-7)
