"""Materials: constants, stresses from energies, ranges of parameters."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.forms.stresses import FieldForm
from polarmpm.kinematics import rotations
from polarmpm.materials.base import check_material
from tests.conftest import COMM, HENCKY, MICROPOLAR, NEO_HOOKEAN, rotation
from tests.helpers.bodies import box

N = 9
BOUNDED = pm.MicropolarElastic.bounded_stiffness(lam=3e3, mu=2e3, kappa=7e2, l_b=0.3)
SOFT = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.5, l_b=0.2, l_t=0.1, psi=1.2)


def states(seed: int = 0, size: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random F, rotation vectors and Gamma."""
    rng = np.random.default_rng(seed)
    F = np.eye(3) + rng.uniform(-size, size, (N, 3, 3))
    return F, rng.uniform(-2, 2, (N, 3)), rng.uniform(-1, 1, (N, 3, 3))


def fields(material: pm.Material, F: np.ndarray, vector: np.ndarray, gamma: np.ndarray):
    """Energy (n,), Cauchy stress and couple stress (n, 3, 3) by the kernel for output."""
    parameters = np.tile(list(material.parameters().values()) or [0.0], (len(F), 1))
    out = FieldForm(material).compile(COMM)(F, rotations.from_vector(vector), gamma, parameters)
    return out[:, 0], out[:, 1:10].reshape(-1, 3, 3), out[:, 10:].reshape(-1, 3, 3)


def linear(a: np.ndarray, trace: float, sym: float, skw: float) -> np.ndarray:
    return trace * np.trace(a) * np.eye(3) + sym * (a + a.T) + skw * (a - a.T)


# constants ----------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "constants",
    [
        {"E": 1e7, "nu": 0.0, "n": 0.1, "l_b": 0.05, "l_t": 0.05, "psi": 1.0},
        {"E": 2.5, "nu": -0.4, "n": 0.9, "l_b": 3.0, "l_t": 6.0, "psi": 1.5},
        {"E": 1e9, "nu": 0.49, "n": 0.0, "l_b": 1e-3, "l_t": 1e-4, "psi": 0.2},
    ],
)
def test_engineering_constants_come_back(constants):
    """T (3.129)-(3.134) there and back."""
    back = pm.MicropolarElastic.from_engineering(**constants).engineering()
    assert back == pytest.approx(constants, rel=1e-12, abs=1e-12)


def test_engineering_constants_mean_what_they_say():
    """kappa = n^2 / (1 - n^2) mu, l_b^2 = (gamma + beta) / (4 mu), l_t^2 = gamma / mu,
    psi = 2 gamma / (2 gamma + alpha)."""
    m = SOFT
    assert m.mu == pytest.approx(1e6 / 2.6)
    assert m.lam == pytest.approx(0.3e6 / (1.3 * 0.4))
    assert m.kappa == pytest.approx(m.mu / 3)
    assert (m.gamma + m.beta) / (4 * m.mu) == pytest.approx(0.04)
    assert m.gamma / m.mu == pytest.approx(0.01)
    assert 2 * m.gamma / (2 * m.gamma + m.alpha) == pytest.approx(1.2)
    assert BOUNDED.engineering()["psi"] == pytest.approx(1.5)
    assert BOUNDED.engineering()["l_b"] == pytest.approx(0.3)
    assert (BOUNDED.beta, BOUNDED.alpha) == (0.0, pytest.approx(-2 / 3 * BOUNDED.gamma))
    assert np.isnan(pm.MicropolarElastic(lam=0, mu=1, kappa=1, alpha=0, beta=0, gamma=0).engineering()["psi"])


@pytest.mark.parametrize("kind", [pm.NeoHookean, pm.Hencky])
def test_classical_constants(kind):
    """Lame's constants of E and nu."""
    m = kind.from_engineering(E=1e6, nu=0.25)
    assert (m.lam, m.mu) == (pytest.approx(4e5), pytest.approx(4e5))


