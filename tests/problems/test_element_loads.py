"""Loads on finite elements, supports by groups of facets, and what reactions say about them."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.kinematics import rotations
from tests.conftest import MICROPOLAR, NEO_HOOKEAN, derivative_error, release_supports, rotation
from tests.helpers.bodies import (
    DIMENSION,
    box,
    cantilever,
    everywhere,
    own_rows,
    prepared,
    residual_at,
    tangent_at,
)

CELLS = [("quadrilateral", 1), ("triangle", 2), ("hexahedron", 1)]
F_OF = {
    2: rotation([0, 0, 0.7]) @ np.array([[1.3, 0.2, 0], [0.1, 0.8, 0], [0, 0, 1]]),
    3: rotation([0.5, -0.3, 0.7]) @ np.array([[1.3, 0.2, 0.1], [0.1, 0.8, -0.2], [0.0, 0.15, 1.1]]),
}


def block(cell, degree=1, material=MICROPOLAR, **options):
    """An unsupported block of size 2 x 1 (x 1.5) cut into cells, its own problem."""
    dim = DIMENSION[cell]
    size = (2.0, 1.0, 1.5)[:dim]
    body = pm.Elements(box(cell, (2,) * dim, size, **options), material=material, degree=degree)
    return pm.QuasiStaticFEM(body)


def loads_after(problem, F, vector=(0.0, 0.0, 0.0), steps=2):
    """Nodal loads (n, block) of all ranks at the positions x = F X, where the body has been led in steps."""
    dim, e = problem.layout.dim, problem.elements
    motion = lambda t, X: t * X @ (F - np.eye(3))[:dim, :dim].T  # noqa: E731
    theta = {} if not problem.layout.rotations else {"theta": vector if dim == 3 else vector[2]}
    problem.fix(everywhere, u=motion, **theta)
    list(problem.march(steps))
    system = problem.system
    x = own_rows(problem, e.nodes.position).reshape(-1, dim) @ F[:dim, :dim].T
    return x, own_rows(problem, system.external).reshape(len(x), -1)


def total(x, loads):
    """Resultant force and moment about the origin of nodal loads, couples included."""
    dim = x.shape[1]
    x3, f3 = np.zeros((len(x), 3)), np.zeros((len(x), 3))
    x3[:, :dim], f3[:, :dim] = x, loads[:, :dim]
    moment = np.cross(x3, f3).sum(axis=0)[2 if dim == 2 else 0 :]
    if loads.shape[1] > dim:
        moment += loads[:, dim:].sum(axis=0)
    return f3.sum(axis=0)[:dim], moment


def face(dim):
    """Area, middle, normal and tangents of the face x = 2 of the block."""
    size = np.array([2.0, 1.0, 1.5])[:dim]
    middle = 0.5 * size
    middle[0] = size[0]
    return np.prod(size[1:]), middle, np.eye(dim)


# resultants by hand --------------------------------------------------------------------------------
@pytest.mark.parametrize(("cell", "degree"), CELLS)
def test_load_is_a_total(cell, degree):
    """Whatever the mesh and the deformation, the force and couple given arrive, the force in the middle."""
    problem, dim = block(cell, degree), DIMENSION[cell]
    middle = face(dim)[1]
    force = np.array([3.0, -5.0, 7.0])[:dim]
    couple = np.array([4.0]) if dim == 2 else np.array([4.0, -6.0, 5.0])
    problem.load(problem.elements.facets(pm.plane(x=2.0)), force=force, couple=couple)
    x, loads = loads_after(problem, F_OF[dim])
    found, moment = total(x, loads)
    np.testing.assert_allclose(found, force, rtol=1e-10)
    np.testing.assert_allclose(loads[:, dim:].sum(axis=0), couple, rtol=1e-10)
    lever = (F_OF[dim][:dim, :dim] @ middle, force)
    expected = np.cross(*lever) + couple if dim == 3 else np.array([_cross2(*lever)]) + couple
    np.testing.assert_allclose(moment, expected, rtol=1e-10)


def _cross2(a, b):
    return a[0] * b[1] - a[1] * b[0]


@pytest.mark.parametrize(("cell", "degree"), CELLS)
@pytest.mark.parametrize("follows", [False, True])
def test_traction(cell, degree, follows):
    """Dead: force per undeformed area. Following: the normal part along the current normal, the tangential
    one along the convected direction, both per current area. The resultant acts in the middle."""
    problem, dim = block(cell, degree), DIMENSION[cell]
    area, middle, axes = face(dim)
    F = F_OF[dim][:dim, :dim]
    given = np.array([30.0, -50.0, 0.0])[:dim]
    problem.traction(pm.plane(x=2.0), force=given, follows=follows)
    x, loads = loads_after(problem, F_OF[dim])
    expected = area * given
    if follows:
        current = area * np.linalg.det(F) * np.linalg.inv(F).T @ axes[0]  # Nanson
        along = F @ axes[1] / np.linalg.norm(F @ axes[1])
        expected = 30.0 * current - 50.0 * np.linalg.norm(current) * along
    force, moment = total(x, loads)
    np.testing.assert_allclose(force, expected, rtol=1e-10)
    lever = (F @ middle, expected)
    np.testing.assert_allclose(
        moment, np.cross(*lever) if dim == 3 else [_cross2(*lever)], rtol=1e-10, atol=1e-10
    )


def test_tractions_that_follow_agree_in_a_pure_turn():
    """Turned by 130 degrees, a following traction is the dead one turned."""
    turn = rotation(np.radians(130) * np.array([2.0, -1.0, 2.0]) / 3)
    problem = block("hexahedron")
    given = np.array([30.0, -50.0, 40.0])
    problem.traction(pm.plane(x=2.0), force=given, follows=True)
    problem.traction(pm.plane(x=2.0), couple=given, follows=True)
    vector = np.radians(130) * np.array([2.0, -1.0, 2.0]) / 3
    loads = loads_after(problem, turn, vector, steps=2)[1]
    area = face(3)[0]
    np.testing.assert_allclose(loads[:, :3].sum(axis=0), area * turn @ given, rtol=1e-10)
    couple = np.linalg.solve(rotations.right_tangent(0.5 * vector[None])[0], loads[:, 3:].sum(axis=0))
    np.testing.assert_allclose(couple, area * turn @ given, rtol=1e-10)


@pytest.mark.parametrize(("cell", "degree"), CELLS)
def test_pressure_on_a_face(cell, degree):
    """Against the current normal, on the current area; the resultant acts in the middle of the face."""
    problem, dim = block(cell, degree), DIMENSION[cell]
    area, middle, axes = face(dim)
    F = F_OF[dim][:dim, :dim]
    problem.pressure(pm.plane(x=2.0), 20.0)
    x, loads = loads_after(problem, F_OF[dim])
    expected = -20.0 * area * np.linalg.det(F) * np.linalg.inv(F).T @ axes[0]
    force, moment = total(x, loads)
    np.testing.assert_allclose(force, expected, rtol=1e-10)
    lever = (F @ middle, expected)
    np.testing.assert_allclose(moment, np.cross(*lever) if dim == 3 else [_cross2(*lever)], rtol=1e-10)


@pytest.mark.parametrize(("cell", "degree"), [*CELLS, ("quadrilateral", 2)])
def test_pressure_on_a_closed_surface_has_no_resultant(cell, degree):
    """Neither force nor moment, on cells that are distorted and deformed at random."""
    problem = block(cell, degree, distort=0.1)
    e, dim = problem.elements, DIMENSION[cell]
    surface = e.facets(everywhere)
    problem.pressure(surface, 20.0)
    system = prepared(problem)
    own = np.random.default_rng(2).uniform(-0.15, 0.15, problem.unknowns)
    residual_at(problem, system, own)
    moved = e.nodes.position + system.x[:, :dim]
    x = own_rows(problem, moved).reshape(-1, dim)
    loads = own_rows(problem, system.external).reshape(len(x), -1)
    assert abs(loads).max() > 1.0
    for resultant in total(x, loads):
        np.testing.assert_allclose(resultant, 0.0, atol=1e-11 * abs(loads).sum())


def test_values_may_depend_on_the_position():
    """A load that grows along its face has its resultant off the middle; elsewhere it isn't asked for."""
    problem = block("triangle", 2)

    def growing(t, X):
        assert np.allclose(X[:, 0], 2.0)
        return t * np.stack([0 * X[:, 1], 6.0 * X[:, 1]], axis=1)

    problem.traction(pm.plane(x=2.0), force=growing)
    problem.traction(pm.plane(x=2.0), couple=lambda t, X: 3.0 * t * X[:, 1] ** 2)
    problem.pressure(pm.plane(y=1.0), lambda t, X: 12.0 * t * X[:, 0])
    x, loads = loads_after(problem, np.eye(3))
    force, moment = total(x, loads)
    np.testing.assert_allclose(force, [0.0, 3.0 - 24.0], atol=1e-12)
    # shear at x = 2, couple, pressure with its resultant at x = 4/3
    np.testing.assert_allclose(moment, 2.0 * 3.0 + 1.0 - 24.0 * 4.0 / 3.0, rtol=1e-12)


