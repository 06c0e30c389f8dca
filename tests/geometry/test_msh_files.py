"""Files of gmsh, written by hand: what they hold is found in every format; what is wrong with them is named
on every rank, and nothing in them is executed."""

from __future__ import annotations

import math
import os
import re
import warnings
from functools import partial

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, NEO_HOOKEAN
from tests.helpers.msh import Msh, block, put, strip

STIFF = pm.NeoHookean(lam=6e3, mu=4e3)
BOTH = {"soft": NEO_HOOKEAN, "stiff": STIFF}


def total(values):
    return COMM.allreduce(float(np.sum(values)))


def message(path, **options):
    """What is said about a file, by elements and by material points alike."""
    with pytest.raises(pm.InputError) as found:
        pm.Elements(path, **{"material": NEO_HOOKEAN, **options})
    said = str(found.value)
    assert set(COMM.allgather(said)) == {said}
    with pytest.raises(pm.InputError) as again:
        pm.seed_mesh(pm.Grid.box((-1, -1), (3, 3), 1.0, COMM), path, **{"material": NEO_HOOKEAN, **options})
    assert str(again.value) == said
    return said


# what is found --------------------------------------------------------------------------------------
@pytest.mark.parametrize("version", ["2.2", "4.1"])
@pytest.mark.parametrize("kind", [2, 3])
def test_groups_of_a_file(folder, version, kind):
    """Cells, regions and facets by their names, also one with a space."""
    body = pm.Elements(strip(kind).write(folder / "strip.msh", version), material=BOTH)
    assert total(body.points.volume0) == pytest.approx(2.0, rel=1e-14)
    np.testing.assert_array_equal(body.points.material, body.points.X[:, 0] > 1.0)
    for name, area, x in (("left", 1.0, 0.0), ("far right", 1.0, 2.0), (2, 1.0, 2.0), ("top", 2.0, None)):
        facets = body.facets(name)
        assert facets.area == pytest.approx(area, rel=1e-14)
        at = np.isclose(body.nodes.position[:, 1 if x is None else 0], 1.0 if x is None else x)
        np.testing.assert_array_equal(facets.nodes, at)


@pytest.mark.parametrize("version", ["2.2", "4.1"])
def test_a_file_in_space(folder, version):
    body = pm.Elements(block().write(folder / "block.msh", version), material={"all": STIFF})
    assert total(body.points.volume0) == pytest.approx(1.0, rel=1e-14)
    foot = body.facets("foot")
    assert foot.area == pytest.approx(1.0, rel=1e-14)
    np.testing.assert_array_equal(foot.nodes, np.isclose(body.nodes.position[:, 2], 0.0))


@pytest.mark.parametrize("version", ["2.2", "4.1"])
def test_gaps_in_the_tags_and_nodes_of_no_cell(folder, version):
    """Tags of nodes needn't be 1, 2, 3, ..., nor in order, nor belong to a cell."""
    plain = strip(2)
    new = {tag: 1000 - 7 * tag for tag in plain.nodes}
    blocks = [(k, g, [[new[t] for t in row] for row in rows]) for k, g, rows in plain.blocks]
    nodes = {5000: (math.nan, 0.0, 0.0), 3: (9.0, 9.0, 9.0)}
    nodes |= {new[tag]: x for tag, x in plain.nodes.items()}
    points = [
        pm.Elements(mesh.write(folder / name, version), material=BOTH).points
        for name, mesh in (("plain.msh", plain), ("gaps.msh", Msh(nodes, blocks, plain.names)))
    ]
    by_id = [
        np.concatenate(COMM.allgather(p.X))[np.argsort(np.concatenate(COMM.allgather(p.id)))] for p in points
    ]
    np.testing.assert_array_equal(*by_id)


def test_the_same_name_for_a_region_and_for_facets(folder):
    """gmsh names the groups of every dimension on their own."""
    mesh = strip()
    mesh.names[1, 2] = "soft"
    body = pm.Elements(mesh.write(folder / "a.msh"), material=BOTH)
    assert body.facets("soft").area == pytest.approx(1.0)


def test_groups_without_names(folder):
    mesh = strip()
    mesh.names.clear()
    body = pm.Elements(mesh.write(folder / "a.msh"), material={1: NEO_HOOKEAN, 2: STIFF})
    assert body.facets(3).area == pytest.approx(2.0)


