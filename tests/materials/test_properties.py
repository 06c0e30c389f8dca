"""Whatever numbers and functions are given to materials, there is an error of the package or a material whose
energy is one."""

from __future__ import annotations

import copy
import pickle
import warnings

import numpy as np
import ufl
from hypothesis import given
from hypothesis import strategies as st

import polarmpm as pm
from polarmpm.materials.base import check_material
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN
from tests.helpers.weird import Rude, anything, attempt, flags, numbers, thorough

OPTIONS = thorough(60)
GRID = pm.Grid.box((0, 0), (1, 1), 1.0, COMM)
VALUES = st.floats(0.1, 3.0) | numbers | anything
MODULI = ("lam", "mu", "kappa", "alpha", "beta", "gamma")
ENGINEERING = ("E", "nu", "n", "l_b", "l_t", "psi")


def named(*names: str) -> st.SearchStrategy[dict]:
    """Numbers by name, mostly admissible ones; one may be missing."""
    return st.fixed_dictionaries(dict.fromkeys(names, VALUES)) | st.fixed_dictionaries(
        {**dict.fromkeys(names, st.floats(0.1, 0.4)), names[-1]: VALUES}
    )


def check(material: pm.Material | None) -> None:
    """Its numbers are numbers, it can be told, copied and pickled."""
    if material is not None:
        assert all(type(v) is float and np.isfinite(v) for v in material.parameters().values())
        assert "\n" not in repr(material)
        assert copy.deepcopy(material) == material
        assert pickle.loads(pickle.dumps(material)) == material
        check_material(material)


@OPTIONS
@given(st.sampled_from([pm.NeoHookean, pm.Hencky]), named("lam", "mu"), named("E", "nu"))
def test_classical(kind, moduli, engineering):
    for made in (attempt(kind, **moduli), attempt(kind.from_engineering, **engineering)):
        check(made)
        assert made is None or (made.mu > 0 and 3 * made.lam + 2 * made.mu > 0)


@OPTIONS
@given(named(*MODULI), named(*ENGINEERING), named("lam", "mu", "kappa", "l_b"))
def test_micropolar(moduli, engineering, bounded):
    for made in (
        attempt(pm.MicropolarElastic, **moduli),
        attempt(pm.MicropolarElastic.from_engineering, **engineering),
        attempt(pm.MicropolarElastic.bounded_stiffness, **bounded),
    ):
        check(made)
        if made is not None:
            assert min(made.mu, 3 * made.lam + 2 * made.mu) > 0
            assert min(made.kappa, made.beta, made.gamma, made.alpha + (2 / 3 + 1e-9) * made.gamma) >= 0


ELASTIC = st.sampled_from(
    [MICROPOLAR] * 5 + [NEO_HOOKEAN, pm.VonMises(NEO_HOOKEAN, k=1.0), None, "a", Rude()]
)
OPTIONAL = {
    name: st.none() | st.floats(0.1, 0.4) | VALUES for name in ("c", "k", "H", "l_p", "tip", "phi", "psi")
}


@OPTIONS
@given(ELASTIC, st.fixed_dictionaries({}, optional=OPTIONAL))
def test_yielding(elastic, numbers):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check(attempt(pm.DruckerPrager, elastic, **numbers))
        check(attempt(pm.VonMises, elastic, **{n: v for n, v in numbers.items() if n in ("k", "H", "l_p")}))


def energies() -> st.SearchStrategy:
    """Functions of (E, Gamma, p), most of which are no energies."""
    return st.sampled_from(
        [
            lambda E, G, p: p.a * ufl.inner(E, E) + ufl.inner(G, G),
            lambda E, G, p: p.a * E[0, 0] ** 2,
            lambda E, G, p: 1.0,
            lambda E, G, p: p.a,
            lambda E, G, p: None,
            lambda E, G, p: E,
            lambda E, G, p: p.nothing * ufl.tr(E),
            lambda E, G, p: np.exp(ufl.tr(E)),
            lambda E, G, p: np.linalg.norm(E),
            lambda E, G, p: ufl.sqrt(ufl.inner(E, E)),
            lambda E, G, p: ufl.ln(ufl.tr(E)),
            lambda E, G, p: 1j * ufl.tr(E),
            lambda E, G, p: float(ufl.tr(E)),
            lambda E, G, p: ufl.tr(E) / 0,
            lambda E, G, p: E[5, 5],
            lambda E, G, p: ufl.conditional(ufl.gt(ufl.tr(E), 0), ufl.tr(E) ** 2, 2 * ufl.tr(E) ** 2),
            lambda E, G, p: "energy" if E else 0,
            lambda E, G: ufl.tr(E),
            lambda E, G, p: Rude(),
            lambda *args: ufl.inner(args[0], args[0]),
        ]
    )


@OPTIONS
@given(
    energies() | anything,
    st.just({"a": 1.0}) | st.dictionaries(st.sampled_from(["a", "b", "a b", 1, ""]), VALUES) | anything,
    flags,
    flags,
)
def test_energies(function, values, micropolar, isotropic):
    material = attempt(pm.UserEnergy, function, values, micropolar, isotropic)
    if material is None:
        return

    def prepare() -> bool:
        pm.QuasiStatic(GRID, pm.seed(GRID, material=material, points_per_cell=1))
        return True

    if attempt(prepare) and material.isotropic and material.micropolar:
        assert "E[0, 0]" not in repr(function)


@OPTIONS
@given(
    ELASTIC,
    st.sampled_from(
        [
            lambda tau, nu, chi, p: ufl.sqrt(ufl.inner(tau, tau)) - p.y,
            lambda tau, nu, chi, p: tau,
            lambda tau, nu, chi, p: None,
            lambda tau, nu, chi, p: p.zz,
            lambda tau: tau,
            {"one": lambda tau, nu, chi, p: ufl.tr(tau) - p.y},
            {"one": 3},
            {},
        ]
    )
    | anything,
    st.just({"y": 1.0}) | anything,
    st.fixed_dictionaries(
        {},
        optional={
            "flow": st.sampled_from([lambda tau, nu, chi, p: ufl.tr(tau), {"one": id}, {"two": id}])
            | anything,
            "hardening": st.sampled_from([lambda chi, p: chi**2, lambda chi: chi]) | anything,
            "length": VALUES,
            "continuation": st.builds(lambda: pm.Continuation("y", (2.0, 3))) | anything,
        },
    ),
)
def test_yield_functions(elastic, function, values, options):
    material = attempt(pm.UserPlasticity, elastic, function, values, **options)
    if material is not None:
        assert "\n" not in repr(material)
        attempt(lambda: pm.QuasiStatic(GRID, pm.seed(GRID, material=material, points_per_cell=1)))


@OPTIONS
@given(anything, anything, anything, anything)
def test_surfaces_and_fields(a, b, c, d):
    attempt(pm.Continuation, a, b)
    surface = attempt(pm.YieldSurface, a, b, c, d)
    for one in (surface, a):
        attempt(pm.Edge, one, one)
        attempt(pm.SmoothPart, one)
        attempt(pm.ConeApex, b, one)
    for kind in (pm.Field, pm.MaterialField):
        field = attempt(kind, a, b, c, d)
        assert field is None or repr(field).startswith("<")