def test_body_loads_are_totals_of_densities():
    """Constant and position-dependent body forces and couples integrate exactly."""
    problem = block("quadrilateral", 2)
    problem.body_load(force=(3.0, -5.0), couple=7.0)
    problem.body_load(force=lambda t, X: t * X**2)
    loads = loads_after(problem, np.eye(3))[1]
    np.testing.assert_allclose(loads.sum(axis=0), [6.0 + 8 / 3, -10.0 + 2 / 3, 14.0], rtol=1e-12)


# tangents ------------------------------------------------------------------------------------------
def far(x):
    """The face that was at x = 2 before the cells were distorted."""
    return x[:, 0] > 1.7


def add_pressure(problem):
    problem.pressure(everywhere, 400.0, counts="total")


def add_follower(problem):
    dim = problem.layout.dim
    problem.traction(far, force=np.array([300.0, -500.0, 200.0])[:dim], follows=True, counts="total")


def add_couples(problem):
    spatial = problem.layout.dim == 3
    couple = np.array([300.0, -200.0, 500.0]) if spatial else 300.0
    problem.traction(far, couple=couple, counts="total")
    problem.traction(far, couple=couple, follows=True, counts="total")
    problem.load(everywhere, couple=couple, counts="total")
    problem.body_load(couple=couple, counts="total")


