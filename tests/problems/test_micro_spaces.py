"""Micro-spaces in bodies: bending with lengths against closed forms, on elements and on material points."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from tests.helpers.bodies import box

E, H, LENGTH, CURVATURE = 1e3, 1.0, 4.0, 1e-4


def bending_energy(material: pm.Material, nu: float) -> float:
    """Of an arc of small curvature in plane strain over the classical one, quadratic elements.
    Rotations are held at the ends."""
    mesh = box("quadrilateral", (4, 1), (LENGTH, H))
    problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=material, degree=2))
    theta = {"theta": 0} if material.micropolar else {}
    problem.fix(lambda x: x[:, 0] < 1e-9, ux=0, **theta)
    problem.fix(lambda x: (x[:, 0] < 1e-9) & (x[:, 1] < 1e-9), uy=0)
    theta = {"theta": CURVATURE * LENGTH} if material.micropolar else {}
    problem.fix(
        lambda x: x[:, 0] > LENGTH - 1e-9,
        ux=lambda t, x: -t * CURVATURE * LENGTH * (x[:, 1] - H / 2),
        **theta,
    )
    for _ in problem.march(1):
        pass
    classical = E * H**3 / (12 * (1 - nu**2)) * CURVATURE**2 * LENGTH / 2
    return float(problem.energies()["stored"] / classical)


@pytest.mark.parametrize("nu", [0.0, 0.3])
def test_bending_of_a_cubic_micro_space(nu):
    """1 + (1 - nu)(l/h)^2."""
    for l in (0.0, 0.3, 1.0):
        found = bending_energy(pm.MicropolarElastic.from_microspace(E=E, nu=nu, l=l), nu)
        assert found == pytest.approx(1 + (1 - nu) * (l / H) ** 2, rel=3e-4)


@pytest.mark.parametrize(
    ("along", "share"), [(0, 0.7), (1, 0.7**2 / 0.4), (2, 0.0)], ids=["along", "across", "out of plane"]
)
def test_bending_of_rigid_fibres(along, share):
    """1 + (1 - nu)(l/h)^2 along the layer, (1 - nu)^2/(1 - 2 nu) across it; none about the
    axis of bending, whose spin a fibre doesn't feel. Fibres have no sense."""
    l = np.zeros(3)
    l[along] = 0.6
    for triad in (np.eye(3), -np.eye(3)):
        material = pm.OrientedMicropolar.from_engineering(E=E, nu=0.3, lengths=l, directors=triad)
        assert bending_energy(material, 0.3) == pytest.approx(1 + share * 0.36, rel=3e-4)


# material points ------------------------------------------------------------------------------------
ELASTIC = {
    "svk": pm.SaintVenantKirchhoff.from_engineering(E=E, nu=0.0),
    "neo-hookean": pm.NeoHookean.from_engineering(E=E, nu=0.0),
    "rubber": pm.ArrudaBoyce.from_engineering(E=E, nu=0.0, N=8, chain="series"),
}


def tip(material: pm.Material, **held: int) -> float:
    """Deflection of the end of a cantilever of splines, 4 x 1 m."""
    grid = pm.Grid.box((0, -0.5), (4.5, 1.5), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (4, 1)), points_per_cell=3, material=material)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, **held)
    end = points.where(lambda x: x[:, 0] > 3.8)
    problem.load(end, force=(0, -0.05))
    for _ in problem.march(1):
        pass
    return float(points.mean_displacement(end)[1])


@pytest.mark.parametrize("elastic", ELASTIC.values(), ids=ELASTIC.keys())
def test_cantilevers_stiffen_with_any_energy(elastic):
    """A director across the layer makes it 1 + (l/h)^2 times as stiff, nu = 0, as a fibre or as a normal,
    with strains of the first order or full ones; one along it hardly does. Shear and clamp stay soft."""
    soft = tip(pm.GradientElastic(elastic, (1e-6, 1e-6)), slope=0)
    stiff = tip(pm.GradientElastic(elastic, 0.5, [[0, 1]]), slope=0)
    assert soft / stiff == pytest.approx(1.241, abs=2e-3)
    full = tip(pm.GradientElastic(elastic, 0.5, [[0, 1]], full=True), slope=0)
    assert full == pytest.approx(stiff, rel=1e-3)
    normals = tip(pm.GradientElastic(elastic, 0.5, [[0, 1]], normals=True), slope=0)
    assert soft / normals == pytest.approx(1.239, abs=2e-3)
    along = tip(pm.GradientElastic(elastic, 0.5, [[1, 0]]))
    assert 1 < tip(pm.GradientElastic(elastic, (1e-6, 1e-6))) / along < 1.03


# restart files --------------------------------------------------------------------------------------
def small(material: pm.Material) -> pm.QuasiStatic:
    grid = pm.Grid.box((0, 0), (2, 1), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (2, 1)), points_per_cell=2, material=material)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    problem.fix(pm.plane(x=2.0), ux=0.01)
    return problem


SVK, SERIES = ELASTIC["svk"], ELASTIC["rubber"]
EXACT = pm.ArrudaBoyce(C_R=SERIES.C_R, N=8, kappa=SERIES.kappa)


@pytest.mark.parametrize(
    ("saved", "other", "differs"),
    [
        (pm.GradientElastic(SVK, 0.1, [[1, 0]]), pm.GradientElastic(SVK, 0.1, [[0, 1]]), "d_1"),
        (pm.GradientElastic(SVK, 0.1, [[1, 0]]), pm.GradientElastic(SVK, 0.2, [[1, 0]]), "l_1"),
        (pm.GradientElastic(SVK, 0.1, [[1, 0]]), pm.GradientElastic(SVK, 0.1, [[1, 0]], full=True), "full"),
        (SERIES, EXACT, "chain"),
        (
            pm.OrientedMicropolar(1e3, 1e3, 0.1),
            pm.OrientedMicropolar(1e3, 1e3, 0.1, [[0, 1, 0], [1, 0, 0], [0, 0, 1]]),
            "d_1",
        ),
    ],
)
def test_a_restart_needs_the_same_directors(saved, other, differs, folder):
    """And the same choices; numbers are compared anyway."""
    problem = small(saved)
    for _ in problem.march(1):
        pass
    file = folder / "saved.h5"
    pm.save_restart(problem, file)
    pm.load_restart(small(saved), file)
    with pytest.raises(pm.InputError, match=differs):
        pm.load_restart(small(other), file)
