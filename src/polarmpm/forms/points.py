"""The weak form at a material point: UFL in, compiled residual and tangent blocks out.

The unknown of a point is the vector z = (du/dx, w, dw/dx) of its increments since the last reset; the
material's energy W(E, Gamma) gives the residual dW[dz] and, by `ufl.derivative`, the tangent. Gradients are
taken in the frame of the state, which leaves little arithmetic (T 3.4; `docs/theory.md`):

* isotropic energies, rotated frame: V~ = F~ Q~^T, E' = dQ^T (V~ + G) - I, Gamma' = Gamma~' + J_r Gw;
* any other energy, reference frame: F = F~ + G, Q = dQ Q~, Gamma = Gamma~ + Q~^T J_r Gw;
* classical energies: F = F~ + G, with second gradients z = (G, h) and H = H~ + h.

G = du/dx~ T and Gw = dw/dx~ T with the frame T = V~ or F~, the first entries of the state.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..kernels import codegen, jit
from ..kernels.codegen import Scalariser
from ..kernels.csource import write_c
from ..kernels.kernel import Kernel, PointSpace, compile_expressions, generator_version
from ..kernels.recall import recalled
from ..kinematics import tensors as kin
from ..kinematics.layout import Layout
from ..materials.base import Material, evaluate_energy, named_parameters, parameter_values
from ..tools import compat
from . import kinds
from .strains import predicts, strains, tangent_work, virtual_work


class PointForm:
    """Residual and tangent of a material at points in `dim` dimensions, as UFL forms and compiled; `axial`:
    of a body of revolution."""

    scalars: int = 0  # that are projected, see `projected`
    turns: int = 0  # of these, components of the relative rotation
    code: str = ""  # name of the compiled residual and tangent, a digest of them

    def __init__(self, material: Material, dim: int, axial: bool = False):
        self.material, self.layout = material, Layout.of_points(material, dim, axial)
        self.space = PointSpace(compat.point_domain())
        self.parameters = self.space.coefficient(len(parameter_values(material)))
        self.z = self.space.coefficient(self.unknowns)
        self.state = self.space.coefficient(self.state_size)
        self._packing: Kernel | None = None

    # sizes --------------------------------------------------------------------------------------
    def take(self, material: Material) -> None:
        """Go on with a material of the same form and other numbers."""
        self.material = material

    @property
    def unknowns(self) -> int:
        """Scalars by which the energy is derived."""
        return self.layout.unknowns

    @property
    def rotated(self) -> bool:
        """Whether the state is in the rotated frame."""
        return self.material.isotropic

    @property
    def packed_size(self) -> int:
        """Scalars of a point in the kernels' input between its unknowns and the parameters."""
        return self.state_size

    @property
    def state_size(self) -> int:
        return self.layout.state(rotated=self.rotated).size

    @property
    def terminals(self) -> dict[Any, int | tuple[int, ...]]:
        """First input slot of each coefficient, or all of its slots."""
        n, s = self.layout.unknowns, self.state_size
        return {self.z: 0, self.state: n, self.parameters: n + s}

    @cached_property
    def inputs(self) -> int:
        return self.layout.unknowns + self.packed_size + len(parameter_values(self.material))

    @property
    def predicts(self) -> bool:
        """Whether the iterations' tangent depends on the last correction, too."""
        return predicts(self.material)

    # kinematics ---------------------------------------------------------------------------------
    def strains(self) -> tuple[Any, ...]:
        """(E, Gamma), of a classical material its strain measures, from z and the state."""
        return strains(self.material, self.layout, self.z, self.state, rotated=self.rotated)

    def pack(
        self,
        F: np.ndarray,
        q: np.ndarray,
        wryness: np.ndarray,
        plastic: Sequence[np.ndarray],
        grad_F: np.ndarray | None = None,
        radii: np.ndarray | None = None,
    ) -> np.ndarray:
        """States (n, state_size) of reference values at points; `plastic`: their `Points.plastic_state`,
        `grad_F`: with second gradients, `radii`: of bodies of revolution, undeformed and present ones (n,
        2)."""
        if not self.rotated or not self.material.micropolar:
            layout = self.layout.state()
            return layout.put_radii(layout.pack(F, wryness, q, grad_F), radii)
        state = self.packing(MPI.COMM_SELF)(F, q, wryness)
        return self.layout.state(rotated=True).put_radii(state, radii)

    def packing(self, comm: MPI.Comm) -> Kernel:
        """Kernel (F, q, Gamma) -> state in the rotated frame. Collective."""
        if self._packing is None:
            size = self.layout.in_space.state().size
            reference, kind = self.space.coefficient(size), ("packing", self.layout)
            self._packing = compile_expressions(
                lambda: self._packed(reference), {reference: 0}, size, self.space.domain, comm, of=kind
            )
        return self._packing

    def _packed(self, reference: Any) -> list[Any]:
        full = self.layout.in_space.state()
        turn = kin.quaternion_tensor(full.quaternion(reference))
        frame = ufl.dot(full.frame(reference), ufl.transpose(turn))
        wryness = ufl.dot(turn, ufl.dot(full.wryness(reference), ufl.transpose(turn)))
        return self.layout.state(rotated=True).scalars(frame, wryness)

    @cached_property
    def kind(self) -> Hashable:
        """All that its kernels depend on: another form of the same kind has the same ones."""
        return self._made_of()

    def _made_of(self) -> Hashable:
        of = kinds.of_material(self.material)
        return type(self), self.layout, self.rotated, self.scalars, self.turns, of

    def check(self) -> None:
        """Raise InputError where one of the material's functions has a mistake that its UFL shows."""
        recalled(("checked", self.kind), lambda: self.energy is not None)

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
        test = ufl.TestFunction(self.space.function_space(self.unknowns))
        work = virtual_work(self.material, self.strains(), self.z, test, self.parameters)
        return work * ufl.dx(domain=self.space.domain, degree=1)

    @cached_property
    def tangent(self) -> ufl.Form:
        """Derivative of the residual; symmetric, being a Hessian."""
        trial = ufl.TrialFunction(self.space.function_space(self.unknowns))
        return ufl.derivative(self.residual, self.z, trial)

    @cached_property
    def iteration_tangent(self) -> ufl.Form:
        """What iterations take for the tangent, see `tangent_work`."""
        if not self.predicts:
            return self.tangent
        m, space = self.material, self.space.function_space(self.unknowns)
        before, now = self._correction
        earlier = strains(m, self.layout, before, self.state, rotated=self.rotated)
        arguments = ufl.TestFunction(space), ufl.TrialFunction(space)
        unknowns = self.z, before, now - before
        work = tangent_work(m, (self.strains(), earlier), unknowns, arguments, self.parameters)
        return work * ufl.dx(domain=self.space.domain, degree=1)

    @cached_property
    def _correction(self) -> tuple[Any, Any]:
        """z before the last correction, and z itself once more, as what isn't derived by."""
        return self.space.coefficient(self.unknowns), self.space.coefficient(self.unknowns)

    # compiled -----------------------------------------------------------------------------------
    def _tangent_terminals(self) -> dict[Any, int | tuple[int, ...]]:
        if not self.predicts:
            return self.terminals
        before, now = self._correction
        return {**self.terminals, before: self.inputs, now: 0}

    def _signature(self, expr: Any) -> str:
        terminals = {c: i for i, c in enumerate(self._tangent_terminals())}
        return compat.expression_signature(expr, {**terminals, self.space.domain: 0})

    @property
    def _waist(self) -> int:
        """Means over a micro-space have many strains of many unknowns: bundles halve the code."""
        return 3 if self.material.second_gradient else 0

    def _source(self) -> str:
        n = self.layout.unknowns
        scalarise = Scalariser(self._tangent_terminals(), waist=self._waist)
        forms = self.residual, self.iteration_tangent
        r, k = (scalarise.scalar(codegen.expand(codegen.integrand(f))) for f in forms)
        r, k = scalarise.flat(r), scalarise.flat(k)
        zero = scalarise.graph.zero
        rows = codegen.coefficients(r, (n,), zero)
        full = codegen.coefficients(k, (n, n), zero)
        upper = [full[i * n + j] for i in range(n) for j in range(i, n)]
        return write_c(scalarise.graph, {"residual": rows, "blocks": rows + upper})

    def _named(self) -> str:
        signature = self._signature(codegen.integrand(self.iteration_tangent))
        return jit.digest(generator_version(), f"blocks {self._waist}", signature)

    def compile(self, comm: MPI.Comm) -> tuple[Kernel, Kernel]:
        """(residual, residual and upper triangle of the iterations' tangent) as kernels of (z, state,
        parameters); the second one, where the form predicts stresses, also of z before the last correction.
        Collective."""
        if self.rotated and self.material.micropolar:
            self.packing(comm)
        n = self.layout.unknowns
        self.code = recalled(("blocks", self.kind), self._named)
        lib = jit.library(self.code, self._source, comm)
        size, inputs = n + n * (n + 1) // 2, self.inputs + (n if self.predicts else 0)
        return Kernel(lib, "residual", self.inputs, n), Kernel(lib, "blocks", inputs, size)

    def compile_energy(self, comm: MPI.Comm) -> Kernel:
        """Energy per reference volume as a kernel of (z, state, parameters)."""
        of, domain = ("energy", self.kind), self.space.domain
        return compile_expressions(lambda: [self.energy], self.terminals, self.inputs, domain, comm, of=of)