@pytest.mark.parametrize("load", [add_pressure, add_follower, add_couples])
@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("triangle", 2), ("hexahedron", 1)])
def test_tangent_of_loads(cell, degree, load):
    """Loads that depend on the unknowns are differentiated, in a state that is deformed already."""
    problem, dim = block(cell, degree, distort=0.1), DIMENSION[cell]
    loads_after(problem, F_OF[dim], 0.4 * np.ones(3), steps=1)
    release_supports(problem)
    load(problem)
    system = prepared(problem)
    x = np.random.default_rng(7).uniform(-0.1, 0.1, (1, problem.unknowns))
    k = tangent_at(problem, system, x[0])
    skew = abs(k - k.T).max() / abs(k).max()
    if load is add_couples and dim == 2:  # the angle moves nothing; but the area under a follower does
        assert skew > 1e-6
    elif load is not add_pressure:
        assert skew > 1e-3
    direction = np.random.default_rng(8).standard_normal(problem.unknowns)
    error = derivative_error(
        lambda y: residual_at(problem, system, x[0] + y[0, 0] * direction)[None],
        lambda y: (tangent_at(problem, system, x[0] + y[0, 0] * direction) @ direction)[None, :, None],
        np.zeros((1, 1)),
    )
    assert error < 1e-7


def test_dead_loads_keep_the_tangent_symmetric():
    """Nothing is made unsymmetric, and so dearer, without need: dead forces, couples in plane strain."""
    problem = cantilever()
    problem.traction(pm.plane(x=4.0), force=(1.0, 2.0), couple=3.0)
    problem.body_load(force=(1.0, 2.0), couple=3.0)
    assert prepared(problem).solver.symmetric


