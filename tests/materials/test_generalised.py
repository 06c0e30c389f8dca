"""Materials of generalised continua: energies against closed forms and quadrature over the micro-space."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.forms.points import PointForm
from polarmpm.forms.stresses import FieldForm
from polarmpm.kinematics import rotations
from tests.conftest import COMM, HENCKY, MICROPOLAR, NEO_HOOKEAN, rotation

SVK = pm.SaintVenantKirchhoff(lam=3e3, mu=2e3)
SERIES = pm.ArrudaBoyce(C_R=2e3, N=8, kappa=5e3, chain="series")
EXACT = pm.ArrudaBoyce(C_R=2e3, N=8, kappa=5e3)
L = (0.3, 0.2, 0.1)
TRIAD = rotation(np.array([0.4, -0.7, 0.2]))
GAUSS3 = ((-math.sqrt(0.6), 5 / 18), (0.0, 8 / 18), (math.sqrt(0.6), 5 / 18))  # of an edge from -1 to 1
GAUSS2 = ((-1 / math.sqrt(3), 1 / 2), (1 / math.sqrt(3), 1 / 2))


def user(F, p):
    """A classical energy that is known as a function of F only."""
    C, J = ufl.dot(ufl.transpose(F), F), ufl.det(F)
    return p.a / 2 * (ufl.tr(C) - 3 - 2 * ufl.ln(J)) + p.b / 2 * (J - 1) ** 2


USER = pm.UserEnergy(user, {"a": 2e3, "b": 3e3}, micropolar=False)


def states(n: int = 6, *, seed: int = 0, plane: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Random F (n, 3, 3) and H (n, 3, 3, 3)."""
    rng = np.random.default_rng(seed)
    F, H = np.eye(3) + rng.uniform(-0.2, 0.2, (n, 3, 3)), rng.uniform(-1, 1, (n, 3, 3, 3))
    H = (H + H.swapaxes(2, 3)) / 2
    if plane:
        F[:, 2, :2] = F[:, :2, 2] = 0.0
        F[:, 2, 2] = 1.0
        H[:, 2], H[:, :, 2], H[:, :, :, 2] = 0.0, 0.0, 0.0
    return F, H


def energy(material: pm.Material, F: np.ndarray, H: np.ndarray | None = None) -> np.ndarray:
    """W (n,) by the kernel of the problem; classical without H."""
    form = PointForm(material, 3)
    none = np.zeros((len(F), 3, 3))
    state = form.pack(F, rotations.identity(len(F)), none, (), H)
    return evaluate(form, np.zeros((len(F), form.layout.unknowns)), state)


def numbers_of(form: PointForm, n: int) -> np.ndarray:
    return np.tile(list(form.material.parameters().values()) or [0.0], (n, 1))


def evaluate(form: PointForm, z: np.ndarray, state: np.ndarray) -> np.ndarray:
    return form.compile_energy(COMM)(z, state, numbers_of(form, len(z)))[:, 0]


def mean(elastic, F, H, lengths, directors, rule, *, full=False) -> np.ndarray:
    """The mean of a classical energy over the micro-space by a rule, place by place; of a truncated strain
    the energy is taken at F = U, the root of C."""
    changes = [np.einsum("nijk,k->nij", H, d) for d in directors]
    total = np.zeros(len(F))
    for places in product(rule, repeat=len(lengths)):
        z = [x * l / 2 for (x, _), l in zip(places, lengths, strict=True)]
        if full:
            at = F + sum(a * g for a, g in zip(z, changes, strict=True))
        else:
            C = np.swapaxes(F, 1, 2) @ F
            for a, g in zip(z, changes, strict=True):
                k = np.swapaxes(F, 1, 2) @ g
                C = C + a * (k + np.swapaxes(k, 1, 2))
            value, vector = np.linalg.eigh(C)
            at = (vector * np.sqrt(value)[:, None]) @ np.swapaxes(vector, 1, 2)
        total += np.prod([w for _, w in places]) * energy(elastic, at)
    return total


