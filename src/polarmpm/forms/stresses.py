"""Stress, couple stress and energy of the points' current state, for output."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import ufl

from ..kernels.kernel import Kernel, PointSpace, compile_expressions, matrix
from ..kinematics import measures as kin
from ..materials.base import Material, evaluate_energy, named_parameters, parameter_values
from ..tools import compat


class FieldForm:
    """Energy and Cauchy stresses of (F, Q, Gamma), and of a plastic material's history (Fp, Gp, chi)."""

    def __init__(self, material: Material):
        self.material = material
        self.space = PointSpace(compat.point_domain())
        sizes = [9, 4, 9, *([9, 9, 1] if material.plastic else []), len(parameter_values(material))]
        self._inputs = [self.space.coefficient(n) for n in sizes]
        self.terminals = {c: sum(sizes[:k]) for k, c in enumerate(self._inputs)}
        self.size = sum(sizes)

    def expressions(self) -> list[Any]:
        """[W, sigma, mu]; sigma = Q B Fe^T / J, mu = Q S F^T / J (T 3.4, (4.26)-(4.27)); W includes what
        hardening stores."""
        material, (f, q, wryness, *history, parameters) = self.material, self._inputs
        p, f, gamma = named_parameters(material, parameters), matrix(f, 3, 3), matrix(wryness, 3, 3)
        fe, stored = f, ufl.as_ufl(0.0)
        if history:
            plastic, plastic_wryness, chi = history
            fe = ufl.dot(f, ufl.inv(matrix(plastic, 3, 3)))
            gamma = gamma - matrix(plastic_wryness, 3, 3)
            stored = material.hardening_energy(chi, p)  # type: ignore[attr-defined]
        j = ufl.det(f)
        if not material.micropolar:
            fv = ufl.variable(fe)
            w = evaluate_energy(material, material.measures(fv), p)
            return [w + stored, ufl.dot(ufl.diff(w, fv), ufl.transpose(fe)) / j, 0 * f]
        turn = kin.quaternion_tensor([q[i] for i in range(4)])
        strain = ufl.variable(ufl.dot(ufl.transpose(turn), fe) - ufl.Identity(3))
        gamma = ufl.variable(gamma)
        w = evaluate_energy(material, (strain, gamma), p)

        def push(s: Any, by: Any) -> Any:
            return ufl.dot(turn, ufl.dot(s, ufl.transpose(by))) / j

        return [w + stored, push(ufl.diff(w, strain), fe), push(ufl.diff(w, gamma), f)]

    def compile(self, comm: MPI.Comm) -> Kernel:
        """Kernel (F, q, Gamma, history, parameters) -> (W, sigma, mu), 19 numbers a row. Collective."""
        return compile_expressions(self.expressions(), self.terminals, self.size, self.space.domain, comm)
