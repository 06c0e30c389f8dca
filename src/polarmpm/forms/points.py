"""The weak form at a material point: UFL in, compiled residual and tangent blocks out.

The unknown of a point is the vector z = (du/dx, w, dw/dx) of its increments since the last reset; the
material's energy W(E, Gamma) makes the residual dW[dz] and, by `ufl.derivative`, the tangent. Gradients
are taken in the frame of the state, so that hardly any arithmetic is left (T 3.4; `docs/theory.md`):

* isotropic energies, rotated frame: V~ = F~ Q~^T, E' = dQ^T (V~ + G) - I, Gamma' = Gamma~' + J_r Gw;
* any other energy, reference frame: F = F~ + G, Q = dQ Q~, Gamma = Gamma~ + Q~^T J_r Gw;
* classical energies: F = F~ + G.

G = du/dx~ T and Gw = dw/dx~ T with the frame T = V~ or F~, the first entries of the state.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..kernels import codegen, jit, native
from ..kernels import graph as scalargraph
from ..kernels.codegen import Scalariser
from ..kinematics import measures as kin
from ..materials.base import Material, evaluate_energy, named_parameters, parameter_values
from ..tools import compat as _compat


@dataclass(frozen=True)
class Layout:
    """Sizes of the values at a point, for a space dimension and a number of rotations."""

    dim: int
    rotations: int

    @property
    def block(self) -> int:
        """Unknowns of a node."""
        return self.dim + self.rotations

    @property
    def unknowns(self) -> int:
        """Length of z."""
        return self.dim * self.dim + self.rotations * (1 + self.dim)

    @staticmethod
    def of(material: Material, dim: int) -> Layout:
        return Layout(dim, (1 if dim == 2 else 3) if material.micropolar else 0)


@cache
def generator_version() -> str:
    return jit.digest(*(Path(str(module.__file__)).read_text() for module in (codegen, scalargraph)))


class Kernel:
    """Compiled functions of arrays (n, inputs) -> (n, outputs), eight rows a call."""

    def __init__(self, lib: ctypes.CDLL, name: str, inputs: int, outputs: int):
        self.inputs, self.outputs = inputs, outputs
        self.address: int = ctypes.cast(getattr(lib, name), ctypes.c_void_p).value or 0
        self._library = lib  # keeps the code loaded

    def __call__(self, *columns: np.ndarray) -> np.ndarray:
        """Evaluate for all rows, (n, outputs). The sums over points call the code from C."""
        rows = len(columns[0])
        flat = [np.ascontiguousarray(c, dtype=float).reshape(rows, _width(c)) for c in columns]
        widths = np.array([c.shape[1] for c in flat], dtype=np.int32)
        if widths.sum() != self.inputs:
            raise ValueError(f"kernel has {self.inputs} inputs, {widths.sum()} are given")
        blocks = np.array([c.ctypes.data for c in flat], dtype=np.uintp)
        out = np.empty((rows, self.outputs))
        if native.library().polarmpm_evaluate(
            self.address,
            rows,
            len(flat),
            widths.ctypes.data,
            blocks.ctypes.data,
            self.outputs,
            out.ctypes.data,
        ):
            raise MemoryError("no memory to evaluate a kernel")
        return out


def _width(columns: np.ndarray) -> int:
    """Numbers in a row, also where there are no rows."""
    return int(np.prod(columns.shape[1:]))


@dataclass
class PointSpace:
    """Vector-valued functions on the points' quadrature space."""

    domain: Any

    def function_space(self, size: int) -> Any:
        return ufl.FunctionSpace(self.domain, _compat.quadrature_element("interval", size))

    def coefficient(self, size: int) -> Any:
        return ufl.Coefficient(self.function_space(size))


def matrix(c: Any, rows: int, columns: int, start: int = 0) -> Any:
    return ufl.as_tensor([[c[start + columns * i + j] for j in range(columns)] for i in range(rows)])


def strains(material: Material, layout: Layout, z: Any, state: Any, *, rotated: bool) -> tuple[Any, ...]:
    """(E, Gamma) of a micropolar material, the strain measures of a classical one.

    Args:
        z: scalars (G, w, Gw), gradients taken in the frame of the state.
        state: scalars (V~, Gamma~') in the rotated frame, else (F~, q~, Gamma~), or F~ of a classical
            material; of a plane problem without the entries that are known.
    """
    d, r = layout.dim, layout.rotations
    g, frame = matrix(z, d, d), matrix(state, d, d)
    f = kin.plane_tensor(frame) + kin.plane_gradient(g) if d == 2 else frame + g
    if r == 0:
        return material.measures(f)
    if d == 2:
        return _plane_strains(f, z, state, rotated)
    w = ufl.as_vector([z[9 + i] for i in range(3)])
    gw = matrix(z, 3, 3, 12)
    dq, increment = kin.exp_map(w), ufl.dot(kin.right_tangent(w), gw)
    if rotated:
        return ufl.dot(ufl.transpose(dq), f) - ufl.Identity(3), matrix(state, 3, 3, 9) + increment
    q0t = ufl.transpose(kin.quaternion_tensor([state[9 + i] for i in range(4)]))
    strain = ufl.dot(q0t, ufl.dot(ufl.transpose(dq), f)) - ufl.Identity(3)
    return strain, matrix(state, 3, 3, 13) + ufl.dot(q0t, increment)