# classical ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("chain", "modulus", "stresses"),
    [
        ("series", 1.0851367, (0.29709, 1.16581, 2.02305, 4.01028)),
        ("exact", 1.0851601, (0.29710, 1.16588, 2.02364, 4.04549)),
    ],
)
def test_rubber_in_uniaxial_tension(chain, modulus, stresses):
    """Nominal stress by C_R of the incompressible material at stretches 1.1, 1.5, 2, 3."""
    material = pm.ArrudaBoyce(C_R=1.0, N=8, kappa=1.0, chain=chain)
    assert material.moduli("mu")["mu"] == pytest.approx(modulus, rel=1e-7)
    step = 1e-5
    for stretch, expected in zip((1.1, 1.5, 2.0, 3.0), stresses, strict=True):
        ends = [np.diag([s, s**-0.5, s**-0.5]) for s in (stretch - step, stretch + step)]
        W = energy(material, np.array(ends))
        assert (W[1] - W[0]) / (2 * step) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("N", [1.01, 2.0, 8.0, 100.0, 1e4])
def test_chains_up_to_their_limit(N):
    """The exact energy against Langevin's function, solved for to rounding; infinite beyond the limit."""
    material = pm.ArrudaBoyce(C_R=1.0, N=N, kappa=1.0)
    least = 1 / math.sqrt(N)
    x = least + (1 - least) * np.array([0.2, 0.5, 0.9, 0.99])
    stretches = [max(np.roots([1.0, 0.0, -3 * N * v**2, 2.0]).real) for v in x]
    W = energy(material, np.array([np.diag([s, s**-0.5, s**-0.5]) for s in stretches]))

    def chain(v: float) -> float:
        low, high = 1e-9, 1e9
        for _ in range(200):
            b = math.sqrt(low * high)
            low, high = (b, high) if 1 / math.tanh(b) - 1 / b < v else (low, b)
        return v * b - b + math.log(2 * b / -math.expm1(-2 * b))

    expected = [N * (chain(v) - chain(least)) for v in x]
    np.testing.assert_allclose(W, expected, rtol=1e-7, atol=1e-9)
    s = max(np.roots([1.0, 0.0, -3 * N * 1.01, 2.0]).real)
    assert np.isnan(energy(material, np.diag([s, s**-0.5, s**-0.5])[None])).all()


def test_rest_is_without_stress():
    """Energy and stress vanish where nothing is deformed, and turned."""
    R = rotation(np.array([0.3, 1.0, -2.0]))[None]
    for material in (SVK, SERIES, EXACT):
        out = FieldForm(material).compile(COMM)(
            R, rotations.identity(1), np.zeros((1, 3, 3)), numbers_of(PointForm(material, 3), 1)
        )
        assert abs(out).max() < 1e-10 * 5e3


def test_saint_venant_kirchhoff_is_the_closed_form():
    F, _ = states()
    E = (np.swapaxes(F, 1, 2) @ F - np.eye(3)) / 2
    expected = 1.5e3 * np.trace(E, axis1=1, axis2=2) ** 2 + 2e3 * np.einsum("nij,nij->n", E, E)
    np.testing.assert_allclose(energy(SVK, F), expected, rtol=1e-13)


def test_constants_of_rubber():
    material = pm.ArrudaBoyce.from_engineering(E=3e6, nu=0.45, N=8, chain="series")
    found = material.moduli("lam", "mu")
    assert found["mu"] == pytest.approx(3e6 / 2.9)
    assert found["lam"] / (2 * (found["lam"] + found["mu"])) == pytest.approx(0.45)


# second gradients -----------------------------------------------------------------------------------
@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("rule", [GAUSS2, GAUSS3])
def test_gradient_energy_of_saint_venant_kirchhoff_is_the_exact_mean(count, rule):
    """Quadratic in z: rules of two and of three places agree."""
    F, H = states()
    W = energy(pm.GradientElastic(SVK, L[:count], TRIAD[:count]), F, H)
    np.testing.assert_allclose(W, mean(SVK, F, H, L[:count], TRIAD[:count], rule), rtol=1e-12)


@pytest.mark.parametrize("elastic", [NEO_HOOKEAN, SERIES, EXACT, HENCKY], ids=lambda m: type(m).__name__)
def test_gradient_energy_is_the_mean_over_the_micro_space(elastic):
    """Gauss' rule of two places; its error goes with the fourth power of the lengths."""
    F, H = states()
    found = energy(pm.GradientElastic(elastic, L[:2], TRIAD[:2]), F, H)
    np.testing.assert_allclose(found, mean(elastic, F, H, L[:2], TRIAD[:2], GAUSS2), rtol=1e-10)
    errors = []
    for l in (0.2, 0.1):
        found = energy(pm.GradientElastic(elastic, [l], TRIAD[:1]), F, H)
        errors.append(abs(found - mean(elastic, F, H, [l], TRIAD[:1], GAUSS3)).max())
    assert errors[0] / errors[1] > 12


