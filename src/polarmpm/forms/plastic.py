"""Elastoplastic points: trial state, local residuals of the return mapping, and their derivatives, in UFL.

The state of a `PlasticForm` holds, after what `pointforms.strains` needs, the plastic history at the last
converged step: P = Fp^-1, Gp and chi (plane strain: the entries that aren't zero). Local unknowns are
X = (Ue, Ge, chi, Dgamma), T (4.61), for classical materials (Fe, chi, Dgamma). In the rotated frame all of it
is turned by Q~, which changes neither tau nor nu.

Two sets of local residuals r(X, z) = 0 exist: on the smooth part of the yield surface, T (4.57)-(4.60), and
at the apex of a cone. With the stresses s(X, z), that multiply the variations of z in the virtual work, the
consistent tangent is ds/dz - ds/dX (dr/dX)^-1 dr/dz; every derivative in it is UFL's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..errors import InputError
from ..kernels import codegen, jit
from ..kernels.codegen import Scalariser
from ..kernels.csource import write_c
from ..kernels.kernel import Kernel, generator_version
from ..kinematics import rotations
from ..kinematics.layout import Layout, state_size
from ..kinematics.spectral import exp_symmetric, squared_log_strain, strain_invariants
from ..materials.base import Material, evaluate_energy, named_parameters
from ..materials.plastic import SPRING, Plastic
from ..tools import compat
from .points import PointForm
from .strains import measures, motion

_PLANE = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2))  # entries of deformations in plane strain
_PLANE_WRYNESS = ((0, 2), (1, 2), (2, 0), (2, 1))  # plastic flow brings in the third column
_WAIST = 2  # scalars that a derivative is carried through; a fifth to a half fewer operations
_SPACE = tuple((i, j) for i in range(3) for j in range(3))


def entries(layout: Layout) -> tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]:
    """Entries of deformations, and of wrynesses, that may differ from those of the undeformed state."""
    if layout.dim == 3:
        return _SPACE, (_SPACE if layout.rotations else ())
    return _PLANE, (_PLANE_WRYNESS if layout.rotations else ())


def history_size(layout: Layout) -> int:
    """Scalars of P, Gp and chi."""
    return sum(map(len, entries(layout))) + 1


def pack_history(layout: Layout, P: np.ndarray, Gp: np.ndarray, chi: np.ndarray) -> np.ndarray:
    """History (n, history_size) of tensors (n, 3, 3) and chi (n,)."""
    deformation, wryness = entries(layout)
    columns = [P[:, i, j] for i, j in deformation] + [Gp[:, i, j] for i, j in wryness] + [chi]
    return np.column_stack(columns)


def _tensor(c: Any, first: int, places: tuple[tuple[int, int], ...]) -> Any:
    rows: list[list[Any]] = [[0.0] * 3 for _ in range(3)]
    for k, (i, j) in enumerate(places):
        rows[i][j] = c[first + k]
    return ufl.as_tensor(rows)


def _chain(outer: Any, inner: Any) -> Any:
    """Derivative of an energy by a measure times the measure's derivative by F."""
    if not outer.ufl_shape:
        return outer * inner
    i, j, k, l = ufl.indices(4)
    return ufl.as_tensor(outer[i, j] * inner[i, j, k, l], (k, l))


def _scalar(material: Plastic, function: str, *arguments: Any) -> Any:
    """A function of a plastic material as a UFL scalar.

    Raises:
        InputError: it raises an error itself, or is not a scalar.
    """
    what = f"material: {function} of {type(material).__name__}"
    try:
        value = ufl.as_ufl(getattr(material, function)(*arguments))
    except InputError:
        raise
    except Exception as e:  # a user's function and UFL may raise anything
        raise InputError(f"{what} can't be evaluated: {e}") from e
    if value.ufl_shape or value.ufl_free_indices:
        raise InputError(f"{what} has the shape {value.ufl_shape}; a scalar is needed")
    return value


@dataclass
class Return:
    """Compiled kernels of one part of the yield surface.

    Attributes:
        local: (inputs, X) -> residual (nx) and its derivative by X (nx, nx).
        stress: (inputs, X) -> s (nz).
        moduli: (inputs, X) -> s, ds/dz (nz, nz), ds/dX (nz, nx), dr/dz (nx, nz).
        flow: (inputs, X) -> dissipation per reference volume (Pa), and a strain that is negative where the
            solution is not admissible.
        row_scale: factors (nx,) that make residuals strains.
    """

    local: Kernel
    stress: Kernel
    moduli: Kernel
    flow: Kernel
    row_scale: np.ndarray