def _plane_strains(f: Any, z: Any, state: Any, rotated: bool) -> tuple[Any, Any]:
    first = 4 if rotated else 6
    wryness = kin.plane_wryness([state[first + j] + z[5 + j] for j in range(2)])
    strain = ufl.dot(ufl.transpose(kin.plane_exp_map(z[4])), f)
    if not rotated:
        strain = ufl.dot(ufl.transpose(kin.quaternion_tensor([state[4], 0, 0, state[5]])), strain)
    return strain - ufl.Identity(3), wryness


def state_size(layout: Layout, *, rotated: bool) -> int:
    """Number of scalars of a state, see `strains`."""
    d, r = layout.dim, layout.rotations
    quaternion = 0 if rotated or r == 0 else (4 if d == 3 else 2)
    return d * d + quaternion + r * d


def pack_state(layout: Layout, frame: np.ndarray, wryness: np.ndarray, q: np.ndarray | None) -> np.ndarray:
    """States (n, state_size) of tensors (n, 3, 3) and, but for the rotated frame, quaternions (n, 4)."""
    d, n = layout.dim, len(frame)
    parts: list[np.ndarray] = [frame[:, :d, :d].reshape(n, d * d)]
    if layout.rotations:
        if q is not None:
            parts.append(q if d == 3 else q[:, [0, 3]])
        parts.append(wryness.reshape(n, 9) if d == 3 else wryness[:, 2, :2])
    return np.concatenate(parts, axis=1)


def stresses(material: Material, strains: Sequence[Any], numbers: Any) -> list[Any]:
    """dW/dE and dW/dGamma, T (3.145)-(3.146); of a classical material the derivatives by its measures."""
    variables = [ufl.variable(e) for e in strains]
    w = evaluate_energy(material, variables, named_parameters(material, numbers))
    return [ufl.diff(w, v) for v in variables]


def virtual_work(material: Material, strains: Sequence[Any], unknown: Any, test: Any, numbers: Any) -> Any:
    """dW/dE : dE + dW/dGamma : dGamma with variations of the strains in `unknown`."""
    pairs = zip(stresses(material, strains, numbers), strains, strict=True)
    return sum(ufl.inner(s, ufl.derivative(e, unknown, test)) for s, e in pairs)


def predicts(material: Material) -> bool:
    """Whether a material's iterations have a tangent of their own, see `tangent_work`."""
    measured = material.micropolar or type(material).measures is not Material.measures
    return material.stress_prediction and measured and not material.plastic


def tangent_work(
    material: Material,
    strains: Sequence[Any],
    unknowns: Sequence[Any],
    arguments: Sequence[Any],
    numbers: Any,
) -> Any:
    """Derivative of the virtual work, but with predicted stresses in its geometric part.

    A correction of the unknowns turns points, and with the turn comes a spurious strain of second order,
    whose stress spoils the next tangent. The geometric part takes instead the stress that the linear solution
    meant, S(x~) + S'(x~) [x - x~] with x~ from before the correction: the mixed integration points of
    Magisano, Leonetti and Garcea (2017). At x = x~, and so at the solution, it's the derivative itself. Where
    the material doesn't predict, it always is.

    Args:
        strains: measures at x, and at x~.
        unknowns: x, x~ and x - x~; the latter holds numbers of its own.
        arguments: test and trial function.
    """
    (now, before), (x, x0, correction), (test, trial) = strains, unknowns, arguments
    if not predicts(material):
        return ufl.derivative(virtual_work(material, now, x, test, numbers), x, trial)
    work = 0
    for e, s, s0 in zip(
        now, stresses(material, now, numbers), stresses(material, before, numbers), strict=True
    ):
        variation, predicted = ufl.derivative(e, x, test), s0 + ufl.derivative(s0, x0, correction)
        work += ufl.inner(ufl.derivative(s, x, trial), variation)
        work += ufl.derivative(ufl.inner(predicted, variation), x, trial)
    return work


