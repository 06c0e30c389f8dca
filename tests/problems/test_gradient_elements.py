"""Elements with second gradients: C0 interior penalty against closed forms, and all that a problem does."""

from __future__ import annotations

import itertools

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.io import restart
from tests.conftest import COMM, NEO_HOOKEAN, by_id, rotation
from tests.helpers.bodies import at_nodes, box, own_rows, prepared, put, residual_at, tangent_at
from tests.helpers.gradient import gradient_solid
from tests.helpers.gradientbodies import clamped_beam, curved_ring, pressed_ring, ring, ring_displacement
from tests.helpers.ranks import close, on_ranks, report

SOLID = gradient_solid(1e3, 0.3, (0.5, 0.8))
IN_SPACE = gradient_solid(1e3, 0.2, (0.5, 0.8, 0.3))


def largest(values: np.ndarray) -> float:
    return COMM.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX)


# the ring of Gao and Park ------------------------------------------------------------------------------
def ring_error(problem: pm.QuasiStaticFEM, load: float = 1e-5) -> float:
    """Largest error of the displacement, relative to the largest displacement."""
    body = problem.elements
    list(problem.march(1, progress=False))
    radius = np.linalg.norm(body.nodes.position, axis=1)
    exact = ring_displacement(54.0189e6, 20e9, 4 / 12**0.5)(radius)[:, None] * body.nodes.position
    exact = exact / radius[:, None]
    return largest(body.displacement / load - exact) / largest(exact)


def test_ring_converges_with_order_two():
    assert ring_displacement(54.0189e6, 20e9, 4 / 12**0.5)([2.0])[0] == pytest.approx(-9.49126e-3, rel=1e-6)
    errors = [ring_error(pressed_ring(ring(n, 2 * n))) for n in (4, 8, 16)]
    assert np.all(np.array(errors) < [1.4e-3, 3.5e-4, 9e-5])
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.05)


def test_ring_of_triangles_converges():
    errors = [ring_error(pressed_ring(ring(n, 2 * n, "triangle"))) for n in (8, 16, 32)]
    assert errors[0] < 2.5e-2
    assert np.log2(errors[1] / errors[2]) > 1.5


@pytest.mark.parametrize("cell", ["quadrilateral", "triangle"])
def test_ring_of_degree_3(cell):
    """What is left is the error of its straight sides: of order 2."""
    errors = [ring_error(pressed_ring(ring(n, 2 * n, cell), degree=3)) for n in (4, 8, 16)]
    quadratic = ring_error(pressed_ring(ring(16, 32, cell)))
    assert errors[2] < 0.51 * quadratic
    assert np.log2(errors[1] / errors[2]) > 2.0
    if cell == "quadrilateral":
        curved = [ring_error(pressed_ring(curved_ring(n, 2 * n), degree=3)) for n in (2, 4, 8)]
        assert np.all(np.array(curved) < [6e-5, 5.3e-6, 3.9e-7])
        assert np.log2(curved[1] / curved[2]) > 3.7


def test_size_of_the_penalty_changes_nothing():
    found = [pressed_ring(ring(16, 32), slope_penalty=eta) for eta in (5.0, 100.0)]
    errors = [ring_error(problem) for problem in found]
    assert abs(errors[0] - errors[1]) < 1e-6
    ends = [problem.elements.displacement for problem in found]
    assert largest(ends[0] - ends[1]) < 1e-5 * largest(ends[0])


def test_symmetry_without_slopes_is_another_problem():
    """A quarter that forgets du_t/dn = 0 doesn't stay round: it guards the support."""
    problem = pressed_ring(ring(8, 16), slopes=False)
    assert ring_error(problem) == pytest.approx(0.059, abs=0.002)
    body = problem.elements
    x = body.nodes.position
    radius = np.linalg.norm(x, axis=1)
    hole = np.abs(radius - 2) < 1e-9
    u = np.einsum("ni,ni->n", body.displacement, x)[hole] / 2
    most = COMM.allreduce(float(u.max(initial=-1)), op=MPI.MAX)
    least = -COMM.allreduce(float(-u.min(initial=0)), op=MPI.MAX)
    assert 0.07 < (most - least) / abs(most + least) * 2 < 0.1


