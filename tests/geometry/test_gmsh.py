"""Bodies seeded from gmsh files, in two and three dimensions; files that can't be used are named."""

import math

import pytest

import polarmpm as pm
from tests.conftest import COMM, NEO_HOOKEAN

gmsh = pytest.importorskip("gmsh")


def write(path, dim, physical=True):
    """A disc or ball of radius 1 with cells of about 0.2; rank 0 writes it."""
    if COMM.rank == 0:
        gmsh.initialize()
        gmsh.option.setNumber("General.Terminal", 0)
        make = gmsh.model.occ
        tag = make.addDisk(0, 0, 0, 1, 1) if dim == 2 else make.addSphere(0, 0, 0, 1)
        make.synchronize()
        if physical:
            gmsh.model.addPhysicalGroup(dim, [tag], 1)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.2)
        gmsh.model.mesh.generate(dim)
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


def test_files_that_cannot_be_used(folder):
    """No such file; no physical group; a file that gmsh can't read."""
    with pytest.raises(pm.InputError, match="no such file"):
        pm.seed_mesh(grid(2), folder / "none.msh", material=NEO_HOOKEAN)
    with pytest.raises(pm.InputError, match="physical group"):
        pm.seed_mesh(grid(3), write(folder / "disc.msh", 2), material=NEO_HOOKEAN)
    if COMM.rank == 0:
        (folder / "broken.msh").write_text("$MeshFormat\nnot a mesh\n")
    COMM.Barrier()
    with pytest.raises(pm.InputError, match=r"broken\.msh"):
        pm.seed_mesh(grid(2), folder / "broken.msh", material=NEO_HOOKEAN)


@pytest.mark.skipif(not hasattr(gmsh, "isInitialized"), reason="gmsh can't tell whether it runs")
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
            assert gmsh.model.getEntities(0) == [(0, 7)]
    finally:
        if COMM.rank == 0:
            gmsh.finalize()
