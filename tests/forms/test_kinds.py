"""Kernels of materials that are the same but for their numbers are known without building them again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.forms.choice import make_form, make_projected
from polarmpm.forms.kinds import of_material
from polarmpm.kernels import recall
from polarmpm.materials.regions import Edge, YieldSurface

COMM = MPI.COMM_WORLD
MICROPOLAR = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.2, n=0.3, l_b=0.1, l_t=0.1, psi=1.0)
SAINT = pm.SaintVenantKirchhoff.from_engineering(E=1e6, nu=0.2)
HENCKY = pm.Hencky.from_engineering(E=1e6, nu=0.2)
PRAGER = pm.DruckerPrager(MICROPOLAR, phi=0.5, psi=0.1, c=2e3, cone="plane strain", l_p=0.2)
OTHERS = {
    "micropolar": (MICROPOLAR, pm.MicropolarElastic(3e3, 2e3, kappa=5.0, alpha=0.0, beta=1.0, gamma=7.0)),
    "Hencky": (HENCKY, pm.Hencky.from_engineering(E=7.0, nu=0.4)),
    "second gradients": (pm.GradientElastic(SAINT, 0.2), pm.GradientElastic(SAINT, 0.4)),
    "plastic": (PRAGER, replace(PRAGER, phi=0.6, psi=0.2, c=7.0)),
    "pyramid": (pm.MohrCoulomb(HENCKY, 0.5, 0.1, 2e3), pm.MohrCoulomb(HENCKY, 0.4, 0.2, 1.0)),
}

BUILT = ("energy", "residual", "tangent", "iteration_tangent", "moved", "local_problem", "_trial_rows")


@pytest.fixture
def forgetful(monkeypatch):
    """A process that hasn't made any kernel."""
    monkeypatch.setattr(recall, "_known", type(recall._known)())


def codes(form: Any) -> list[str]:
    kernels = list(form.compile(COMM))
    if form.material.yields:
        kernels.append(form.trial_kernel(COMM))
        for region in form.regions:
            r = form.return_kernels(region, COMM)
            kernels += [r.local, r.stress, r.moduli, r.flow]
    if form.scalars:
        scalars = form.compile_scalars(COMM)
        kernels += [scalars.measure, scalars.moved]
    kernels.append(form.compile_energy(COMM))
    return [kernel.code for kernel in kernels]


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("make", [make_form, make_projected])
def test_another_material_of_a_kind_needs_no_UFL(name, make, forgetful, monkeypatch):
    first, second = OTHERS[name]
    if make is make_projected and name == "second gradients":
        pytest.skip("isn't projected")
    form = make(first, 2)
    form.check()
    made = codes(form)
    again = make(second, 2)
    for what in BUILT:
        if hasattr(type(again), what):
            monkeypatch.setattr(type(again), what, property(lambda self: pytest.fail("is built anew")))
    again.check()
    assert codes(again) == made
    monkeypatch.undo()
    recall._known.clear()
    assert codes(make(second, 2)) == made  # the names that it has of its own UFL


@pytest.mark.parametrize("name", OTHERS)
def test_dimensions_and_bodies_of_revolution_differ(name):
    material = OTHERS[name][0]
    if name == "second gradients":
        kinds = [make_form(material, dim).kind for dim in (2, 3)]
    else:
        of = (2,), (3,), (2, True)
        kinds = [make(material, *at).kind for make in (make_form, make_projected) for at in of]
    assert len(set(kinds)) == len(kinds)


def user(W: Any, values: dict[str, float] | None = None, **kind: bool) -> pm.UserEnergy:
    return pm.UserEnergy(W, {"a": 1e3, "b": 2e2} if values is None else values, **kind)


def test_what_a_material_has_in_its_UFL_tells_it_from_others():
    means = [pm.GradientElastic(HENCKY, length) for length in (0.2, 0.4)]  # of places a length apart
    assert of_material(means[0]) != of_material(means[1])