@pytest.mark.parametrize("elastic", [NEO_HOOKEAN, USER, SVK], ids=lambda m: type(m).__name__)
def test_full_strain_of_a_micro_space(elastic):
    F, H = states()
    found = energy(pm.GradientElastic(elastic, L[:2], full=True), F, H)
    np.testing.assert_allclose(
        found, mean(elastic, F, H, L[:2], np.eye(3)[:2], GAUSS2, full=True), rtol=1e-11
    )


MATERIALS = {
    "svk": pm.GradientElastic(SVK, L, TRIAD),
    "neo-hookean": pm.GradientElastic(NEO_HOOKEAN, L[:1]),
    "rubber": pm.GradientElastic(EXACT, L[:1]),
    "full": pm.GradientElastic(USER, L[:1], TRIAD[:1]),
    "normals": pm.GradientElastic(SVK, L[:1], TRIAD[:1], normals=True),
    "normals, full": pm.GradientElastic(NEO_HOOKEAN, L[:1], normals=True, full=True),
}


# tens of thousands of lines: of the last one in space either half is tested
CASES = [
    pytest.param(m, dim, id=f"{dim}-{name}", marks=pytest.mark.slow if (name, dim) == ("normals", 3) else ())
    for dim in (2, 3)
    for name, m in MATERIALS.items()
    if (name, dim) != ("normals, full", 3)
]


@pytest.mark.parametrize(("material", "dim"), CASES)
def test_residual_and_tangent_are_derivatives(material, dim):
    """Of the energy, by differences."""
    if dim == 2 and material.directors[0][2]:
        material = pm.GradientElastic(material.elastic, L[:1], full=material.full, normals=material.normals)
    form = PointForm(material, dim)
    F, H = states(1, plane=dim == 2)
    state = form.pack(F, rotations.identity(1), np.zeros((1, 3, 3)), (), H)
    n, h = form.layout.unknowns, 1e-5
    p = numbers_of(form, n)
    steps, states_ = h * np.eye(n), np.tile(state, (n, 1))
    residual, blocks = form.compile(COMM)
    zero = np.zeros((1, n))
    given = (zero,) if form.predicts else ()
    out = blocks(zero, state, p[:1], *given)[0]
    slope = (evaluate(form, steps, states_) - evaluate(form, -steps, states_)) / (2 * h)
    scale = abs(out[:n]).max()
    np.testing.assert_allclose(out[:n], slope, rtol=0, atol=1e-6 * scale)
    K = (residual(steps, states_, p) - residual(-steps, states_, p)) / (2 * h)
    upper = K[np.triu_indices(n)]
    np.testing.assert_allclose(out[n:], upper, rtol=0, atol=1e-6 * abs(upper).max())


@pytest.mark.parametrize("material", MATERIALS.values(), ids=MATERIALS.keys())
def test_gradient_energy_does_not_see_rotations(material):
    """Frame indifference: a rotation on top of the motion changes nothing."""
    F, H = states()
    R = rotation(np.array([2.0, -0.5, 1.0]))
    turned = energy(material, np.einsum("ij,njk->nik", R, F), np.einsum("ij,njkl->nikl", R, H))
    np.testing.assert_allclose(turned, energy(material, F, H), rtol=1e-12)


def test_equal_lengths_prefer_no_direction():
    """Directors may be turned; with unequal lengths they mayn't."""
    F, H = states()
    for lengths, same in ((0.3, True), (L, False)):
        one, two = (energy(pm.GradientElastic(SVK, lengths, d), F, H) for d in (np.eye(3), TRIAD))
        assert np.allclose(one, two, rtol=1e-12) == same


@pytest.mark.parametrize("elastic", [SVK, NEO_HOOKEAN, HENCKY, EXACT, USER], ids=lambda m: type(m).__name__)
def test_without_an_extent_it_is_the_classical_material(elastic):
    """The same digits; a small length changes W by its square."""
    F, H = states()
    classical = energy(elastic, F)
    np.testing.assert_array_equal(energy(pm.GradientElastic(elastic, (0.0, 0.0)), F, H), classical)
    one, two = (energy(pm.GradientElastic(elastic, [l]), F, H) - classical for l in (0.02, 0.01))
    np.testing.assert_allclose(one, 4 * two, rtol=1e-2)


