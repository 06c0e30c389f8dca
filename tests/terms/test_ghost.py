"""Ghost penalty: its form, its faces, what it does to the tangent, nothing to linear fields."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.assembly.nodalterms import NodalTerms
from polarmpm.basis.registry import basis_of
from polarmpm.geometry import cells as cellmesh
from polarmpm.geometry.grid import box_indices
from polarmpm.geometry.nodes import ActiveNodes
from polarmpm.kinematics.layout import Layout
from polarmpm.terms.ghost import Ghost, boundary_faces, curvature_jumps, face_size, penalty_form, stencil
from polarmpm.tools import compat
from tests.assembly.test_system import collected, residual_at, stored_matrix, tangent_at
from tests.conftest import (
    COMM,
    HENCKY,
    MICROPOLAR,
    NEO_HOOKEAN,
    beam,
    by_id,
    derivative_error,
    release_supports,
)
from tests.helpers.ranks import on_ranks


def mine(values: Any) -> np.ndarray:
    """This rank's part of what every rank has."""
    return np.array_split(np.asarray(values), COMM.size)[COMM.rank]


def everything(values: np.ndarray) -> np.ndarray:
    """The parts of all ranks, ascending. Collective."""
    return np.sort(np.concatenate(COMM.allgather(np.asarray(values))))


def faces_of(grid: pm.Grid, cells: Any) -> list[set[tuple[int, ...]]]:
    """Lattice indices of the cells below the faces across each axis; `cells` are shared out to the ranks."""
    reached = np.unique(mine(grid.cell_number(np.array(cells))))
    found = [everything(f) for f in boundary_faces(grid, reached)]
    return [{tuple(map(int, i)) for i in grid.node_index(f)} for f in found]


# form ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("cell", [(1.0, 1.0), (0.5, 0.2), (1.0, 1.0, 1.0), (0.5, 0.2, 0.3)])
def test_stencil_in_closed_form(cell):
    """The jump of the normal derivative of the tent functions is (1, -2, 1) / h_n, times the mass matrix of
    the face: the tensor product that T (2.59) comes to on a lattice."""
    tent, mass = np.array([1.0, -2.0, 1.0]), np.array([[2.0, 1.0], [1.0, 2.0]]) / 6
    for axis in range(len(cell)):
        for power in (1, 3):
            expected = np.ones((1, 1)) * face_size(cell, axis) ** power / 3
            for k, h in enumerate(cell):
                expected = np.kron(expected, np.outer(tent, tent) / h**2 if k == axis else mass * h)
            assert np.abs(stencil(cell, axis, power) - expected).max() < 1e-13 * np.abs(expected).max()


