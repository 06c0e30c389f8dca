"""Physical groups of a mesh that material points keep: materials, selections, surfaces."""

from __future__ import annotations

import sys
from functools import partial

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN
from tests.helpers.msh import block, strip
from tests.helpers.ranks import close, on_ranks, report

STIFF = pm.NeoHookean(lam=12e3, mu=8e3)
BOTH = {"soft": NEO_HOOKEAN, "stiff": STIFF}


def seeded(folder, mesh=None, cell=0.25, **options):
    path = (mesh or strip()).write(folder / "strip.msh")
    dim = 3 if mesh else 2
    return pm.seed_mesh(
        pm.Grid.box((-1,) * dim, (3,) * dim, cell, COMM), path, **{"material": BOTH, **options}
    )


def chosen(points, selection):
    return np.isin(points.id, selection.ids)


@pytest.mark.parametrize("degree", [None, 3])
def test_materials_and_selections_by_name(folder, degree):
    points = seeded(folder, degree=degree)
    stiff = points.X[:, 0] > 1.0
    np.testing.assert_array_equal(points.material, stiff)
    for name, expected in (("stiff", stiff), (2, stiff), ("soft", ~stiff), (np.int64(1), ~stiff)):
        np.testing.assert_array_equal(chosen(points, points.region(name)), expected)
    assert len(points.region("soft")) == points.total // 2
    with pytest.raises(pm.InputError, match=r"region = 'hard': the regions are 'soft', 'stiff'"):
        points.region("hard")
    with pytest.raises(
        pm.InputError, match=r"surface = 'bottom': the groups of boundary facets are .*'far right'"
    ):
        points.surface("bottom")
    for wrong in (None, 1.5, True):
        with pytest.raises(pm.InputError, match="name or the number"):
            points.region(wrong)


def test_surfaces_by_name(folder):
    """The lengths, places and normals of the boundary, with two points or more in a cell of the grid."""
    points = seeded(folder)
    for name, x, normal in (("left", 0.0, (-1, 0)), ("far right", 2.0, (1, 0)), (2, 2.0, (1, 0))):
        surface = points.surface(name)
        assert surface.area.sum() == pytest.approx(1.0, rel=1e-14)
        np.testing.assert_allclose(surface.x[:, 0], x, atol=1e-15)
        np.testing.assert_allclose(surface.normal, np.tile(normal, (len(surface), 1)), atol=1e-14)
        assert len(surface) == 8
    assert len(seeded(folder, cell=1.0).surface("left")) == 4
    foot = seeded(folder, block(), material=STIFF).surface("foot")
    assert foot.area.sum() == pytest.approx(1.0, rel=1e-14)
    np.testing.assert_allclose(foot.normal, np.tile((0, 0, -1.0), (len(foot), 1)), atol=1e-14)
    np.testing.assert_allclose(foot.area @ foot.x, (0.5, 0.5, 0.0), atol=1e-14)


def test_points_without_groups():
    points = pm.seed(pm.Grid.box((0, 0), (1, 1), 0.5, COMM), material=STIFF)
    with pytest.raises(pm.InputError, match="these points have no regions"):
        points.region("soft")
    with pytest.raises(pm.InputError, match="these points have no groups of boundary facets"):
        points.surface("top")


def test_bodies_that_join(folder):
    """Regions of the same name are one; ids of the second body follow on."""
    points, other = seeded(folder), seeded(folder)
    boxes = pm.seed(pm.Grid.box((-1, -1), (3, 3), 0.5, COMM), material=STIFF, bounds=((-1, -1), (0, 0)))
    boxes.join(points)
    boxes.join(other)
    stiff = boxes.X[:, 0] > 1.0
    np.testing.assert_array_equal(chosen(boxes, boxes.region("stiff")), stiff)
    assert boxes.surface("top").area.sum() == pytest.approx(4.0)