# bending, bars, cantilevers ----------------------------------------------------------------------------
@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize(
    ("cell", "cells"),
    [("quadrilateral", (4, 2)), ("triangle", (4, 2)), ("hexahedron", (2, 2, 1)), ("tetrahedron", (2, 1, 1))],
)
def test_pure_bending_is_exact(cell, cells, degree, strict):
    """The classical field holds with l/h = 1/2 across the thickness; its energy is 1.25 of that of l = 0."""
    dim, energies = len(cells), np.zeros(2)
    # strains of 1e-6, both ways: what is of third order in them cancels
    for k, (row, length) in itertools.product((1e-6, -1e-6), enumerate((0.5, 0.0))):

        def bent(t: float, X: np.ndarray, k: float = k) -> np.ndarray:
            rest = [0 * X[:, 0]] * (dim - 2)
            return np.stack([k * t * X[:, 0] * (X[:, 1] - 0.5), -k * t * X[:, 0] ** 2 / 2, *rest], axis=1)

        solid = gradient_solid(1e3, 0.0, (0.0, length, 0.0)[:dim])
        body = pm.Elements(box(cell, cells, (2.0, 1.0, 1.0)[:dim]), material=solid, degree=degree)
        problem = pm.QuasiStaticFEM(body, controls=strict)
        problem.fix(lambda x: (np.abs(x[:, 0]) < 1e-9) | (np.abs(x[:, 0] - 2) < 1e-9), u=bent)
        list(problem.march(1, progress=False))
        assert largest(body.displacement - bent(1.0, body.nodes.position)) < 1e-5 * abs(k)
        energies[row] += problem.energy()
        assert abs(problem.energies()["faces"]) < 1e-7 * problem.energy()
    assert energies[0] / energies[1] == pytest.approx(1.25, abs=1e-9)


def test_bar_with_a_held_slope():
    """u(L) = sigma/E (L - g tanh(L/g)): the clamp's boundary layer, order 2 (degree - 1)."""
    g = 1 / 12**0.5
    exact = 1 - g * np.tanh(1 / g)
    assert exact == pytest.approx(0.711890, abs=1e-6)
    errors = held_bar((4, 8, 16, 32), 2, exact)
    assert np.all(np.array(errors) < [5.8e-3, 1.8e-3, 5.1e-4, 1.4e-4])
    assert np.log2(errors[2] / errors[3]) > 1.85
    better = held_bar((4, 8, 16), 3, exact)
    assert np.all(np.array(better) < [8.5e-5, 5.8e-6, 3.8e-7])
    assert np.log2(better[1] / better[2]) > 3.85


def held_bar(cells: tuple[int, ...], degree: int, exact: float) -> list[float]:
    errors = []
    for n in cells:
        solid = gradient_solid(1e3, 0.0, (1.0, 0.0))
        body = pm.Elements(box("quadrilateral", (n, 1)), material=solid, degree=degree)
        problem = pm.QuasiStaticFEM(body)
        problem.fix(pm.plane(x=0.0), ux=0, slope_x=0)
        problem.fix(pm.plane(y=0.0), uy=0)
        problem.load(pm.plane(x=1.0), force=(1e-3, 0.0))
        list(problem.march(1, progress=False))
        errors.append(abs(body.mean_displacement(body.facets(pm.plane(x=1.0)))[0] * 1e6 - exact))
    return errors


