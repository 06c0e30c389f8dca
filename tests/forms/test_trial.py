"""Energies of users are tried before any work is done with them."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.forms.trial import try_energy
from tests.conftest import ANISOTROPIC, COMM, GENERAL, HENCKY, MICROPOLAR


def isotropic(function, values=None, **options):
    return pm.UserEnergy(function, values or {"a": 1.0}, **{"isotropic": True, **options})


@pytest.mark.parametrize(
    "material",
    [
        MICROPOLAR,
        HENCKY,
        GENERAL,
        ANISOTROPIC,
        isotropic(MICROPOLAR.energy, MICROPOLAR.parameters()),
        isotropic(lambda E, G, p: ufl.inner(E, E) + p.a * ufl.det(E) * ufl.tr(G) ** 2),
        isotropic(lambda E, G, p: ufl.conditional(ufl.gt(ufl.tr(E), 0), 1.0, 2.0) * ufl.tr(E) ** 2),
        isotropic(lambda E, G, p: ufl.exp(ufl.tr(E)) + ufl.erf(ufl.tr(E)) + ufl.atan(ufl.inner(E, G))),
        isotropic(lambda E, G, p: E[0, 0], isotropic=False),
        pm.UserEnergy(lambda F, p: F[0, 0], micropolar=False),
        pm.UserEnergy(lambda E, G, p: ufl.bessel_J(0, ufl.tr(E))),  # the generator of code refuses it
        pm.VonMises(GENERAL, k=1.0, l_p=0.1),
    ],
)
def test_good_energies(material):
    try_energy(material, COMM)


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (isotropic(lambda E, G, p: p.a), "doesn't depend on the deformation"),
        (isotropic(lambda E, G, p: 1.0), "doesn't depend on the deformation"),
        (isotropic(lambda E, G, p: 0 * ufl.tr(E)), "doesn't depend on the deformation"),
        (isotropic(lambda E, G, p: p.a * E[0, 0] ** 2), r"isotropic = True, but .* in the same state turned"),
        (isotropic(lambda E, G, p: ufl.inner(E, E) + G[1, 0] ** 2), "isotropic = True"),
        (isotropic(lambda E, G, p: ufl.sqrt(ufl.inner(E, E))), "has a stress of nan at rest"),
        (isotropic(lambda E, G, p: ufl.ln(ufl.tr(E))), "is -inf at rest"),
        (isotropic(lambda E, G, p: ufl.tr(E) * float("nan")), "nan at rest"),
        (pm.UserEnergy(lambda F, p: ufl.ln(-ufl.det(F)), micropolar=False), "is nan at rest"),
        (pm.VonMises(isotropic(lambda E, G, p: E[0, 1] ** 2), k=1.0, l_p=0.1), "isotropic = True"),
    ],
)
def test_bad_energies(material, message):
    with np.errstate(all="raise"), pytest.raises(pm.InputError, match=message):
        try_energy(material, COMM)


def classical(function):
    return pm.UserEnergy(function, {"a": 2.0}, micropolar=False)


def neo_hooke(F, p):
    """Without a Lame modulus."""
    return p.a / 2 * (ufl.tr(F.T * F) - 3 - 2 * ufl.ln(ufl.det(F)))


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (classical(lambda F, p: p.a * (ufl.tr(F.T * F) - 3)), "has a stress of 4 in the undeformed state"),
        (classical(lambda F, p: -neo_hooke(F, p)), "is less, by .*, in a strained state"),
        (isotropic(lambda E, G, p: -p.a * ufl.inner(E, E)), "is less, by .*, in a strained state"),
        (
            classical(
                lambda F, p: p.a * ufl.inner(ufl.sym(F) - ufl.Identity(3), ufl.sym(F) - ufl.Identity(3))
            ),
            "in the same state turned as a whole: stresses are wrong where the body turns",
        ),
        (
            pm.UserEnergy(
                lambda F, H, p: neo_hooke(F, p) + H[0, 0, 0] ** 2,
                {"a": 2.0},
                micropolar=False,
                second_gradient=True,
            ),
            "in the same state turned as a whole",
        ),
    ],
)
def test_doubtful_energies(material, message):
    """They are computed with, after a warning: a body may be meant to have a stress at rest."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try_energy(material, COMM)
    found = [str(one.message) for one in caught if one.category is pm.TrustWarning]
    assert len(found) == (COMM.rank == 0)
    assert all(re.search(message, text) for text in found)


@pytest.mark.parametrize(
    "material",
    [
        *(MICROPOLAR, GENERAL, ANISOTROPIC, classical(neo_hooke)),
        pm.UserEnergy(
            lambda F, H, p: neo_hooke(F, p) + ufl.inner(H, H),
            {"a": 2.0},
            micropolar=False,
            second_gradient=True,
        ),
        pm.GradientElastic(classical(neo_hooke), 0.1, [(1.0, 0.0, 0.0)]),
        pm.GradientElastic(pm.Hencky(lam=1.0, mu=1.0), 0.1, [(0.6, 0.8, 0.0)]),
    ],
)
def test_energies_without_a_doubt(material):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try_energy(material, COMM)


def test_problems_try_them():
    """On the grid and on meshes."""
    from tests.helpers.bodies import box

    bad = isotropic(lambda E, G, p: p.a * E[0, 0] ** 2 + ufl.inner(G, G))
    grid = pm.Grid.box((0, 0), (2, 1), 0.5)
    with pytest.raises(pm.InputError, match="isotropic = True"):
        pm.QuasiStatic(grid, pm.seed(grid, material=bad))
    with pytest.raises(pm.InputError, match="isotropic = True"):
        pm.QuasiStaticFEM(pm.Elements(box("quadrilateral", (2, 1)), material=bad))