def test_tags_of_a_dolfinx_mesh():
    """Tags of cells and facets that the script has made."""
    from dolfinx import mesh as dmesh

    made = dmesh.create_rectangle(COMM, [[0.0, 0.0], [2.0, 1.0]], [4, 2], dmesh.CellType.quadrilateral)
    here = made.topology.index_map(2)
    cells = np.arange(here.size_local + here.num_ghosts, dtype=np.int32)
    values = np.where(dmesh.compute_midpoints(made, 2, cells)[:, 0] < 1.0, 5, 9).astype(np.int32)
    tags = dmesh.meshtags(made, 2, cells, values)
    found = dmesh.locate_entities_boundary(made, 1, lambda x: np.isclose(x[0], 2.0))
    facets = dmesh.meshtags(made, 1, np.sort(found), np.full(len(found), 4, dtype=np.int32))
    grid = pm.Grid.box((-1, -1), (3, 3), 0.5, COMM)
    points = pm.seed_mesh(grid, made, material={5: NEO_HOOKEAN, 9: STIFF}, cells=tags, facets=facets)
    np.testing.assert_array_equal(chosen(points, points.region(9)), points.X[:, 0] > 1.0)
    np.testing.assert_array_equal(points.material, points.X[:, 0] > 1.0)
    assert points.surface(4).area.sum() == pytest.approx(1.0)
    other = dmesh.create_rectangle(COMM, [[0.0, 0.0], [2.0, 1.0]], [3, 2], dmesh.CellType.quadrilateral)
    for use in (pm.Elements, lambda *a, **k: pm.seed_mesh(grid, *a, **k)):
        for options, message in (
            ({"cells": np.ones(8)}, "cells = an array of shape .8,.: tags of dolfinx are needed"),
            ({"cells": "a"}, "cells = 'a': tags of dolfinx are needed"),
            ({"cells": facets}, "cells: its tags are of 1 dimensions; those of cells are of 2"),
            ({"facets": tags}, "facets: its tags are of 2 dimensions"),
        ):
            with pytest.raises(pm.InputError, match=message):
                use(made, material=STIFF, **options)
        with pytest.raises(pm.InputError, match="cells: its tags are of another mesh"):
            use(other, material=STIFF, cells=tags)


def test_meshes_of_dolfinx_that_cannot_be_used():
    """Nodes without positions, cells in space, another communicator."""
    from mpi4py import MPI

    from dolfinx import mesh as dmesh

    grid = pm.Grid.box((-1, -1), (3, 3), 0.5, COMM)

    def made(comm=COMM):
        return dmesh.create_rectangle(comm, [[0.0, 0.0], [2.0, 1.0]], [4, 2], dmesh.CellType.triangle)

    nan = made()
    if COMM.rank == COMM.size - 1:
        nan.geometry.x[0] = np.nan
    flat = made()
    flat.geometry.x[:, 1] = 0.0
    for mesh, message in ((nan, "nodes have coordinates that aren't finite"), (flat, "Jacobian of")):
        for use in (pm.Elements, lambda *a, **k: pm.seed_mesh(grid, *a, **k)):
            with pytest.raises(pm.InputError, match=message):
                use(mesh, material=STIFF)
    if COMM.size > 1:
        with pytest.raises(pm.InputError, match="is shared by 1 rank"):
            pm.seed_mesh(grid, made(MPI.COMM_SELF), material=STIFF)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"degree": -1}, "degree = -1"),
        ({"degree": "2"}, "degree = '2'"),
        ({"degree": 2.5}, r"degree = 2\.5"),
        ({"degree": 99}, "degree = 99"),
        ({"degree": True}, "degree = True"),
        ({"points_per_cell": 0}, "points_per_cell = 0"),
        ({"points_per_cell": np.nan}, "points_per_cell = nan"),
        ({"material": None}, "material"),
        ({"material": {}}, "no region is given"),
        ({"material": {"soft": NEO_HOOKEAN, "stiff": MICROPOLAR}}, "can't be mixed"),
        ({"material": {"soft": NEO_HOOKEAN, "stiff": 3}}, "material"),
    ],
)
def test_wrong_options(folder, options, message):
    with pytest.raises(pm.InputError, match=message):
        seeded(folder, **options)


# beside finite elements -----------------------------------------------------------------------------
def pulled(folder, reset=None):
    """The same on points and on elements: held on the left, pulled and sheared on the right."""
    path = strip(nx=16, ny=8).write(folder / "fine.msh")
    grid = pm.Grid.box((-0.5, -0.5), (2.75, 1.75), 0.125, COMM)
    points = pm.seed_mesh(grid, path, material=BOTH)
    mpm = pm.QuasiStatic(grid, points, reset=reset)
    elements = pm.Elements(path, material=BOTH, degree=2)
    fem = pm.QuasiStaticFEM(elements)
    supports = []
    for problem in (mpm, fem):
        supports.append(problem.fix("left", u=0))
        problem.traction("far right", force=(300.0, -60.0))
    return (mpm, supports[0]), (fem, supports[1])


