"""Fields of the points' current state that need the material: energy, stresses, and the rest of `TABLE`."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

from mpi4py import MPI

import numpy as np
import ufl

from ..errors import InputError
from ..kernels.kernel import Kernel, PointSpace, compile_expressions, matrix, third
from ..kernels.recall import recalled
from ..kinematics import tensors as kin
from ..materials.base import Material, evaluate_energy, named_parameters, parameter_values
from ..tools import checks, compat, quiet
from . import kinds
from .strains import elastic_stress, pushed, strain_measures

if TYPE_CHECKING:
    from ..materials.plastic import Plastic  # lazy import: elastic scenes need no plasticity


# what a field is computed of --------------------------------------------------------------------------
class PointState:
    """A point's state as UFL expressions; tensors are 3 x 3 also in plane strain.

    Attributes:
        material, p: the material, and its numbers by name.
        F, Gamma: deformation gradient, wryness (1/m).
        H: second gradient of the motion (1/m), 3 x 3 x 3; None of a material without second gradients.
        Q: microrotation; None of a classical material.
        Fe, Ge: elastic parts of F and Gamma, F and Gamma themselves of an elastic material.
        Fp: plastic part of F; the identity of an elastic material.
        chi: hardening variable; None of an elastic material.
    """

    def __init__(self, material: Material, coefficients: Sequence[Any]):
        f, q, wryness, *more, parameters = coefficients
        second, plastic = (more[:1], more[1:]) if material.second_gradient else ([], more)
        self.H = third(second[0]) if second else None
        self.material, self.p = material, named_parameters(material, parameters)
        self.F, self.Gamma = matrix(f, 3, 3), matrix(wryness, 3, 3)
        self.Q = kin.quaternion_tensor([q[i] for i in range(4)]) if material.micropolar else None
        self.Fe, self.Ge, self.chi = _elastic_parts(self.F, self.Gamma, plastic)
        self.Fp = matrix(plastic[0], 3, 3) if plastic else ufl.Identity(3)

    @cached_property
    def _stretch(self) -> Any:
        """Ue = Q^T Fe; Fe of a classical material."""
        return self.Fe if self.Q is None else ufl.dot(ufl.transpose(self.Q), self.Fe)

    @cached_property
    def _wryness(self) -> Any:
        return None if self.Q is None else self.Ge

    @cached_property
    def _stresses(self) -> tuple[Any, Any]:
        return elastic_stress(self.material, self._stretch, self._wryness, self.p, self.H)

    @cached_property
    def energy(self) -> Any:
        """Energy per reference volume (Pa), with what hardening stores."""
        stored = ufl.as_ufl(0.0)
        if self.chi is not None:
            stored = cast("Plastic", self.material).hardening_energy(self.chi, self.p)
        measures = strain_measures(self.material, self._stretch, self._wryness, self.H)
        return evaluate_energy(self.material, measures, self.p) + stored

    @cached_property
    def stress(self) -> Any:
        """Cauchy stress (Pa) sigma = Q B Fe^T / J, T 3.4, (4.26); with second gradients what does work on
        velocity gradients, (dW/dF F^T + dW/dH : H^T) / J, which is symmetric, too."""
        forward = pushed(self._stresses[0], self.Q, self.Fe)
        if self.H is not None:
            i, j, k, l = ufl.indices(4)
            forward += ufl.as_tensor(self._stresses[1][i, k, l] * self.H[j, k, l], (i, j))
        return forward / ufl.det(self.F)

    @cached_property
    def double_stress(self) -> Any:
        """Cauchy double stress (N/m) tau_ijk = dW/dH_iJK F_jJ F_kK / J, which does work on second gradients
        of the velocity; zero of a material without second gradients."""
        if self.H is None:
            return ufl.as_tensor(np.zeros((3, 3, 3)).tolist())
        i, j, k, l, m = ufl.indices(5)
        forward = self._stresses[1][i, l, m] * self.Fe[j, l] * self.Fe[k, m]
        return ufl.as_tensor(forward, (i, j, k)) / ufl.det(self.F)

    @cached_property
    def couple_stress(self) -> Any:
        """Cauchy couple stress (N/m) mu = Q S F^T / J, T (4.27); zero of a classical material."""
        if self.Q is None:
            return 0 * self.F
        return pushed(self._stresses[1], self.Q, self.F) / ufl.det(self.F)

    @cached_property
    def _deviator(self) -> tuple[Any, Any]:
        """Deviator of sym sigma (Pa), and its second invariant."""
        s = ufl.dev(ufl.sym(self.stress))
        return s, ufl.inner(s, s) / 2

    @cached_property
    def q(self) -> Any:
        """sqrt(3/2 s : s) (Pa) of the deviator s of sym sigma."""
        return ufl.sqrt(3 * self._deviator[1])

    @cached_property
    def lode_angle(self) -> Any:
        """Lode's angle (rad) of sym sigma, sin(3 theta) = -sqrt(27)/2 det(s) / J2^1.5: -pi/6 in triaxial
        extension, pi/6 in triaxial compression; 0 where there is no deviator."""
        s, second = self._deviator
        cube = second * ufl.sqrt(second)
        none = ufl.le(cube, 0.0)
        sine = -math.sqrt(27) / 2 * ufl.det(s) / ufl.conditional(none, 1.0, cube)
        angle = ufl.asin(ufl.max_value(-1.0, ufl.min_value(1.0, sine))) / 3
        return ufl.conditional(none, 0.0, angle)


def _elastic_parts(F: Any, Gamma: Any, plastic: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Fe = F Fp^-1, Ge = Gamma - Gp and chi of the coefficients of the plastic state (T 4.1)."""
    if not plastic:
        return F, Gamma, None
    plastic_F, plastic_wryness, chi = plastic
    return ufl.dot(F, ufl.inv(matrix(plastic_F, 3, 3))), Gamma - matrix(plastic_wryness, 3, 3), chi[0]


