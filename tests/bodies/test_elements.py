"""Meshes with finite elements: sources, names, regions, and what can't be used."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.tools import compat
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, assert_repeated
from tests.helpers.bodies import DIMENSION, at_nodes, box, cantilever, everywhere

STIFF = pm.NeoHookean(lam=6e3, mu=4e3)


def on_first(*arrays):
    """All rows on rank 0, none elsewhere."""
    return arrays if COMM.rank == 0 else tuple(a[:0] for a in arrays)


def volume(body):
    return COMM.allreduce(body.points.volume0.sum())


# dolfinx meshes -------------------------------------------------------------------------------------
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", list(DIMENSION))
def test_measures_of_a_body(cell, degree):
    """Volume, area, number of points and mean values are those of the box, whose cells grow along x."""
    dim = DIMENSION[cell]
    mesh = box(cell, (3, 2, 1)[:dim], (3.0, 2.0, 5.0)[:dim])
    mesh.geometry.x[:, 0] *= mesh.geometry.x[:, 0] / 3.0
    body = pm.Elements(mesh, material=NEO_HOOKEAN, degree=degree)
    assert volume(body) == pytest.approx((6.0, 30.0)[dim - 2], rel=1e-12)
    assert body.facets(everywhere).area == pytest.approx((10.0, 62.0)[dim - 2], rel=1e-12)
    side = body.facets(pm.plane(x=3.0))
    assert side.area == pytest.approx((2.0, 10.0)[dim - 2], rel=1e-12)
    assert body.farthest((1, 0, 0)[:dim]).area == pytest.approx(side.area, rel=1e-12)
    np.testing.assert_array_equal(side.nodes, np.abs(body.nodes.position[:, 0] - 3.0) < 1e-9)
    np.testing.assert_allclose(body.mean(body.nodes.position, side), (3.0, 1.0, 2.5)[:dim], rtol=1e-12)
    np.testing.assert_allclose(body.mean(body.nodes.position), (1.5, 1.0, 2.5)[:dim], rtol=1e-12)
    ids = np.sort(np.concatenate(COMM.allgather(body.points.id)))
    np.testing.assert_array_equal(ids, np.arange(body.points.total))


def test_mean_over_a_body_of_revolution():
    """A whole turn weighs more at the rim: of a cylinder, the mean radius is two thirds of it."""
    body = pm.Elements(box("quadrilateral", (3, 2), (3.0, 2.0)), material=NEO_HOOKEAN, axisymmetric=True)
    np.testing.assert_allclose(body.mean(body.nodes.position), (2.0, 1.0), rtol=1e-12)


def test_points_are_numbered_along_the_cells_of_the_input():
    """Ids tell the cell in the order of the input, whatever dolfinx and the ranks made of it."""
    nodes = np.array([[0, 0], [1, 0], [3, 0], [6, 0], [0, 1], [1, 1], [3, 1], [6, 1]], dtype=float)
    cells = np.array([[2, 3, 6, 7], [0, 1, 4, 5], [1, 2, 5, 6]])
    mesh = compat.create_mesh(COMM, *on_first(cells, nodes), "quadrilateral")
    body = pm.Elements(mesh, material=NEO_HOOKEAN)
    p = body.points
    order = np.argsort(np.concatenate(COMM.allgather(p.id)))
    x = np.concatenate(COMM.allgather(p.X))[order].reshape(3, 4, 2)
    np.testing.assert_allclose(x[:, :, 0].mean(axis=1), [4.5, 0.5, 2.0], rtol=1e-12)


def test_materials_by_tags():
    """Two regions in a row under tension: each has the strain of its own material."""
    from dolfinx import mesh as dmesh

    mesh = box("quadrilateral", (4, 1), (4.0, 1.0))
    count = mesh.topology.index_map(2).size_local + mesh.topology.index_map(2).num_ghosts
    cells = np.arange(count, dtype=np.int32)
    middle = dmesh.compute_midpoints(mesh, 2, cells)
    tags = dmesh.meshtags(mesh, 2, cells, np.where(middle[:, 0] < 2.0, 5, 9).astype(np.int32))
    body = pm.Elements(mesh, material={5: NEO_HOOKEAN, 9: STIFF}, cells=tags)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(everywhere, uy=0)
    problem.load(pm.plane(x=4.0), force=(500.0, 0.0))
    list(problem.march(1))
    stretch = body.points.F[:, 0, 0] - 1
    soft = body.points.X[:, 0] < 2.0
    both = [np.concatenate(COMM.allgather(stretch[rows])) for rows in (soft, ~soft)]
    assert all(np.ptp(part) < 1e-9 for part in both)
    assert both[0][0] > 1.8 * both[1][0] > 0.01
    stress = np.concatenate(COMM.allgather(problem.fields().stress[:, 0, 0]))
    np.testing.assert_allclose(stress, 500.0, rtol=1e-8)
    with pytest.raises(pm.InputError, match="no region has the cells"):
        pm.Elements(mesh, material={5: NEO_HOOKEAN}, cells=tags)
    with pytest.raises(pm.InputError, match=r"no physical group 7 of 2 dimensions; it has 5, 9"):
        pm.Elements(mesh, material={7: NEO_HOOKEAN}, cells=tags)
    with pytest.raises(pm.InputError, match="can't be mixed"):
        pm.Elements(mesh, material={5: NEO_HOOKEAN, 9: MICROPOLAR}, cells=tags)
    with pytest.raises(pm.InputError, match="no region is given"):
        pm.Elements(mesh, material={}, cells=tags)


def cells_of(kind, nodes, cells, dim):
    """A small mesh from its nodes and cells, given by rank 0."""
    import inspect

    import ufl
    from dolfinx import mesh as dmesh

    cells, x = on_first(np.array(cells), np.array(nodes, dtype=float)[:, :dim])
    if kind == "prism" or dim > DIMENSION[kind]:
        if compat._HAS_BASIX_ELEMENTS:
            import basix.ufl

            element = basix.ufl.element("Lagrange", kind, 1, shape=(dim,))
        else:
            element = ufl.VectorElement("Lagrange", ufl.Cell(kind, geometric_dimension=dim), 1, dim=dim)
        domain = ufl.Mesh(element)
        names = list(inspect.signature(dmesh.create_mesh).parameters)
        return dmesh.create_mesh(COMM, cells, *((x, domain) if names[2] == "x" else (domain, x)))
    return compat.create_mesh(COMM, cells, x, kind)


def test_meshes_that_cannot_be_used():
    """The cells' type, the dimension, and every distorted cell are named."""
    square = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    bow_tie = cells_of("quadrilateral", [*square, [2, 0, 0], [2, 1, 0]], [[0, 1, 2, 3], [1, 4, 5, 3]], 2)
    flat = cells_of("quadrilateral", [*square, [2, 0, 0], [3, 0, 0]], [[0, 1, 2, 3], [1, 4, 5, 1]], 2)
    for mesh, message in [
        (bow_tie, r"Jacobian of 1 cell\(s\) is not positive everywhere: numbers 1, one at \(1\.5, 0\.5\)"),
        (flat, r"Jacobian of 1 cell\(s\).*numbers 1"),
        (cells_of("quadrilateral", square, [[0, 1, 2, 3]], 3), "2 dimensions and its nodes 3"),
        (3.0, r"mesh = 3\.0: a dolfinx mesh, the path"),
    ]:
        with pytest.raises(pm.InputError, match=message):
            pm.Elements(mesh, material=NEO_HOOKEAN)
    # seen from the other side a cell is as good
    mirrored = cells_of("quadrilateral", square, [[1, 0, 3, 2]], 2)
    assert volume(pm.Elements(mirrored, material=NEO_HOOKEAN)) == pytest.approx(1.0, rel=1e-14)