class PointForm:
    """Residual and tangent of a material at points in `dim` dimensions, as UFL forms and compiled."""

    def __init__(self, material: Material, dim: int):
        self.material, self.layout = material, Layout.of(material, dim)
        self.space = PointSpace(_compat.point_domain())
        self.parameters = self.space.coefficient(len(parameter_values(material)))
        self.z = self.space.coefficient(self.layout.unknowns)
        self.state = self.space.coefficient(self.state_size)
        self._packing: Kernel | None = None

    # sizes --------------------------------------------------------------------------------------
    @property
    def state_size(self) -> int:
        return state_size(self.layout, rotated=self.material.isotropic)

    @property
    def terminals(self) -> dict[Any, int]:
        """First input slot of each coefficient."""
        n, s = self.layout.unknowns, self.state_size
        return {self.z: 0, self.state: n, self.parameters: n + s}

    @property
    def inputs(self) -> int:
        return self.layout.unknowns + self.state_size + len(parameter_values(self.material))

    @property
    def predicts(self) -> bool:
        """Whether the iterations' tangent depends on the last correction, too."""
        return predicts(self.material)

    # kinematics ---------------------------------------------------------------------------------
    def strains(self) -> tuple[Any, ...]:
        """(E, Gamma) of a micropolar material, the strain measures of a classical one, from z and the
        state.
        """
        return strains(self.material, self.layout, self.z, self.state, rotated=self.material.isotropic)

    def pack(
        self, F: np.ndarray, q: np.ndarray, wryness: np.ndarray, history: Sequence[np.ndarray]
    ) -> np.ndarray:
        """States (n, state_size) of reference values at points; `history` is what `Points.history` gives."""
        if not self.material.isotropic or not self.material.micropolar:
            return pack_state(self.layout, F, wryness, q)
        return self.packing(MPI.COMM_SELF)(F, q, wryness)

    def packing(self, comm: MPI.Comm) -> Kernel:
        """Kernel (F, q, Gamma) -> state in the rotated frame. Collective."""
        if self._packing is None:
            d, reference = self.layout.dim, self.space.coefficient(22)
            turn = kin.quaternion_tensor([reference[9 + i] for i in range(4)])
            frame = ufl.dot(matrix(reference, 3, 3), ufl.transpose(turn))
            wryness = ufl.dot(turn, ufl.dot(matrix(reference, 3, 3, 13), ufl.transpose(turn)))
            rows = range(3) if d == 3 else [2]
            parts = [frame[i, j] for i in range(d) for j in range(d)]
            parts += [wryness[i, j] for i in rows for j in range(d)]
            self._packing = compile_expressions(parts, {reference: 0}, 22, self.space.domain, comm)
        return self._packing

    # forms --------------------------------------------------------------------------------------
    @cached_property
    def energy(self) -> Any:
        """Strain energy per reference volume as a UFL expression of z, state and parameters."""
        return evaluate_energy(
            self.material, self.strains(), named_parameters(self.material, self.parameters)
        )

    @cached_property
    def residual(self) -> ufl.Form:
        """Virtual work for a test function in z."""
        test = ufl.TestFunction(self.space.function_space(self.layout.unknowns))
        work = virtual_work(self.material, self.strains(), self.z, test, self.parameters)
        return work * ufl.dx(domain=self.space.domain, degree=1)

    @cached_property
    def tangent(self) -> ufl.Form:
        """Derivative of the residual; symmetric, being a Hessian."""
        trial = ufl.TrialFunction(self.space.function_space(self.layout.unknowns))
        return ufl.derivative(self.residual, self.z, trial)

    @cached_property
    def iteration_tangent(self) -> ufl.Form:
        """What iterations take for the tangent, see `tangent_work`."""
        if not self.predicts:
            return self.tangent
        m, space = self.material, self.space.function_space(self.layout.unknowns)
        before, now = self._correction
        earlier = strains(m, self.layout, before, self.state, rotated=m.isotropic)
        arguments = ufl.TestFunction(space), ufl.TrialFunction(space)
        unknowns = self.z, before, now - before
        work = tangent_work(m, (self.strains(), earlier), unknowns, arguments, self.parameters)
        return work * ufl.dx(domain=self.space.domain, degree=1)

    @cached_property
    def _correction(self) -> tuple[Any, Any]:
        """z before the last correction, and z itself once more, as what isn't derived by."""
        return self.space.coefficient(self.layout.unknowns), self.space.coefficient(self.layout.unknowns)

    # compiled -----------------------------------------------------------------------------------
    def _tangent_terminals(self) -> dict[Any, int]:
        if not self.predicts:
            return self.terminals
        before, now = self._correction
        return {**self.terminals, before: self.inputs, now: 0}

    def _signature(self, expr: Any) -> str:
        terminals = {c: i for i, c in enumerate(self._tangent_terminals())}
        return _compat.expression_signature(expr, {**terminals, self.space.domain: 0})

    def _source(self) -> str:
        n = self.layout.unknowns
        scalarise = Scalariser(self._tangent_terminals())
        forms = self.residual, self.iteration_tangent
        r, k = (scalarise.scalar(codegen.expand(codegen.integrand(f))) for f in forms)
        zero = scalarise.graph.zero
        rows = codegen.coefficients(r, (n,), zero)
        full = codegen.coefficients(k, (n, n), zero)
        upper = [full[i * n + j] for i in range(n) for j in range(i, n)]
        return codegen.write_c(scalarise.graph, {"residual": rows, "blocks": rows + upper})

    def compile(self, comm: MPI.Comm) -> tuple[Kernel, Kernel]:
        """(residual, residual and upper triangle of the iterations' tangent) as kernels of (z, state,
        parameters); the second one, where the form predicts stresses, also of z before the last correction.
        Collective."""
        if self.material.isotropic and self.material.micropolar:
            self.packing(comm)
        n = self.layout.unknowns
        signature = self._signature(codegen.integrand(self.iteration_tangent))
        lib = jit.library(jit.digest(generator_version(), "blocks", signature), self._source, comm)
        size, inputs = n + n * (n + 1) // 2, self.inputs + (n if self.predicts else 0)
        return Kernel(lib, "residual", self.inputs, n), Kernel(lib, "blocks", inputs, size)

    def compile_energy(self, comm: MPI.Comm) -> Kernel:
        """Energy per reference volume as a kernel of (z, state, parameters)."""
        return compile_expressions([self.energy], self.terminals, self.inputs, self.space.domain, comm)


