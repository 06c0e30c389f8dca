"""Initial stresses at points: what is added to the material's stress until the next reset of the grid.

A field of them balances, in force and in moment, whatever the body does after the reset, since its energy
doesn't change when the body moves rigidly. Per reference volume it is, with the deformation F_inc and the
turn dQ = exp(hat(w)) since the reset (docs/theory.md):

* micropolar: B0 : (dQ^T F_inc - I) + M0 : J_r(w) grad w;
* classical, symmetric S0: S0 : [(C - I)/4 + (C - C^-1)/8], C = F_inc^T F_inc, which is U - I to second order;
* classical, by Green's strain: S0 : (C - I)/2. The stress is then S0 convected with the body: F S0 F^T at the
  next reset stands for the same stress;
* with second gradients besides M0_ijk C_ij,k / 2, C_ij,k the gradient of C by x~. It does the work T0 on
  second gradients at the reset where M0_ijk = T0_ijk + T0_jik - T0_kij.

The kernels' z has gradients in the point's frame T, G = du/dx~ T, so that F_inc = (T + G) T^-1. T^-1 goes to
the stresses once a reset (`pack`): with P = B0 T^-T, N = M0 T^-T and D = (T + G)^T (T + G)

    B0 : dQ^T F_inc = P : dQ^T (T + G),     M0 : J_r grad w = N : J_r Gw,
    S0 : C = (T^-1 S0 T^-T) : D,            S0 : C^-1 = (T^T S0 T) : D^-1.

With M_LJK = T^-1_Li T^-1_Jj T^-1_Kk M0_ijk and N = T^-1 H~, where D = F^T F and H = H~ + h,

    M0_ijk C_ij,k / 2 = M_LJK F_pL H_pJK - (M_LJK N_QJK) : D_LQ.
"""

from __future__ import annotations

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
from ..kernels.kernel import Kernel, PointSpace, compile_expressions, generator_version, matrix
from ..kernels.recall import recalled
from ..kinematics import tensors as kin
from ..kinematics.layout import Layout
from ..tools import compat
from ..tools.rows import flat

_MIXED, _GREEN = (0.375, -0.125), (0.5, 0.0)  # of C and of C^-1


@dataclass(frozen=True)
class InitialKernels:
    """Kernels of (z, frame, packed stress): residual; residual and upper triangle of the tangent; energy."""

    form: InitialStressForm
    residual: Kernel
    blocks: Kernel
    energy: Kernel