@pytest.mark.parametrize(
    ("cells", "lengths", "held", "tip"),
    [
        ((40, 1), (0.0, 1.0), True, (-0.15812, 0.48863)),
        ((40, 2), (0.0, 1.0), True, (-0.15788, 0.48819)),
        ((40, 2), (0.0, 1.0), False, (-0.16167, 0.49525)),
        ((40, 2), (1.0, 1.0), True, (-0.15479, 0.48249)),
    ],
)
def test_large_bending(cells, lengths, held, tip):
    """The same tip as another implementation of the method; an elastica has (-0.16064, 0.49346)."""
    problem = clamped_beam(cells, lengths, held=held)
    list(problem.march(4, progress=False))
    body = problem.elements
    found = body.mean_displacement(body.facets(pm.plane(x=20.0))) / 20
    np.testing.assert_allclose(found, [tip[0], -tip[1]], rtol=0, atol=3e-5)
    support, work = problem.supports[0], problem.energies()
    reaction = problem.reaction(support)
    assert max(problem.balance().residue) < 1e-8
    arm = 20 * (1 + found[0])  # the slope's support turns the beam back, too
    assert reaction.moment[0] == pytest.approx(reaction.force[1] * arm, rel=1e-4)
    assert abs(work["residue"]) < 0.05 * work["external"]


# tangent and invariance --------------------------------------------------------------------------------
def loose(
    cell: str, held: bool = True, material: pm.Material | None = None, degree: int = 2
) -> pm.QuasiStaticFEM:
    dim = {"quadrilateral": 2, "triangle": 2}.get(cell, 3)
    mesh = box(cell, (2,) * dim if dim == 2 else (2, 1, 1), distort=0.15)
    solid = material or (SOLID if dim == 2 else IN_SPACE)
    problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=solid, degree=degree))
    if held:
        problem.fix(lambda x: x[:, 0] < 0.2, slope=0)  # distorted, they don't lie in a plane
    return problem


@pytest.mark.parametrize(
    ("cell", "degree"),
    [
        *((cell, 2) for cell in ("quadrilateral", "triangle", "hexahedron", "tetrahedron")),
        ("quadrilateral", 3),
        ("triangle", 3),
    ],
)
def test_tangent_is_the_derivative(cell, degree):
    problem = loose(cell, degree=degree)
    system = prepared(problem)
    rng, size = np.random.default_rng(3), problem.unknowns
    x, direction = 0.05 * rng.uniform(-1, 1, (2, size))
    matrix = tangent_at(problem, system, x)
    assert np.abs(matrix - matrix.T).max() < 1e-12 * np.abs(matrix).max()
    step = 1e-4
    ends = [residual_at(problem, system, x + sign * step * direction) for sign in (1, -1)]
    difference = (ends[0] - ends[1]) / (2 * step)
    exact = matrix @ direction
    assert np.abs(difference - exact).max() < 1e-7 * np.abs(exact).max()


def test_forces_are_the_derivative_of_the_energy():
    """Of cells, faces and held slopes, all of one potential."""
    problem = loose("quadrilateral")
    system = prepared(problem)
    rng = np.random.default_rng(4)
    x, direction = 0.05 * rng.uniform(-1, 1, (2, problem.unknowns))
    force = residual_at(problem, system, x) @ direction

    def energy(x: np.ndarray) -> float:
        put(problem, system, x)
        forms, body = problem.forms, problem.elements
        body.displacement = system.x.copy()
        body.points.F = np.tile(np.eye(3), (len(body.points), 1, 1))
        forms.x.x.array[:] = system.x.ravel()
        body.points.F[:, :2, :2] += forms.values_at_points()[1]
        forms.x.x.array[:] = 0.0
        forms.total.x.array[:] = system.x.ravel()
        body.points.grad_F = forms.second_gradient()
        total = problem.energy() + forms.face_energy()
        forms.total.x.array[:] = 0.0
        return total

    step = 1e-4
    difference = (energy(x + step * direction) - energy(x - step * direction)) / (2 * step)
    assert difference == pytest.approx(force, rel=1e-7)


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_turned_bodies_have_turned_forces(cell):
    """Cells and inner faces don't mind a turn of 2 rad."""
    problem = loose(cell, held=False)
    system, dim = prepared(problem), problem.elements.dim
    x = own_rows(problem, problem.elements.nodes.position).reshape(-1, dim)
    moved = x + 0.05 * np.random.default_rng(5).uniform(-1, 1, x.shape)
    axis = np.array([0, 0, 2.0]) if dim == 2 else np.array([1.2, -0.9, 1.32])
    turn = rotation(axis)[:dim, :dim]
    plain = residual_at(problem, system, (moved - x).ravel()).reshape(-1, dim)
    turned = residual_at(problem, system, (moved @ turn.T - x).ravel()).reshape(-1, dim)
    assert np.abs(turned - plain @ turn.T).max() < 1e-11 * np.abs(plain).max()
    at_rest = residual_at(problem, system, (x @ turn.T - x).ravel())
    assert np.abs(at_rest).max() < 1e-12 * np.abs(plain).max()