# fields -----------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class MaterialField:
    """A field of the current state, written once in UFL.

    `problem.fields(field)[field.name]` are its values, and `Recorder` takes it among its fields.

    Args:
        name: of the field.
        function: of a `PointState`; a UFL scalar, vector or tensor.
        unit: of its values.
        plastic: computed of materials that can yield only, and zero of others.
        second_gradient: computed of materials with second gradients only, and zero of others.
        after: a function of the computed rows (n, ...) in NumPy, which gives rows: for what UFL has no words
            for, such as eigenvalues.

    Raises:
        InputError: no name, or not a function of one argument.

    Example:
        >>> MaterialField("deviator", lambda s: ufl.sqrt(ufl.inner(ufl.dev(s.stress), s.stress)), "Pa")
    """

    name: str
    function: Callable[[PointState], Any]
    unit: str = ""
    plastic: bool = False
    second_gradient: bool = False
    after: Callable[[np.ndarray], np.ndarray] | None = None

    def __post_init__(self) -> None:
        if self.after is not None:
            name = f"MaterialField {self.name!r}: after"
            checks.function(name, self.after, "a function of rows (n, ...) is", takes=("rows",))
        check_field(self, "a function of a PointState in UFL is", "state")
        checks.flag(f"MaterialField {self.name!r}: second_gradient", self.second_gradient)

    def __repr__(self) -> str:
        return f"<MaterialField {self.name!r}{f' in {self.unit}' if self.unit else ''}>"


def check_field(field: Any, what: str, takes: str) -> None:
    """Checks of what fields of materials and of points share."""
    name, kind = field.name, type(field).__name__
    checks.text(f"{kind}: name", name)
    if not name.isprintable() or name != name.strip():
        raise checks.refuse(f"{kind}: name", name, "a name on one line is needed")
    checks.function(f"{kind} {name!r}: function", field.function, what, takes=(takes,))
    if not isinstance(field.unit, str):
        raise checks.refuse(f"{kind} {name!r}: unit", field.unit, 'a text is needed, such as "Pa"')
    checks.flag(f"{kind} {name!r}: plastic", field.plastic)


def _principal(rows: np.ndarray) -> np.ndarray:
    """Eigenvalues (n, 3) of symmetric tensors (n, 3, 3), the largest first."""
    values: np.ndarray = np.linalg.eigvalsh(rows)[:, ::-1]
    return values


def _half_logarithm(rows: np.ndarray) -> np.ndarray:
    """ln(C)/2 (n, 3, 3) of symmetric, positive tensors."""
    values, vectors = np.linalg.eigh(rows)
    found: np.ndarray = np.einsum("nij,nj,nkj->nik", vectors, 0.5 * np.log(values), vectors)
    return found


