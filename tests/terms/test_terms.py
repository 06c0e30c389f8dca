"""Terms on meshes against dolfinx' facet integrals; their rows, flags and restart; the arc-length method."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import ufl

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, beam, by_id
from tests.helpers.bodies import DIMENSION, box

CELLS = [("triangle", 1), ("triangle", 2), ("quadrilateral", 2), ("tetrahedron", 1), ("hexahedron", 2)]


def block(cell: str, degree: int, material: pm.Material = MICROPOLAR) -> Any:
    dim = DIMENSION[cell]
    mesh = box(cell, (3, 2, 2)[:dim], (2.0, 1.0, 0.8)[:dim], distort=0.05)
    problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=material, degree=degree))
    problem.fix(lambda x: x[:, 0] < 0.1, u=0, **({"theta": 0} if material.micropolar else {}))
    return problem


def end(x: np.ndarray) -> np.ndarray:
    return np.asarray(x[:, 0] > 1.9)


# surfaces of meshes -------------------------------------------------------------------------------
@pytest.mark.parametrize(("cell", "degree"), CELLS)
def test_a_surface_of_facets_has_their_area_and_normals(cell, degree):
    """Of the closed surface area times normal sums up to nothing, with x to the volume."""
    elements = block(cell, degree).elements
    s = elements.surface(lambda x: np.ones(len(x), dtype=bool))
    dim = elements.dim
    volume = elements.points.volume0.sum()
    volume = COMM.allreduce(volume)
    assert np.abs(s.area @ s.normal).max() < 1e-12
    assert s.area @ np.einsum("ni,ni->n", s.x, s.normal) == pytest.approx(dim * volume, rel=1e-10)
    faces = elements.surface(end)
    assert faces.area.sum() == pytest.approx(elements.facets(end).area, rel=1e-10)
    assert COMM.allreduce(len(s.rows)) == len(s)
    np.testing.assert_allclose(s.table[:, 0].sum(axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(s.table[:, 1:].sum(axis=2), 0.0, atol=1e-12)


LOADS = {
    "dead": ("traction", {"force": (30.0, -60.0, 20.0), "couple": (4.0, 6.0, 9.0)}),
    "follower": ("traction", {"force": (30.0, -60.0, 20.0), "couple": (4.0, 6.0, 9.0), "follows": True}),
    "pressure": ("pressure", {"p": 80.0}),
    "total": ("load", {"force": (30.0, -60.0, 20.0)}),
}


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize(("cell", "degree"), [("triangle", 2), ("quadrilateral", 1), ("hexahedron", 1)])
def test_terms_do_what_facet_integrals_do(cell, degree, load):
    """Two codes that share nothing but the law: dolfinx' forms, and shape functions tabulated at points."""
    name, given = LOADS[load]
    dim = DIMENSION[cell]
    if "couple" in given:
        given = {**given, "couple": given["couple"][-1:] if dim == 2 else given["couple"]}
    if "force" in given:
        given = {**given, "force": given["force"][:dim]}
    found = []
    for surface in (False, True):
        problem = block(cell, degree)
        where = problem.elements.surface(end) if surface else problem.elements.facets(end)
        getattr(problem, name)(where, **given)
        list(problem.march(2, progress=False))
        nodes = problem.elements
        found.append([nodes.mean_displacement(nodes.facets(end)), problem.reaction(problem.supports[0])[0]])
        found[-1].append(problem.energies()["external"])
    for a, b in zip(*found, strict=True):
        assert np.abs(a).max() > 1e-3
        np.testing.assert_allclose(b, a, rtol=1e-8, atol=1e-8 * np.abs(a).max())


def test_springs_hold_facets():
    """Fixed by stiff springs as by nodes, and the reaction is the load."""
    dim, ends = 2, []
    for springs in (False, True):
        mesh = box("quadrilateral", (4, 2), (2.0, 1.0))
        problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=NEO_HOOKEAN, degree=2))
        foot = lambda x: np.asarray(x[:, 0] < 0.01)  # noqa: E731
        where = problem.elements.surface(foot) if springs else foot
        support = problem.fix(where, u=0, **({"stiffness": 1e9} if springs else {}))
        problem.traction(end, force=(100.0, -50.0))
        list(problem.march(2, progress=False))
        ends.append(problem.elements.mean_displacement(problem.elements.facets(end)))
        np.testing.assert_allclose(problem.reaction(support)[0], (-100.0, 50.0), rtol=1e-7)
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-5)
    assert dim == 2