@pytest.mark.parametrize("cell", [(0.5, 0.2), (0.5, 0.2, 0.3)])
def test_stencil_between_cells_of_two_sizes(cell):
    """There the jump is (1/a, -1/a - 1/b, 1/b)."""
    mass, above = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6, 0.35
    for axis in range(len(cell)):
        expected = np.ones((1, 1)) * face_size(cell, axis) / 3
        jump = np.array([1 / cell[axis], -1 / cell[axis] - 1 / above, 1 / above])
        for k, h in enumerate(cell):
            expected = np.kron(expected, np.outer(jump, jump) if k == axis else mass * h)
        found = stencil(cell, axis, 1, above)
        assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_faces_add_up_to_dolfinx_assembly(dim):
    """All faces of an irregular body against one assembly by dolfinx over tagged facets of its cell mesh."""
    from dolfinx import mesh as dmesh

    if COMM.size > 1:
        pytest.skip("the cell mesh has no ghost cells, so that dolfinx leaves out facets between ranks")
    shape = (5, 4, 4)[:dim]
    grid = pm.Grid.box((0.0,) * dim, np.multiply(shape, (0.5, 0.3, 0.4)[:dim]), (0.5, 0.3, 0.4)[:dim])
    index = np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), axis=1)
    cells = grid.cell_number(index[(index.sum(axis=1) > 1) & (index.sum(axis=1) < 7)])
    layout = Layout(dim, 0)
    terms = Ghost(pm.GhostPenalty(7.0, power=3), layout).faces(grid, cells)
    nodes = ActiveNodes.build(grid, np.unique(np.concatenate([t.boxes.numbers(grid).ravel() for t in terms])))
    bound = NodalTerms(nodes, terms, COMM)
    x = np.random.default_rng(3).uniform(-1, 1, (len(nodes), dim))

    body = cellmesh.cell_mesh(grid, np.sort(cells)).mesh
    space = compat.function_space(body, 1, 1)
    at = np.rint(grid.local(space.tabulate_dof_coordinates()[:, :dim])).astype(np.int64)
    field = np.zeros((len(at), dim))
    known = np.isin(grid.node_number(at), nodes.lattice)
    rows = nodes.local(grid.node_number(at)[known])
    field[known] = x[rows]
    total = np.zeros_like(field)
    body.topology.create_connectivity(dim - 1, dim)
    centres = dmesh.compute_midpoints(
        body, dim - 1, np.arange(body.topology.index_map(dim - 1).size_local, dtype=np.int32)
    )[:, :dim]
    for axis, below in enumerate(boundary_faces(grid, np.sort(cells))):
        middle = grid.node_index(below) + 0.5
        middle[:, axis] += 0.5
        gap = np.abs(grid.local(centres)[:, None] - middle[None]).max(axis=2).min(axis=1)
        facets = np.flatnonzero(gap < 1e-6).astype(np.int32)
        assert len(facets) == len(below)
        tags = dmesh.meshtags(body, dim - 1, facets, np.ones(len(facets), dtype=np.int32))
        dS = ufl.Measure("dS", domain=body, subdomain_data=tags)(1)
        form = compat.compile_form(penalty_form(body, space, face_size(grid.cell, axis), facets=dS))
        matrix = compat.create_matrix(form)
        compat.add_to_matrix(matrix, form)
        matrix.assemble()
        k = np.arange(len(at), dtype=np.int32)
        total += 7.0 * matrix.getValues(k, k) @ field
        matrix.destroy()
    forces = bound.forces(x, lambda piece: True)
    assert np.abs(forces[rows] - total[known]).max() < 1e-12 * np.abs(total).max()
    assert np.abs(total[~known]).max(initial=0.0) < 1e-12 * np.abs(total).max()
    assert len(rows) == len(nodes)


def test_linear_fields_have_no_ghost_forces():
    grid = pm.Grid.box((-1.0, 0.0, 0.0), (2.0, 4.0, 6.0), (0.5, 1.0, 1.5))
    cells = np.array([[1, 1, 1], [2, 1, 1], [2, 2, 1], [2, 2, 2], [3, 2, 2]])
    reached = np.unique(mine(grid.cell_number(cells)))
    terms = Ghost(pm.GhostPenalty(3.0, 2.0, power=3), Layout(3, 3)).faces(grid, reached)
    numbers = [t.boxes.numbers(grid).ravel() for t in terms]
    nodes = ActiveNodes.build(grid, np.unique(np.concatenate(numbers)))
    bound = NodalTerms(nodes, terms, COMM)
    rng = np.random.default_rng(1)
    slope, bent = rng.uniform(-1, 1, (3, 6)), rng.uniform(-1, 1, (3, 6))
    linear = 0.3 + nodes.position @ slope
    curved = linear + nodes.position**2 @ bent

    def largest(x: np.ndarray) -> float:
        forces = bound.forces(x, lambda piece: True)
        nodes.add_to_owners(forces)
        return max(COMM.allgather(float(np.abs(forces[: nodes.owned]).max(initial=0.0))))

    assert sum(COMM.allgather(sum(len(t.boxes.lowest) for t in terms))) == 4
    assert largest(curved) > 1.0
    assert largest(linear) < 1e-13 * largest(curved)


# faces --------------------------------------------------------------------------------------------
def test_faces_of_a_body_in_the_plane():
    """A block of 4 x 4 cells far from the walls: its ring of 12 boundary cells, the four inner ones none. The
    faces between inner cells are left out, 24 - 4 = 20."""
    grid = pm.Grid.box((0, 0), (8, 8), 1.0)
    block = [(i, j) for i in range(2, 6) for j in range(2, 6)]
    across_x, across_y = faces_of(grid, block)
    assert across_x == {(i, j) for i in range(2, 5) for j in range(2, 6)} - {(3, 3), (3, 4)}
    assert across_y == {(j, i) for i, j in across_x}


