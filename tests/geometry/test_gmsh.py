"""Bodies from gmsh: its files and its models, of first and second order; what can't be used is named."""

import math
from functools import partial

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, NEO_HOOKEAN

gmsh = pytest.importorskip("gmsh")


def write(path, dim, *, order=1, size=0.2, version=4.1, binary=0):
    """A disc or ball of radius 1 with its boundary, "skin"; rank 0 writes it."""
    if COMM.rank == 0:
        gmsh.initialize()
        gmsh.option.setNumber("General.Terminal", 0)
        make = gmsh.model.occ
        tag = make.addDisk(0, 0, 0, 1, 1) if dim == 2 else make.addSphere(0, 0, 0, 1)
        make.synchronize()
        gmsh.model.addPhysicalGroup(dim, [tag], 1)
        skin = gmsh.model.addPhysicalGroup(dim - 1, [t for _, t in gmsh.model.getEntities(dim - 1)], 5)
        gmsh.model.setPhysicalName(dim - 1, skin, "skin")
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.option.setNumber("Mesh.Binary", binary)
        gmsh.model.mesh.generate(dim)
        gmsh.model.mesh.setOrder(order)
        gmsh.write(str(path))
        gmsh.finalize()
    COMM.Barrier()
    return path


def grid(dim):
    return pm.Grid.box((-2,) * dim, (2,) * dim, 0.5, COMM)


@pytest.mark.parametrize(("dim", "volume"), [(2, math.pi), (3, 4 / 3 * math.pi)])
def test_volume_and_reach(folder, dim, volume):
    """Points fill the body: its volume, but for flat facets, and its radius."""
    points = pm.seed_mesh(grid(dim), write(folder / "ball.msh", dim), material=NEO_HOOKEAN)
    assert COMM.allreduce(points.volume0.sum()) == pytest.approx(volume, rel=0.05)
    radius = (points.x**2).sum(axis=1) ** 0.5
    assert COMM.allreduce(int((radius > 1).sum())) == 0
    assert max(COMM.allgather(radius.max(initial=0.0))) > 0.9


def test_a_body_of_another_dimension(folder):
    with pytest.raises(pm.InputError, match="2 dimensions, the grid has 3"):
        pm.seed_mesh(grid(3), write(folder / "disc.msh", 2), material=NEO_HOOKEAN)
    with pytest.raises(pm.InputError, match="3 dimensions, the grid has 2"):
        pm.seed_mesh(grid(2), write(folder / "ball.msh", 3), material=NEO_HOOKEAN)


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize(("dim", "volume"), [(2, math.pi), (3, 4 / 3 * math.pi)])
def test_curved_cells(folder, dim, volume, version, binary):
    """Of second order, volume and second moment of a disc or ball are met to the fourth order in the cells'
    size, from files of every format."""
    file = write(folder / "ball.msh", dim, order=2, size=0.4, version=version, binary=binary)
    points = pm.seed_mesh(grid(dim), file, material=NEO_HOOKEAN, points_per_cell=1)
    assert COMM.allreduce(points.volume0.sum()) == pytest.approx(volume, rel=2e-4)
    square = np.einsum("ni,ni->n", points.x, points.x) + np.einsum("nki,nki->n", *[points.half_axes0] * 2) / 3
    exact = volume * {2: 1 / 2, 3: 3 / 5}[dim]
    assert COMM.allreduce(float(points.volume0 @ square)) == pytest.approx(exact, rel=4e-4)
    assert points.surface("skin").area.sum() == pytest.approx(dim * volume, rel=4e-4)
    elements = pm.Elements(file, material=NEO_HOOKEAN)
    assert COMM.allreduce(elements.points.volume0.sum()) == pytest.approx(volume, rel=2e-4)


@pytest.fixture
def session():
    """A session of the caller on rank 0."""
    if COMM.rank == 0:
        gmsh.initialize()
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("mine")
    yield gmsh.model if COMM.rank == 0 else None
    if COMM.rank == 0:
        gmsh.finalize()


def test_a_session_of_the_caller_goes_on(folder):
    """Reading a file neither ends gmsh nor touches the caller's model, also when the file is broken."""
    file = write(folder / "ball.msh", 2)
    if COMM.rank == 0:
        gmsh.initialize()
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("mine")
        gmsh.model.occ.addPoint(0, 0, 0, tag=7)
        gmsh.model.occ.synchronize()
    try:
        pm.seed_mesh(grid(2), file, material=NEO_HOOKEAN)
        with pytest.raises(pm.InputError):
            pm.seed_mesh(grid(3), file, material=NEO_HOOKEAN)
        if COMM.rank == 0:
            gmsh.model.setCurrent("mine")
            assert list(gmsh.model.getEntities(0)) == [(0, 7)]
    finally:
        if COMM.rank == 0:
            gmsh.finalize()


def test_a_facet_group_on_no_cell(session):
    """An arc with nodes of its own at its ends: dolfinx crashes on facets that no cell has."""
    if COMM.rank == 0:
        make = gmsh.model.occ
        ends = make.addPoint(-1, 0, 0), make.addPoint(1, 0, 0)
        line, arc = make.addLine(*ends[::-1]), make.addCircle(0, 0, 0, 1, angle1=0, angle2=math.pi)
        face = make.addPlaneSurface([make.addCurveLoop([line, arc])])
        make.synchronize()
        gmsh.model.setPhysicalName(1, gmsh.model.addPhysicalGroup(1, [arc], 7), "the arc")
        gmsh.model.addPhysicalGroup(2, [face], 1)
        gmsh.model.mesh.generate(2)
    for use in (pm.Elements, partial(pm.seed_mesh, grid(2))):
        with pytest.raises(
            pm.InputError, match=r"'the arc' has .* facets .* on no cell of the body, such as .* at"
        ):
            use(session, material=NEO_HOOKEAN)


def test_gaps_in_the_tags_of_nodes(session):
    """As removeDuplicateNodes leaves them, up to some version of gmsh."""
    if COMM.rank == 0:
        a, b = (gmsh.model.occ.addRectangle(x, 0, 0, 1, 1) for x in (0, 1))
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(2, [a, b], 1)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.removeDuplicateNodes()
    body = pm.Elements(session, material=NEO_HOOKEAN)
    assert COMM.allreduce(body.points.volume0.sum()) == pytest.approx(2.0, rel=1e-12)
    assert body.facets(lambda x: np.ones(len(x), bool)).area == pytest.approx(6.0, rel=1e-12)  # one body


def test_a_session_that_has_ended():
    """gmsh says so; all ranks raise it."""
    with pytest.raises(pm.InputError, match="the gmsh model can't be read"):
        pm.Elements(gmsh.model if COMM.rank == 0 else None, material=NEO_HOOKEAN)
    with pytest.raises(pm.InputError, match="a gmsh model"):
        pm.Elements(None if COMM.rank == 0 else gmsh.model, material=NEO_HOOKEAN)