# ranges -------------------------------------------------------------------------------------------
MODULI = {"lam": 3e3, "mu": 2e3, "kappa": 7e2, "alpha": 11.0, "beta": 13.0, "gamma": 17.0}
ENGINEERING = {"E": 1e6, "nu": 0.3, "n": 0.5, "l_b": 0.2, "l_t": 0.1, "psi": 1.2}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mu", 0.0),
        ("mu", -1.0),
        ("lam", -1334.0),
        ("kappa", -1.0),
        ("beta", -0.1),
        ("gamma", -0.1),
        ("alpha", -11.4),
    ],
)
def test_moduli_out_of_range(name, value):
    """The modulus and its value are named."""
    with pytest.raises(pm.InputError, match=rf"^{name} = {value:g} is out of range: .*{name}"):
        pm.MicropolarElastic(**{**MODULI, name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [("E", 0.0), ("E", -5.0), ("nu", 0.5), ("nu", -1.0), ("n", 1.0), ("n", -0.1), ("l_b", -1.0),
     ("l_t", -1.0), ("l_t", 0.41), ("psi", 0.0), ("psi", 1.51)],
)  # fmt: skip
def test_engineering_constants_out_of_range(name, value):
    """The constant and its value are named, not a modulus that follows from it."""
    with pytest.raises(pm.InputError, match=rf"^{name} = {value:g} is out of range"):
        pm.MicropolarElastic.from_engineering(**{**ENGINEERING, name: value})


@pytest.mark.parametrize("bad", [np.nan, np.inf, "soft", None, 1j])
@pytest.mark.parametrize("name", list(MODULI))
def test_moduli_that_are_no_numbers(name, bad):
    """Not finite, or no number at all."""
    with pytest.raises(pm.InputError, match=f"^{name} = .*: a finite number"):
        pm.MicropolarElastic(**{**MODULI, name: bad})


@pytest.mark.parametrize("bad", [np.nan, "soft", None])
@pytest.mark.parametrize("name", list(ENGINEERING))
def test_engineering_constants_that_are_no_numbers(name, bad):
    """The same for engineering constants."""
    with pytest.raises(pm.InputError, match=f"^{name} = .*: a finite number"):
        pm.MicropolarElastic.from_engineering(**{**ENGINEERING, name: bad})


@pytest.mark.parametrize(
    ("name", "bad"), [("mu", "soft"), ("mu", -1.0), ("mu", None), ("l_b", -1.0), ("lam", np.nan)]
)
def test_bounded_stiffness_out_of_range(name, bad):
    """The argument is named, also where a modulus is computed from it."""
    with pytest.raises(pm.InputError, match=f"^{name} = "):
        pm.MicropolarElastic.bounded_stiffness(**{"lam": 3e3, "mu": 2e3, "kappa": 7e2, "l_b": 0.3, name: bad})


@pytest.mark.parametrize("kind", [pm.NeoHookean, pm.Hencky])
def test_classical_moduli_out_of_range(kind):
    """Lame's constants and E, nu."""
    for constants, name in (({"lam": 1.0, "mu": 0.0}, "mu"), ({"lam": -1.0, "mu": 1.0}, "lam")):
        with pytest.raises(pm.InputError, match=f"^{name} = {constants[name]:g} is out of range"):
            kind(**constants)
    with pytest.raises(pm.InputError, match=r"^nu = 0\.5 is out of range"):
        kind.from_engineering(E=1.0, nu=0.5)


@pytest.mark.parametrize("number", [np.float32(2e3), np.int64(2000), 2000, np.float64(2e3)])
def test_numbers_of_any_kind(number):
    """NumPy's scalars are numbers too, as they come out of tables and arrays."""
    assert pm.MicropolarElastic(**{**MODULI, "mu": number}).engineering()["nu"] == pytest.approx(0.3)
    assert pm.UserEnergy(lambda E, G, p: p.a * ufl.inner(E, E), {"a": number}).parameters() == {"a": 2000}


@pytest.mark.parametrize("kind", ["bounded", "longest", "largest"])
def test_limits_are_admissible(kind):
    """Rounding does not push the limits of the ranges out of them."""
    for scale in np.geomspace(1e-9, 1e9, 37):
        if kind == "bounded":
            pm.MicropolarElastic.bounded_stiffness(lam=0, mu=scale / 3, kappa=0, l_b=0.7)
        elif kind == "longest":
            m = pm.MicropolarElastic.from_engineering(
                E=scale, nu=0.3, n=0.5, l_b=0.1 * scale, l_t=0.2 * scale, psi=1
            )
            assert m.beta >= 0
        else:
            pm.MicropolarElastic.from_engineering(E=scale, nu=0.3, n=0.5, l_b=0.3, l_t=0.1, psi=1.5)


# stresses -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("material", [MICROPOLAR, BOUNDED, SOFT])
def test_micropolar_stress_is_the_closed_form(material):
    """sigma = Q B F^T / J with B = lam tr E I + 2 mu sym E + 2 kappa skw E, mu likewise;
    W = (E:B + Gamma:S) / 2."""
    m = material
    F, vector, gamma = states()
    W, sigma, mu = fields(m, F, vector, gamma)
    for p in range(N):
        Q, J = rotation(vector[p]), np.linalg.det(F[p])
        E = Q.T @ F[p] - np.eye(3)
        B, S = linear(E, m.lam, m.mu, m.kappa), linear(gamma[p], m.alpha, m.gamma, m.beta)
        assert W[p] == pytest.approx(0.5 * np.sum(E * B + gamma[p] * S), rel=1e-12)
        expected = Q @ B @ F[p].T / J
        np.testing.assert_allclose(sigma[p], expected, rtol=0, atol=1e-12 * abs(expected).max())
        expected = Q @ S @ F[p].T / J
        np.testing.assert_allclose(mu[p], expected, rtol=0, atol=1e-12 * abs(expected).max())


def test_energy_vanishes_for_rigid_motions_only():
    """No stress for F = Q, Gamma = 0; and W > 0 elsewhere, since the moduli are admissible."""
    _, vector, gamma = states()
    R = np.array([rotation(v) for v in vector])
    W, sigma, mu = fields(MICROPOLAR, R, vector, 0 * gamma)
    assert max(abs(W).max(), abs(sigma).max(), abs(mu).max()) < 1e-11
    assert fields(MICROPOLAR, *states())[0].min() > 0.0


def test_neo_hookean_is_the_closed_form():
    """sigma = (mu (b - I) + lambda ln J I) / J."""
    F, vector, gamma = states()
    m = NEO_HOOKEAN
    W, sigma, mu = fields(m, F, vector, gamma)
    for p in range(N):
        J, b = np.linalg.det(F[p]), F[p] @ F[p].T
        energy = 0.5 * m.mu * (np.trace(b) - 3 - 2 * np.log(J)) + 0.5 * m.lam * np.log(J) ** 2
        assert W[p] == pytest.approx(energy, rel=1e-11)
        np.testing.assert_allclose(
            sigma[p], (m.mu * (b - np.eye(3)) + m.lam * np.log(J) * np.eye(3)) / J, atol=1e-9
        )
    assert np.all(mu == 0.0)


def hencky_reference(F: np.ndarray) -> tuple[float, np.ndarray]:
    """By eigenvalues: tau = 2 mu ln V + lambda ln J I."""
    value, vector = np.linalg.eigh(F @ F.T)
    log_v = vector @ np.diag(0.5 * np.log(value)) @ vector.T
    J, m = np.linalg.det(F), HENCKY
    tau = 2 * m.mu * log_v + m.lam * np.log(J) * np.eye(3)
    return m.mu * np.sum(log_v**2) + 0.5 * m.lam * np.log(J) ** 2, tau / J


STRETCHES = {
    "undeformed": (1, 1, 1),
    "tiny": (1 + 1e-7, 1 - 2e-7, 1),
    "uniaxial": (1.6, 0.8, 0.8),
    "equibiaxial": (1.3, 1.3, 0.5),
    "spherical": (0.6, 0.6, 0.6),
    "nearly coincident": (1.2, 1.2 + 1e-9, 0.9),
    "distinct": (0.7, 1.1, 1.9),
    "large": (9.5, 0.105, 1.0),
    "long": (9.5, 1.0, 1.0),
}


@pytest.mark.parametrize("stretches", STRETCHES.values(), ids=STRETCHES.keys())
def test_hencky_is_that_of_the_eigenvalues(stretches):
    """Energy and stress to the accuracy of the fit, also where principal stretches coincide."""
    rng = np.random.default_rng(1)
    turn, back = rotation(rng.uniform(-2, 2, 3)), rotation(rng.uniform(-2, 2, 3))
    F = (turn @ np.diag(stretches) @ back)[None]
    W, sigma, _ = fields(HENCKY, F, np.zeros((1, 3)), np.zeros((1, 3, 3)))
    energy, stress = hencky_reference(F[0])
    scale = max(abs(stress).max(), 1e-9 * HENCKY.mu)
    assert W[0] == pytest.approx(energy, rel=1e-9, abs=1e-15 * HENCKY.mu)
    np.testing.assert_allclose(sigma[0], stress, rtol=0, atol=1e-8 * scale + 1e-12 * HENCKY.mu)


def test_hencky_between_the_limits():
    """Random stretches between 1/10 and 10."""
    rng = np.random.default_rng(3)
    turns = np.array([[rotation(v) for v in pair] for pair in rng.uniform(-2, 2, (200, 2, 3))])
    stretches = np.eye(3) * 10 ** rng.uniform(-0.99, 0.99, (200, 1, 3))
    F = turns[:, 0] @ stretches @ turns[:, 1]
    W, sigma, _ = fields(HENCKY, F, np.zeros((200, 3)), np.zeros((200, 3, 3)))
    for p in range(200):
        energy, stress = hencky_reference(F[p])
        assert W[p] == pytest.approx(energy, rel=1e-8)
        # close to 1/10 the fit's slope is a little off
        np.testing.assert_allclose(sigma[p], stress, rtol=0, atol=1e-6 * abs(stress).max())


# user's energies ----------------------------------------------------------------------------------
def test_user_energy_equals_the_built_in_one():
    """The same W written by a user, in both frames, and as a subclass."""

    def W(E, G, p):
        B = p.lam * ufl.tr(E) * ufl.Identity(3) + 2 * p.mu * ufl.sym(E) + 2 * p.kappa * ufl.skew(E)
        S = p.alpha * ufl.tr(G) * ufl.Identity(3) + 2 * p.gamma * ufl.sym(G) + 2 * p.beta * ufl.skew(G)
        return ufl.inner(E, B) / 2 + ufl.inner(G, S) / 2

    class Mine(pm.Material):
        isotropic = True

        def parameters(self):
            return MICROPOLAR.parameters()

        def energy(self, E, G, p):
            return W(E, G, p)

    expected = fields(MICROPOLAR, *states())
    for material in (pm.UserEnergy(W, MODULI), pm.UserEnergy(W, MODULI, isotropic=True), Mine()):
        for found, e in zip(fields(material, *states()), expected, strict=True):
            np.testing.assert_allclose(found, e, rtol=0, atol=1e-12 * abs(e).max())


def test_classical_user_energy():
    """W(F, p) without a rotation."""

    def energy(F, p):
        return NEO_HOOKEAN.energy(F.T * F, p)

    material = pm.UserEnergy(energy, NEO_HOOKEAN.parameters(), micropolar=False)
    for found, e in zip(fields(material, *states()), fields(NEO_HOOKEAN, *states()), strict=True):
        np.testing.assert_allclose(found, e, rtol=0, atol=1e-12 * max(abs(e).max(), 1e-300))


def test_energy_without_parameters():
    """Numbers may be written into the energy."""
    W, _, _ = fields(pm.UserEnergy(lambda E, G, p: 2 * ufl.inner(E, E) + ufl.inner(G, G)), *states())
    F, vector, gamma = states()
    for p in range(N):
        E = rotation(vector[p]).T @ F[p] - np.eye(3)
        assert W[p] == pytest.approx(2 * np.sum(E**2) + np.sum(gamma[p] ** 2))


def test_material_without_energy():
    """What is missing is said when points get the material, not by a compiler."""

    class Empty(pm.Material):
        pass

    for bad in (Empty(), pm.Material()):
        with pytest.raises(pm.InputError, match=f"{type(bad).__name__} has no energy"):
            check_material(bad)
    for bad in (None, "steel", pm.MicropolarElastic, 1e6):
        with pytest.raises(pm.InputError, match="is not a material"):
            check_material(bad)
    with pytest.raises(pm.InputError, match=r"function = 3\.0: an energy in UFL is needed"):
        pm.UserEnergy(3.0)
    with pytest.raises(pm.InputError, match=r"^stiffness = nan"):
        pm.UserEnergy(lambda E, G, p: 0, {"stiffness": np.nan})


@pytest.mark.parametrize(("nu", "tents", "splines"), [(0.48, 0, 0), (0.494, 1, 0), (0.4999, 1, 1)])
def test_functions_of_incompressible_materials_warn(nu, tents, splines):
    """On rank 0; elements of degree 2 don't lock, splines later than multilinear functions."""
    material = pm.NeoHookean.from_engineering(E=1e6, nu=nu)
    grid = pm.Grid.box((0, 0), (2, 1), 0.5)
    points = pm.seed(grid, material=material, points_per_cell=2)
    mesh = box("quadrilateral", (4, 2))
    problems = [
        (splines, lambda: pm.QuasiStatic(grid, points, locking=None)),
        (tents, lambda: pm.QuasiStatic(grid, points, basis="mpm", locking=None)),
        (tents, lambda: pm.QuasiStatic(grid, points, basis="gimpm", locking=None)),
        (tents, lambda: pm.QuasiStatic(grid, points, basis="mpm", assembly="projection")),
        (splines, lambda: pm.QuasiStatic(grid, points, basis="bspline3")),
        *((0, lambda b=b: pm.QuasiStatic(grid, points, basis=b)) for b in ("mpm", "gimpm", "bspline")),
        (tents, lambda: pm.QuasiStaticFEM(pm.Elements(mesh, material=material), locking=None)),
        (tents, lambda: pm.QuasiStaticFEM(pm.Elements(mesh, material=material), assembly="dolfinx")),
        (tents, lambda: pm.QuasiStaticFEM(pm.Elements(box("triangle", (4, 2)), material=material))),
        (0, lambda: pm.QuasiStaticFEM(pm.Elements(mesh, material=material))),
        (0, lambda: pm.QuasiStaticFEM(pm.Elements(mesh, material=material, degree=2))),
    ]
    for locks, make in problems:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            make()
        found = [w for w in caught if "lock" in str(w.message)]
        assert len(found) == (locks and COMM.rank == 0)
        assert all(w.filename == __file__ and w.category is pm.TrustWarning for w in found)