@pytest.mark.skipif(not compat._HAS_BASIX_ELEMENTS, reason="ufl of this dolfinx has no prisms")
def test_prisms_cannot_be_used():
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]]
    with pytest.raises(pm.InputError, match="of the type prism; allowed are triangle"):
        pm.Elements(cells_of("prism", corners, [[0, 1, 2, 3, 4, 5]], 3), material=NEO_HOOKEAN)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"degree": 4}, "degree = 4: allowed are 1, 2 and 3"),
        ({"quadrature_degree": 0}, "quadrature_degree = 0"),
        ({"material": 3.0}, "material"),
        ({"material": {"rubber": NEO_HOOKEAN}}, "no physical group 'rubber' of 2 dimensions; it has none"),
    ],
)
def test_wrong_options(options, message):
    """The argument and what it was are told."""
    with pytest.raises(pm.InputError, match=message):
        pm.Elements(box("triangle", (1, 1)), **{"material": NEO_HOOKEAN, **options})


# gmsh -----------------------------------------------------------------------------------------------
@pytest.fixture
def gmsh():
    """A session of gmsh on rank 0; elsewhere gmsh isn't started."""
    module = pytest.importorskip("gmsh")
    if COMM.rank == 0:
        module.initialize()
        module.option.setNumber("General.Terminal", 0)
        module.model.add("body")
    yield module
    if COMM.rank == 0:
        with contextlib.suppress(Exception):  # old versions end with the reading of a file
            module.finalize()