def test_faces_of_a_body_in_space():
    """A block of 3 x 3 x 3 cells has one inner cell; every inner face touches a boundary cell."""
    grid = pm.Grid.box((0, 0, 0), (5, 5, 5), 1.0)
    faces = faces_of(grid, [(i, j, k) for i in (1, 2, 3) for j in (1, 2, 3) for k in (1, 2, 3)])
    assert [len(f) for f in faces] == [18, 18, 18]
    large = pm.Grid.box((0, 0, 0), (6, 6, 6), 1.0)
    four = range(1, 5)  # 4 x 4 x 4: the inner 2 x 2 x 2 have four inner faces across each axis
    faces = faces_of(large, [(i, j, k) for i in four for j in four for k in four])
    assert [len(f) for f in faces] == [48 - 4] * 3


def test_walls_of_the_grid_are_no_empty_cells():
    """A full grid has no boundary cells; nor do cells beyond the walls, which domains may reach, count."""
    grid = pm.Grid.box((0, 0), (3, 3), 1.0)
    full = [(i, j) for i in range(3) for j in range(3)]
    assert faces_of(grid, full) == [set(), set()]
    assert faces_of(grid, [*full, (-1, 0), (3, 2), (1, -1)]) == [set(), set()]
    assert faces_of(grid, [(i, j) for i in range(2) for j in range(3)]) == [
        {(0, 0), (0, 1), (0, 2)},
        {(1, 0), (1, 1)},
    ]


def test_domains_reach_cells_without_points():
    """The last points of a bar lie in the cell 0..1, their domains reach into 1..2: an active, partly reached
    cell for "gimpm", an empty one for "mpm"."""
    grid = pm.Grid.box((0.0, 0.0), (4.0, 1.0), 1.0)
    points = pm.seed(grid, material=NEO_HOOKEAN, points_per_cell=2, bounds=((0.0, 0.0), (1.0, 1.0)))
    points.x = points.x + np.array([0.2, 0.0])
    for basis, faces in (("gimpm", 1), ("mpm", 0)):
        problem = pm.QuasiStatic(
            grid, points, basis=basis, ghost=pm.GhostPenalty(1.0), reset=1, balanced_reset=False
        )
        problem.fix(pm.plane(x=0.0), u=0)
        system = problem.system_at(0.0)
        count = COMM.allreduce(sum(len(t.boxes.lowest) for t in system.terms.pieces))
        assert count == faces


# systems ------------------------------------------------------------------------------------------
def stabilised(
    ghost: Any, dim: int = 2, material: pm.Material = MICROPOLAR, **options: Any
) -> pm.QuasiStatic:
    problem = beam(dim, material, ghost=ghost, **options)
    force = np.eye(dim)[1] * -8.0
    problem.load(problem.points.farthest((1.0, 0.0, 0.0)[:dim]), force=force)
    return problem


PENALTY = pm.GhostPenalty(900.0, 40.0, power=3)
CASES = [(2, MICROPOLAR), (2, HENCKY), (3, MICROPOLAR), (3, NEO_HOOKEAN)]


@pytest.mark.parametrize("basis", ["gimpm", "mpm"])
@pytest.mark.parametrize(("dim", "material"), CASES)
def test_tangent_with_ghost_is_the_derivative_of_the_residual(dim, material, basis):
    problem = beam(dim, material, basis=basis, ghost=PENALTY)
    release_supports(problem)
    system = problem.system_at(1.0)
    x = np.random.default_rng(5).uniform(-0.05, 0.05, system.nodes.total * system.layout.block)
    k = tangent_at(system, x)
    plain = beam(dim, material, basis=basis)
    release_supports(plain)
    without = plain.system_at(1.0)
    assert abs(k - tangent_at(without, x)).max() > 1e-2 * abs(k).max()
    error = derivative_error(
        lambda y: residual_at(system, y[0])[None], lambda y: tangent_at(system, y[0])[None], x[None]
    )
    assert error < 1e-7


