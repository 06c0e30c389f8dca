"""Slopes that are held on planes, and what else ties nodes together."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.basis.registry import BASES
from polarmpm.conditions.supports import Mirror, Support
from polarmpm.conditions.ties import Ties
from polarmpm.geometry.nodes import ActiveNodes
from polarmpm.terms.base import Boxes, Piece
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, by_id
from tests.helpers.bodies import cantilever

STRICT = pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-26)


def beam(
    basis: str = "bspline", material: pm.Material = NEO_HOOKEAN, *, low: float = 0.0, **options: Any
) -> pm.QuasiStatic:
    """A beam of 4 x 1, or from x = low on, in a grid that it fills along x."""
    grid = pm.Grid.box((0.0, -2.0), (4.0, 2.0), 0.5)
    points = pm.seed(grid, material=material, bounds=((low, 0.0), (4.0, 1.0)))
    return pm.QuasiStatic(grid, points, basis=basis, controls=STRICT, **{"reset": None, **options})


def bent(problem: pm.QuasiStatic, steps: int = 2) -> np.ndarray:
    """Displacements of the points under a weight that bends the beam. Collective."""
    problem.body_load(force=lambda t: (0.0, -12.0 * t))
    list(problem.march(steps, progress=False))
    assert problem.balance().residue == pytest.approx((0.0, 0.0), abs=1e-9)
    return by_id(problem.points, problem.points.displacement)


@pytest.mark.parametrize("reset", [None, 1])
@pytest.mark.parametrize("material", [NEO_HOOKEAN, MICROPOLAR], ids=["classical", "micropolar"])
@pytest.mark.parametrize(("basis", "second"), [("bspline", 0.25), ("bspline3", 0.5 / 3)])
def test_a_clamp_that_holds_the_slope(basis, second, material, reset):
    """It fixes the first two layers of control values. It is stiffer by a part of a cell's length."""
    theta = {"theta": 0} if material.micropolar else {}
    options = {"basis": basis, "material": material, "reset": reset}
    clamped, layers, free = beam(**options), beam(**options), beam(**options)
    clamp = clamped.fix(pm.plane(x=0.0), u=0, slope=0, **theta)
    layers.fix(lambda x: x[:, 0] < second + 1e-9, u=0)
    if theta:
        layers.fix(pm.plane(x=0.0), theta=0)
    free.fix(pm.plane(x=0.0), u=0, **theta)
    found = bent(clamped)
    np.testing.assert_allclose(found, bent(layers), atol=1e-12 * np.abs(found).max())
    softer = np.abs(bent(free)).max()
    assert 0.7 * softer < np.abs(found).max() < 0.999 * softer
    reaction = clamped.reaction(clamp)
    assert reaction.force == pytest.approx((0.0, 48.0), abs=1e-8)
    assert reaction.moment[0] == pytest.approx(-clamped.balance().parts[0].moment[0], rel=1e-9)


def test_slopes_of_single_components():
    """The slope across and the displacement on the plane are told apart, in any combination."""
    for words in ({"ux": 0, "slope_y": 0}, {"u": 0, "slope_x": 0}, {"ux": 0, "slope": 0}):
        one, two = beam(), beam()
        one.fix(pm.plane(x=0.0), **words)
        for name, value in words.items():
            two.fix(pm.plane(x=0.0), **{name: value})
        for problem in (one, two):
            if "u" not in words:
                problem.fix(lambda x: x[:, 0] > 3.9, uy=0)
        np.testing.assert_allclose(bent(one), bent(two), atol=1e-12)
        first = [one.reaction(s).force for s in one.supports]
        assert np.sum(first, axis=0)[1] == pytest.approx(48.0, rel=1e-9)
    mirror = beam()
    mirror.symmetry(pm.plane(x=0.0))
    apart = beam()
    apart.fix(pm.plane(x=0.0), ux=0, slope_y=0)
    for problem in (mirror, apart):
        problem.fix(pm.plane(x=4.0), u=0)
    np.testing.assert_allclose(bent(mirror), bent(apart), atol=1e-13)


def test_who_carries_what():
    """The slope's own support has no force, but a moment, that of a double force; the sum is the clamp's."""
    together, apart = beam(), beam()
    clamp = together.fix(pm.plane(x=0.0), u=0, slope=0)
    place, slope = apart.fix(pm.plane(x=0.0), u=0), apart.fix(pm.plane(x=0.0), slope=0)
    bent(together), bent(apart)
    one, two, three = together.reaction(clamp), apart.reaction(place), apart.reaction(slope)
    np.testing.assert_allclose(three.force, 0.0, atol=1e-9)
    assert abs(three.moment[0]) > 1.0
    np.testing.assert_allclose(two.force + three.force, one.force, atol=1e-9)
    np.testing.assert_allclose(two.moment + three.moment, one.moment, atol=1e-9)
    assert repr(slope) == "Support('support 2 (x = 0)': slopes)"