def test_a_plane_at_another_height(folder):
    mesh = strip()
    mesh.nodes = {t: (x, y, 7.5) for t, (x, y, _) in mesh.nodes.items()}
    assert total(pm.Elements(mesh.write(folder / "a.msh"), material=BOTH).points.volume0) == pytest.approx(
        2.0
    )


def quadratic(kind):
    """One curved cell with all its nodes: a triangle (9) or a quadrilateral (10) whose side y = 0 is a
    parabola of height 0.3, with its area."""
    if kind == 9:
        nodes = [(0, 0), (1, 0), (0, 1), (0.5, -0.3), (0.5, 0.5), (0, 0.5)]
        area = 0.5 + 2 / 3 * 0.3
    else:
        nodes = [(0, 0), (1, 0), (1, 1), (0, 1), (0.5, -0.3), (1, 0.5), (0.5, 1), (0, 0.5), (0.5, 0.5)]
        area = 1.0 + 2 / 3 * 0.3
    tags = list(range(1, len(nodes) + 1))
    side = 1, tags[4 if kind == 10 else 3]
    listed = {t: (*map(float, x), 0.0) for t, x in zip(tags, nodes, strict=True)}
    return Msh(
        listed, [(8, 4, [[side[0], 2, side[1]]]), (kind, 1, [tags])], {(1, 4): "bent", (2, 1): "all"}
    ), area


@pytest.mark.parametrize("version", ["2.2", "4.1"])
@pytest.mark.parametrize("kind", [9, 10])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_curved_cells(folder, kind, version, number):
    """Volume, centroid and second moments of a curved cell, and the length of its curved side."""
    mesh, area = quadratic(kind)
    path = mesh.write(folder / "bent.msh", version)
    grid = pm.Grid.box((-1, -1), (3, 3), 0.125, COMM)
    p = pm.seed_mesh(grid, path, material={"all": STIFF}, points_per_cell=number)
    assert total(p.volume0) == pytest.approx(area, rel=1e-13)
    fine = pm.seed_mesh(grid, path, material=STIFF, degree=12)
    spread = np.swapaxes(p.half_axes0, 1, 2) @ p.half_axes0 / 3
    for moment in ((lambda x: x[:, 0]), (lambda x: x[:, 1])):
        assert total(p.volume0 * moment(p.x)) == pytest.approx(
            total(fine.volume0 * moment(fine.x)), rel=1e-12
        )
    for i, j in ((0, 0), (0, 1), (1, 1)):
        found = total(p.volume0 * (p.x[:, i] * p.x[:, j] + spread[:, i, j]))
        exact = total(fine.volume0 * fine.x[:, i] * fine.x[:, j])
        assert found == pytest.approx(exact, rel=1e-12)
    c = 1.2  # of the parabola's slope at its ends
    arc = math.sqrt(1 + c * c) / 2 + math.asinh(c) / (2 * c)
    assert p.surface("bent").area.sum() == pytest.approx(arc, rel=1e-4)
    assert np.all(p.surface("bent").normal[:, 1] < 0)
    assert pm.Elements(path, material=STIFF, quadrature_degree=8).facets("bent").area == pytest.approx(
        arc, rel=1e-3
    )


# what is wrong --------------------------------------------------------------------------------------
def spoilt(change, mesh=None):
    mesh = mesh or strip()
    change(mesh)
    return mesh


def add(*blocks, nodes=(), names=()):
    def change(mesh):
        mesh.nodes.update(nodes)
        mesh.blocks.extend(blocks)
        mesh.names.update(names)

    return change


def put_in(key, value):
    return lambda mesh: mesh.nodes.__setitem__(key, value)


def renamed(tag, name):
    return lambda mesh: mesh.names.__setitem__(tag, name)


def only(*kinds):
    def change(mesh):
        mesh.blocks = [b for b in mesh.blocks if b[0] in kinds]

    return change


def ungrouped(mesh):
    mesh.blocks = [(k, 0, rows) for k, _, rows in mesh.blocks]
    mesh.names.clear()


def swapped(mesh):
    """The second cell crosses itself."""
    row = mesh.blocks[3][2][1]
    row[2], row[3] = row[3], row[2]