def test_pressure_counts_from_the_deformed_body(strict):
    """A second problem goes on from the state of the elements, where the surface is."""
    problem = block("quadrilateral")
    loads_after(problem, F_OF[2], np.array([0, 0, 0.7]))
    other = pm.QuasiStaticFEM(problem.elements)
    other.pressure(pm.plane(x=2.0), 20.0)
    system = prepared(other)
    F = F_OF[2][:2, :2]
    found = own_rows(other, system.working_loads()).reshape(-1, 3).sum(axis=0)[:2]
    expected = -20.0 * np.linalg.det(F) * np.linalg.inv(F).T @ [1.0, 0.0]
    np.testing.assert_allclose(found, expected, rtol=1e-10)


# equilibrium ---------------------------------------------------------------------------------------
def balanced(cell, material, controls):
    """A problem with all kinds of loads and two supports, solved in two steps, and its external forces."""
    dim = DIMENSION[cell]
    problem = cantilever(cell, material, controls=controls)
    couple = None if not material.micropolar else 6.0 if dim == 2 else (6.0, 4.0, -7.0)
    tip = problem.elements.farthest((1, 0, 0)[:dim])
    problem.load(tip, force=np.array([4.0, -8.0, 5.0])[:dim], couple=couple)
    problem.body_load(force=(1.0, 2.0, -3.0)[:dim])
    problem.pressure(pm.plane(y=1.0), 3.0)
    if material.micropolar:
        problem.fix(lambda x: abs(x[:, 0] - 3.0) < 1e-6, theta=(0.2, 0.3, -0.4) if dim == 3 else -0.4)
    list(problem.march(2))
    return problem, own_rows(problem, problem.system.external).reshape(-1, problem.layout.block)


@pytest.mark.parametrize(
    ("cell", "material"), [("triangle", MICROPOLAR), ("tetrahedron", NEO_HOOKEAN), ("hexahedron", MICROPOLAR)]
)
def test_reactions_balance_the_loads(cell, material, strict):
    """Forces add up to zero, and so do moments and couples.

    In space the latter hold to the accuracy of the mesh only: a rigid turn on top of increments Dw is no
    member of the elements' functions.
    """
    dim = DIMENSION[cell]
    problem, external = balanced(cell, material, strict)
    force = problem.reaction(problem.supports[0])[0]
    np.testing.assert_allclose(force, -external[:, :dim].sum(axis=0), rtol=1e-8)
    if dim == 3 and material.micropolar:
        return
    e, system = problem.elements, problem.system
    x = own_rows(problem, e.nodes.position + e.displacement).reshape(-1, dim)
    reactions = own_rows(problem, system.residual * system.prescribed.fixed).reshape(external.shape)
    np.testing.assert_allclose(total(x, external + reactions)[1], 0.0, atol=1e-7)
    if material.micropolar:
        couples = sum(problem.reaction(s)[1] for s in problem.supports)
        np.testing.assert_allclose(couples, reactions[:, dim:].sum(axis=0), rtol=1e-12)


def turned_end(vector, controls):
    problem = cantilever("hexahedron", controls=controls)
    end = problem.fix(pm.plane(x=4.0), u=(0.0, 0.0, 0.1), theta=vector)
    list(problem.march(1))
    return problem, end


def test_reaction_to_a_turn_in_space(strict):
    """The couple is what does work on a small further turn, also after a finite one about another axis."""
    vector, turn = np.array([0.3, 0.9, -0.6]), 1e-4 * np.eye(3)
    problem, end = turned_end(vector, strict)
    found = problem.reaction(end)[1]
    slope = []
    for small in turn:
        further = [
            rotations.to_vector(
                rotations.multiply(*rotations.from_vector(np.stack([s * small, vector]))[:, None])
            )
            for s in (-1, 1)
        ]
        low, high = (turned_end(w[0], strict)[0].energy() for w in further)
        slope.append((high - low) / 2e-4)
    assert abs(found).max() > 1.0
    np.testing.assert_allclose(found, slope, rtol=1e-6)


