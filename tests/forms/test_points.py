"""Kernels at material points: consistent derivatives, and the same numbers as dolfinx's own compiler."""

from __future__ import annotations

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.forms import points as pointforms
from polarmpm.forms.couples import CoupleForm
from polarmpm.forms.points import PointForm
from polarmpm.kernels.kernel import compile_expressions
from polarmpm.kinematics import rotations
from polarmpm.tools import compat
from tests.conftest import (
    ANISOTROPIC,
    COMM,
    GENERAL,
    HENCKY,
    MICROPOLAR,
    NEO_HOOKEAN,
    derivative_error,
    rotation,
)

MATERIALS = {
    "rotated": MICROPOLAR,
    "reference": GENERAL,
    "anisotropic": ANISOTROPIC,
    "neo-hookean": NEO_HOOKEAN,
    "hencky": HENCKY,
}
CASES = [
    pytest.param(
        dim,
        material,
        id=f"{dim}d-{name}",
        marks=[pytest.mark.slow] if (dim, name) == (3, "anisotropic") else [],  # a long compile
    )
    for name, material in MATERIALS.items()
    for dim in (2, 3)
]
POINTS = 11  # more than a kernel call's eight, and no multiple of it


def draw(dim: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random finite states: F~, Q~ up to a turn, Gamma~, and gradients and rotations of an increment."""
    rng = np.random.default_rng(seed)
    n = POINTS
    F = np.tile(np.eye(3), (n, 1, 1))
    F[:, :dim, :dim] += rng.uniform(-0.25, 0.25, (n, dim, dim))
    vector, turn = np.zeros((n, 3)), rng.uniform(-1.0, 1.0, (n, 3))
    w, gamma = np.zeros((n, 3)), np.zeros((n, 3, 3))
    h, k = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    h[:, :dim, :dim] = rng.uniform(-0.2, 0.2, (n, dim, dim))
    if dim == 3:
        vector, w, gamma = 3.0 * turn, rng.uniform(-1, 1, (n, 3)), rng.uniform(-1, 1, (n, 3, 3))
        k = rng.uniform(-1, 1, (n, 3, 3))
    else:
        vector[:, 2], w[:, 2] = 3.0 * turn[:, 2], rng.uniform(-1, 1, n)
        gamma[:, 2, :2], k[:, 2, :2] = rng.uniform(-1, 1, (2, n, 2))
    return {"F": F, "vector": vector, "gamma": gamma, "h": h, "w": w, "k": k}


def inputs(form: PointForm, s: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(z, state, parameters) of the kernels as `forms.points` defines them."""
    d, n, material = form.layout.dim, POINTS, form.material
    q = rotations.from_vector(s["vector"])
    Q = np.array([rotation(v) for v in s["vector"]])
    back = np.swapaxes(Q, 1, 2)
    frame, gamma = s["F"], s["gamma"]
    if material.micropolar and material.isotropic:
        frame, gamma = frame @ back, Q @ gamma @ back
    g, gw = s["h"] @ frame, s["k"] @ frame
    z, state = [g[:, :d, :d].reshape(n, -1)], [frame[:, :d, :d].reshape(n, -1)]
    if material.micropolar:
        z += [s["w"], gw.reshape(n, -1)] if d == 3 else [s["w"][:, 2:], gw[:, 2, :2]]
        if not material.isotropic:
            state.append(q if d == 3 else q[:, [0, 3]])
        state.append(gamma.reshape(n, -1) if d == 3 else gamma[:, 2, :2])
    parameters = np.tile(list(material.parameters().values()), (n, 1))
    return np.concatenate(z, axis=1), np.concatenate(state, axis=1), parameters


def at_rest(form: PointForm, z: np.ndarray, state: np.ndarray, parameters: np.ndarray) -> tuple:
    """Inputs of the tangent's kernel with no correction before: there it derives the residual."""
    return (z, state, parameters, z) if form.predicts else (z, state, parameters)


def full(upper: np.ndarray, n: int) -> np.ndarray:
    """Symmetric matrices of their upper triangles, row by row."""
    out = np.zeros((len(upper), n, n))
    i, j = np.triu_indices(n)
    out[:, i, j] = out[:, j, i] = upper
    return out


def derivative_errors(
    form: PointForm, z: np.ndarray, state: np.ndarray, parameters: np.ndarray
) -> tuple[float, float]:
    """Relative errors of residual and tangent against differences of the energy and of the residual."""
    residual, blocks = form.compile(COMM)
    energy, n = form.compile_energy(COMM), z.shape[1]

    def r(z: np.ndarray) -> np.ndarray:
        return residual(z, state, parameters)

    def tangent(z: np.ndarray) -> np.ndarray:
        return full(blocks(*at_rest(form, z, state, parameters))[:, n:], n)

    of_energy = derivative_error(lambda z: energy(z, state, parameters), lambda z: r(z)[:, None], z)
    return of_energy, derivative_error(r, tangent, z)


@pytest.mark.parametrize(("dim", "material"), CASES)
def test_residual_and_tangent_are_derivatives(dim, material):
    """Residual against differences of the energy and tangent against those of the residual, below 1e-7."""
    form = PointForm(material, dim)
    z, state, parameters = inputs(form, draw(dim))
    n = z.shape[1]
    residual, blocks = form.compile(COMM)
    r = residual(z, state, parameters)
    assert max(derivative_errors(form, z, state, parameters)) < 1e-7
    np.testing.assert_allclose(
        blocks(*at_rest(form, z, state, parameters))[:, :n], r, rtol=1e-13, atol=1e-13 * abs(r).max()
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_energy_is_that_of_the_composed_rotations(dim):
    """W(E, Gamma) of F = (I + H) F~, Q = dQ Q~, Gamma = Gamma~ + Q~^T J_r K F~, evaluated with NumPy."""
    s = draw(dim)
    m = MICROPOLAR
    J = rotations.right_tangent(s["w"])
    for material in (MICROPOLAR, GENERAL):
        form = PointForm(material, dim)
        W = form.compile_energy(COMM)(*inputs(form, s))[:, 0]
        for p in range(POINTS):
            F = (np.eye(3) + s["h"][p]) @ s["F"][p]
            q0 = rotation(s["vector"][p])
            E = (rotation(s["w"][p]) @ q0).T @ F - np.eye(3)
            gamma = s["gamma"][p] + q0.T @ J[p] @ s["k"][p] @ s["F"][p]
            expected = 0.0
            for a, (trace, sym, skw) in ((E, (m.lam, m.mu, m.kappa)), (gamma, (m.alpha, m.gamma, m.beta))):
                b = trace * np.trace(a) * np.eye(3) + sym * (a + a.T) + skw * (a - a.T)
                expected += 0.5 * np.sum(a * b)
            assert W[p] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_rotated_and_reference_frame_agree(dim):
    """The cheaper frame of isotropic energies changes rounding only: dG = dG' Q~ for the same increment."""
    s = draw(dim, seed=1)
    out = []
    for material in (MICROPOLAR, GENERAL):
        form = PointForm(material, dim)
        z = inputs(form, s)
        n = z[0].shape[1]
        values = form.compile(COMM)[1](*at_rest(form, *z))
        out.append((form.compile_energy(COMM)(*z), values[:, :n], full(values[:, n:], n)))
    n = out[0][1].shape[1]
    change = np.zeros((POINTS, n, n))  # rotated z' = change z
    for p in range(POINTS):
        back = rotation(s["vector"][p]).T[:dim, :dim]
        rows = np.kron(np.eye(dim), back.T)  # G' = G Q~^T
        r = 3 if dim == 3 else 1
        change[p, : dim * dim, : dim * dim] = rows
        change[p, dim * dim : dim * dim + r, dim * dim : dim * dim + r] = np.eye(r)
        change[p, dim * dim + r :, dim * dim + r :] = np.kron(np.eye(r), back.T)
    (w1, r1, k1), (w2, r2, k2) = out
    np.testing.assert_allclose(w1, w2, rtol=1e-12)
    turned = np.einsum("pji,pj->pi", change, r1)
    np.testing.assert_allclose(turned, r2, atol=1e-12 * abs(r2).max())
    turned = np.einsum("pki,pkl,plj->pij", change, k1, change)
    np.testing.assert_allclose(turned, k2, atol=1e-12 * abs(k2).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_iterations_predict_the_stress_of_the_geometric_part(dim):
    """K = S'[dE, dE] + S~ . d2E with S~ = S(z~) + S'(z~) [z - z~], put together from differences of E(z)."""
    form = PointForm(MICROPOLAR, dim)
    z, state, parameters = inputs(form, draw(dim))
    before = z + 0.05 * np.random.default_rng(7).normal(size=z.shape)
    n, m = z.shape[1], MICROPOLAR
    strain = compile_expressions(list(form.strains()), form.terminals, form.inputs, form.space.domain, COMM)
    eye = np.eye(3)
    transposed = np.einsum("il,jk->ijkl", eye, eye).reshape(9, 9)
    law = np.zeros((18, 18))
    for at, (trace, sym, skw) in ((0, (m.lam, m.mu, m.kappa)), (9, (m.alpha, m.gamma, m.beta))):
        block = trace * np.outer(eye.ravel(), eye.ravel()) + sym * (np.eye(9) + transposed)
        law[at : at + 9, at : at + 9] = block + skw * (np.eye(9) - transposed)

    def first(z, h=1e-3):  # of fourth order
        out = np.zeros((len(z), 18, n))
        for k in range(n):
            d = np.zeros(n)
            d[k] = h
            e = [strain(z + c * d, state, parameters) for c in (-2, -1, 1, 2)]
            out[:, :, k] = (e[0] - 8 * e[1] + 8 * e[2] - e[3]) / (12 * h)
        return out

    second = np.zeros((len(z), 18, n, n))
    for k in range(n):
        d = np.zeros(n)
        d[k] = 1e-3
        e = [first(z + c * d) for c in (-2, -1, 1, 2)]
        second[..., k] = (e[0] - 8 * e[1] + 8 * e[2] - e[3]) / 12e-3
    slope = first(z)
    meant = strain(before, state, parameters) + np.einsum("pek,pk->pe", first(before), z - before)
    expected = np.einsum("pek,ef,pfl->pkl", slope, law, slope) + np.einsum(
        "pe,ef,pfkl->pkl", meant, law, second
    )
    found = full(form.compile(COMM)[1](z, state, parameters, before)[:, n:], n)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * abs(expected).max())
    exact = full(form.compile(COMM)[1](z, state, parameters, z)[:, n:], n)
    assert abs(found - exact).max() > 1e-3 * abs(expected).max()  # the prediction matters here


def test_differences_notice_a_wrong_tangent():
    """The yardstick of this module: an entry that is off by a millionth of the largest one is found."""
    form = PointForm(MICROPOLAR, 2)
    residual, blocks = form.compile(COMM)
    z, state, parameters = inputs(form, draw(2))
    n = z.shape[1]

    def wrong(z):
        k = full(blocks(*at_rest(form, z, state, parameters))[:, n:], n)
        k[3, 1, 2] += 1e-6 * abs(k).max()
        return k

    assert derivative_error(lambda z: residual(z, state, parameters), wrong, z) > 5e-7


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 1.0, 3.0])
def test_couple_kernel(angle):
    """-m . J_l(w) dw and its unsymmetric derivative, from tiny to large rotations."""
    rng = np.random.default_rng(4)
    w = rng.standard_normal((POINTS, 3))
    w *= angle / np.linalg.norm(w, axis=1, keepdims=True)
    m = rng.standard_normal((POINTS, 3))
    kernel = CoupleForm().compile(COMM)
    left = rotations.right_tangent(-w)
    np.testing.assert_allclose(kernel(w, m)[:, :3], -np.einsum("pi,pij->pj", m, left), atol=1e-12)

    def tangent(w):
        return kernel(w, m)[:, 3:].reshape(-1, 3, 3)

    assert derivative_error(lambda w: kernel(w, m)[:, :3], tangent, w, step=1e-4) < 1e-7
    # symmetric only where w = 0: then the derivative is the skew -1/2 hat(m)
    k = tangent(w)
    assert abs(k - np.swapaxes(k, 1, 2)).max() > 0.1