def _equivalent(rows: np.ndarray) -> np.ndarray:
    """sqrt(2/3 e : e) (n,) of the deviators e of ln(C)/2."""
    strain = _half_logarithm(rows)
    deviator = strain - np.trace(strain, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    size: np.ndarray = np.sqrt(2 / 3 * np.einsum("nij,nij->n", deviator, deviator))
    return size


def _plastic_metric(s: PointState) -> Any:
    return ufl.dot(ufl.transpose(s.Fp), s.Fp)


TABLE: dict[str, MaterialField] = {
    field.name: field
    for field in (
        MaterialField("energy", lambda s: s.energy, "Pa"),
        MaterialField("stress", lambda s: s.stress, "Pa"),
        MaterialField("couple_stress", lambda s: s.couple_stress, "N/m"),
        MaterialField("double_stress", lambda s: s.double_stress, "N/m", second_gradient=True),
        MaterialField("mean_pressure", lambda s: -ufl.tr(s.stress) / 3, "Pa"),
        MaterialField("p", lambda s: -ufl.tr(s.stress) / 3, "Pa"),  # as soils have it beside q
        MaterialField("q", lambda s: s.q, "Pa"),
        MaterialField("von_mises", lambda s: s.q, "Pa"),  # the same, as metals have it
        MaterialField("lode_angle", lambda s: s.lode_angle, "rad"),
        MaterialField("principal_stress", lambda s: ufl.sym(s.stress), "Pa", after=_principal),
        MaterialField("skew_stress", lambda s: ufl.skew(s.stress), "Pa"),
        MaterialField("plastic_strain", _plastic_metric, plastic=True, after=_half_logarithm),
        MaterialField("equivalent_plastic_strain", _plastic_metric, plastic=True, after=_equivalent),
    )
}
MECHANICAL = tuple(TABLE[name] for name in ("energy", "stress", "couple_stress"))  # share a kernel


class FieldForm:
    """Fields of (F, Q, Gamma), of H with second gradients, and of a plastic material's state (Fp, Gp, chi),
    for output.

    Args:
        fields: by default energy, stress and couple stress.
    """

    def __init__(self, material: Material, fields: Sequence[MaterialField] = MECHANICAL):
        self.material, self.fields = material, fields
        self.space = PointSpace(compat.point_domain())
        more = ([27] if material.second_gradient else []) + ([9, 9, 1] if material.plastic else [])
        sizes = [9, 4, 9, *more, len(parameter_values(material))]
        self._inputs = [self.space.coefficient(n) for n in sizes]
        self.terminals = {c: sum(sizes[:k]) for k, c in enumerate(self._inputs)}
        self.size = sum(sizes)

    @cached_property
    def expressions(self) -> list[Any]:
        """One UFL expression for each field.

        Raises:
            InputError: a field's function raises an error itself, or is no scalar, vector or tensor.
        """
        state, out = PointState(self.material, self._inputs), []
        for field in self.fields:
            with checks.evaluating(f"field {field.name!r}"), quiet.ufl():
                value = ufl.as_ufl(field.function(state))
            if value.ufl_shape not in ((), (3,), (3, 3), (3, 3, 3)) or value.ufl_free_indices:
                raise InputError(
                    f"field {field.name!r} has the shape {value.ufl_shape}; a scalar, a vector of three or a "
                    "tensor, 3 x 3 or 3 x 3 x 3, is needed"
                )
            out.append(value)
        return out

    def compile(self, comm: MPI.Comm) -> Kernel:
        """Kernel (F, q, Gamma, H, plastic state, parameters) -> the fields, row by row; by default 19
        numbers, (W, sigma, mu). Collective."""
        domain, of = self.space.domain, self._kind
        return compile_expressions(lambda: self.expressions, self.terminals, self.size, domain, comm, of=of)

    @cached_property
    def _kind(self) -> Hashable:
        """What its own fields are made of; a script's functions aren't known."""
        if not all(TABLE.get(field.name) is field for field in self.fields):
            return None
        of = kinds.of_material(self.material)
        if self.material.plastic:
            from . import plastickinds  # lazy import: elastic scenes need no plasticity

            of = of, plastickinds.of_hardening(cast("Plastic", self.material))
        return "fields", tuple(field.name for field in self.fields), of

    @cached_property
    def _shapes(self) -> list[tuple[int, ...]]:
        of = self._kind
        return recalled(of and ("shapes", of), lambda: [e.ufl_shape for e in self.expressions])

    def split(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Fields by name, of what the kernel gives."""
        out, first = {}, 0
        for field, shape in zip(self.fields, self._shapes, strict=True):
            last = first + int(np.prod(shape, dtype=int))
            out[field.name] = rows[:, first:last].reshape(len(rows), *shape)
            if field.after is not None:
                out[field.name] = _changed(field, out[field.name])
            first = last
        return out


def _changed(field: MaterialField, rows: np.ndarray) -> np.ndarray:
    """What a field's NumPy function makes of the computed rows.

    Raises:
        InputError: not numbers, or not a row for each point.
    """
    assert field.after is not None
    with checks.evaluating(f"field {field.name!r}"):
        values = np.asarray(field.after(rows))
    if values.dtype.kind not in "biuf" or values.shape[:1] != (len(rows),) or 0 in values.shape[1:]:
        raise InputError(
            f"field {field.name!r}: after gives values of type {values.dtype} and shape {values.shape}; "
            f"numbers, a row for each of the {len(rows)} points, are needed"
        )
    return values