# what a problem does -----------------------------------------------------------------------------------
def test_second_gradients_are_those_of_all_increments():
    """H of the displacement is what a history at the quadrature points would have summed up."""
    problem = clamped_beam((8, 2), (0.0, 1.0), held=True)
    body, summed = problem.elements, 0.0
    for _ in problem.march(3, progress=False):
        pass
    pattern = body.points.grad_F
    assert np.array_equal(pattern, np.swapaxes(pattern, 2, 3))
    assert largest(pattern) > 1e-3

    def quadratic(x: np.ndarray) -> np.ndarray:
        return np.stack([0.3 * x[:, 0] ** 2 + 0.2 * x[:, 0] * x[:, 1], -0.1 * x[:, 1] ** 2], axis=1)

    problem = loose("quadrilateral", held=False)
    body = problem.elements
    for share in (0.25, 0.75):  # two steps of increments, each with its own second gradients
        problem.forms.total.x.array[:] = (share * quadratic(body.nodes.position)).ravel()
        summed = summed + problem.forms.second_gradient()
    exact = np.zeros((3, 3, 3))
    exact[0, 0, 0], exact[0, 0, 1], exact[0, 1, 0], exact[1, 1, 1] = 0.6, 0.2, 0.2, -0.2
    middle = np.abs(summed - exact).mean(axis=0)  # distorted cells don't hold a quadratic field exactly
    assert largest(middle) < 0.3
    straight = pm.QuasiStaticFEM(pm.Elements(box("triangle", (2, 2)), material=SOLID, degree=2))
    straight.forms.total.x.array[:] = quadratic(straight.elements.nodes.position).ravel()
    assert largest(straight.forms.second_gradient() - exact) < 1e-12