@pytest.mark.parametrize("first", [True, False])
def test_what_is_tied_to_a_prescribed_node_is_prescribed(first):
    """Either layer may be prescribed by another support, also with values that change."""
    problem, both = beam("bspline", reset=1), beam("bspline", reset=1)
    for one in (problem, both):
        one.fix(pm.plane(x=4.0), u=0)
    held = (lambda x: x[:, 0] < 0.1) if first else (lambda x: np.abs(x[:, 0] - 0.25) < 0.1)
    given = {"uy": lambda t: -0.2 * t, "ux": lambda t, x: 0.1 * t * x[:, 1]}
    support = problem.fix(held, **given)
    slope = problem.fix(pm.plane(x=0.0), slope=0)
    both.fix(lambda x: x[:, 0] < 0.3, **given)
    np.testing.assert_allclose(bent(problem), bent(both), atol=1e-12)
    np.testing.assert_allclose(
        problem.reaction(support).force + problem.reaction(slope).force,
        both.reaction(both.supports[1]).force,
        rtol=1e-9,
    )


def test_a_body_that_does_not_touch_the_walls_cells():
    """One layer of the wall's functions reaches it: tied to one that isn't active, it is free."""
    far, same = beam(low=0.5), beam(low=0.5)
    for problem in (far, same):
        problem.fix(pm.plane(x=4.0), u=0)
    far.fix(pm.plane(x=0.0), slope=0)
    same.symmetry(pm.plane(x=0.0))
    with pytest.raises(pm.InputError, match=r"support 2 \(x = 0\) holds nothing"):
        far.attempt(1.0)
    with pytest.raises(pm.InputError, match=r"support 2 \(symmetry, x = 0\) holds nothing"):
        same.attempt(1.0)


def test_steps_that_fail_leave_all_as_it_was():
    problem = beam()
    problem.symmetry(pm.plane(x=0.0))
    problem.fix(pm.plane(x=4.0), u=0)
    problem.body_load(force=lambda t: (0.0, -12.0 * t))
    list(problem.march(1, to=0.5, progress=False))
    before = problem.system.x.copy()
    assert not problem.attempt(1e7).converged
    np.testing.assert_array_equal(problem.system.x, before)
    steps = list(problem.march(1, adaptive=True, progress=False))
    assert steps[-1].factor == 1.0
    again = beam()
    again.symmetry(pm.plane(x=0.0))
    again.fix(pm.plane(x=4.0), u=0)
    np.testing.assert_allclose(by_id(problem.points, problem.points.displacement), bent(again), atol=1e-9)


# chains -----------------------------------------------------------------------------------------------
def all_nodes(basis: str, shape: tuple[int, ...]) -> ActiveNodes:
    """All nodes of a lattice, on one rank."""
    grid = pm.Grid.box((0.0,) * len(shape), tuple(map(float, shape)), 1.0, MPI.COMM_SELF)
    index = np.stack(np.indices([n + BASES[basis].degree for n in shape]), -1).reshape(-1, len(shape))
    return ActiveNodes.build(grid, np.sort(grid.node_number(index)))


def mirrors(basis: str, planes: list[tuple[int, int]], grid: pm.Grid, block: int) -> list[Support]:
    """Planes of symmetry (axis, side) of all of its components."""
    out = []
    for axis, side in planes:
        index = 0 if side < 0 else grid.shape[axis]
        even = {column: column != axis for column in range(block)}
        out.append(
            Support(f"{axis} {side}", lambda x: x, {}, mirror=Mirror(BASES[basis], axis, index, side, even))
        )
    return out