class _Carrier:
    """Stands in for the abstract space: dolfinx's quadrature functions on a mesh of intervals."""

    def __init__(self, mesh):
        self.mesh, self.spaces = mesh, {}

    def __call__(self, domain):
        self.domain = self.mesh.ufl_domain()
        return self

    def function_space(self, size):
        from dolfinx import fem

        if size not in self.spaces:
            make = getattr(fem, "functionspace", None) or fem.FunctionSpace
            self.spaces[size] = make(self.mesh, compat.quadrature_element("interval", size))
        return self.spaces[size]

    def coefficient(self, size):
        from dolfinx import fem

        return fem.Function(self.function_space(size))


def assembled(form: PointForm, z: np.ndarray, state: np.ndarray, parameters: np.ndarray):
    """Residual (n, nz) and tangent (n, nz, nz) by FFCx and dolfinx's assembler; form lives on a carrier."""
    from dolfinx import fem
    from dolfinx.fem import petsc

    for function, values in ((form.z, z), (form.state, state), (form.parameters, parameters)):
        function.x.array[:] = values.ravel()
    n, nz = z.shape
    vector = petsc.assemble_vector(fem.form(form.residual)).array * n  # an interval's length is 1 / n
    matrix = petsc.assemble_matrix(fem.form(form.tangent))
    matrix.assemble()
    dense = matrix.convert("dense").getDenseArray().reshape(n, nz, n, nz) * n
    return vector.reshape(n, nz), np.array([dense[p, :, p] for p in range(n)])