def test_reactions_of_two_supports(strict):
    """Each support answers for its own nodes and components: a roller only for the direction it holds."""
    body = pm.Elements(box("quadrilateral", (4, 2), (4.0, 1.0)), material=NEO_HOOKEAN)
    problem = pm.QuasiStaticFEM(body, controls=strict)
    left = problem.fix(body.facets(pm.plane(x=0.0)), ux=0)
    bottom = problem.fix(body.facets(pm.plane(y=0.0)), uy=0)
    problem.load(body.facets(pm.plane(x=4.0)), force=(10.0, 0.0))
    problem.load(body.facets(pm.plane(y=1.0)), force=(0.0, -6.0))
    list(problem.march(1))
    np.testing.assert_allclose(problem.reaction(left)[0], [-10.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(problem.reaction(bottom)[0], [0.0, 6.0], atol=1e-8)


def test_prescribed_rotations(strict):
    """A turned end takes its rotation, past a turn by half, and its couple is the strain energy's slope."""
    problem = cantilever("quadrilateral", controls=strict)
    end = problem.elements.facets(pm.plane(x=4.0))
    support = problem.fix(end, theta=lambda t: t)
    work = []
    list(problem.march(8, to=3.5))
    np.testing.assert_allclose(problem.elements.rotation_vector[end.nodes, 2] % (2 * np.pi), 3.5, rtol=1e-12)
    couple = problem.reaction(support)[1][0]
    for factor in (3.5 - 1e-4, 3.5 + 1e-4):
        list(problem.march(1, to=factor))
        work.append(problem.energy())
    assert couple == pytest.approx((work[1] - work[0]) / 2e-4, rel=1e-6)


# mistakes ------------------------------------------------------------------------------------------
def test_mistakes_are_named():
    """What was given and what is allowed, before anything is solved."""
    problem, solid = cantilever(), cantilever("tetrahedron", NEO_HOOKEAN)
    body, end = problem.elements, pm.plane(x=4.0)
    for call, message in [
        (lambda: problem.load(pm.plane(x=3.3), force=1.0), "no facet on the boundary"),
        (lambda: problem.load(lambda x: x[:, 0] > 9, force=1.0), "no facet on the boundary"),
        (lambda: problem.load(lambda x: x[:, 0], force=1.0), "a bool for each of the"),
        (lambda: problem.load(3.0, force=1.0), r"facets = 3\.0: a physical group, a plane or"),
        (lambda: problem.fix(pm.plane(x=3.3), u=0), r"x = 3\.3: no node"),
        (lambda: problem.fix(pm.plane(z=0.0), u=0), "plane z: the mesh has 2 dimensions"),
        (lambda: problem.fix(3.0, u=0), r"where = 3\.0"),
        (lambda: problem.fix(end, uz=0), "unknown component 'uz'"),
        (lambda: solid.fix(end, theta=0), "no microrotation"),
        (lambda: solid.load(end, couple=1.0), "no microrotation"),
        (lambda: solid.traction(end, couple=1.0), "no microrotation"),
        (lambda: solid.load(end, force=(1.0, 2.0)), "3 numbers are"),
        (lambda: problem.pressure(end, (1.0, 2.0)), "one number"),
        (lambda: problem.pressure(end, None), "no pressure is given"),
        (lambda: problem.traction(end), "neither force nor couple"),
        (lambda: problem.load(end, force=np.nan), "nan"),
        (lambda: problem.reaction(problem.supports[0]), "no load step has been solved"),
        (lambda: body.farthest((1, 0, 0)), "direction"),
    ]:
        with pytest.raises(pm.InputError, match=message):
            call()


def test_values_that_are_wrong_later_leave_the_state():
    """A function that returns NaN, or too few numbers, is named with the load factor."""
    for value, message in [
        (lambda t, X: np.where(X > 0.5, np.nan, 1.0), r"traction 1 \(x = 4\), force is nan at load factor 1"),
        (lambda t, X: np.ones((len(X), 3)), "2 numbers are needed"),
    ]:
        problem = cantilever()
        problem.traction(pm.plane(x=4.0), force=value)
        with pytest.raises(pm.InputError, match=message):
            list(problem.march(1))
        assert problem.progress.factor == 0.0