def two_halves(gmsh, dim, *, order=1, boxes=False):
    """A box of 2 x 1 (x 1) of two halves "soft" and "stiff", with the ends "left" (tag 7) and "right"."""
    occ, model = gmsh.model.occ, gmsh.model
    made = [occ.addRectangle(x, 0, 0, 1, 1) if dim == 2 else occ.addBox(x, 0, 0, 1, 1, 1) for x in (0, 1)]
    occ.fragment([(dim, made[0])], [(dim, made[1])])
    occ.synchronize()
    for name, tag in zip(("soft", "stiff"), made, strict=True):
        model.setPhysicalName(dim, model.addPhysicalGroup(dim, [tag]), name)
    for d, tag in model.getEntities(dim - 1):
        x = occ.getCenterOfMass(d, tag)[0]
        if abs(x) < 1e-9 or abs(x - 2) < 1e-9:
            group = model.addPhysicalGroup(d, [tag], 7 if x < 1 else 8)
            model.setPhysicalName(d, group, "left" if x < 1 else "right")
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
    if boxes:
        for _, tag in model.getEntities(1):
            model.mesh.setTransfiniteCurve(tag, 3)
        for d, tag in model.getEntities(2):
            model.mesh.setTransfiniteSurface(tag)
            model.mesh.setRecombine(d, tag)
        for _, tag in model.getEntities(3):
            model.mesh.setTransfiniteVolume(tag)
    model.mesh.generate(dim)
    model.mesh.setOrder(order)
    return model