def test_energies_that_differ_have_other_kernels():
    def energy(factor: float) -> Any:
        return lambda E, G, p: factor * p.a * ufl.inner(E, E) + p.b * ufl.inner(G, G)

    materials = [
        user(energy(1.0)),
        user(energy(2.0)),  # a number in the UFL
        user(lambda E, G, p: p.b * ufl.inner(E, E) + p.a * ufl.inner(G, G)),  # another number
        user(lambda E, G, p: p.a * ufl.inner(E, E) + p.b * ufl.inner(G, G.T)),
        user(energy(1.0), isotropic=True),
        user(energy(1.0), {"b": 1.0, "a": 1.0}),  # another order
        user(lambda F, p: p.a * (ufl.tr(F.T * F) - 3), micropolar=False),
        user(lambda F, H, p: p.a * (ufl.tr(F.T * F) - 3), micropolar=False, second_gradient=True),
    ]
    assert len({of_material(m) for m in materials}) == len(materials)
    assert of_material(user(energy(1.0))) == of_material(user(energy(1.0), {"a": 5.0, "b": 7.0}))
    assert len({make_form(m, 2).compile(COMM)[1].code for m in materials[:3]}) == 3


def test_a_function_that_reads_a_changed_variable_is_another_one():
    factor = [1.0]
    material = user(lambda E, G, p: factor[0] * p.a * ufl.inner(E, E) + p.b * ufl.inner(G, G))

    def energy() -> float:
        form = make_form(material, 3)
        F = (1.1 * np.eye(3))[None]
        state = form.pack(F, np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3, 3)), ())
        z, numbers = np.zeros((1, form.unknowns)), np.array([[1e3, 2e2]])
        return float(form.compile_energy(COMM)(z, state, numbers)[0, 0])

    first = energy()
    assert first > 0
    factor[0] = 3.0
    assert energy() == pytest.approx(3 * first, rel=1e-14)


def test_measures_tell_energies_apart():
    class ByC(pm.Material):
        micropolar = False

        def measures(self, F: Any) -> tuple[Any, ...]:
            return (ufl.tr(F.T * F),)

        def energy(self, I: Any, p: Any) -> Any:
            return I - 3

    class ByF(pm.Material):
        micropolar = False

        def energy(self, F: Any, p: Any) -> Any:
            return ufl.tr(F.T * F) - 3

    assert of_material(ByC()) != of_material(ByF())


def yielding(**options: Any) -> pm.UserPlasticity:
    functions = {
        "function": lambda tau, nu, chi, p: ufl.sqrt(ufl.inner(ufl.dev(tau), ufl.dev(tau))) - p.y,
        "values": {"y": 1e3, "h": 1.0},
    }
    return pm.UserPlasticity(HENCKY, **{**functions, **options})


def test_yield_functions_flow_and_hardening_that_differ_have_other_kernels():
    def cone(tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return ufl.sqrt(ufl.inner(ufl.dev(tau), ufl.dev(tau))) + 0.1 * ufl.tr(tau) - p.y

    materials = [
        yielding(),
        yielding(function=cone),
        yielding(flow=cone),
        yielding(hardening=lambda chi, p: p.h * chi**2),
        yielding(hardening=lambda chi, p: 2 * p.h * chi**2),
        yielding(function={"cone": cone}),
        PRAGER,
        replace(PRAGER, phi=0.0, psi=0.0),  # without an apex
        replace(PRAGER, elastic=HENCKY, l_p=None),
    ]
    kinds = [make_form(m, 2).kind for m in materials]
    assert len(set(kinds)) == len(kinds)
    first = [make_form(m, 2) for m in materials[:5]]
    assert len({form.trial_kernel(COMM).code for form in first}) == 2  # the trial state knows f alone
    returns = [form.return_kernels(form.regions[0], COMM) for form in first]
    assert len({r.local.code for r in returns}) == 3  # hardening without a change of f is in the flow alone
    assert len({r.flow.code for r in returns}) == 4  # f itself is none of it


class Slower(Edge):
    """An edge with a script's own equation."""

    factor = 1.0

    def flow(self, s: Any) -> list[Any]:
        work, least = super().flow(s)
        return [self.factor * work, least]


def test_a_regions_own_equations_tell_it_from_others():
    class Own(pm.UserPlasticity):
        factor = 1.0

        @property
        def regions(self) -> tuple[Any, ...]:
            region = Slower(YieldSurface("surface", self.function))
            region.factor = self.factor
            return (region,)

    class Twice(Own):
        factor = 2.0

    function = yielding().function
    codes = []
    for kind in (Own, Twice, Own):
        form = make_form(kind(HENCKY, function, {"y": 1e3, "h": 1.0}), 2)
        codes.append(form.return_kernels(form.regions[0], COMM).flow.code)
    assert codes[0] == codes[2] != codes[1]