def test_a_surface_of_another_mesh_is_refused():
    problem, other = block("quadrilateral", 1), block("quadrilateral", 1)
    surface, before = other.elements.surface(end), problem.terms
    with pytest.raises(pm.InputError, match=r"is not made of facets of this mesh; use elements.surface"):
        problem.traction(surface, force=(1.0, 0.0))
    assert problem.terms == before


def test_springs_belong_to_surfaces():
    with pytest.raises(pm.InputError, match="fix: stiffness belongs to springs on a Surface"):
        beam(2).fix(pm.plane(x=6.0), u=0, stiffness=3.0)


# restart --------------------------------------------------------------------------------------------
def marked(kind: str) -> Any:
    """A loaded problem with a term on a surface that has rows of its own."""
    if kind == "elements":
        problem: Any = block("quadrilateral", 2)
        surface: pm.Surface = problem.elements.surface(end)
    else:
        problem = beam(2, basis="mpm")
        surface = pm.Surface.line((3.4, 0.35), (3.4, 1.25), 6)
    problem.pressure(surface, 40.0)
    problem.traction(surface, force=(20.0, 30.0))
    problem.terms[-1].rows["mark"] = np.column_stack([problem.points.id, problem.points.id**2]).astype(float)
    return problem


@pytest.mark.parametrize("kind", ["points", "elements"])
def test_terms_go_on_after_a_restart(kind, folder):
    whole, first, second = (marked(kind) for _ in range(3))
    list(whole.march(4, progress=False))
    list(first.march(2, to=0.5, progress=False))
    pm.save_restart(first, folder / "half.h5")
    second.terms[-1].rows.clear()
    pm.load_restart(second, folder / "half.h5")
    ids = second.points.id
    np.testing.assert_array_equal(second.terms[-1].rows["mark"], np.column_stack([ids, ids**2]))
    list(second.march(2, progress=False))
    tolerance = {"rtol": 0, "atol": 1e-13 if COMM.size == 1 else 1e-9}
    np.testing.assert_allclose(
        by_id(second.points, second.points.x), by_id(whole.points, whole.points.x), **tolerance
    )
    np.testing.assert_allclose(second.surfaces[0].u, whole.surfaces[0].u, **tolerance)


# arc length -------------------------------------------------------------------------------------------
def test_tractions_along_a_path():
    """Dead tractions as terms, and as forms of dolfinx, lead to the same load factors."""
    factors = []
    for surface in (False, True):
        problem = block("quadrilateral", 2, NEO_HOOKEAN)
        where = problem.elements.surface(end) if surface else problem.elements.facets(end)
        problem.traction(where, force=(0.0, -200.0))
        problem.body_load(force=lambda t: (10.0, 5.0))  # there from the start
        steps = list(problem.march_arc_length(0.05, steps=4, progress=False))
        factors.append([step.factor for step in steps])
    assert factors[0][-1] > 0.1
    np.testing.assert_allclose(factors[1], factors[0], rtol=1e-7)


def test_what_the_arc_length_method_cannot_take():
    problem = beam(2, basis="mpm")
    problem.pressure(pm.Surface.line((3.4, 0.35), (3.4, 1.25), 6), 40.0)
    with pytest.raises(pm.InputError, match="pressure 1: the arc-length method takes terms only"):
        problem.march_arc_length(0.1, steps=1)
    problem = beam(2, basis="mpm")
    problem.traction(pm.Surface.line((3.4, 0.35), (3.4, 1.25), 6), force=lambda t: (t**2, 0.0))
    with pytest.raises(pm.InputError, match="traction 1: not linear in the load factor"):
        problem.march_arc_length(0.1, steps=1)


# flags --------------------------------------------------------------------------------------------------
class Pull(pm.Term):
    """A constant force on every node of one cell: a piece by hand."""

    name = "pull"

    def __init__(self, carried: bool):
        self.carried = carried

    def pieces(self, setting: Any) -> list[pm.Piece]:
        mine = setting.reached[:1] if setting.comm.rank == 0 else setting.reached[:0]
        piece = _Constant()
        piece.boxes = pm.Boxes((2,) * setting.grid.dim, mine)
        piece.name, piece.carried, piece.linear = self.name, self.carried, True
        piece.pairs = np.zeros((1, 2), dtype=int)
        return [piece]