@pytest.mark.parametrize("basis", ["bspline", "bspline3"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (4, 2), (2, 3, 1), (3, 2, 3)])
def test_chains(basis, shape):
    """What is free parametrises all values that fulfil the ties, and no others; forces are folded by the
    transposed of that; what supports do, and what acts on what is left, sums up to the forces."""
    d, rng = len(shape), np.random.default_rng(1)
    nodes = all_nodes(basis, shape)
    planes = [(axis, side) for axis in range(d) for side in (-1, 1) if side < 0 or axis != 1]
    supports = mirrors(basis, planes, nodes.grid, d)
    index = nodes.grid.node_index(nodes.lattice)
    fixed = np.zeros((len(nodes), d), dtype=bool)
    rows = []
    for (axis, side), support in zip(planes, supports, strict=True):
        on = index[:, axis] == (0 if side < 0 else shape[axis] + BASES[basis].degree - 1)
        fixed[on, axis] = True
        for column, even in support.mirror.even.items():
            for layer in BASES[basis].mirror(nodes.grid, axis, support.mirror.index, side, even):
                for node in np.flatnonzero(index[:, axis] == layer.follower):
                    lead = nodes.find(
                        nodes.lattice[[node]] + (layer.leader - layer.follower) * nodes.grid.strides[axis]
                    )
                    row = np.zeros((len(nodes), d))
                    row[node, column] = 1.0
                    row[lead[0], column] -= layer.factor
                    rows.append(row.ravel())
    rows += list(np.eye(fixed.size)[fixed.ravel()])
    constraints = np.array(rows)
    ties = Ties(nodes, supports, fixed, MPI.COMM_SELF)
    free = ~(ties.fixed | ties.tied)
    assert free.sum() == fixed.size - np.linalg.matrix_rank(constraints)
    T = []
    for k in np.flatnonzero(free):
        x = np.zeros(fixed.size)
        x[k] = 1.0
        x = x.reshape(fixed.shape)
        ties.follow(x)
        T.append(x.ravel())
    T = np.array(T).T
    np.testing.assert_allclose(constraints @ T, 0.0, atol=1e-15)
    forces = rng.normal(size=fixed.shape)
    folded = ties.fold(forces)
    np.testing.assert_allclose(folded[free], T.T @ forces.ravel(), atol=1e-14)
    np.testing.assert_array_equal(folded[~free], 0.0)
    rest, shares = ties.shares(forces)
    np.testing.assert_allclose(rest + sum(shares.values()), forces, atol=1e-13)
    np.testing.assert_allclose(rest[free], folded[free], atol=1e-13)
    assert not np.any(rest[~free & ~fixed])
    for force in shares.values():  # ties do no work
        np.testing.assert_allclose(T.T @ force.ravel(), 0.0, atol=1e-13)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("basis", ["bspline", "bspline3"])
def test_the_folded_matrix(basis, dim):
    """T' K T of the free unknowns, the identity or nothing but a diagonal beside."""
    if COMM.size > 1:
        pytest.skip("one rank's matrix")
    grid = pm.Grid.box((0.0,) * dim, (2.0,) * dim, 1.0)
    found = []
    for tied in (True, False):
        points = pm.seed(grid, material=MICROPOLAR, points_per_cell=2)
        problem = pm.QuasiStatic(grid, points, basis=basis, solver="direct")
        for axis in "xyz"[:dim]:
            support = problem.symmetry(pm.plane(**{axis: 0.0}))
            if not tied:
                support.mirror = None
        problem.body_load(force=(1.0,) * dim)
        system = problem.system_at(1.0)
        system.evaluate(True)
        system.solve_free(system.residual, True)
        whole = system.tangent.convert("aij", out=PETSc.Mat()).getValues(*2 * [range(system.tangent.size[0])])
        upper = np.triu(whole)
        found.append((system.prescribed, upper + np.triu(upper, 1).T))
    (prescribed, folded), (_, plain) = found
    free, ties = prescribed.free.ravel(), prescribed.ties
    T = np.zeros((free.size, free.size))
    for k in np.flatnonzero(free):
        x = np.zeros(prescribed.free.shape)
        x.ravel()[k] = 1.0
        ties.follow(x)
        T[:, k] = x.ravel()
    expected = (T.T @ plain @ T)[np.ix_(free, free)]
    np.testing.assert_allclose(folded[np.ix_(free, free)], expected, atol=1e-12 * np.abs(expected).max())
    assert np.any(ties.tied)
    np.testing.assert_array_equal(folded[np.ix_(~free, free)], 0.0)
    beside = folded[np.ix_(~free, ~free)]
    np.testing.assert_array_equal(beside, np.diag(np.diag(beside)))
    assert np.all(np.diag(beside) > 0.0)


