"""Manufactured solutions: the body force and couple that make given fields a solution (T 3.5.1).

Displacement u(X) and rotation vector theta(X) are UFL functions of the initial position. UFL derives
F, Q = exp(theta), Gamma = J_r(theta) dtheta/dX, the stresses and their divergence:
f = -Div P and m_k = e_ijk tau_ij - (Div Q S)_k, per reference volume.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..forms.strains import strain_measures
from ..kernels.kernel import compile_expressions
from ..kinematics.motion import Increment, move
from ..materials import Material
from ..materials.base import named_parameters, parameter_values
from ..problems.base import Problem
from ..tools import compat


class Solution:
    """Exact fields of a micropolar solid in three dimensions.

    Args:
        material: micropolar.
        displacement, rotation: functions of the UFL vector X that return UFL vectors of three components.
    """

    def __init__(
        self,
        material: Material,
        displacement: Callable[[Any], Any],
        rotation: Callable[[Any], Any],
        comm: MPI.Comm,
    ):
        domain = compat.point_domain()
        space = ufl.FunctionSpace(domain, compat.quadrature_element("interval", 3))
        names = material.parameters()
        numbers = ufl.Coefficient(
            ufl.FunctionSpace(domain, compat.quadrature_element("interval", len(names)))
        )
        point = ufl.Coefficient(space)
        X = ufl.variable(ufl.as_vector([point[i] for i in range(3)]))
        p = named_parameters(material, numbers)
        u, theta = displacement(X), rotation(X)
        now = move(Increment(ufl.diff(u, X), theta, ufl.diff(theta, X)), ufl.Identity(3))
        F, Q = now.F, now.Q
        E, wryness = map(ufl.variable, strain_measures(material, now.stretch, now.wryness))
        w = material.energy(E, wryness, p)
        P, QS = ufl.dot(Q, ufl.diff(w, E)), ufl.dot(Q, ufl.diff(w, wryness))
        tau, J = ufl.dot(P, ufl.transpose(F)), ufl.det(F)
        force = ufl.as_vector([-sum(ufl.diff(P[i, j], X)[j] for j in range(3)) for i in range(3)])
        couple = ufl.as_vector(
            [
                tau[(k + 1) % 3, (k + 2) % 3]
                - tau[(k + 2) % 3, (k + 1) % 3]
                - sum(ufl.diff(QS[k, j], X)[j] for j in range(3))
                for k in range(3)
            ]
        )
        self._values = parameter_values(material)
        terminals = {point: 0, numbers: 3}
        inputs = 3 + len(names)
        self._sources = compile_expressions([force, couple], terminals, inputs, domain, comm)
        fields = [u, theta, tau / J, ufl.dot(QS, ufl.transpose(F)) / J]
        self._fields = compile_expressions(fields, terminals, inputs, domain, comm)

    def _inputs(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return X, np.tile(self._values, (len(X), 1))

    def sources(self, X: np.ndarray) -> np.ndarray:
        """Body force (N/m^3) and couple (N/m^2) at initial positions (n, 3): (n, 6)."""
        return self._sources(*self._inputs(X)) if len(X) else np.zeros((0, 6))

    def fields(self, X: np.ndarray) -> tuple[np.ndarray, ...]:
        """Displacement (n, 3), rotation vector (n, 3), Cauchy stress and couple stress (n, 3, 3)."""
        out = self._fields(*self._inputs(X)) if len(X) else np.zeros((0, 24))
        return out[:, :3], out[:, 3:6], out[:, 6:15].reshape(-1, 3, 3), out[:, 15:].reshape(-1, 3, 3)

    def errors(self, problem: Problem) -> dict[str, float]:
        """L1 norms of the errors at the points, those of stresses relative, T (3.187)-(3.188). Collective."""
        p, stresses = problem.points, problem.fields()
        u, theta, stress, couple_stress = self.fields(p.X)

        def size(a: np.ndarray) -> np.ndarray:
            norms: np.ndarray = np.sqrt(np.sum(a**2, axis=tuple(range(1, a.ndim))))
            return norms

        values = {
            "displacement": size(p.displacement - u),
            "rotation": size(p.rotation_vector - theta),
            "stress": size(stresses.stress - stress) / size(stress),
            "couple_stress": size(stresses.couple_stress - couple_stress) / size(couple_stress),
        }
        return {name: p.comm.allreduce(float(v @ p.volume0)) for name, v in values.items()}