@pytest.mark.parametrize("from_file", [False, True])
@pytest.mark.parametrize(("dim", "boxes"), [(2, False), (2, True), (3, False), (3, True)])
def test_physical_groups(gmsh, folder, dim, boxes, from_file):
    """Regions and ends by name and by tag, from a model in memory and from a file, of every type of cell."""
    source = two_halves(gmsh, dim, boxes=boxes) if COMM.rank == 0 else None
    if from_file:
        source = folder / "halves.msh"
        if COMM.rank == 0:
            gmsh.write(str(source))
        COMM.Barrier()
    body = pm.Elements(source, material={"soft": NEO_HOOKEAN, "stiff": STIFF})
    expected = {2: "triangle", 3: "tetrahedron"} if not boxes else {2: "quadrilateral", 3: "hexahedron"}
    assert body.body.cell == expected[dim]
    assert volume(body) == pytest.approx(2.0, rel=1e-12)
    np.testing.assert_array_equal(body.points.material, body.points.X[:, 0] > 1.0)
    for name, x in (("left", 0.0), (7, 0.0), ("right", 2.0)):
        group = body.facets(name)
        assert group.area == pytest.approx(1.0, rel=1e-12)
        np.testing.assert_array_equal(group.nodes, abs(body.nodes.position[:, 0] - x) < 1e-9)
    with pytest.raises(pm.InputError, match=r"no physical group 'top' of . dimensions; it has left, right"):
        body.facets("top")
    with pytest.raises(pm.InputError, match=r"no physical group 'hard' of . dimensions; it has soft, stiff"):
        pm.Elements(source, material={"hard": NEO_HOOKEAN})
    problem = pm.QuasiStaticFEM(body)
    left = problem.fix("left", u=0)
    problem.load("right", force=(50.0, 0.0, 0.0)[:dim])
    list(problem.march(1))
    np.testing.assert_allclose(problem.reaction(left)[0], (-50.0, 0.0, 0.0)[:dim], atol=1e-6)
    by_tag = {1: NEO_HOOKEAN, 2: STIFF} if dim == 2 else {"soft": NEO_HOOKEAN, 2: STIFF}
    assert volume(pm.Elements(source, material=by_tag)) == pytest.approx(2.0, rel=1e-12)


def test_curved_cells(gmsh):
    """With quadratic geometry a disc's area and circumference are met to the fourth order."""
    if COMM.rank == 0:
        gmsh.model.occ.addDisk(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(2, [1], 1)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.3)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(2)
    body = pm.Elements(gmsh.model if COMM.rank == 0 else None, material=MICROPOLAR, degree=2)
    assert volume(body) == pytest.approx(math.pi, rel=1e-4)
    surface = body.facets(everywhere)
    assert surface.area == pytest.approx(2 * math.pi, rel=1e-4)
    problem = pm.QuasiStaticFEM(body)
    problem.pressure(surface, 100.0)
    problem.fix(lambda x: np.hypot(*x.T) < 0.2, theta=0)
    problem.fix(lambda x: abs(x[:, 0]) > 1 - 1e-9, uy=0)
    problem.fix(lambda x: x[:, 0] > 1 - 1e-9, ux=0)
    list(problem.march(1))
    stress = np.concatenate(COMM.allgather(problem.fields().stress))
    np.testing.assert_allclose(stress[:, 0, 0], -100.0, rtol=0.01)
    np.testing.assert_allclose(stress[:, 1, 1], -100.0, rtol=0.01)


def test_a_name_may_stand_for_a_region_and_for_facets(gmsh):
    """gmsh numbers and names the groups of every dimension on their own."""
    if COMM.rank == 0:
        gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        for dim, tag in ((2, 1), (1, 4)):
            gmsh.model.setPhysicalName(dim, gmsh.model.addPhysicalGroup(dim, [tag], 1), "both")
        gmsh.model.mesh.generate(2)
    body = pm.Elements(gmsh.model if COMM.rank == 0 else None, material={"both": NEO_HOOKEAN})
    assert body.facets("both").area == pytest.approx(1.0, rel=1e-12)


def overlapping(gmsh, dim):
    gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
    gmsh.model.occ.synchronize()
    for d in {2, dim}:
        gmsh.model.setPhysicalName(d, gmsh.model.addPhysicalGroup(d, [1]), f"first{d}")
    gmsh.model.setPhysicalName(dim, gmsh.model.addPhysicalGroup(dim, [1]), "second")


def ball_surface(gmsh):
    gmsh.model.occ.addSphere(0, 0, 0, 1)
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(2, [1])


def mixed(gmsh):
    two_halves(gmsh, 2)
    gmsh.model.mesh.clear()
    gmsh.model.mesh.setRecombine(2, 1)


def prisms(gmsh):
    gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
    gmsh.model.occ.extrude([(2, 1)], 0, 0, 1, numElements=[1], recombine=True)
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(3, [1])