def copied(mesh):
    """The whole body once more, with nodes of its own."""
    rows = [[t + 100 for t in row] for k, _, table in mesh.blocks if k == 3 for row in table]
    mesh.nodes |= {t + 100: x for t, x in mesh.nodes.items()}
    mesh.blocks.append((3, 9, rows))


SERENDIPITY = Msh({k: (k, k * k, 0.0) for k in range(1, 9)}, [(16, 1, [[*range(1, 9)]])])
EDGE = {90: (0.0, 0.0, 0.0), 91: (0.0, 0.5, 0.0)}
WRONG = {
    "no cells": (spoilt(only(1)), "has no cells|generate the mesh first"),
    "no groups": (spoilt(ungrouped), "no cells of two or three dimensions in a physical group"),
    "two types": (spoilt(add((2, 7, [[1, 2, 7]]))), "Triangle 3 and Quadrilateral 4"),
    "prisms": (spoilt(add((6, 7, [[1, 2, 7, 3, 4, 8]]))), "Prism 6; one of triangles"),
    "not all nodes": (SERENDIPITY, "Quadrilateral 8; one of.*with all nodes of their degree"),
    "missing node": (spoilt(lambda m: m.nodes.pop(8)), r"cells have 1 nodes that it doesn't list: 8"),
    "not a number": (spoilt(put_in(8, (math.nan, 0.0, 0.0))), "1 of its nodes have .* that aren't finite: 8"),
    "infinite": (spoilt(put_in(8, (math.inf, 0.0, 0.0))), "aren't finite: 8"),
    "not plane": (spoilt(put_in(8, (0.5, 0.5, 0.5))), "not a plane z = constant"),
    "twice": (spoilt(add((3, 1, [[1, 2, 7, 6]]))), r"1 of its cells are listed twice.* at \(0\.25, 0\.25\)"),
    "twice, turned": (spoilt(add((3, 1, [[7, 6, 1, 2]]))), "1 of its cells are listed twice"),
    "in two groups": (spoilt(add((3, 2, [[1, 2, 7, 6]]))), "listed twice.*'soft' and 'stiff'"),
    "body twice": (spoilt(copied), "8 of its cells lie upon others, with nodes of their own"),
    "node twice": (spoilt(add((3, 1, [[1, 2, 7, 7]]))), "1 of its cells have a node twice"),
    "bow tie": (spoilt(swapped), r"Jacobian of 1 cell\(s\) is not positive everywhere: numbers 1"),
    "flat": (spoilt(put_in(7, (0.5, 0.0, 0.0))), r"Jacobian of .* cell\(s\) is not positive everywhere"),
    "overlap": (spoilt(add((3, 1, [[2, 7, 13, 3]]))), "facets have more than two cells"),
    "facet on no cell": (spoilt(add((1, 1, [[1, 7]]))), r"'left' has 1 facets \(of 3\).*\(0\.25, 0\.25\)"),
    "facets elsewhere": (
        spoilt(add((1, 8, [[90, 91]]), nodes=EDGE, names={(1, 8): "my edge"})),
        r"'my edge' has 1 facets \(of 1\) that are on no cell",
    ),
    "facet in two groups": (spoilt(add((1, 2, [[1, 6]]))), "'left' and 'far right' share 1 facets"),
    "one name for two": (spoilt(renamed((2, 2), "soft")), "1 and 2, have the name 'soft'"),
}


@pytest.mark.parametrize("version", ["2.2", "4.1"])
@pytest.mark.parametrize("case", WRONG)
def test_meshes_that_cannot_be_used(folder, case, version):
    """On every rank, of elements and material points alike, before dolfinx sees the mesh."""
    mesh, expected = WRONG[case]
    assert re.search(expected, message(mesh.write(folder / "wrong.msh", version)))


def test_other_dimensions(folder):
    """A body in space isn't taken for its surface in the plane."""
    path = block().write(folder / "block.msh")
    with pytest.raises(pm.InputError, match="its cells have 3 dimensions, the grid has 2"):
        pm.seed_mesh(pm.Grid.box((-1, -1), (3, 3), 1.0, COMM), path, material=STIFF)
    assert "'foot' has cells of the type triangle" in message(
        spoilt(add((2, 5, [[1, 2, 4]])), block()).write(folder / "mixed.msh")
    )