@pytest.mark.parametrize(
    ("dim", "material"),
    [
        pytest.param(2, MICROPOLAR, id="2d-rotated"),
        pytest.param(2, ANISOTROPIC, id="2d-anisotropic"),
        pytest.param(2, NEO_HOOKEAN, id="2d-neo-hookean"),
        pytest.param(2, HENCKY, id="2d-hencky"),
        pytest.param(3, NEO_HOOKEAN, id="3d-neo-hookean"),
        pytest.param(3, MICROPOLAR, id="3d-rotated", marks=pytest.mark.slow),
    ],
)
def test_same_numbers_as_ffcx(dim, material, monkeypatch):
    """dolfinx's own assembler, given the very same UFL forms, gives the kernel's numbers to 1e-12."""
    from mpi4py import MPI

    from dolfinx import mesh

    kernel = PointForm(material, dim).compile(COMM)[1]
    carrier = _Carrier(mesh.create_unit_interval(MPI.COMM_SELF, POINTS))
    monkeypatch.setattr(pointforms, "PointSpace", carrier)
    form = PointForm(material, dim)
    z, state, parameters = inputs(form, draw(dim, seed=2))
    vector, matrix = assembled(form, z, state, parameters)
    out = kernel(*at_rest(form, z, state, parameters))
    n = z.shape[1]
    np.testing.assert_allclose(out[:, :n], vector, rtol=0, atol=1e-12 * abs(vector).max())
    np.testing.assert_allclose(full(out[:, n:], n), matrix, rtol=0, atol=1e-12 * abs(matrix).max())