def test_unsymmetric_tangent_with_ghost():
    """Dead couples in space: the stored matrix is whole, and differs from the plain one by the same part.

    Increments and matrices are compared node by node: the penalty may make another rank own a node.
    """

    def tangent(system, x):
        nodes, b = system.nodes, system.layout.block
        lattice = np.concatenate(COMM.allgather(nodes.lattice[: nodes.owned]))
        at = (np.argsort(np.argsort(lattice))[:, None] * b + np.arange(b)).ravel()
        out = np.empty((len(x), len(x)))
        out[np.ix_(at, at)] = tangent_at(system, x[at])
        return out

    matrices = []
    for ghost in (None, PENALTY):
        problem = beam(3, ghost=ghost)
        problem.load(problem.points.farthest((1.0, 0.0, 0.0)), couple=(0.0, 0.0, 3.0))
        system = problem.system_at(1.0)
        assert not system.pattern.symmetric
        x = np.random.default_rng(5).uniform(-0.05, 0.05, system.nodes.total * system.layout.block)
        matrices.append(tangent(system, x))
    part = matrices[1] - matrices[0]
    symmetric = []
    for ghost in (None, PENALTY):
        problem = beam(3, ghost=ghost)
        system = problem.system_at(1.0)
        symmetric.append(tangent(system, x))
    assert np.abs(part - (symmetric[1] - symmetric[0])).max() < 1e-12 * np.abs(part).max()
    assert np.abs(part).max() > 1.0


@pytest.mark.parametrize("ghost", [None, PENALTY])
def test_small_cut(ghost):
    """A bar of 2.001 cells of single points: the last cell is held by a point 1e-3 inside it. Without ghost
    penalty the tangent's condition number is beyond 1e6; with it that of the regular bar."""

    def condition(end: float) -> float:
        grid = pm.Grid.box((0.0, 0.0), (4.0, 2.0), 1.0)
        x = np.array([(a, b) for a in (0.25, 0.75, 1.25, 1.75, end) for b in (0.25, 0.75)])
        volume = np.where(x[:, 0] > 2.0, 0.5 * (end - 2.0), 0.25)
        half = np.full((len(x), 2), 0.25)
        points = pm.Points(mine(x), mine(volume), mine(half), MICROPOLAR, COMM)
        problem = pm.QuasiStatic(grid, points, basis="mpm", ghost=ghost, reset=1, balanced_reset=False)
        problem.fix(pm.plane(x=0.0), u=0, theta=0)
        system = problem.system_at(0.0)
        system.evaluate(True)
        k = stored_matrix(system)
        k = k + np.triu(k, 1).T
        free = np.flatnonzero(~collected(system, system.prescribed.fixed.astype(float)).astype(bool))
        return float(np.linalg.cond(k[np.ix_(free, free)]))

    cut, whole = condition(2.001), condition(2.25)
    if ghost is None:
        assert cut > 1e6 > 1e3 > 0.1 * whole
    else:
        assert cut < 5 * whole


@pytest.mark.parametrize("dim", [2, 3])
def test_prescribed_displacements_with_ghost(dim):
    """In the linear range one iteration with prescribed end displacements is the solution: the columns of
    prescribed unknowns are moved to the right-hand side, those of the ghost faces too."""
    problem = beam(dim, ghost=PENALTY, controls=pm.Controls(force_tolerance=1e-8))
    size = 1e-9
    problem.fix(lambda x: x[:, 0] > 2.5, ux=size, uy=-size)
    (step,) = problem.march(1, progress=False)
    assert step.iterations == 1
    # the same by hand: the whole matrix of a problem without supports
    free = beam(dim, ghost=PENALTY)
    release_supports(free)
    system = free.system_at(0.0)
    k = tangent_at(system, np.zeros(system.nodes.total * system.layout.block))
    solved = problem.system
    x, fixed = collected(solved, solved.x), collected(solved, solved.prescribed.fixed.astype(float)) > 0.5
    free_part = ~fixed
    expected = np.linalg.lstsq(
        k[np.ix_(free_part, free_part)], -k[np.ix_(free_part, fixed)] @ x[fixed], rcond=1e-14
    )[0]
    out = k[np.ix_(free_part, free_part)] @ x[free_part] + k[np.ix_(free_part, fixed)] @ x[fixed]
    assert np.abs(out).max() < 1e-7 * np.abs(k[:, fixed] @ x[fixed]).max()
    assert np.abs(x[free_part] - expected).max() < 1e-5 * size


def test_newton_with_ghost_converges_quadratically():
    problem = stabilised("thesis", controls=pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-30))
    (step,) = problem.march(1, progress=False)
    forces = np.array([f for f, _ in step.history])
    drops = forces[forces < 1e-2]
    assert drops[1] < 50 * drops[0] ** 2 or drops[1] < 1e-12
    assert step.iterations <= 8