class Spring(Piece):
    """Between the ends of a row of nodes."""

    name, pairs, linear = "far spring", np.array([[1, 1]]), True

    def __init__(self, boxes: Boxes):
        self.boxes = boxes
        n = int(np.prod(boxes.count))
        self.matrix = np.zeros((1, n, n, 1))
        self.matrix[0, [0, 0, -1, -1], [0, -1, 0, -1], 0] = 1.0, -1.0, -1.0, 1.0

    def forces(self, x: np.ndarray) -> np.ndarray:
        out = np.zeros_like(x)
        out[..., 1] = np.einsum(
            "mabk,mb->ma", np.broadcast_to(self.matrix, (len(x), *self.matrix.shape[1:])), x[..., 1]
        )
        return out

    def matrices(self, x: np.ndarray) -> np.ndarray:
        return self.matrix


class Springs(pm.Term):
    def __init__(self, count: tuple[int, int]):
        self.count = count

    def pieces(self, setting: Any) -> list[Piece]:
        first = 0 if setting.comm.rank == 0 else 1
        lowest = setting.grid.node_number(np.array([[0, 5]]))[first:]
        return [Spring(Boxes(self.count, lowest))]


def test_terms_of_a_script():
    """What acts on tied nodes alone acts on their masters; what couples them with far ones needs room."""
    answers = []
    for plane in ("symmetry", "fix"):
        problem = beam()
        problem.fix(pm.plane(x=4.0), u=0)
        if plane == "symmetry":
            problem.symmetry(pm.plane(x=0.0))
        else:
            problem.fix(pm.plane(x=0.0), ux=0, slope_y=0)
        problem.add(Springs((1, 2)))
        answers.append(bent(problem))
    np.testing.assert_allclose(*answers, atol=1e-13)
    problem = beam()
    problem.fix(pm.plane(x=4.0), u=0)
    problem.symmetry(pm.plane(x=0.0))
    problem.add(Springs((1, 5)))
    with pytest.raises(pm.InputError, match="a term acts on nodes at a plane with a slope or symmetry"):
        problem.attempt(1.0)


# messages ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: p.fix(pm.plane(x=0.0), slope=0.1), r"fix: slope = 0.1: 0 is allowed: slopes can be held"),
        (lambda p: p.fix(pm.plane(x=0.0), slope=True), "fix: slope = True: 0 is allowed"),
        (lambda p: p.fix(pm.plane(x=0.0), slope=lambda t: 0.0), "fix: slope = .*: 0 is allowed"),
        (lambda p: p.fix(pm.plane(x=0.0), slope_y=np.nan), "fix: slope_y = nan: 0 is allowed"),
        (
            lambda p: p.fix(lambda x: x[:, 0] < 0, slope=0),
            "slope = 0: a slope is held on a plane of the grid",
        ),
        (
            lambda p: p.fix(pm.plane(x=0.0), slope_z=0),
            "unknown component 'slope_z'.* slopes of nodes on a plane are slope, slope_x, slope_y",
        ),
        (
            lambda p: p.fix(pm.plane(x=1.0), slope=0),
            r"plane x = 1 is not a boundary plane .* allowed are 0 and 4",
        ),
        (
            lambda p: p.fix(pm.plane(x=0.0), slope=0, stiffness=1.0),
            "stiffness belongs to springs on a Surface",
        ),
        (lambda p: p.symmetry("x"), "symmetry: where = 'x': a plane, such as"),
        (lambda p: p.symmetry(pm.plane(z=0.0)), "symmetry: plane z = 0: the body has 2 dimensions"),
        (lambda p: p.symmetry(pm.plane(x=1.0)), "plane x = 1 is not a boundary plane"),
    ],
)
def test_what_is_refused(call, message):
    problem = beam()
    with pytest.raises(pm.InputError, match=message):
        call(problem)
    assert problem.supports == ()


def test_what_bases_and_elements_refuse():
    for basis in ("mpm", "gimpm"):
        problem = beam(basis)
        with pytest.raises(
            pm.InputError, match=f"basis = '{basis}', allowed is .*'bspline3'.*: its functions have kinks"
        ):
            problem.fix(pm.plane(x=0.0), u=0, slope=0)
        with pytest.raises(pm.InputError, match="symmetry: plane x = 1: the body has points on both sides"):
            problem.symmetry(pm.plane(x=1.0))
        assert problem.supports == ()
    elements = cantilever(material=NEO_HOOKEAN)
    with pytest.raises(pm.InputError, match="slope = 0: none of the body's materials has second gradients"):
        elements.fix(pm.plane(x=0.0), u=0, slope=0)
    problem = beam()
    problem.fix(pm.plane(x=0.0), u=0)
    problem.attempt(1.0)
    with pytest.raises(pm.InputError, match="counts = 'total': a slope has no total in mid-run"):
        problem.fix(pm.plane(x=4.0), u=0, slope=0, counts="total")
