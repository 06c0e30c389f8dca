"""Sums over elements by compiled loops against dolfinx' assembly: the same residual and tangent."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.kinematics import rotations
from polarmpm.tools import compat
from tests.conftest import ANISOTROPIC, COMM, HENCKY, MICROPOLAR, NEO_HOOKEAN
from tests.helpers import plasticity
from tests.helpers.bodies import DIMENSION, at_nodes, box, dense, own_rows, prepared, put

SLOW = pytest.mark.slow  # dolfinx' forms take minutes to compile
CASES = [
    *(
        (cell, degree, m)
        for cell in ("triangle", "quadrilateral")
        for degree in (1, 2)
        for m in (MICROPOLAR, HENCKY)
    ),
    ("triangle", 2, ANISOTROPIC),
    ("triangle", 3, MICROPOLAR),
    ("quadrilateral", 3, HENCKY),
    ("quadrilateral", 1, ANISOTROPIC),
    *((cell, degree, NEO_HOOKEAN) for cell in ("tetrahedron", "hexahedron") for degree in (1, 2)),
    pytest.param("hexahedron", 1, MICROPOLAR, marks=SLOW),
]


def random_state(body: pm.Elements, dim: int) -> None:
    """Deformations, rotations and wrynesses that differ from point to point, the same on all ranks."""
    p = body.points
    at = np.concatenate([p.X, np.ones((len(p), 1))], axis=1)

    def field(size: int, seed: int, scale: float) -> np.ndarray:
        rng = np.random.default_rng(seed)
        return scale * np.sin(7 * at @ rng.uniform(-1, 1, (at.shape[1], size)))

    F = np.tile(np.eye(3), (len(p), 1, 1))
    F[:, :dim, :dim] += field(dim * dim, 1, 0.15).reshape(-1, dim, dim)
    p.F = F
    if p.materials[0].micropolar:
        vector, wryness = np.zeros((len(p), 3)), np.zeros((len(p), 3, 3))
        turning = slice(3 - body.layout.rotations, 3)
        vector[:, turning] = field(body.layout.rotations, 2, 1.5)
        wryness[:, turning, :dim] = field(body.layout.rotations * dim, 3, 0.4).reshape(len(p), -1, dim)
        p.q, p.wryness = rotations.from_vector(vector), wryness


def sums(problem: pm.QuasiStaticFEM, corrected: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residual, what prescribed increments add to it, and tangent at random increments, without prescribed
    unknowns; with `corrected` after a correction."""
    system, rng = prepared(problem), np.random.default_rng(4)
    size = 0.04 / problem.elements.degree**2  # gradients that turn no point inside out, however ranks number
    x = rng.uniform(-size, size, problem.unknowns)
    put(problem, system, x)
    before = system.x.copy()
    if corrected:
        put(problem, system, x + rng.uniform(-size / 4, size / 4, problem.unknowns))
        system.x = system.x.copy()
    system.before = before
    system.evaluate(True)
    k = dense(problem, system)
    free = ~own_rows(problem, system.prescribed.fixed)
    lifted = np.zeros_like(system.x) if system.step.lifted is None else system.step.lifted
    f, g = own_rows(problem, system.residual), own_rows(problem, lifted)
    return f[free], g[free], k[np.ix_(free, free)]


def assert_same(found: Any, expected: Any) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * abs(expected[-1]).max())


@pytest.mark.parametrize(("cell", "degree", "material"), CASES)
def test_sums_are_those_of_dolfinx(cell, degree, material):
    """Distorted cells, states that differ from point to point, a prescribed motion that isn't put in yet; at
    the start of a step, and after a correction, from which stresses are predicted."""
    dim, found = DIMENSION[cell], []
    for assembly in ("native", "dolfinx"):
        body = pm.Elements(box(cell, (2,) * dim, distort=0.12), material=material, degree=degree)
        random_state(body, dim)
        problem = pm.QuasiStaticFEM(body, assembly=assembly)
        problem.fix(lambda x: x[:, 0] > 0.9, ux=0.1)
        problem.fix(lambda x: x[:, 0] < 0.1, uy=0)
        found.append([*sums(problem), *sums(problem, corrected=True)])
    assert_same(found[0][:3], found[1][:3])
    assert_same(found[0][3:], found[1][3:])
    assert np.abs(found[0][1]).max() > 0.0