def test_beside_a_classical_material():
    """Faces between the two have no penalty; with a vanishing length the body is classical."""
    mesh = box("quadrilateral", (4, 2), (4.0, 1.0))
    from dolfinx import mesh as dmesh

    cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    middle = pm.Elements(mesh, material=NEO_HOOKEAN).body.midpoints(cells)[:, 0]
    tags = dmesh.meshtags(mesh, 2, cells, np.where(middle < 2, 1, 2).astype(np.int32))

    def solved(one: pm.Material, two: pm.Material) -> pm.QuasiStaticFEM:
        body = pm.Elements(mesh, material={1: one, 2: two}, cells=tags, degree=2)
        problem = pm.QuasiStaticFEM(body)
        problem.fix(pm.plane(x=0.0), u=0, **({"slope": 0} if one.second_gradient else {}))
        problem.load(pm.plane(x=4.0), force=(0.0, -1.0))
        list(problem.march(2, progress=False))
        return problem

    def svk(F, p):
        E = (ufl.dot(F.T, F) - ufl.Identity(3)) / 2
        return p.lam / 2 * ufl.tr(E) ** 2 + p.mu * ufl.inner(E, E)

    numbers = gradient_solid(1e3, 0.3, (0.0, 0.0)).parameters()
    classical = pm.UserEnergy(svk, numbers, micropolar=False)
    thin, thick = (gradient_solid(1e3, 0.3, (l, l)) for l in (1e-6, 0.5))
    plain = solved(classical, classical).elements.displacement
    assert largest(solved(thin, classical).elements.displacement - plain) < 1e-4 * largest(plain)
    mixed = solved(thick, classical)
    stiffer = mixed.elements.displacement
    assert largest(stiffer) < 0.9 * largest(plain)
    assert largest(stiffer - plain) > 0.05 * largest(plain)
    of_classical = mixed.points.material == mixed.points.materials.index(classical)
    assert not np.any(mixed.points.grad_F[of_classical])
    assert not np.any(mixed.fields("double_stress")["double_stress"][of_classical])
    both = solved(thick, gradient_solid(1e3, 0.3, (0.25, 0.25)))
    assert largest(both.elements.displacement) < largest(stiffer)


def test_restart_goes_on_with_slopes(folder):
    """Slopes that are held from mid-run on count from there, after a restart, too."""

    def script() -> pm.QuasiStaticFEM:
        problem = clamped_beam((8, 1), (1.0, 1.0), held=False)
        return problem

    through = script()
    list(through.march(1, to=0.5, progress=False))
    through.fix(pm.plane(x=20.0), slope=0)
    list(through.march(1, to=0.75, progress=False))
    restart.save(through, folder / "half.h5")
    list(through.march(1, progress=False))
    again = script()
    again.fix(pm.plane(x=20.0), slope=0)
    restart.load(again, folder / "half.h5")
    held = again.reaction(again.supports[1])
    list(again.march(1, progress=False))
    np.testing.assert_allclose(again.elements.displacement, through.elements.displacement, rtol=0, atol=1e-9)
    free = script()
    list(free.march(2, progress=False))
    assert largest(free.elements.displacement - through.elements.displacement) > 1e-3
    assert np.linalg.norm(held.moment) > 0
    again.release(again.supports[1], over=0.5)
    list(again.march(2, to=1.5, progress=False))


def test_adaptive_steps_and_arc_length():
    problem = clamped_beam((8, 1), (0.0, 1.0), held=True)
    list(problem.march(1, adaptive=True, progress=False))
    other = clamped_beam((8, 1), (0.0, 1.0), held=True)
    list(other.march_arc_length(2.0, to=1.0, progress=False))
    ends = [p.elements.displacement for p in (problem, other)]
    assert largest(ends[0] - ends[1]) < 1e-5 * largest(ends[0])


def test_energies_balance():
    """External work is what cells and faces store, to the square of the step."""
    residues = []
    for steps in (4, 8):
        problem = clamped_beam((8, 1), (1.0, 1.0), held=True, alpha=1.0)
        list(problem.march(steps, progress=False))
        found = problem.energies()
        assert found["faces"] != 0.0
        residues.append(abs(found["residue"]) / found["external"])
    assert residues[1] < 0.3 * residues[0] < 0.01