class _Constant(pm.Piece):
    def forces(self, x: np.ndarray) -> np.ndarray:
        out = np.zeros_like(x)
        out[:, :, 0] = 7.0
        return out

    def matrices(self, x: np.ndarray) -> np.ndarray:
        return np.zeros((1, x.shape[1], x.shape[1], 1))


@pytest.mark.parametrize("carried", [True, False])
def test_a_reset_carries_along_what_it_may(carried):
    """After a balanced reset, under the same load, nothing is out of balance but a term that forbids it."""
    problem = beam(2, basis="mpm", balanced_reset=True, reset=1)
    problem.body_load(force=(0.0, -5.0))
    problem.add(Pull(carried))
    list(problem.march(1, to=0.5, progress=False))
    system = problem.system_at(0.5)
    system.evaluate(False)
    own = slice(0, system.nodes.owned)
    free = ~system.prescribed.fixed[own]
    forces = system.term_forces()[own]
    assert COMM.allreduce(float(np.abs(forces[free]).sum())) > 0
    expected = np.where(free, 0.0 if carried else forces, 0.0)
    np.testing.assert_allclose(np.where(free, system.residual[own], 0.0), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("surface", [True, False])
def test_a_term_that_is_added_in_mid_run_is_felt(surface):
    """The balanced reset before its first step doesn't carry its forces away."""
    problem = beam(2, basis="mpm", balanced_reset=True, reset=None)
    problem.body_load(force=(0.0, -5.0))
    list(problem.march(1, to=0.5, progress=False))
    if surface:
        problem.traction(pm.Surface.line((3.4, 0.35), (3.4, 1.25), 6), force=lambda t: (3.0, 0.0))
    else:
        problem.add(Pull(True))
    system = problem.system_at(0.5)
    system.evaluate(False)
    own = slice(0, system.nodes.owned)
    free = ~system.prescribed.fixed[own]
    forces = system.terms.forces(system.x, lambda piece: True)
    system.nodes.add_to_owners(forces)
    assert COMM.allreduce(float(np.abs(forces[own][free]).sum())) > 1.0
    np.testing.assert_allclose(system.residual[own][free], forces[own][free], rtol=0, atol=1e-9)


# the body's volume at the nodes ---------------------------------------------------------------------------
class Bedding(pm.Term):
    """A body on springs of p (N/m^4), lumped at the nodes."""

    name = "bedding"

    def __init__(self, k: float):
        self.k = k

    def pieces(self, setting: Any) -> list[pm.Piece]:
        nodes, volumes = setting.node_volumes()
        return [_Springs(setting.alone(nodes), self.k * volumes, setting.layout.dim)]


class _Springs(pm.Piece):
    name, linear = "bedding", True

    def __init__(self, boxes: Any, stiffness: np.ndarray, dim: int):
        self.boxes, self.stiffness = boxes, stiffness
        self.pairs = np.stack([np.arange(dim)] * 2, axis=1)

    def forces(self, x: np.ndarray) -> np.ndarray:
        out = np.zeros_like(x)
        d = len(self.pairs)
        out[:, :, :d] = self.stiffness[:, None, None] * x[:, :, :d]
        return out

    def matrices(self, x: np.ndarray) -> np.ndarray:
        return np.tile(self.stiffness[:, None, None, None], (1, 1, 1, len(self.pairs)))


@pytest.mark.parametrize("method", ["mpm", "gimpm", "bspline", "projection", "elements"])
def test_a_body_on_springs_moves_as_a_whole(method):
    """u = b/k everywhere under a body load b, over balanced resets, which carry the springs' forces along."""
    k, load, steps = 500.0, np.array([30.0, -20.0]), 1 if method == "elements" else 4
    if method == "elements":
        elements = pm.Elements(box("triangle", (4, 3)), material=NEO_HOOKEAN)
        problem: Any = pm.QuasiStaticFEM(elements)
    else:
        grid = pm.Grid.box((-1.0, -1.0), (2.0, 2.0), 0.25)
        bounds = (0.0, 0.0), (1.0, 1.0)
        points = pm.seed(grid, material=NEO_HOOKEAN, points_per_cell=3, bounds=bounds)
        options = {"basis": "mpm", "assembly": method} if method == "projection" else {"basis": method}
        problem = pm.QuasiStatic(grid, points, reset=2, balanced_reset=True, **options)
    problem.body_load(force=load)
    problem.add(Bedding(k))
    list(problem.march(steps, progress=False))
    np.testing.assert_allclose(
        problem.points.displacement, np.tile(load / k, (len(problem.points), 1)), atol=1e-9
    )
    if method == "elements":
        assert problem.energies()["terms"] == pytest.approx(load @ load / k / 2, rel=1e-9)  # k V u^2 / 2
    assert abs(problem.energies()["residue"]) < 1e-8


# a scene that nobody built the seam for ------------------------------------------------------------------
class Floor(pm.SurfaceTerm):
    """A rigid floor y = p.y: a penalty on what lies below it."""

    def energy(self, at: Any, p: Any) -> Any:
        depth = p.y - (at.X[1] + at.u[1])
        return p.k / 2 * ufl.conditional(ufl.gt(depth, 0.0), depth, 0.0) ** 2


class Alarm(Exception):
    """What a script's alarm may raise at any time."""


@pytest.mark.parametrize(("raised", "expected"), [(ValueError("no"), pm.InputError), (Alarm("late"), Alarm)])
def test_what_the_function_of_a_surface_term_raises(raised, expected):
    """A mistake in it is the script's; what comes from outside while it is called isn't."""

    class Wrong(pm.SurfaceTerm):
        def energy(self, at: Any, p: Any) -> Any:
            raise raised

    surface = pm.Surface.line((0.0, 1.3), (0.0, 0.3), 3)
    with pytest.raises(expected, match=r"no|late"):
        beam(2).add(Wrong("wrong", surface))


@pytest.mark.parametrize("method", ["bspline", "projection", "elements"])
def test_a_block_comes_to_rest_on_a_floor(method):
    """Let down with its head it meets the floor 0.05 m below, is pressed onto it, and lifted off."""
    gap, k, width = 0.05, 2e6, 2.0
    if method == "elements":
        elements = pm.Elements(box("quadrilateral", (6, 3), (width, 1.0)), material=NEO_HOOKEAN, degree=2)
        problem: Any = pm.QuasiStaticFEM(elements)
        foot: pm.Surface = elements.surface(pm.plane(y=0.0))
    else:
        grid = pm.Grid.box((0.0, -1.0), (width, 1.0), 0.25)
        bounds = (0.0, 0.0), (width, 1.0)
        points = pm.seed(grid, material=NEO_HOOKEAN, points_per_cell=3, bounds=bounds, layout="gauss")
        options = {"basis": "mpm", "assembly": method} if method == "projection" else {"basis": method}
        problem = pm.QuasiStatic(grid, points, reset=None, **options)
        foot = pm.Surface.line((0.0, 0.0), (width, 0.0), 64)
    for side in (0.0, width):
        problem.fix(pm.plane(x=side), ux=0)
    head = problem.fix(pm.plane(y=1.0), uy=lambda t: -0.1 * t)
    problem.add(Floor("floor", foot, {"k": k, "y": -gap}))
    list(problem.march(4, progress=False))
    forces = [problem.reaction(head)[0][1]]
    # uniaxial strain: S(u) of the block in series with the floor's springs
    lam, mu = NEO_HOOKEAN.lam, NEO_HOOKEAN.mu
    sunk = -forces[0] / (k * width)
    stretch = 1.0 - 0.1 + gap + sunk
    stress = mu * (stretch - 1 / stretch) + lam * np.log(stretch) / stretch
    exact = 1e-4 if method == "bspline" else 1e-6  # the floor's points sum up parabolas only nearly
    np.testing.assert_allclose(forces[0], stress * width, rtol=exact)
    np.testing.assert_allclose(problem.surfaces[0].u[:, 1], -gap - sunk, rtol=exact)
    list(problem.march(4, to=0.0, progress=False))
    forces.append(problem.reaction(head)[0][1])
    assert abs(forces[1]) < 1e-8 * abs(forces[0])
    np.testing.assert_allclose(problem.surfaces[0].u, 0.0, atol=1e-9)