UNUSABLE = [
    (lambda gmsh: overlapping(gmsh, 2), "'first2' and 'second' share the surface 1"),
    (lambda gmsh: overlapping(gmsh, 1), "'first1' and 'second' share the curve 1"),
    (ball_surface, "not a plane z = constant"),
    (mixed, "Triangle 3 and Quadrilateral 4"),
    (prisms, "Prism 6; one of triangles"),
    (lambda gmsh: gmsh.model.occ.synchronize(), "no cells of two or three dimensions in a physical group"),
]


@pytest.mark.parametrize(("make", "message"), UNUSABLE)
def test_models_that_cannot_be_used(gmsh, make, message):
    """All ranks raise what only one of them can see."""
    if COMM.rank == 0:
        make(gmsh)
        gmsh.model.mesh.generate(3)
    with pytest.raises(pm.InputError, match=message):
        pm.Elements(gmsh.model if COMM.rank == 0 else None, material=NEO_HOOKEAN)


def test_a_model_without_a_mesh(gmsh):
    if COMM.rank == 0:
        gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(2, [1])
    with pytest.raises(pm.InputError, match="generate the mesh first"):
        pm.Elements(gmsh.model if COMM.rank == 0 else None, material=NEO_HOOKEAN)


def test_files_that_cannot_be_read(folder):
    """No such file, and a file that isn't a mesh."""
    pytest.importorskip("gmsh")
    with pytest.raises(pm.InputError, match=r"none\.msh' can't be read: no such file"):
        pm.Elements(folder / "none.msh", material=NEO_HOOKEAN)
    if COMM.rank == 0:
        (folder / "broken.msh").write_text("$MeshFormat\nnot a mesh\n")
    COMM.Barrier()
    with pytest.raises(pm.InputError, match=r"broken\.msh"):
        pm.Elements(folder / "broken.msh", material=NEO_HOOKEAN)


# steps that fail ------------------------------------------------------------------------------------
def state(problem):
    e = problem.elements
    arrays = {**e.points.arrays(), "displacement": e.displacement, "nodal q": e.q}
    return {name: a.copy() for name, a in arrays.items()}


def test_a_failed_step_leaves_the_last_state():
    """Inverted elements are named; state and reactions stay, and the run goes on as if nothing had been."""
    problems = [cantilever(), cantilever()]
    for problem in problems:
        problem.fix(pm.plane(x=4.0), ux=lambda t: -1.0 * t, uy=0, theta=0)
        list(problem.march(1, to=0.2))
    problem, undisturbed = problems
    before, reaction = state(problem), problem.reaction(problem.supports[0])
    with pytest.raises(pm.NotConverged, match=r"4 element\(s\) turned inside out: 0, 1, 2, 3"):
        list(problem.march(1, to=6.0))
    for name, values in state(problem).items():
        np.testing.assert_array_equal(values, before[name], err_msg=name)
    assert (problem.progress.factor, problem.progress.step) == (0.2, 1)
    np.testing.assert_array_equal(problem.reaction(problem.supports[0])[0], reaction[0])
    for p in problems:
        list(p.march(1, to=0.4))
    for name, values in state(undisturbed).items():
        assert_repeated(state(problem)[name], values, name)


def test_adaptive_steps_recover():
    """A step that is too large for Newton's method is cut, and the end is where small steps lead."""
    large, small = cantilever("triangle", cells=(8, 2)), cantilever("triangle", cells=(8, 2))
    for problem in (large, small):
        problem.load(problem.elements.farthest((1, 0)), force=(90.0, -300.0))
    steps = list(large.march(1, adaptive=True))
    assert sum(s.cuts for s in steps) > 0
    list(small.march(20))
    found, expected = (at_nodes(p.elements, p.elements.displacement) for p in (large, small))
    assert abs(expected).max() > 1.0
    np.testing.assert_allclose(found, expected, atol=1e-6)