# messages ----------------------------------------------------------------------------------------------
def test_what_is_refused():
    mesh = box("quadrilateral", (2, 2))
    with pytest.raises(pm.InputError, match="degree = 1: materials with second gradients need degree = 2"):
        pm.Elements(mesh, material=SOLID)
    body = pm.Elements(mesh, material=SOLID, degree=2)
    for wrong in (0.0, -1.0, np.nan, "20"):
        with pytest.raises(pm.InputError, match="slope_penalty"):
            pm.QuasiStaticFEM(body, slope_penalty=wrong)
    problem = pm.QuasiStaticFEM(body)
    with pytest.raises(pm.InputError, match="slopes can be held, not prescribed"):
        problem.fix(pm.plane(x=0.0), slope=0.1)
    with pytest.raises(pm.InputError, match="slopes are held on facets of the boundary"):
        problem.fix(pm.plane(x=0.5), slope=0)
    with pytest.raises(pm.InputError, match="normal to x, y or z"):
        problem.symmetry(body.facets(lambda x: (x[:, 0] < 1e-9) | (x[:, 1] < 1e-9)))
    with pytest.raises(pm.InputError, match="a plane, such as"):
        problem.symmetry(lambda x: x[:, 0] < 1e-9)
    assert problem.supports == ()
    classical = pm.QuasiStaticFEM(pm.Elements(mesh, material=NEO_HOOKEAN, degree=2))
    with pytest.raises(pm.InputError, match="none of the body's materials has second gradients"):
        classical.fix(pm.plane(x=0.0), u=0, slope=0)

    def quartic(F, H, p):
        return ufl.inner(F, F) + ufl.inner(H, H) ** 2

    with pytest.raises(pm.InputError, match="no stiffness against second gradients at rest"):
        pm.QuasiStaticFEM(
            pm.Elements(
                mesh, material=pm.UserEnergy(quartic, micropolar=False, second_gradient=True), degree=2
            )
        )


# ranks -------------------------------------------------------------------------------------------------
def solve_case(case: str) -> dict:
    """What a case finds, in an order that doesn't depend on the ranks."""
    if case == "ring":
        problem = pressed_ring(ring(4, 8))
        list(problem.march(1, progress=False))
    elif case == "space":
        mesh = box("hexahedron", (4, 2, 1), (4, 2, 1))
        problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=IN_SPACE, degree=2))
        problem.fix(pm.plane(x=0.0), u=0, slope=0)
        problem.load(pm.plane(x=4.0), force=(0.0, -5.0, 3.0))
        list(problem.march(1, progress=False))
    else:
        problem = clamped_beam((20, 2), (0.5, 1.0), held=True)
        list(problem.march(2, progress=False))
    reaction = problem.reaction(problem.supports[0])
    return {
        "u": at_nodes(problem.elements, problem.elements.displacement).tolist(),
        "H": by_id(problem.points, problem.points.grad_F).tolist(),
        "stress": by_id(problem.points, problem.fields().stress).tolist(),
        "reaction": [*reaction.force, *reaction.moment],
        "energies": [problem.energies()[name] for name in ("external", "stored", "faces")],
    }


@pytest.mark.mpi
@pytest.mark.timeout(300)
@pytest.mark.parametrize("case", ["ring", "beam", "space"])
def test_on_ranks(case):
    expected = solve_case(case)
    for ranks in (2, 3):
        for found in on_ranks(ranks, case, __file__):
            for name, values in expected.items():
                if (case, name) == ("ring", "stress"):  # strains of 1e-8, which rounding of F shows in
                    np.testing.assert_allclose(found[name], values, rtol=0, atol=1e-8 * np.abs(values).max())
                else:
                    close(found[name], values)


@pytest.mark.mpi
@pytest.mark.timeout(120)
def test_ranks_that_do_not_know_their_neighbours():
    found = on_ranks(2, "blind", __file__)
    for one in found:
        assert "ghost_mode = dolfinx.mesh.GhostMode.shared_facet" in one["message"]


def blind(case: str) -> dict:
    if case != "blind":
        return solve_case(case)
    from dolfinx import mesh

    none = {"ghost_mode": mesh.GhostMode.none}
    made = mesh.create_rectangle(COMM, [[0.0, 0.0], [1.0, 1.0]], [4, 4], mesh.CellType.quadrilateral, **none)
    try:
        pm.QuasiStaticFEM(pm.Elements(made, material=SOLID, degree=2))
    except pm.InputError as e:
        return {"message": str(e)}
    return {"message": "nothing"}


if __name__ == "__main__":
    report(blind)