class InitialStressForm:
    """Energy, residual and tangent of an initial stress, of a layout's unknowns.

    Args:
        green: classical bodies measure by Green's strain.

    Attributes:
        size: numbers of a packed stress.

    Raises:
        InputError: of a body of revolution.
    """

    def __init__(self, layout: Layout, *, green: bool = False):
        if layout.axial:  # their hoop stress would be left out
            raise InputError("initial stress: there are none in bodies of revolution (axisymmetric)")
        self.layout, self._weights = layout, _GREEN if green else _MIXED
        d = layout.dim
        self.size = layout.block * d if layout.rotations else d * (d + 1)
        self._second = self.size  # where what belongs to second gradients begins
        if layout.second:
            self.size += d * len(layout.axes(2)) + d * d
        self.space = PointSpace(compat.point_domain())
        sizes = layout.unknowns, d * d, self.size
        self.z, self._frame, self._stress = (self.space.coefficient(n) for n in sizes)
        self.terminals = {self.z: 0, self._frame: sizes[0], self._stress: sizes[0] + sizes[1]}
        self.inputs = sum(sizes)

    def pack(self, stress: np.ndarray, frame: np.ndarray, grown: np.ndarray | None = None) -> np.ndarray:
        """What kernels take (n, size) of stresses (n, b, d), see `Reference.initial_stress`, in frames (n,
        d, d); with second gradients of stresses (n, d, d + m) and the points' H~, `grown` (n, d, m)."""
        d, second = self.layout.dim, stress[:, :, self.layout.dim :]
        back, stress = np.linalg.inv(frame), stress[:, :, :d]
        if self.layout.rotations:
            return flat(stress @ np.swapaxes(back, 1, 2))
        upper = np.triu_indices(self.layout.dim)
        of_square = self._weights[0] * (back @ stress @ np.swapaxes(back, 1, 2))
        of_inverse = self._weights[1] * (np.swapaxes(frame, 1, 2) @ stress @ frame)
        more: list[np.ndarray] = []
        if self.layout.second:
            assert grown is not None
            of_second, of_frame, less = self._pack_second(second, back, self.layout.symmetric(grown))
            of_square, more = of_square - less, [of_second, of_frame]
        return np.hstack([of_square[:, upper[0], upper[1]], of_inverse[:, upper[0], upper[1]], *more])

    def _pack_second(
        self, work: np.ndarray, back: np.ndarray, grown: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of work T0 (n, d, m): M of the different second gradients, M H~ (n, d d), and sym(M N) (n, d,
        d).
        """
        j, k = self.layout.pairs
        t = self.layout.symmetric(np.where(j == k, 1.0, 0.5) * work)
        m0 = t + np.swapaxes(t, 1, 2) - np.transpose(t, (0, 2, 3, 1))
        m = np.einsum("nli,naj,nbk,nijk->nlab", back, back, back, m0, optimize=True)
        m = 0.5 * (m + np.swapaxes(m, 2, 3))
        of_second = m[:, :, j, k] * np.where(j == k, 1.0, 2.0)
        of_frame = np.einsum("nljk,npjk->npl", m, grown)
        less = back @ of_frame
        less = 0.5 * (less + np.swapaxes(less, 1, 2))
        return flat(of_second), flat(of_frame), less

    def _symmetric(self, first: int) -> Any:
        d = self.layout.dim
        place = {pair: first + k for k, pair in enumerate(zip(*np.triu_indices(d), strict=True))}
        return ufl.as_tensor(
            [[self._stress[place[min(i, j), max(i, j)]] for j in range(d)] for i in range(d)]
        )

    @property
    def energy(self) -> Any:
        """Per reference volume; zero at z = 0."""
        d, r = self.layout.dim, self.layout.rotations
        before = matrix(self._frame, d, d)
        now = before + self.layout.derivative(self.z, "displacement")
        if r == 0:
            square, start = (ufl.dot(ufl.transpose(f), f) for f in (now, before))
            half = d * (d + 1) // 2
            total = ufl.inner(self._symmetric(0), square - start)
            if self._weights[1]:
                total += ufl.inner(self._symmetric(half), ufl.inv(square) - ufl.inv(start))
            return total + self._energy_of_second(now, before)
        w, change = self.layout.value(self.z, "rotation"), self.layout.derivative(self.z, "rotation")
        if d == 2:
            turn = kin.plane_exp_map(w[2])
            turn = ufl.as_tensor([[turn[i, j] for j in range(2)] for i in range(2)])
        else:
            turn, change = kin.exp_map(w), ufl.dot(kin.right_tangent(w), change)
        total = ufl.inner(matrix(self._stress, d, d), ufl.dot(ufl.transpose(turn), now) - before)
        return total + ufl.inner(matrix(self._stress, r, d, d * d), change)

    def _energy_of_second(self, now: Any, before: Any) -> Any:
        """M_LJK F_pL H_pJK, less what it is at z = 0."""
        d, axes, total = self.layout.dim, self.layout.axes(2), ufl.as_ufl(0.0)
        if not self.layout.second:
            return total
        first, at, h = self._second, self._second + d * len(axes), self.layout.where("displacement", 2).start
        for p in range(d):
            for l in range(d):
                total += self._stress[at + d * p + l] * (now[p, l] - before[p, l])
                for k in range(len(axes)):
                    m = self._stress[first + len(axes) * l + k]
                    total += m * now[p, l] * self.z[h + len(axes) * p + k]
        return total

    def compile(self, comm: MPI.Comm) -> InitialKernels:
        """Collective."""
        n, domain, of = self.layout.unknowns, self.space.domain, ("initial", self.layout, self._weights)
        lib = jit.library(recalled(of, self._named), self._source, comm)
        return InitialKernels(
            self,
            Kernel(lib, "residual", self.inputs, n),
            Kernel(lib, "blocks", self.inputs, n + n * (n + 1) // 2),
            compile_expressions(lambda: [self.energy], self.terminals, self.inputs, domain, comm, of=of),
        )

    @cached_property
    def _derivatives(self) -> list[Any]:
        """Integrands of residual and tangent."""
        space = self.space.function_space(self.layout.unknowns)
        test, trial = ufl.TestFunction(space), ufl.TrialFunction(space)
        residual = ufl.derivative(self.energy, self.z, test) * ufl.dx(domain=self.space.domain, degree=1)
        return [codegen.integrand(form) for form in (residual, ufl.derivative(residual, self.z, trial))]

    def _named(self) -> str:
        terminals = {**{c: i for i, c in enumerate(self.terminals)}, self.space.domain: 0}
        signature = compat.expression_signature(self._derivatives[1], terminals)
        return jit.digest(generator_version(), "blocks", signature)

    def _source(self) -> str:
        n, scalarise = self.layout.unknowns, Scalariser(self.terminals)
        r, k = (scalarise.scalar(codegen.expand(integrand)) for integrand in self._derivatives)
        zero = scalarise.graph.zero
        rows, full = codegen.coefficients(r, (n,), zero), codegen.coefficients(k, (n, n), zero)
        upper = [full[i * n + j] for i in range(n) for j in range(i, n)]
        return write_c(scalarise.graph, {"residual": rows, "blocks": rows + upper})