class PlasticForm(PointForm):
    """Elastic predictor (the inherited kernels, with plastic deformation frozen) and return mapping."""

    material: Plastic

    def __init__(self, material: Material, dim: int):
        super().__init__(material, dim)
        self.local = self.space.coefficient(self.local_size)
        self._compiled: dict[str, Any] = {}

    # sizes ----------------------------------------------------------------------------------------
    @property
    def elastic_size(self) -> int:
        """Scalars of the state before the history."""
        return state_size(self.layout, rotated=self.material.isotropic)

    @property
    def state_size(self) -> int:
        return self.elastic_size + history_size(self.layout)

    @property
    def local_size(self) -> int:
        """Length of X."""
        return history_size(self.layout) + 1

    @property
    def local_terminals(self) -> dict[Any, int]:
        return {**self.terminals, self.local: self.inputs}

    def pack(
        self, F: np.ndarray, q: np.ndarray, wryness: np.ndarray, history: Sequence[np.ndarray]
    ) -> np.ndarray:
        plastic_F, plastic_wryness, chi = history
        P = np.linalg.inv(plastic_F)
        if self.material.isotropic and self.material.micropolar:
            turn = rotations.to_tensor(q)
            back = np.swapaxes(turn, 1, 2)
            P, plastic_wryness = turn @ P @ back, turn @ plastic_wryness @ back
        elastic = super().pack(F, q, wryness, history)
        return np.hstack([elastic, pack_history(self.layout, P, plastic_wryness, chi)])

    # trial state ----------------------------------------------------------------------------------
    @cached_property
    def _history(self) -> tuple[Any, Any, Any]:
        """P, Gp and chi."""
        deformation, wryness = entries(self.layout)
        first = self.elastic_size
        P = _tensor(self.state, first, deformation)
        Gp = _tensor(self.state, first + len(deformation), wryness)
        return P, Gp, self.state[self.state_size - 1]

    @cached_property
    def _motion(self) -> tuple[Any, Any, Any]:
        """F, Q and Gamma in the frame of the state; Q and Gamma are None of classical materials."""
        now = motion(self.layout, self.z, self.state, rotated=self.material.isotropic)
        return now.F, now.Q, now.wryness

    @cached_property
    def _trial(self) -> tuple[Any, Any]:
        """Ue (Fe of a classical material) and Ge if nothing flowed, T (4.42)-(4.44)."""
        f, q, wryness = self._motion
        P, Gp, _ = self._history
        fe = ufl.dot(f, P)
        return (fe, None) if q is None else (ufl.dot(ufl.transpose(q), fe), wryness - Gp)

    def strains(self) -> tuple[Any, ...]:
        """Measures of the elastic energy in the trial state."""
        return measures(self.material, *self._trial)

    @cached_property
    def energy(self) -> Any:
        """Strain energy of the trial state; evaluates all functions, so that a mistake in one shows."""
        tau, nu = self.kirchhoff(*self._trial)
        for name in ("yield_function", "potential"):
            _scalar(self.material, name, tau, nu, self._history[2], self._numbers)
        _scalar(self.material, "hardening_energy", self._history[2], self._numbers)
        return super().energy

    # stresses -------------------------------------------------------------------------------------
    @property
    def _numbers(self) -> Any:
        return named_parameters(self.material, self.parameters)

    def _elastic_stress(self, deformation: Any, wryness: Any) -> tuple[Any, Any]:
        """B and S of Ue and Ge; dW/dFe of a classical material."""
        material, p = self.material, self._numbers
        if wryness is None:
            fe = ufl.variable(deformation)
            measures = material.measures(fe)
            v = [ufl.variable(m) for m in measures]
            w = evaluate_energy(material, v, p)  # derived by the few measures first
            parts = [_chain(ufl.diff(w, vi), ufl.diff(m, fe)) for vi, m in zip(v, measures, strict=True)]
            return sum(parts[1:], parts[0]), None
        e, g = ufl.variable(deformation - ufl.Identity(3)), ufl.variable(wryness)
        w = evaluate_energy(material, (e, g), p)
        return ufl.diff(w, e), ufl.diff(w, g)

    def kirchhoff(self, deformation: Any, wryness: Any) -> tuple[Any, Any]:
        """tau = Q B Fe^T and nu = Q S F^T (T (4.26)-(4.27) times J); nu is None of classical materials."""
        f, q, _ = self._motion
        b, s = self._elastic_stress(deformation, wryness)
        if wryness is None:
            return ufl.dot(b, ufl.transpose(deformation)), None
        fe = ufl.dot(q, deformation)
        return ufl.dot(q, ufl.dot(b, ufl.transpose(fe))), ufl.dot(q, ufl.dot(s, ufl.transpose(f)))

    # local problem --------------------------------------------------------------------------------
    @cached_property
    def _unknown(self) -> tuple[Any, Any, Any, Any]:
        """Ue (Fe), Ge, chi and Dgamma of X."""
        deformation, wryness = entries(self.layout)
        x, n = self.local, self.local_size
        ge = _tensor(x, len(deformation), wryness) if wryness else None
        return _tensor(x, 0, deformation), ge, x[n - 2], x[n - 1]

    @cached_property
    def _fe_trial(self) -> Any:
        return ufl.dot(self._motion[0], self._history[0])

    def _fe(self) -> Any:
        q, ue = self._motion[1], self._unknown[0]
        return ue if q is None else ufl.dot(q, ue)

    def _flat(self, tensor: Any, wryness: bool = False) -> list[Any]:
        return [tensor[i, j] for i, j in entries(self.layout)[wryness]]

    def _directions(self) -> tuple[Any, Any]:
        """dg/dtau and dg/dnu at X."""
        ue, ge, chi, _ = self._unknown
        tau, nu = self.kirchhoff(ue, ge)
        tau = ufl.variable(tau)
        nu = None if nu is None else ufl.variable(nu)
        g = _scalar(self.material, "potential", tau, nu, chi, self._numbers)
        return ufl.diff(g, tau), None if nu is None else ufl.diff(g, nu)

    def _surface_residual(self) -> list[Any]:
        """T (4.57)-(4.60)."""
        ue, ge, chi, multiplier = self._unknown
        f, q, _ = self._motion
        flow, wryness_flow = self._directions()
        fe = ufl.dot(exp_symmetric(-multiplier * flow), self._fe_trial)
        rows = self._flat(ue - (fe if q is None else ufl.dot(ufl.transpose(q), fe)))
        if ge is not None:
            step = multiplier * ufl.dot(ufl.transpose(q), ufl.dot(wryness_flow, f))
            rows += self._flat(ge + step - self._trial[1], True)
        tau, nu = self.kirchhoff(ue, ge)
        rows.append(chi - self._history[2] - multiplier)
        rows.append(_scalar(self.material, "yield_function", tau, nu, chi, self._numbers))
        return rows

    def _apex_residual(self) -> list[Any]:
        """sym tau = p I on the cone's tip, the flow symmetric, no couple stress.

        The flow of wryness has the direction of a couple stress: on the smooth cone it is a multiple of S C,
        C = F^T F, so that (Ge_trial - Ge) C^-1 has no part of which the couple stress vanishes (as it does
        for skew wryness with bounded stiffness). A spring of a billionth of the moduli sees to that.
        """
        ue, ge, chi, multiplier = self._unknown
        p = self._numbers
        tau, _ = self.kirchhoff(ue, ge)
        s, ratio = ufl.dev(ufl.sym(tau)), ufl.dot(self._fe_trial, ufl.inv(self._fe()))
        pairs = ((0, 1), (0, 2), (1, 2)) if self.layout.dim == 3 else ((0, 1),)
        rows = [s[0, 0], s[1, 1], *(s[i, j] for i, j in pairs)]
        rows.append(p.friction * ufl.tr(tau) / 3 - (p.k + p.H * chi))
        rows += [ratio[i, j] - ratio[j, i] for i, j in pairs]
        if ge is not None:
            f, couple = self._motion[0], self._elastic_stress(ue, ge)[1]
            back = ufl.inv(ufl.dot(ufl.transpose(f), f))
            rows += self._flat(couple + p.spring * ufl.dot(ge - self._trial[1], back), True)
        rows.append(chi - self._history[2] - multiplier)
        dilatancy = ufl.conditional(ufl.gt(p.dilatancy, 0.0), p.dilatancy, p.friction)
        rows.append(multiplier - ufl.ln(ufl.det(ratio)) / dilatancy)
        return rows

    def _surface_scale(self) -> np.ndarray:
        deformation, wryness = map(len, entries(self.layout))
        scale = [1.0] * deformation + [self.material.length] * wryness + [1.0, 1.0 / self.material.modulus]
        return np.array(scale)

    def _apex_scale(self) -> np.ndarray:
        deformation, wryness = map(len, entries(self.layout))
        pairs = 3 if self.layout.dim == 3 else 1
        stress = [1.0 / self.material.modulus] * (deformation - pairs)
        couple = self.material.plastic_parameters().get("spring", SPRING) / SPRING
        spring = [self.material.length / couple] * wryness
        return np.array([*stress, *([1.0] * pairs), *spring, 1.0, 1.0])

    # virtual work at X ----------------------------------------------------------------------------
    def _stresses(self) -> Any:
        """s(X, z), a linear form in variations of z.

        tau = Q B Fe^T does the work of Q B (F^-1 Fe)^T on the variation of Q^T F.
        """
        f, q, wryness = self._motion
        test = ufl.TestFunction(self.space.function_space(self.layout.unknowns))
        ue, ge, _, _ = self._unknown
        b, s = self._elastic_stress(ue, ge)
        total = ufl.dot(b, ufl.transpose(ufl.dot(ufl.inv(f), self._fe())))
        if q is None:
            return ufl.inner(total, ufl.derivative(f, self.z, test))
        strain = ufl.dot(ufl.transpose(q), f)
        work = ufl.inner(total, ufl.derivative(strain, self.z, test))
        return work + ufl.inner(s, ufl.derivative(wryness, self.z, test))

    # what the flow did ----------------------------------------------------------------------------
    def _hardening_work(self) -> Any:
        chi, before = ufl.variable(self._unknown[2]), self._history[2]
        energy = _scalar(self.material, "hardening_energy", chi, self._numbers)
        return ufl.diff(energy, chi) * (self._unknown[2] - before)

    def _surface_flow(self) -> list[Any]:
        """tau : dFp-flow + nu : dGp-flow - Lambda Dchi (4.23), and the multiplier."""
        ue, ge, _, multiplier = self._unknown
        tau, nu = self.kirchhoff(ue, ge)
        flow, wryness_flow = self._directions()
        work = multiplier * ufl.inner(tau, flow)
        if nu is not None:
            work += multiplier * ufl.inner(nu, wryness_flow)
        return [work - self._hardening_work(), multiplier]

    def _apex_flow(self) -> list[Any]:
        """As `_surface_flow`; admissible is a flow within the cone of normals at the apex (Koiter)."""
        ue, ge = self._unknown[:2]
        tau, nu = self.kirchhoff(ue, ge)
        f, q, _ = self._motion
        ratio = ufl.dot(self._fe_trial, ufl.inv(self._fe()))
        volume = ufl.ln(ufl.det(ratio))
        square = squared_log_strain(*strain_invariants(ratio)) - volume**2 / 3
        work = ufl.tr(tau) / 3 * volume
        if ge is not None:
            wryness = ufl.dot(q, ufl.dot(self._trial[1] - ge, ufl.inv(f)))
            square += self._numbers.l_p**2 * ufl.inner(wryness, wryness)
            work += ufl.inner(nu, wryness)
        least = self._numbers.dilatancy * ufl.sqrt(ufl.max_value(square, 0.0) / 1.5)
        return [work - self._hardening_work(), volume * (1.0 + 1e-6) - least]

    # compiled -------------------------------------------------------------------------------------
    def trial_kernel(self, comm: MPI.Comm) -> Kernel:
        """Kernel inputs -> X of the trial state, f, and whether it is likely to be beyond the apex (> 0).
        Compiled when it is asked for first; collective."""
        if "trial" not in self._compiled:
            self._compiled["trial"] = self._compile_trial(comm)
        return self._compiled["trial"]

    def return_kernels(self, apex: bool, comm: MPI.Comm) -> Return:
        """Kernels of one part of the yield surface. Compiled when they are asked for first; collective."""
        name = "apex" if apex else "surface"
        if name not in self._compiled:
            self._compiled[name] = self._compile_return(apex, comm)
        return self._compiled[name]

    def _compile_trial(self, comm: MPI.Comm) -> Kernel:
        ue, ge = self._trial
        chi = self._history[2]
        tau, nu = self.kirchhoff(ue, ge)
        p = self._numbers
        rows = self._flat(ue) + ([] if ge is None else self._flat(ge, True)) + [chi, ufl.as_ufl(0.0)]
        rows += [_scalar(self.material, name, tau, nu, chi, p) for name in ("yield_function", "beyond_apex")]
        return self._compile("trial", {"trial": rows}, self.terminals, comm)["trial"]

    def _compile_return(self, apex: bool, comm: MPI.Comm) -> Return:
        name = "apex" if apex else "surface"
        residual = self._apex_residual() if apex else self._surface_residual()
        flow = self._apex_flow() if apex else self._surface_flow()
        vector, s = ufl.as_vector(residual), self._stresses()
        space = self.space.function_space
        nz, nx = self.layout.unknowns, self.local_size
        by_local, by_z = ufl.TrialFunction(space(nx)), ufl.TrialFunction(space(nz))
        row = ufl.TestFunction(space(nx))
        form = ufl.dot(vector, row)
        local: dict[str, list[Any]] = {
            "local": [_Vector(form, nx), _Matrix(ufl.derivative(form, self.local, by_local), nx, nx)],
        }
        work: dict[str, list[Any]] = {
            "stress": [_Vector(s, nz)],
            "moduli": [
                _Vector(s, nz),
                _Matrix(ufl.derivative(s, self.z, by_z), nz, nz),
                _Matrix(ufl.derivative(s, self.local, by_local), nz, nx),
                _Matrix(ufl.derivative(form, self.z, by_z), nx, nz),
            ],
        }
        terminals = self.local_terminals
        kernels = self._compile(f"{name}_local", local, terminals, comm)
        kernels |= self._compile(f"{name}_work", work, terminals, comm)
        kernels |= self._compile(f"{name}_flow", {"flow": flow}, terminals, comm)
        scale = self._apex_scale() if apex else self._surface_scale()
        return Return(kernels["local"], kernels["stress"], kernels["moduli"], kernels["flow"], scale)

    def _compile(
        self, name: str, functions: dict[str, list[Any]], terminals: dict[Any, int], comm: MPI.Comm
    ) -> dict[str, Kernel]:
        """Compile functions that are lists of UFL scalars or of forms' coefficients. Collective."""
        inputs = self.inputs + (self.local_size if self.local in terminals else 0)
        order = {**{c: i for i, c in enumerate(terminals)}, self.space.domain: 0}
        parts = [part for list_ in functions.values() for part in list_]
        key = [compat.expression_signature(getattr(part, "form", part), order) for part in parts]
        layout = ",".join(f"{slot}" for slot in terminals.values())

        def source() -> str:
            scalarise = Scalariser(terminals, waist=_WAIST)
            written: dict[str, Sequence[int]] = {
                function: [node for part in parts for node in _nodes(scalarise, part)]
                for function, parts in functions.items()
            }
            return write_c(scalarise.graph, written)

        lib = jit.library(jit.digest(generator_version(), name, layout, *key), source, comm)
        sizes = {function: sum(_size(part) for part in parts) for function, parts in functions.items()}
        return {function: Kernel(lib, function, inputs, size) for function, size in sizes.items()}


@dataclass
class _Vector:
    """Coefficients of the test function's components."""

    form: Any
    rows: int


@dataclass
class _Matrix:
    """Coefficients of test and trial function, row by row."""

    form: Any
    rows: int
    columns: int


def _size(part: Any) -> int:
    return part.rows * getattr(part, "columns", 1) if isinstance(part, _Vector | _Matrix) else 1


def _nodes(scalarise: Scalariser, part: Any) -> list[int]:
    if not isinstance(part, _Vector | _Matrix):
        return [scalarise.plain(scalarise.scalar(codegen.expand(ufl.as_ufl(part))))]
    linear = scalarise.flat(scalarise.scalar(codegen.expand(part.form)))
    shape = (part.rows, part.columns) if isinstance(part, _Matrix) else (part.rows,)
    return codegen.coefficients(linear, shape, scalarise.graph.zero)