def test_normals_of_a_bent_plate():
    """Bent to a cylinder without stretch, fibres across the plate and normals to it are the same; sheared
    alike everywhere fibres turn no more than normals do."""
    l, k = 0.3, 0.7  # x = (sin(k X)/k - Z sin(k X), Z cos(k X) + ..): n,X = k t
    a = 0.4
    t, n = np.array([math.cos(a), 0, math.sin(a)]), np.array([-math.sin(a), 0, math.cos(a)])
    F = np.column_stack([t, [0, 1, 0], n])[None]
    H = np.zeros((1, 3, 3, 3))
    H[0, :, 0, 0] = k * n
    H[0, :, 0, 2] = H[0, :, 2, 0] = -k * t
    fibres, normals = (
        energy(pm.GradientElastic(SVK, l, [[0, 0, 1]], normals=which), F, H) for which in (False, True)
    )
    expected = l**2 / 12 * (SVK.lam / 2 + SVK.mu) * k**2
    np.testing.assert_allclose([fibres[0], normals[0]], expected, rtol=1e-12)


def test_planes_and_their_normal():
    """A director along the third axis adds nothing in a plane; one at an angle is refused there."""
    grid = pm.Grid.box((0, 0), (1, 1), 0.5)
    F, H = states(plane=True)
    with_it = energy(pm.GradientElastic(SVK, (0.3, 0.3, 0.7)), F, H)
    np.testing.assert_allclose(with_it, energy(pm.GradientElastic(SVK, (0.3, 0.3)), F, H), rtol=1e-13)
    for material in (
        pm.GradientElastic(SVK, 0.1, [[0.6, 0.0, 0.8]]),
        pm.OrientedMicropolar(1.0, 1.0, 0.1, TRIAD),
    ):
        with pytest.raises(pm.InputError, match=r"^directors: \(.*\) leaves the plane"):
            pm.seed(grid, material=material, points_per_cell=2)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"elastic": MICROPOLAR}, "elastic: MicropolarElastic is micropolar"),
        ({"elastic": "rubber"}, "is not a material"),
        ({"elastic": pm.GradientElastic(SVK, 1.0)}, "elastic: GradientElastic has second gradients already"),
        ({"elastic": pm.VonMises(NEO_HOOKEAN, k=1.0)}, "elastic: VonMises yields"),
        ({"lengths": -1.0}, r"^lengths = -1\.0: one length"),
        ({"lengths": (1.0, np.nan)}, r"^lengths\[1\] = nan"),
        ({"lengths": ()}, r"^lengths = \(\)"),
        ({"lengths": (1, 1, 1, 1)}, "^lengths = "),
        ({"lengths": "long"}, "^lengths = 'long'"),
        ({"lengths": {0.1}}, "^lengths = "),
        ({"lengths": (1.0, 1.0), "directors": np.eye(3)}, "^lengths = .*one for each of the 3 directors"),
        ({"directors": [1.0, 1.0, 0.0]}, "^directors = .*their lengths are 1.41421356"),
        ({"directors": np.zeros((1, 3))}, "^directors = .*unit vectors"),
        ({"directors": np.eye(4)}, "^directors = "),
        ({"directors": [[np.nan, 1, 0]]}, "^directors = "),
        ({"directors": "x"}, "^directors = 'x'"),
        ({"full": 1}, "^full = 1: True, False or None"),
        ({"normals": None}, "^normals = None: True or False"),
        ({"elastic": USER, "full": False}, "^full = False: the energy of UserEnergy is known"),
        ({"elastic": pm.UserEnergy(user, {"a": 1, "b": 1, "l_1": 1}, micropolar=False)}, "called l_1"),
    ],
)
def test_gradient_materials_that_are_none(given, message):
    with pytest.raises(pm.InputError, match=message):
        pm.GradientElastic(**{"elastic": SVK, "lengths": 0.1, **given})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"C_R": 0.0}, "^C_R = 0"),
        ({"N": 1.0}, "^N = 1 "),
        ({"N": 1e7}, r"^N = 1e\+07"),
        ({"kappa": -1.0}, "^kappa = -1"),
        ({"chain": "pade"}, "^chain = 'pade': one of 'exact', 'series'"),
        ({"N": "8"}, "^N = '8'"),
    ],
)
def test_rubber_that_is_none(given, message):
    with pytest.raises(pm.InputError, match=message):
        pm.ArrudaBoyce(**{"C_R": 1.0, "N": 8.0, "kappa": 1.0, **given})