@pytest.mark.parametrize("degree", [1, 2])
def test_curved_cells_and_finer_rules(degree):
    """A mesh of quadratic geometry, and a rule of another degree than the default one."""
    x = np.array(
        [[0, 0], [1, 0], [0, 1], [1, 1], [0.55, 0.45], [0.1, 0.5], [0.5, -0.1], [1.1, 0.5], [0.5, 0.9]]
    )
    cells, first = np.array([[0, 1, 2, 4, 5, 6], [3, 2, 1, 4, 7, 8]]), COMM.rank == 0
    found = []
    for assembly in ("native", "dolfinx"):
        mesh = compat.create_mesh(
            COMM, cells if first else cells[:0], x if first else x[:0], "triangle", degree=2
        )
        body = pm.Elements(mesh, material=HENCKY, degree=degree, quadrature_degree=6)
        random_state(body, 2)
        found.append(sums(pm.QuasiStaticFEM(body, assembly=assembly)))
    assert_same(*found)


@pytest.mark.parametrize("degree", [1, 2])
def test_regions(degree):
    """Several materials in one body, elastic and plastic ones."""
    found = []
    plastic, elastic = plasticity.cylinder(), plasticity.FULL
    for assembly in ("native", "dolfinx"):
        from dolfinx import mesh as dmesh

        made = box("quadrilateral", (4, 3), (4.0, 3.0), distort=0.1)
        cells = np.arange(made.topology.index_map(2).size_local, dtype=np.int32)
        values = np.asarray(made.topology.original_cell_index)[: len(cells)] % 3 + 1
        tags = dmesh.meshtags(made, 2, cells, values.astype(np.int32))
        body = pm.Elements(made, material={1: plastic, 2: elastic, 3: MICROPOLAR}, degree=degree, cells=tags)
        random_state(body, 2)
        problem = pm.QuasiStaticFEM(body, assembly=assembly, locking=None)  # dolfinx' forms have no cure
        found.append([*sums(problem), body.points.material])
    assert len(np.unique(np.concatenate(COMM.allgather(found[0].pop())))) == 3
    assert_same(found[0], found[1][:3])
    k = found[0][2]
    assert abs(k - k.T).max() > 1e-6 * abs(k).max()  # some points yield


RUNS = [
    pytest.param("quadrilateral", 1, MICROPOLAR, id="micropolar"),
    pytest.param("triangle", 2, NEO_HOOKEAN, id="neo-hookean"),
    pytest.param("quadrilateral", 2, plasticity.cone(plasticity.HENCKY), id="plastic"),
    pytest.param("quadrilateral", 1, plasticity.cylinder(), id="micropolar plastic"),
]


@pytest.mark.parametrize(("cell", "degree", "material"), RUNS)
def test_a_run_with_all_kinds_of_loads_is_the_same(cell, degree, material, strict):
    """Followers, surface terms, prescribed motions: the same iterations, displacements, reactions, energy."""
    answers = []
    for assembly in ("native", "dolfinx"):
        body = pm.Elements(box(cell, (6, 2), (6.0, 2.0), distort=0.05), material=material, degree=degree)
        problem = pm.QuasiStaticFEM(body, controls=strict, assembly=assembly, locking=None)
        left = body.facets(lambda x: x[:, 0] < 0.3)
        support = problem.fix(left, u=0, **({"theta": 0} if material.micropolar else {}))
        problem.fix(body.facets(lambda x: x[:, 0] > 5.7), uy=-0.04)
        problem.pressure(body.facets(lambda x: x[:, 1] > 1.7), 3.0)
        problem.traction(body.surface(lambda x: x[:, 1] < 0.3), force=(2.0, 1.0))
        problem.body_load(force=(1.0, -1.0))
        steps = list(problem.march(2, progress=False))
        force, couple = problem.reaction(support)
        found = [at_nodes(body, body.displacement), np.array([*force, *couple]), np.array([problem.energy()])]
        answers.append(([s.iterations for s in steps], found))
    assert answers[0][0] == answers[1][0]
    for one, other in zip(answers[0][1], answers[1][1], strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9 * abs(other).max())


def test_other_names_are_refused():
    body = pm.Elements(box("triangle", (1, 1)), material=NEO_HOOKEAN, degree=2)
    with pytest.raises(pm.InputError, match=r"assembly = 'projection'.*'native', 'dolfinx'"):
        pm.QuasiStaticFEM(body, assembly="projection")
