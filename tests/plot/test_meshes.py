"""Figures of finite elements: the mesh is drawn where it is, in the values' colours."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import mesh as dmesh

import polarmpm as pm
from polarmpm.plot import figures as plot

pytest.importorskip("matplotlib")

COMM = MPI.COMM_WORLD
MATERIAL = pm.MicropolarElastic(lam=1e6, mu=1e6, kappa=2e5, alpha=0.0, gamma=1e4, beta=0.0)  # Pa, N
DIVISIONS = (4, 3, 2)


def bent(cell, degree=1):
    """2 x 1 (x 0.5) m; u_y grows with the square of x, and z is stretched."""
    dim = 2 if cell in ("triangle", "quadrilateral") else 3
    kind = getattr(dmesh.CellType, cell)
    ends = [np.zeros(dim), np.array([2.0, 1.0, 0.5])[:dim]]
    create = dmesh.create_rectangle if dim == 2 else dmesh.create_box
    elements = pm.Elements(create(COMM, ends, DIVISIONS[:dim], kind), material=MATERIAL, degree=degree)
    x = elements.nodes.position
    elements.displacement[:, 1] = 0.1 * x[:, 0] ** 2
    if dim == 3:
        elements.displacement[:, 2] = x[:, 2]
    return elements


def vertices(collection, count):
    return np.array([path.vertices[:count] for path in collection.get_paths()])


def area(rings):
    a, b = rings, np.roll(rings, -1, axis=1)
    return 0.5 * np.abs(np.sum(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], axis=1))


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_nodal_values_in_the_plane(cell, degree, folder):
    elements = bent(cell, degree)
    options = {"label": "$u_y$ (mm)", "length": (1e3, "mm")}
    ax = plot.plot_mesh(elements, 1e3 * elements.displacement[:, 1], **options)
    plot.save(ax, folder / "figures" / "mesh.png")
    assert (ax is None) == (COMM.rank > 0)
    if ax is None:
        return
    outline, filling, shading, lines = ax.collections
    count = degree * (3 if cell == "triangle" else 4)
    rings = vertices(lines, count)
    assert len(rings) == 12 * (2 if cell == "triangle" else 1)
    np.testing.assert_allclose(area(vertices(filling, count)).sum(), 2e6)
    np.testing.assert_allclose(area(rings).sum(), 2e6)  # the deformation is a shear
    # values are the displacements of the vertices they are drawn at
    grid, values = shading._triangulation, shading.get_array()
    x = np.stack([grid.x, grid.y], axis=1)
    on_bottom = np.isclose(x[:, 1], 1e2 * (x[:, 0] / 1e3) ** 2)
    assert on_bottom.sum() >= 5
    np.testing.assert_allclose(values[on_bottom], x[on_bottom, 1], atol=1e-9)
    assert (np.min(values), np.max(values)) == pytest.approx((0.0, 400.0))
    if degree > 1:  # curved edges go through their middle nodes, and the quadratic field is exact
        np.testing.assert_allclose(values, 1e2 * (x[:, 0] / 1e3) ** 2, atol=1e-9)
    assert outline.get_zorder() < filling.get_zorder() < shading.get_zorder() < lines.get_zorder()
    assert ax.get_xlabel() == "x (mm)"
    assert ax.get_aspect() == 1.0
    assert "$u_y$ (mm)" in [a.get_ylabel() for a in (*ax.child_axes, *ax.figure.axes)]
    assert (folder / "figures" / "mesh.png").read_bytes().startswith(b"\x89PNG")


def test_values_of_cells_and_points():
    elements = bent("quadrilateral", 2)
    own = elements.body.owned_cells
    middle = elements.body.midpoints(own)[:, 0]
    for at, values in (("cells", middle), ("points", elements.points.X[:, 0])):
        ax = plot.plot_mesh(elements, values, at=at, undeformed=False, edges=False, limits=(0.0, 2.0))
        if ax is None:
            continue
        (patches,) = ax.collections
        x = vertices(patches, 8)[:, ::2, 0].mean(axis=1)
        mappable = plot.drawing.colours(x, "viridis", (0.0, 2.0))
        np.testing.assert_allclose(patches.get_facecolor(), mappable.to_rgba(x), atol=0.02)


@pytest.mark.parametrize(
    ("cell", "degree"), [("tetrahedron", 1), ("tetrahedron", 2), ("hexahedron", 2), ("hexahedron", 3)]
)
def test_the_surface_in_space(cell, degree, folder):
    elements = bent(cell, degree)
    ax = plot.plot_mesh(elements, elements.displacement[:, 1], label="$u_y$ (m)")
    plot.save(ax, folder / "solid.png")
    if ax is None:
        return
    ghost, solid = ax.collections
    a, b, c = DIVISIONS
    faces = 2 * (a * b + b * c + a * c) * (2 if cell == "tetrahedron" else 1)
    assert len(solid.get_facecolor()) == faces
    # three of the box' six sides face the camera: y = 0, x = 2 and the top
    seen = (a * b + b * c + a * c) * (2 if cell == "tetrahedron" else 1)
    assert len(ghost.get_facecolor()) == seen
    span = np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()])
    assert np.all(span[:, 0] <= [0, 0, 0])
    assert np.all(span[:, 1] >= [2, 1.4, 1.0])
    scale = np.ptp(span, axis=1) / ax.get_box_aspect()
    np.testing.assert_allclose(scale, scale[0])
    assert (folder / "solid.png").stat().st_size > 5000


def test_without_values():
    ax = plot.plot_mesh(bent("triangle"))
    if ax is not None:
        _, _, patches, _ = ax.collections
        assert np.ptp(patches.get_facecolor(), axis=0).max() == 0
        assert len(ax.figure.axes) == 1


def test_bad_values_are_refused_on_all_ranks():
    elements = bent("triangle")
    with pytest.raises(pm.InputError, match=r"values: have the shape .* numbers are needed"):
        plot.plot_mesh(elements, np.zeros(len(elements.nodes) + 1 - COMM.rank))
    with pytest.raises(pm.InputError, match="at = 'edges': allowed are nodes, cells, points"):
        plot.plot_mesh(elements, np.zeros(3), at="edges")