# runs ---------------------------------------------------------------------------------------------
def test_light_ghost_hardly_changes_an_answer_and_thesis_does_more():
    def tip(ghost: Any) -> np.ndarray:
        problem = stabilised(ghost)
        list(problem.march(3, progress=False))
        return by_id(problem.points, problem.points.x - problem.points.X)

    plain, light, thesis = tip(None), tip("light"), tip("thesis")
    largest = np.abs(plain).max()
    assert 0 < np.abs(light - plain).max() < 1e-4 * largest
    assert 1e-4 * largest < np.abs(thesis - plain).max() < 5e-2 * largest


def test_work_of_the_ghost_forces():
    """In one step from rest the forces are K_g x, their work x . K_g x / 2; on several steps with resets it
    adds up to a positive number that is small against the strain energy."""
    problem = stabilised("thesis")
    list(problem.march(1, to=0.5, progress=False))
    system = problem.system
    forces = system.term_forces()
    own = system.nodes.owned
    expected = 0.5 * COMM.allreduce(float(np.sum(forces[:own] * system.x[:own])))
    assert problem.progress.ghost_work == pytest.approx(expected, rel=1e-12)
    list(problem.march(4, progress=False))
    assert expected < problem.progress.ghost_work < 0.05 * problem.energy()
    assert stabilised(None).progress.ghost_work == 0.0


def test_restart_between_resets(folder):
    """A run that is interrupted between two resets goes on to the same answer."""
    whole = stabilised("thesis", reset=4)
    list(whole.march(5, progress=False))
    first = stabilised("thesis", reset=4)
    list(first.march(2, to=0.4, progress=False))
    pm.save_restart(first, folder / "ghost.h5")
    second = stabilised("thesis", reset=4)
    pm.load_restart(second, folder / "ghost.h5")
    list(second.march(3, progress=False))
    a, b = by_id(whole.points, whole.points.x), by_id(second.points, second.points.x)
    assert np.abs(a - b).max() < 1e-10


def test_new_rotation_base_keeps_the_equilibrium():
    """Counting rotations from a new base loses their part of the ghost forces, which is carried instead."""
    problem = stabilised("thesis", reset=None)
    list(problem.march(2, to=0.5, progress=False))
    system = problem.system
    system.evaluate(False)
    free = ~system.prescribed.fixed[: system.nodes.owned]
    before = system.residual[: system.nodes.owned][free]
    system.rebase_rotations()
    system.evaluate(False)
    after = system.residual[: system.nodes.owned][free]
    scale = COMM.allreduce(float(np.abs(system.term_forces()).max()))
    lost = COMM.allreduce(float(np.abs(system.carried).max(initial=0.0)))
    assert lost > 1e-6 * scale
    assert np.abs(after - before).max(initial=0.0) < 1e-9 * scale


def answer() -> dict[str, Any]:
    """A body in space whose resets keep it in equilibrium."""
    problem = stabilised("thesis", 3, balanced_reset=True)
    list(problem.march(2, progress=False))
    return {"x": by_id(problem.points, problem.points.x).tolist(), "work": problem.progress.ghost_work}


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks_agree(ranks):
    serial = answer()
    for found in on_ranks(ranks, "answer", script=__file__):
        assert np.abs(np.array(found["x"]) - serial["x"]).max() < 1e-10
        assert found["work"] == pytest.approx(serial["work"], rel=1e-8)


# input --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ghost": "strong"}, "ghost = 'strong': allowed are None, 'light', 'thesis' and a GhostPenalty"),
        ({"ghost": 3.0}, "ghost = 3.0: allowed are"),
        (
            {"ghost": "light", "basis": "bspline"},
            "cell aggregation, which is always on, serves there. Allowed are 'gimpm' and 'mpm'",
        ),
        ({"ghost": "light", "basis": "bspline3"}, "gradients of basis = 'bspline3' don't jump"),
        ({"ghost": "light", "basis": "mpm", "assembly": "projection"}, "allowed is 'direct'"),
    ],
)
def test_bad_choices(options, message):
    with pytest.raises(pm.InputError, match="ghost") as caught:
        beam(2, **options)
    assert message in str(caught.value)