@pytest.mark.parametrize("reset", [None, "every step"])
def test_points_and_elements_agree(folder, reset):
    """Two materials, a clamped group, a traction on another: the same displacements of both regions within
    the discretisation's error, and the same reactions."""
    policy = pm.EverySteps(1) if reset else None
    (mpm, held), (fem, wall) = pulled(folder, policy)
    for problem in (mpm, fem):
        list(problem.march(3, progress=False))
    elements = fem.elements
    reference = {}
    for name, tag in (("soft", 0), ("stiff", 1)):
        rows = elements.points.material == tag
        p = elements.points
        weight = COMM.allreduce(p.volume0[rows].sum())
        reference[name] = COMM.allreduce(p.volume0[rows] @ (p.x - p.X)[rows]) / weight
    for name, expected in reference.items():
        found = mpm.points.mean_displacement(mpm.points.region(name))
        assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)
    assert np.linalg.norm(reference["stiff"]) > 0.1
    force, expected = mpm.reaction(held)[0], fem.reaction(wall)[0]
    np.testing.assert_allclose(expected, (-300.0, 60.0), rtol=1e-6)
    np.testing.assert_allclose(force, expected, rtol=2e-3)


def test_names_are_surfaces_for_points(folder):
    """A name means `points.surface(name)` in every condition; an unknown one lists the groups."""
    points = seeded(folder)
    problem = pm.QuasiStatic(pm.Grid.box((-1, -1), (3, 3), 0.25, COMM), points)
    for condition in (
        lambda where: problem.load(where, force=(1.0, 0.0)),
        lambda where: problem.traction(where, force=(1.0, 0.0)),
        lambda where: problem.pressure(where, 1.0),
        lambda where: problem.fix(where, u=0),
    ):
        condition("top")
        condition(3)
        with pytest.raises(pm.InputError, match=r"surface = 'bottom': the groups of boundary facets are"):
            condition("bottom")
    assert len(problem.surfaces) == 8


def test_selections_and_surfaces_after_resets_and_a_restart(folder):
    """A restart of the same script finds the same points in each region, and the surfaces where they went."""
    found = []
    for part in ("whole", "first", "second"):
        (problem, held), _ = pulled(folder, pm.EverySteps(1))
        if part == "second":
            pm.load_restart(problem, folder / "half.h5")
        steps, to = (4, 1.0) if part == "whole" else (2, 0.5 if part == "first" else 1.0)
        list(problem.march(steps, to=to, progress=False))
        if part == "first":
            pm.save_restart(problem, folder / "half.h5")
            continue
        stiff = problem.points.region("stiff")
        found.append((stiff.ids, problem.points.mean_displacement(stiff), problem.reaction(held)[0]))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-9)
    np.testing.assert_allclose(found[0][2], found[1][2], rtol=1e-7)


# ranks ----------------------------------------------------------------------------------------------
def solve(case):
    """Points and elements from a file; on rank 0 all of them in the order of their ids."""
    points = pm.seed_mesh(pm.Grid.box((-1, -1), (3, 3), 0.25, COMM), case, material=BOTH)
    elements = pm.Elements(case, material=BOTH).points
    found = {}
    for name, p in (("points", points), ("elements", elements)):
        gathered = COMM.allgather(
            (p.id, np.column_stack([p.X, p.volume0, p.material, p.half_axes0.reshape(len(p), -1)]))
        )
        ids, rows = (np.concatenate([g[k] for g in gathered]) for k in (0, 1))
        found[name] = rows[np.argsort(ids)].tolist()
        found[f"{name} ids"] = np.sort(ids).tolist()
    stiff = points.region("stiff")
    surface = points.surfaces.get("top")  # the cracked one has no groups of facets
    top = [] if surface is None else np.column_stack([surface.x, surface.area]).tolist()
    return {**found, "stiff": stiff.ids.tolist(), "top": top}


def cracked():
    """Cells that have let go of a corner: dolfinx 0.5 waited for ever when three ranks shared them."""
    mesh = strip(nx=6, ny=4)
    rows = [row for block in mesh.blocks[3:] for row in block[2]]
    mesh.blocks, mesh.names = mesh.blocks[3:], {(2, 1): "soft", (2, 2): "stiff"}
    for new, (cell, corner) in enumerate([(20, 0), (2, 0), (11, 0), (16, 1)], 101):
        mesh.nodes[new] = mesh.nodes[rows[cell][corner]]
        rows[cell][corner] = new
    return mesh


@pytest.mark.mpi
@pytest.mark.timeout(200)
@pytest.mark.parametrize("ranks", [2, 3])
@pytest.mark.parametrize("make", [partial(strip, 2), strip, cracked])
@pytest.mark.filterwarnings("ignore:mesh")
def test_the_same_points_on_any_number_of_ranks(folder, make, ranks):
    path = str(make().write(folder / "strip.msh"))
    alone = solve(path)
    for rank in on_ranks(ranks, path, __file__):
        assert rank["stiff"] == alone["stiff"]
        for name in ("points ids", "elements ids"):
            assert rank[name] == alone[name]
        for name in ("points", "elements", "top"):
            assert len(rank[name]) == len(alone[name])
            if rank[name]:
                close(rank[name], alone[name])


if __name__ == "__main__":
    report(solve)
    sys.exit(0)
