"""Files and figures of finite elements: what is read back is what the problem has."""

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import mesh as dmesh

import polarmpm as pm
from polarmpm.geometry.meshes import BodyMesh
from polarmpm.kinematics import rotations
from tests.conftest import assert_repeated
from tests.helpers.ranks import PATH
from tests.io.test_recorder import read_collection

COMM = MPI.COMM_WORLD
MATERIAL = pm.MicropolarElastic(lam=1e6, mu=1e6, kappa=2e5, alpha=0.0, gamma=1e4, beta=0.0)  # Pa, N
CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
GRADIENT = np.array([[0.2, 0.3, 0.1], [-0.1, 0.15, 0.0], [0.05, -0.2, 0.1]])
STATE = ("x", "F", "q", "wryness")

# positions in the unit cell of a cell's nodes in VTK's order, from its documentation
_CORNERS = {
    "triangle": [(0, 0, 0), (1, 0, 0), (0, 1, 0)],
    "quad": [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)],
    "tetra": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
}
_CORNERS["hexahedron"] = _CORNERS["quad"] + [(x, y, 1) for x, y, _ in _CORNERS["quad"]]
_MIDDLES = {
    "triangle6": [(0, 1), (1, 2), (2, 0)],
    "quad9": [(0, 1), (1, 2), (2, 3), (3, 0), (0, 1, 2, 3)],
    "tetra10": [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)],
    "hexahedron27": [
        *((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
        *((0, 3, 4, 7), (1, 2, 5, 6), (0, 1, 4, 5), (2, 3, 6, 7), (0, 1, 2, 3), (4, 5, 6, 7)),
        tuple(range(8)),
    ],
}
KINDS = {  # meshio's names for VTK's cells of degree 1 and 2; cells of degree 3 are written as of degree 1
    "triangle": ("triangle", "triangle6", "triangle"),
    "quadrilateral": ("quad", "quad9", "quad"),
    "tetrahedron": ("tetra", "tetra10", "tetra"),
    "hexahedron": ("hexahedron", "hexahedron27", "hexahedron"),
}


def body(cell, degree=1, comm=COMM, divisions=None, **options):
    """Two metres long, half a metre wide (and high)."""
    dim = 2 if cell in ("triangle", "quadrilateral") else 3
    kind = getattr(dmesh.CellType, cell)
    if dim == 2:
        ends = [np.zeros(2), np.array([2.0, 0.5])]
        mesh = dmesh.create_rectangle(comm, ends, divisions or (6, 2), kind)
    else:
        ends = [np.zeros(3), np.array([2.0, 0.5, 0.5])]
        mesh = dmesh.create_box(comm, ends, divisions or (3, 1, 1), kind)
    return pm.Elements(mesh, material=MATERIAL, degree=degree, **options)


def cantilever(cell, degree=1, **options):
    """Clamped on the left, with a dead load at its end, a body load, and in the plane a pressure."""
    elements = body(cell, degree, **options)
    dim = elements.dim
    problem = pm.QuasiStaticFEM(elements)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(elements.farthest((1, 0, 0)[:dim]), force=(0.0, -2e3, 1e3)[:dim])
    if dim == 2:
        problem.pressure(pm.plane(y=0.5), 200.0)
    problem.body_load(force=lambda t, X: 100 * t * X)
    return problem


def deform(elements):
    """A homogeneous deformation and a rotation that grows along x, written into the state."""
    dim, points = elements.dim, elements.points
    gradient = np.zeros((3, 3))
    gradient[:dim, :dim] = GRADIENT[:dim, :dim]
    elements.displacement = elements.nodes.position @ gradient[:dim, :dim].T
    elements.q = rotations.from_vector(0.3 * elements.nodes.position[:, :1] * [0.0, 0.0, 1.0])
    points.x = points.X + points.X @ gradient[:dim, :dim].T
    points.F = np.tile(np.eye(3) + gradient, (len(points), 1, 1))
    points.wryness = np.zeros((len(points), 3, 3))
    points.wryness[:, 2, 0] = points.X[:, 0]  # its mean over a cell is the cell's middle
    return np.eye(3) + gradient


def assembled(meshes, name):
    """Cell data of all pieces in the order of the ids."""
    ids = np.concatenate([m.cell_data["id"][0] for m in meshes])
    return np.concatenate([m.cell_data[name][0] for m in meshes])[np.argsort(ids)]


# ParaView -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("cell", CELLS)
def test_a_homogeneous_deformation_is_read_back(cell, degree, folder):
    problem = pm.QuasiStaticFEM(body(cell, degree))
    elements = problem.elements
    F = deform(elements)
    fields = ("displacement", "rotation", "F", "stretch", "wryness", "volume", "id", "material")
    with pm.Recorder(folder / "new" / "body.pvd", problem, fields=fields):
        pass
    ((time, _, meshes),) = read_collection(folder / "new" / "body.pvd")
    assert time == 0.0
    simple, kind = KINDS[cell][0], KINDS[cell][degree - 1]
    for m in meshes:
        assert [block.type for block in m.cells] == [kind]
        assert set(m.point_data) == {"displacement", "rotation"}
        np.testing.assert_allclose(m.point_data["displacement"], m.points @ (F - np.eye(3)).T, atol=1e-14)
        rotation = 0.3 * m.points[:, :1] * [0.0, 0.0, 1.0]
        np.testing.assert_allclose(m.point_data["rotation"], rotation, atol=1e-14)
        # each cell is its corners' image of the unit cell
        corners = np.array(_CORNERS[simple], float)
        unit = np.vstack([corners, *[corners[list(ends)].mean(axis=0) for ends in _MIDDLES.get(kind, ())]])
        x = m.points[m.cells[0].data]
        dim = elements.dim
        edges = [x[:, np.flatnonzero((corners == axis).all(axis=1))[0]] - x[:, 0] for axis in np.eye(3)[:dim]]
        image = x[:, :1] + np.einsum("ka,anx->nkx", unit[:, :dim], np.array(edges))
        np.testing.assert_allclose(x, image, atol=1e-14)
    middle = assembled(meshes, "wryness").reshape(-1, 3, 3)[:, 2, 0]
    assert len(middle) == {"triangle": 24, "quadrilateral": 12, "tetrahedron": 18, "hexahedron": 3}[cell]
    np.testing.assert_array_equal(assembled(meshes, "id"), np.arange(len(middle)))
    x = np.concatenate([m.points[m.cells[0].data[:, : len(corners)]].mean(axis=1) for m in meshes])
    ids = np.concatenate([m.cell_data["id"][0] for m in meshes])
    np.testing.assert_allclose(middle, x[np.argsort(ids), 0], rtol=1e-13)
    np.testing.assert_allclose(assembled(meshes, "F"), np.tile(F.ravel(), (len(middle), 1)), atol=1e-14)
    U = assembled(meshes, "stretch").reshape(-1, 3, 3)
    np.testing.assert_allclose(U @ U, np.tile(F.T @ F, (len(U), 1, 1)), rtol=1e-12, atol=1e-14)
    undeformed = 2.0 * 0.5 ** (elements.dim - 1) / len(middle)
    np.testing.assert_allclose(assembled(meshes, "volume"), undeformed * np.linalg.det(F), rtol=1e-12)
    assert not np.any(assembled(meshes, "material"))


def test_stresses_are_the_cells_means(folder):
    problem = cantilever("triangle", 2)
    with pm.Recorder(folder / "body.pvd", problem, fields=("stress", "couple_stress", "energy")) as record:
        for step in problem.march(2):
            record(step)
    steps = read_collection(folder / "body.pvd")
    assert [time for time, _, _ in steps] == [0.0, 0.5, 1.0]
    fields, volume = problem.fields(), problem.points.volume0
    found = {n: np.concatenate([m.cell_data[n][0] for m in steps[-1][2]]) for n in steps[-1][2][0].cell_data}
    assert set(found) == {"stress", "couple_stress", "energy"}
    total = COMM.allreduce(np.tensordot(volume, fields.stress.reshape(-1, 9), 1))
    cell = 1.0 / 24  # m^2, all alike
    np.testing.assert_allclose(cell * found["stress"].sum(axis=0), total, rtol=1e-11, atol=1e-9)
    assert cell * found["energy"].sum() == pytest.approx(problem.energy(), rel=1e-12)
    assert np.ptp(found["couple_stress"][:, 6]) > 1.0


def test_a_curved_mesh_of_degree_two(folder):
    """The file has the nodes' own positions, on a mesh whose geometry is curved too."""
    gmsh = pytest.importorskip("gmsh")
    if COMM.rank == 0:
        gmsh.initialize()
        gmsh.option.setNumber("General.Terminal", 0)
        disk = gmsh.model.occ.addDisk(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(2, [disk], 1)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(2)
    elements = pm.Elements(gmsh.model if COMM.rank == 0 else None, material=MATERIAL, degree=2)
    if COMM.rank == 0:
        gmsh.finalize()
    with pm.Recorder(folder / "disk.pvd", pm.QuasiStaticFEM(elements)):
        pass
    ((_, _, meshes),) = read_collection(folder / "disk.pvd")
    x = np.concatenate([m.points for m in meshes])
    radius = np.linalg.norm(x, axis=1)
    rim = radius > 0.99
    assert rim.sum() >= 24
    np.testing.assert_allclose(radius[rim], 1.0, atol=1e-6)


def test_quadrature_points_as_vertices(folder):
    problem = pm.QuasiStaticFEM(body("quadrilateral"))
    deform(problem.elements)
    with pm.Recorder(folder / "points.pvd", problem, fields=("displacement", "id"), domains=False):
        pass
    ((_, _, meshes),) = read_collection(folder / "points.pvd")
    ids = np.concatenate([m.point_data["id"] for m in meshes])
    np.testing.assert_array_equal(np.sort(ids), np.arange(problem.points.total))


def test_a_grid_is_refused(folder):
    with pytest.raises(pm.InputError, match="grid = True: finite elements have no background grid"):
        pm.Recorder(folder / "out" / "body.pvd", pm.QuasiStaticFEM(body("triangle")), grid=True)
    assert not (folder / "out").exists()


# restart ------------------------------------------------------------------------------------------
def nodal(problem):
    e = problem.elements
    return {"displacement": e.displacement, "q": e.q} | {
        f"points.{name}": getattr(e.points, name) for name in STATE
    }


@pytest.mark.parametrize(("cell", "degree"), [("triangle", 1), ("quadrilateral", 2), ("hexahedron", 1)])
def test_a_run_continues_to_the_same_digits(cell, degree, folder):
    whole, first, second = (cantilever(cell, degree) for _ in range(3))
    list(whole.march(4))
    list(first.march(2, to=0.5))
    pm.save_restart(first, folder / "half.h5")
    pm.load_restart(second, folder / "half.h5")
    for name, value in nodal(second).items():
        np.testing.assert_array_equal(value, nodal(first)[name], err_msg=name)
    assert second.progress == first.progress
    list(second.march(2))
    for name, value in asdict(second.progress).items():
        assert_repeated(value, getattr(whole.progress, name), name)
    assert COMM.allreduce(np.abs(whole.elements.displacement).max(initial=0.0), op=MPI.MAX) > 0.05
    for name, value in nodal(second).items():
        assert_repeated(value, nodal(whole)[name], name)


def test_an_older_state_is_put_back(folder):
    """Into the same problem, whose later state is forgotten."""
    problem = cantilever("triangle")
    list(problem.march(2, to=0.5))
    pm.save_restart(problem, folder / "half.h5")
    half, reaction = nodal(problem), problem.reaction(problem.supports[0])
    list(problem.march(1))
    pm.load_restart(problem, folder / "half.h5")
    assert (problem.progress.step, problem.progress.factor) == (2, 0.5)
    for name, value in nodal(problem).items():
        np.testing.assert_array_equal(value, half[name])
    assert_repeated(problem.reaction(problem.supports[0]).force, reaction.force)
    list(problem.march(1))
    assert problem.progress.factor == 1.0


def test_another_problem_is_refused(folder):
    file = folder / "state.h5"
    pm.save_restart(cantilever("triangle"), file)
    others = {
        "cell is triangle, this problem has quadrilateral": cantilever("quadrilateral"),
        "degree is 1, this problem has 2": cantilever("triangle", 2, quadrature_degree=2),
        "quadrature_degree is 2, this problem has 3": cantilever("triangle", quadrature_degree=3),
        "cells is 24, this problem has 32": cantilever("triangle", divisions=(8, 2)),
        "another mesh": cantilever("triangle", divisions=(2, 6)),
    }
    for message, problem in others.items():
        with pytest.raises(pm.InputError, match=message):
            pm.load_restart(problem, file)
        assert problem.progress.step == 0


def test_other_regions_are_refused(folder):
    stiff = pm.MicropolarElastic(lam=1e7, mu=1e7, kappa=2e5, alpha=0.0, gamma=1e4, beta=0.0)

    def two(edge):
        mesh = dmesh.create_rectangle(COMM, [np.zeros(2), np.ones(2)], (4, 4), dmesh.CellType.triangle)
        own = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
        x = BodyMesh(mesh).midpoints(own)[:, 0]
        tags = dmesh.meshtags(mesh, 2, own, np.where(x < edge, 1, 2).astype(np.int32))
        return pm.QuasiStaticFEM(pm.Elements(mesh, material={1: MATERIAL, 2: stiff}, cells=tags))

    pm.save_restart(two(0.5), folder / "state.h5")
    pm.load_restart(two(0.5), folder / "state.h5")
    with pytest.raises(pm.InputError, match="other regions"):
        pm.load_restart(two(0.7), folder / "state.h5")
    one = dmesh.create_rectangle(COMM, [np.zeros(2), np.ones(2)], (4, 4), dmesh.CellType.triangle)
    with pytest.raises(pm.InputError, match="materials is 2, this problem has 1"):
        pm.load_restart(pm.QuasiStaticFEM(pm.Elements(one, material=MATERIAL)), folder / "state.h5")


def test_points_and_elements_are_not_exchanged(folder):
    grid = pm.Grid.box((0, 0), (3, 1), 0.5)
    points = pm.QuasiStatic(grid, pm.seed(grid, bounds=((0, 0), (2, 0.5)), material=MATERIAL), **pm.PUBLISHED)
    elements = cantilever("triangle")
    pm.save_restart(points, folder / "points.h5")
    pm.save_restart(elements, folder / "elements.h5")
    with pytest.raises(pm.InputError, match="its state is of material points, this problem's of finite"):
        pm.load_restart(elements, folder / "points.h5")
    with pytest.raises(pm.InputError, match="its state is of finite elements, this problem's of material"):
        pm.load_restart(points, folder / "elements.h5")
    with pytest.raises(pm.InputError, match=r"missing\.h5 can't be read"):
        pm.load_restart(elements, folder / "missing.h5")


# on two ranks -------------------------------------------------------------------------------------
def by_cell(problem):
    """Nodal values of each cell and the points' state, in the order of the mesh's input."""
    e = problem.elements
    nodes = e.cell_nodes[: len(e.body.owned_cells)]
    rows = {"displacement": e.displacement[nodes], "rotation": e.q[nodes]}
    rows |= {name: getattr(e.points, name) for name in STATE}
    order = {len(nodes): e.body.original_cells, len(e.points): e.points.id}
    out = {}
    for name, values in rows.items():
        number = np.concatenate(COMM.allgather(order[len(values)]))
        out[name] = np.concatenate(COMM.allgather(values))[np.argsort(number)].tolist()
    return out


def run(cell, degree, folder):
    """What a run on any number of ranks finds; it leaves its files in the folder."""
    name = f"{cell}{degree}"
    problem = cantilever(cell, degree)
    restored = folder / f"{name}.h5"
    if COMM.size > 1:
        pm.load_restart(problem, restored)
        half = by_cell(problem)
    else:
        list(problem.march(2, to=0.5))
        pm.save_restart(problem, restored)
        half = by_cell(problem)
    with pm.Recorder(folder / f"{name}_{COMM.size}.pvd", problem, fields=("displacement", "stress", "id")):
        list(problem.march(2))
    return {"half": half, "end": by_cell(problem), "factor": problem.progress.factor}


@pytest.mark.mpi
@pytest.mark.parametrize(("cell", "degree"), [("triangle", 2), ("quadrilateral", 1), ("hexahedron", 1)])
def test_two_ranks_continue_what_one_began(cell, degree, tmp_path):
    serial = run(cell, degree, tmp_path)
    command = ["mpirun", "-n", "2", sys.executable, __file__, cell, str(degree), str(tmp_path)]
    # os.environ is as Python found it, without what this process' own MPI has put there since
    done = subprocess.run(
        command, timeout=200, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": PATH}
    )
    assert done.returncode == 0, done.stderr[-2000:]
    parallel = json.loads((tmp_path / "found.json").read_text())
    for name, value in serial["half"].items():
        np.testing.assert_array_equal(parallel["half"][name], value, err_msg=name)
    for name, value in serial["end"].items():
        np.testing.assert_allclose(parallel["end"][name], value, rtol=0, atol=1e-9, err_msg=name)
    assert parallel["factor"] == serial["factor"] == 1.0
    one, two = (read_collection(tmp_path / f"{cell}{degree}_{n}.pvd") for n in (1, 2))
    for (time, _, before), (_, parts, after) in zip(one, two, strict=True):
        assert time == 0.5
        assert parts == [0, 1]
        expected = assembled(before, "stress")
        limit = 1e-9 * np.abs(expected).max()
        np.testing.assert_allclose(assembled(after, "stress"), expected, rtol=0, atol=limit)
        np.testing.assert_array_equal(corner_values(after), corner_values(before))


def corner_values(meshes):
    """Displacements of the cells' nodes in the order of the ids."""
    ids = np.concatenate([m.cell_data["id"][0] for m in meshes])
    values = [m.point_data["displacement"][m.cells[0].data] for m in meshes]
    return np.concatenate(values)[np.argsort(ids)]


if __name__ == "__main__":
    found = run(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
    if COMM.rank == 0:
        Path(sys.argv[3], "found.json").write_text(json.dumps(found))