def compile_expressions(
    expressions: list[Any], terminals: dict[Any, int], inputs: int, domain: Any, comm: MPI.Comm
) -> Kernel:
    """One kernel that evaluates UFL expressions (any shape, flattened row by row) of its inputs."""
    order = {c: i for i, c in enumerate(terminals)}
    signatures = [_compat.expression_signature(e, {**order, domain: 0}) for e in expressions]
    size = sum(int(np.prod(e.ufl_shape, dtype=int)) for e in expressions)

    def source() -> str:
        scalarise = Scalariser(terminals)
        nodes = []
        for e in expressions:
            data = scalarise(codegen.expand(e)).data
            nodes += [scalarise.plain(data[index]) for index in np.ndindex(*data.shape)]
        return codegen.write_c(scalarise.graph, {"evaluate": nodes})

    layout = ",".join(f"{slot}" for slot in terminals.values())
    lib = jit.library(jit.digest(generator_version(), "expr", layout, *signatures), source, comm)
    return Kernel(lib, "evaluate", inputs, size)


class CoupleForm:
    """Virtual work of dead couples in three dimensions, -m . J_l(w) dw, and its derivative.

    Spatially constant couples do work on the spin, not on the rotation vector's increment; that makes
    the tangent unsymmetric. In plane strain the two agree and a couple is a plain nodal load.
    """

    def __init__(self) -> None:
        self.space = PointSpace(_compat.point_domain())
        self.w, self.m = self.space.coefficient(3), self.space.coefficient(3)
        space = self.space.function_space(3)
        test, trial = ufl.TestFunction(space), ufl.TrialFunction(space)
        w, m = (ufl.as_vector([c[i] for i in range(3)]) for c in (self.w, self.m))
        work = -ufl.dot(m, ufl.dot(kin.left_tangent(w), test))
        self.residual = work * ufl.dx(domain=self.space.domain, degree=1)
        self.tangent = ufl.derivative(self.residual, self.w, trial)

    def _source(self) -> str:
        scalarise = Scalariser({self.w: 0, self.m: 3})
        r, k = (scalarise.scalar(codegen.expand(codegen.integrand(f))) for f in (self.residual, self.tangent))
        zero = scalarise.graph.zero
        nodes = codegen.coefficients(r, (3,), zero) + codegen.coefficients(k, (3, 3), zero)
        return codegen.write_c(scalarise.graph, {"couple": nodes})

    def compile(self, comm: MPI.Comm) -> Kernel:
        """Kernel (w, m) -> residual (3) and tangent (3 x 3). Collective."""
        terminals = {self.w: 0, self.m: 1, self.space.domain: 0}
        signature = _compat.expression_signature(codegen.integrand(self.tangent), terminals)
        lib = jit.library(jit.digest(generator_version(), "couple", signature), self._source, comm)
        return Kernel(lib, "couple", 6, 12)