def test_bad_numbers():
    with pytest.raises(pm.InputError, match=r"displacement = -1\.0: a finite number, not negative"):
        pm.GhostPenalty(-1.0)
    with pytest.raises(pm.InputError, match="rotation = nan: a finite number"):
        pm.GhostPenalty(1.0, float("nan"))
    with pytest.raises(pm.InputError, match="power = 2: allowed are 1 and 3"):
        pm.GhostPenalty(1.0, power=2)


def test_moduli_are_found_by_name():
    penalty = beam(2, ghost="thesis").ghost
    assert penalty == pm.GhostPenalty(30.0, 0.17, power=3)
    light = beam(2, ghost="light").ghost
    assert light.displacement == pytest.approx(0.03, rel=1e-12)
    assert light.power == 1
    soft = pm.MicropolarElastic(lam=0.0, mu=2e3, kappa=7e2, alpha=0.0, beta=0.0, gamma=0.0)
    assert beam(2, soft, ghost="thesis").ghost == pm.GhostPenalty(20.0, 0.0, power=3)
    assert beam(2, NEO_HOOKEAN, ghost="thesis").ghost == pm.GhostPenalty(30.0, 0.0, power=3)
    nameless = pm.UserEnergy(lambda E, G, p: p.a * (ufl.inner(E, E) + ufl.inner(G, G)), {"a": 1.0})
    with pytest.raises(pm.InputError, match="UserEnergy has no parameter named gamma; give numbers"):
        beam(2, nameless, ghost="thesis")
    assert beam(2, nameless, ghost=PENALTY).ghost is PENALTY


if __name__ == "__main__":
    Path(sys.argv[2], f"{COMM.rank}.json").write_text(json.dumps(answer()))


# splines --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("power", [1, 3])
def test_jumps_of_second_derivatives(axis, power):
    """Of a spline that begins at a plane: the penalty is the square of the jump, over the whole face. Linear
    functions have none. The first face is at a wall."""
    h, basis = 0.5, basis_of("bspline")
    grid = pm.Grid.box((0.0, 0.0), (4.0, 3.0), h, MPI.COMM_SELF)
    for index in (np.array([0, 0]), np.array([3, 2])):
        cells = grid.node_number(index[None])
        (matrix,) = curvature_jumps(grid, basis, axis, cells, power)
        count = tuple(3 + (k == axis) for k in range(2))
        nodes = box_indices(count) + index
        straight = basis.positions(grid, grid.node_number(nodes)) @ (0.3, -0.7) + 2.0
        assert straight @ matrix @ straight == pytest.approx(0.0, abs=1e-10)
        # control values of max(0, t)^2, t the distance from the plane: of the last function alone
        kink = np.where(nodes[:, axis] == index[axis] + 3, 1.0, 0.0)
        side = grid.node_position(cells)[0] + (np.arange(2) == axis) * h
        here = (index + (np.arange(2) == axis))[None]
        second = basis.curvatures(grid, side[None], here)[0, axis, 2]
        wanted = h ** (2 + power) * second**2 * h
        assert kink @ matrix @ kink == pytest.approx(wanted, rel=1e-12)


def test_splines_take_a_penalty():
    """It holds a sliver's nodes, and a uniform strain feels nothing of it."""
    answers = []
    for ghost in (None, pm.GhostPenalty(1e2)):
        grid = pm.Grid.box((0.0, 0.0), (5.0, 4.0), 1.0)
        points = pm.seed(grid, bounds=((0.0, 0.3), (3.1, 2.3)), material=NEO_HOOKEAN)
        problem = pm.QuasiStatic(grid, points, ghost=ghost, boxes=False, reset=None)
        problem.fix(pm.plane(x=0.0), ux=0.0)
        problem.fix(lambda x: (x[:, 0] > 2.9) & (x[:, 0] < 9.0), ux=lambda t: 0.0 * t)
        problem.fix(lambda x: x[:, 1] < 0.1, uy=0.0)
        problem.body_load(force=(0.0, 5.0))
        list(problem.march(1, progress=False))
        answers.append(problem.energies())
    assert answers[0]["ghost"] == 0.0
    assert 0.0 < answers[1]["ghost"] < 0.1 * answers[1]["stored"]
    assert answers[1]["stored"] == pytest.approx(answers[0]["stored"], rel=0.1)