def test_cells_of_a_degree_that_is_too_high(folder):
    nodes = {k: (float(k % 4), float(k // 4), 0.0) for k in range(1, 11)}
    said = message(Msh(nodes, [(21, 1, [[*range(1, 11)]])]).write(folder / "cubic.msh"))
    assert "Triangle 10" in said
    assert "degree 1 or 2" in said


# no meshes ------------------------------------------------------------------------------------------
SHELL = 'SystemCall "touch {}";\n'
HEADER = "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n"


@pytest.mark.parametrize(
    ("name", "head", "expected"),
    [
        ("evil.geo", "", "is a geometry or a script.*mesh it first"),
        ("evil.msh", "", "no gmsh mesh, which begins with .MeshFormat"),
        ("evil.msh", "\n\n", "no gmsh mesh"),
        ("evil.msh", "$MeshFormat\n", "no gmsh mesh"),
        ("evil.msh", HEADER, "it has no section .Nodes|no section"),
        ("evil.msh", HEADER + "$Comments\nhello\n$EndComments\n", "no section"),
        ("evil.msh", strip().text(), "something after .EndElements that is no section"),
        ("evil.msh", HEADER + "$Nodes\n", "damaged: its section .Nodes has no end"),
        ("evil.opt", "", "is a geometry or a script"),
        ("evil.txt", "", "no gmsh mesh"),
    ],
)
def test_scripts_are_never_executed(folder, name, head, expected):
    """gmsh runs what isn't a mesh as a script."""
    path = put(folder / name, head + SHELL.format(folder / "PWNED"))
    assert re.search(expected, message(path))
    COMM.Barrier()
    assert not os.path.exists(folder / "PWNED")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "it is empty"),
        (b"\x00\x01\xff\xfe" * 100, "no gmsh mesh"),
        ("$MeshFormat\n3.0 0 8\n$EndMeshFormat\n", r"has the format 3\.0; save it in 4\.1 or 2\.2"),
        ("$MeshFormat\n4 0 8\n$EndMeshFormat\n", "has the format 4;"),
        ("$MeshFormat\n4.1 7 8\n$EndMeshFormat\n", "type 7"),
        (b"$MeshFormat\n4.1 1 8\n\x00\x00\x00\x01\n$EndMeshFormat\n", "another byte order"),
        (strip().text().replace("$EndNodes", "$EndNode"), "no end|no section"),
        (strip().text().replace("1 15 1 15", "1 16 1 15"), "announces 16 nodes and has 15"),
        (strip().text().replace("2 1 0 15", "2 1 0 99"), "ends before the numbers|fractions"),
        (strip().text().replace("0.5", "0.5x"), "something that is no number"),
        (strip().text().replace("2 4 3 4\n", "2 4 77 4\n"), "gmsh's type 77"),
        (strip().text().replace("2 4 3 4\n", "3 4 3 4\n"), "cells of 2 dimensions on an entity of 3"),
        (strip().text().replace("$PhysicalNames\n5", "$PhysicalNames\n6"), "another number of names"),
        (strip().text("2.2").replace("$Nodes\n15", "$Nodes\n-1"), "damaged"),
        (strip().text("2.2").replace("$Elements\n16", "$Elements\n99"), "announces 99 cells|more or fewer"),
        (HEADER + "$PartitionedEntities\n$EndPartitionedEntities\n", "it is partitioned"),
    ],
)
def test_files_that_are_damaged_or_something_else(folder, content, expected):
    assert re.search(expected, message(put(folder / "bad.msh", content)))