# micropolar -----------------------------------------------------------------------------------------
def micropolar_energy(material: pm.Material, seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(W, E, Gamma) at random states."""
    rng = np.random.default_rng(seed)
    F, gamma = np.eye(3) + rng.uniform(-0.3, 0.3, (6, 3, 3)), rng.uniform(-1, 1, (6, 3, 3))
    vector = rng.uniform(-2, 2, (6, 3))
    form = PointForm(material, 3)
    W = FieldForm(material).compile(COMM)(F, rotations.from_vector(vector), gamma, numbers_of(form, 6))[:, 0]
    Q = np.array([rotation(v) for v in vector])
    return W, np.swapaxes(Q, 1, 2) @ F - np.eye(3), gamma


def hooke(A: np.ndarray, lam: float, mu: float) -> np.ndarray:
    return lam / 2 * np.trace(A, axis1=1, axis2=2) ** 2 + mu * np.einsum("nij,nij->n", A, A)


@pytest.mark.parametrize("directors", [None, TRIAD, TRIAD[[1, 0, 2]]])
def test_oriented_micropolar_energy_is_the_mean_over_fibres(directors):
    """K_a v = (Gamma v) x d_a, by Gauss' rule of 2^3 places; left-handed triads, too."""
    W, E, gamma = micropolar_energy(pm.OrientedMicropolar(3e3, 2e3, L, directors))
    rows = np.eye(3) if directors is None else directors
    expected = np.zeros(6)
    for places in product(GAUSS2, repeat=3):
        A = E.copy()
        for (x, _), l, d in zip(places, L, rows, strict=True):
            A += x * l / 2 * np.cross(gamma, d, axisa=1, axisc=1)
        expected += hooke(A, 3e3, 2e3) / 8
    np.testing.assert_allclose(W, expected, rtol=1e-12)


def test_oriented_micropolar_of_equal_lengths():
    """Moduli of the isotropic material that it is, and not with one length."""
    l, lam, mu = 0.3, 3e3, 2e3
    moduli = {"kappa": mu, "alpha": 0.0, "gamma": l**2 * mu / 6, "beta": l**2 * (lam + 2 * mu) / 12}
    isotropic, _, _ = micropolar_energy(pm.MicropolarElastic(lam=lam, mu=mu, **moduli))
    W, _, _ = micropolar_energy(pm.OrientedMicropolar(lam, mu, l, TRIAD))
    np.testing.assert_allclose(W, isotropic, rtol=1e-14)
    W, _, _ = micropolar_energy(pm.OrientedMicropolar(lam, mu, (l, 0, 0)))
    assert abs(W / isotropic - 1).max() > 0.02


def test_micropolar_of_a_cubic_micro_space():
    """W = psi(E) + l^2/12 psi(Gamma) with all of both."""
    material = pm.MicropolarElastic.from_microspace(E=1e4, nu=0.3, l=0.4)
    W, E, gamma = micropolar_energy(material)
    lam, mu = material.lam, material.mu
    np.testing.assert_allclose(W, hooke(E, lam, mu) + 0.16 / 12 * hooke(gamma, lam, mu), rtol=1e-13)
    known = material.engineering()
    assert known["n"] == pytest.approx(math.sqrt(0.5))
    assert known["l_b"] ** 2 == pytest.approx(0.16 / 24)
    assert known["l_t"] ** 2 == pytest.approx(0.16 / 12)
    for name, value in (("l", -1.0), ("l", None), ("nu", 0.5), ("E", 0.0)):
        with pytest.raises(pm.InputError, match=f"^{name} = "):
            pm.MicropolarElastic.from_microspace(**{"E": 1.0, "nu": 0.3, "l": 0.1, name: value})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mu": 0.0}, "^mu = 0"),
        ({"lam": -2.0}, "^lam = -2"),
        ({"lengths": (1.0, 1.0)}, "^lengths = "),
        ({"lengths": -1.0}, "^lengths = "),
        ({"directors": np.eye(3)[:2]}, "^lengths = 0.1: one length, or 3"),
        ({"directors": [[1, 0, 0], [0.6, 0.8, 0], [0, 0, 1]]}, "^directors = .*right angles"),
    ],
)
def test_oriented_micropolar_that_is_none(given, message):
    with pytest.raises(pm.InputError, match=message):
        pm.OrientedMicropolar(**{"lam": 1.0, "mu": 1.0, "lengths": 0.1, **given})