@pytest.mark.parametrize("material", [MICROPOLAR, NEO_HOOKEAN], ids=["micropolar", "neo-hookean"])
def test_kernels_are_found_again(material, monkeypatch):
    """Whatever else was made in UFL before, one compiled kernel serves all forms of a material."""
    names: list[str] = []
    find = pointforms.jit.library

    def library(key, source, comm):
        names.append(key)
        return find(key, source, comm)

    monkeypatch.setattr(pointforms.jit, "library", library)
    for _ in range(2):
        form = PointForm(material, 3)
        form.compile(COMM)
        form.compile_energy(COMM)
        ufl.variable(form.space.coefficient(3)), ufl.indices(3)
    half = len(names) // 2
    assert half >= 2
    assert names[:half] == names[half:]


def test_constants_of_an_energy_are_part_of_its_kernel():
    """Two energies that differ only in a number written into them don't share a cached kernel."""
    results = []
    for factor in (1.0, 1.0 + 1e-15):
        material = pm.UserEnergy(lambda E, G, p, c=factor: c * ufl.inner(E, E) + ufl.inner(G, G))
        form = PointForm(material, 2)
        z, state, _ = inputs(form, draw(2))
        results.append(form.compile_energy(COMM)(z, state, np.zeros((POINTS, 1))))
    assert np.any(results[0] != results[1])
    np.testing.assert_allclose(*results, rtol=1e-14)


def test_kernel_wants_the_right_number_of_inputs():
    """A wrong number of columns is refused, not read past the end."""
    form = PointForm(MICROPOLAR, 2)
    residual, _ = form.compile(COMM)
    with pytest.raises(ValueError, match="inputs"):
        residual(np.zeros((3, 4)))