@pytest.mark.parametrize("version", ["2.2", "4.1"])
def test_files_that_end_too_early(folder, version):
    """Wherever a file is cut, the error is ours."""
    text = strip().text(version)
    for end in range(0, len(text) - 15, max(1, len(text) // 17)):
        assert "can't be read" in message(put(folder / "cut.msh", text[:end]))


def test_what_is_no_source_at_all(folder):
    """Anything else than a mesh, a path and a model; a folder; a file that isn't there."""
    for source in (None, 3.0, [], np.ones(3), pm):
        with pytest.raises(pm.InputError, match=r"a dolfinx mesh, the path of a \.msh file"):
            pm.Elements(source, material=STIFF)
    assert "no such file" in message(folder / "none.msh")
    assert "can't be read: it is a directory" in message(folder)
    assert "can't be read: it is a directory or a device" in message("/dev/zero")  # has no end
    assert "can't be read" in message("")


def test_regions_without_material_and_materials_without_region(folder):
    path = strip().write(folder / "strip.msh")
    assert "(of 'stiff')" in message(path, material={"soft": NEO_HOOKEAN})
    assert "no physical group 'hard' of 2 dimensions; it has soft, stiff" in message(
        path, material={"hard": STIFF}
    )
    assert "'soft' and 1 are the same region" in message(path, material={"soft": STIFF, 1: STIFF, 2: STIFF})
    assert "name or the number" in message(path, material={1.5: STIFF})
    assert "cells = 'a'" in message(path, cells="a")
    mesh = strip()
    mesh.names[2, 9] = "nothing"
    said = message(mesh.write(folder / "empty.msh"), material={**BOTH, "nothing": STIFF})
    assert "'nothing' is empty" in said


@pytest.fixture
def told():
    """What this rank has been warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield caught


def test_a_crack_is_told(folder, told):
    """Halves that touch without common nodes are a warning of elements; points don't mind."""
    mesh = strip()
    middle = {3: 103, 8: 108, 13: 113}
    mesh.nodes |= {new: mesh.nodes[old] for old, new in middle.items()}
    for index in (4, 2):
        kind, group, rows = mesh.blocks[index]
        fresh = [[middle.get(t, t) if index == 4 or min(row) > 12 else t for t in row] for row in rows]
        mesh.blocks[index] = (kind, group, fresh)
    path = mesh.write(folder / "crack.msh")
    body = pm.Elements(path, material=BOTH)
    assert len(told) == (COMM.rank == 0)
    assert all("at 3 places of the boundary, such as (1.0, 0.0)" in str(one.message) for one in told)
    assert body.nodes.total == 18
    told.clear()
    pm.seed_mesh(pm.Grid.box((-1, -1), (3, 3), 1.0, COMM), path, material=BOTH)
    pm.Elements(strip().write(folder / "whole.msh"), material=BOTH)
    assert not told


@pytest.mark.parametrize("make", [partial(strip, 3, 2, 1), partial(block, 1)])
def test_a_node_in_the_middle_of_a_side_is_told(folder, told, make):
    """Halved beside a cell that isn't: dolfinx takes both sides for boundary."""
    mesh = make()
    mesh.blocks = [b for b in mesh.blocks if b[0] in (3, 5) and b[1] != 5]
    dim = 2 if mesh.blocks[0][0] == 3 else 3
    kind, group, rows = mesh.blocks[-1]
    shift = len(mesh.nodes) + 1
    # the same cell once more on its right, in two layers along y
    corner = {t: np.array(mesh.nodes[t]) for t in rows[-1]}
    size = np.ptp(list(corner.values()), axis=0)
    low = [t for t in rows[-1] if corner[t][1] == 0]
    layers = []
    for y in (0.0, 0.5):
        row = []
        for t in rows[-1]:
            x = corner[t] + [size[0], 0, 0]
            x[1] = size[1] * (y + 0.5 * (t not in low))
            old = [k for k, p in mesh.nodes.items() if np.allclose(p, x)]
            tag = old[0] if old else shift
            shift += not old
            mesh.nodes[tag] = tuple(map(float, x))
            row.append(tag)
        layers.append(row)
    mesh.blocks[-1] = (kind, group, rows + layers)
    pm.Elements(mesh.write(folder / "hanging.msh"), material=NEO_HOOKEAN)
    assert len(told) == (COMM.rank == 0)
    assert all(f"at {dim - 1} places of the boundary" in str(one.message) for one in told)


def test_facets_inside_of_the_body_are_told(folder, told):
    """A group may go on between two regions; those facets carry nothing."""
    path = spoilt(add((1, 1, [[3, 8], [8, 13]]))).write(folder / "inner.msh")
    body = pm.Elements(path, material=BOTH)
    assert body.facets("left").area == pytest.approx(1.0)
    assert body.facets("top").area == pytest.approx(2.0)
    assert len(told) == (COMM.rank == 0)
    assert all("facets 'left': some of the group's facets lie inside" in str(one.message) for one in told)
    points = pm.seed_mesh(pm.Grid.box((-1, -1), (3, 3), 1.0, COMM), path, material=BOTH)
    assert points.surface("left").area.sum() == pytest.approx(1.0)
