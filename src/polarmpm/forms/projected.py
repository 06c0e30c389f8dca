"""Points whose stiff scalars are averages over patches: the cure of locking (docs/theory.md).

A point's stiff scalars e(z) are the logarithm of the volume or the trace of E, and the relative rotation of a
micropolar material. They count from the last reset. The material sees a deformation in which they have other
values t, those of a projection on few functions of the point's patch,

    L(z, t, pi) = W(Fbar(z, t)) + s/2 (e(z) - t)^2 + pi . e(z),

with the projected derivatives pi of L by t. What sums over points need are derivatives of L by z and t; the
sums themselves are the same for points of a grid and of elements (`assembly.patches`).

A point's input of kernels is (z, state, t, pi, base, s, parameters). `base` is what e(z) has begun with,
which isn't zero once rotations have got a new base since the reset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..kernels import codegen, jit
from ..kernels.codegen import Scalariser
from ..kernels.csource import write_c
from ..kernels.kernel import Kernel, compile_expressions, generator_version
from ..kernels.recall import recalled
from ..kinematics import projected as proj
from ..kinematics import rotations
from ..kinematics import tensors as kin
from ..kinematics.motion import Moved
from ..materials.base import Material
from ..tools import compat
from .points import PointForm
from .strains import motion, strain_measures, virtual_work


@dataclass
class ScalarKernels:
    """Kernels of the stiff scalars of m points, (z, state, t, pi, base, s, parameters) -> ...

    Attributes:
        measure: e (m) and its derivative by z (m, nz).
        slopes: L_t (m) alone, a fifth of the work of `conjugate`.
        conjugate: L_t (m), L_tz (m, nz) and L_tt (m, m).
        curvature: upper triangle of pi . e_zz.
        moved: Fbar (3, 3) in the frame of the state.
    """

    measure: Kernel
    slopes: Kernel
    conjugate: Kernel
    curvature: Kernel
    moved: Kernel


class Unrotated(PointForm):
    """A form whose state is in the unloaded body's frame, whatever its material allows."""

    @property
    def rotated(self) -> bool:
        return False


class ProjectedForm(PointForm):
    """Form of an elastic material whose stiff scalars are projected.

    Args:
        rotation: the relative rotation is projected, too; of a micropolar material.
        stabilisation: s (Pa), with which the points' own volumes are held to the projected ones.

    Attributes:
        scalars: how many there are; the volume, or the trace, comes first.
    """

    def __init__(
        self,
        material: Material,
        dim: int,
        axial: bool = False,
        *,
        rotation: bool = False,
        stabilisation: float = 0.0,
    ):
        self.turns = (1 if dim == 2 else 3) if rotation and material.micropolar else 0
        self.scalars = 1 + self.turns
        self.stabilisation = stabilisation
        self._kernels: ScalarKernels | None = None
        self._plain_kernel: Kernel | None = None
        super().__init__(material, dim, axial)
        self.extra = self.space.coefficient(2 * self.scalars + 1)  # pi, base and s

    # sizes ----------------------------------------------------------------------------------------
    def take(self, material: Material) -> None:
        super().take(material)
        plain = self.__dict__.get("plain")
        if plain is not None:
            plain.take(material if plain.material.plastic else material.elastic_part)

    @property
    def unknowns(self) -> int:
        return self.layout.unknowns + self.scalars

    @property
    def rotated(self) -> bool:
        # `turned` takes products of the points' scalars, of which elastic materials can do without
        return super().rotated and (self.turns < 3 or self.material.measure == "log")

    @property
    def turned(self) -> bool:
        """The relative rotations of a point, in space, are vectors in its rotated frame; those that are
        averaged have to be in one frame, the unrotated body's."""
        return self.rotated and self.turns == 3

    @property
    def packed_size(self) -> int:
        return self.state_size + 3 * self.scalars + 1

    @property
    def terminals(self) -> dict[Any, int | tuple[int, ...]]:
        nz, end = self.layout.unknowns, self.layout.unknowns + self.state_size
        projected = range(end, end + self.scalars)
        return {
            self.z: (*range(nz), *projected),
            self.state: nz,
            self.extra: end + self.scalars,
            self.parameters: nz + self.packed_size,
        }

    @property
    def predicts(self) -> bool:
        return False  # but for pi, see `assembly.patches`

    def extend(self, state: np.ndarray, base: np.ndarray) -> np.ndarray:
        """States (n, packed_size) of packed ones and `base` (n, scalars or more); t and pi are zero."""
        n, m = len(state), self.scalars
        return np.hstack([state, np.zeros((n, 2 * m)), base[:, :m], np.full((n, 1), self.stabilisation)])

    def frames(self, q: np.ndarray) -> np.ndarray:
        """What takes scalars of points from their frames into the unrotated one, (n, scalars, scalars), of
        microrotations (n, 4) of the state."""
        turns = np.tile(np.eye(self.scalars), (len(q), 1, 1))
        if self.turned:
            turns[:, 1:, 1:] = np.swapaxes(rotations.to_tensor(q), 1, 2)
        return turns

    def in_frame(self, values: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Scalars (n, scalars) in the points' frames, of ones (n, scalars or more) in the unrotated frame."""
        values = values[:, : self.scalars]
        return np.einsum("pij,pi->pj", self.frames(q), values) if self.turned else values

    # kinematics -----------------------------------------------------------------------------------
    @property
    def _t(self) -> list[Any]:
        nz = self.layout.unknowns
        return [self.z[nz + k] for k in range(self.scalars)]

    @cached_property
    def _unprojected(self) -> Moved:
        return motion(self.layout, self.z, self.state, rotated=self.rotated)

    @cached_property
    def _before(self) -> tuple[Any, Any]:
        """F and Q^T F of the state."""
        at = self.layout.state(rotated=self.rotated)
        frame = at.frame(self.state)
        if not self.layout.rotations or self.rotated:
            return frame, frame
        base = kin.quaternion_tensor(at.quaternion(self.state))
        return frame, ufl.dot(ufl.transpose(base), frame)

    @cached_property
    def scalars_now(self) -> list[Any]:
        """e(z)."""
        now, (F, U), m = self._unprojected, self._before, self.scalars
        base = [self.extra[m + k] for k in range(m)]
        if self.material.measure == "trace":
            found = [sum(now.stretch[i, i] - U[i, i] for i in range(self.layout.stretched))]
            a, b = proj.axial(now.stretch), proj.axial(U)
            found += [a[i] - b[i] for i in range(3 - self.turns, 3)]
        else:
            found = [ufl.ln(ufl.det(now.F) / ufl.det(F))]
            if self.turns == 1:
                found.append(proj.relative_rotation(now.stretch) - proj.relative_rotation(U))
            elif self.turns:
                a, b = proj.axial(now.stretch), proj.axial(U)
                found += [a[i] - b[i] for i in range(3)]
        return [e + b for e, b in zip(found, base, strict=True)]

    @cached_property
    def plain(self) -> PointForm:
        """The form of the elastic material without any projection, in the same frame."""
        of = self.material.elastic_part, self.layout.dim, self.layout.axial
        form = PointForm(*of)
        return form if form.rotated == self.rotated else Unrotated(*of)

    def compile_plain(self, comm: MPI.Comm) -> Kernel:
        """Residual and tangent of `plain`, compiled when they are asked for first. Collective."""
        if self._plain_kernel is None:
            self._plain_kernel = self.plain.compile(comm)[1]
        return self._plain_kernel

    @cached_property
    def moved(self) -> Moved:
        """The motion with projected scalars, Fbar in the place of F."""
        now, dim = self._unprojected, self.layout.stretched
        gain = [t - e for t, e in zip(self._t, self.scalars_now, strict=True)]
        if self.material.measure == "trace":
            turn = ufl.as_vector([*[0.0] * (3 - self.turns), *gain[1:]]) if self.turns else None
            stretch = proj.with_spherical_and_skew(now.stretch, gain[0], turn, dim)
            return now._replace(F=ufl.dot(now.Q, stretch))
        if self.turns == 3:
            return now._replace(F=ufl.dot(now.Q, self._turned_stretch))
        F = proj.with_log_volume(now.F, gain[0], dim)
        if self.turns:
            U = ufl.dot(ufl.transpose(now.Q), F)
            F = ufl.dot(now.Q, proj.with_relative_rotation(U, gain[1]))
        return now._replace(F=F)

    @cached_property
    def _turned_stretch(self) -> Any:
        """U with projected volume and relative rotations, in space; shorter than Q^T of `moved.F`."""
        (F, U), m = self._before, self.scalars
        volume, *turns = (t - self.extra[m + k] for k, t in enumerate(self._t))
        turn = proj.axial(U) + ufl.as_vector(turns)
        return proj.with_volume_and_skew(self._unprojected.stretch, volume + ufl.ln(ufl.det(F)), turn)

    def strains(self) -> tuple[Any, ...]:
        now = self.moved
        return strain_measures(self.material, now.stretch, now.wryness)

    # forms ----------------------------------------------------------------------------------------
    @cached_property
    def residual(self) -> ufl.Form:
        """Variation of L in z and t."""
        test = ufl.TestFunction(self.space.function_space(self.unknowns))
        e, t, m = self.scalars_now, self._t, self.scalars
        work = virtual_work(self.material, self.strains(), self.z, test, self.parameters)
        work += self.extra[2 * m] * (e[0] - t[0]) * ufl.derivative(e[0] - t[0], self.z, test)
        for k in range(m):
            work += self.extra[k] * ufl.derivative(e[k], self.z, test)
        return work * ufl.dx(domain=self.space.domain, degree=1)

    # compiled -------------------------------------------------------------------------------------
    @property
    def _waist(self) -> int:
        """All that is projected of classical elastic materials goes through one scalar: bundles save a fifth
        to a half of the code. Of others they save nothing."""
        return 0 if self.turns or self.material.plastic else 3

    def _source(self) -> str:
        n, nz, m = self.unknowns, self.layout.unknowns, self.scalars
        scalarise = Scalariser(self.terminals, waist=self._waist)
        zero = scalarise.graph.zero

        def coefficients(form: Any, *shape: int) -> list[int]:
            found = scalarise.flat(scalarise.scalar(codegen.expand(form)))
            return codegen.coefficients(found, shape, zero)

        r = coefficients(codegen.integrand(self.residual), n)
        k = coefficients(codegen.integrand(self.tangent), n, n)
        space = self.space.function_space(n)
        test, trial = ufl.TestFunction(space), ufl.TrialFunction(space)
        by_z = [ufl.derivative(e, self.z, test) for e in self.scalars_now]
        bent = sum(self.extra[c] * ufl.derivative(by_z[c], self.z, trial) for c in range(m))
        curvature = coefficients(bent, n, n)
        upper = [i * n + j for i in range(nz) for j in range(i, nz)]
        values = [scalarise.plain(scalarise.scalar(codegen.expand(e))) for e in self.scalars_now]
        functions: dict[str, Sequence[int]] = {
            "residual": r[:nz],
            "blocks": r[:nz] + [k[i] for i in upper],
            "measure": values + [node for e in by_z for node in coefficients(e, n)[:nz]],
            "slopes": r[nz:],
            "conjugate": r[nz:]
            + [k[i * n + j] for i in range(nz, n) for j in range(nz)]
            + [k[i * n + j] for i in range(nz, n) for j in range(nz, n)],
            "curvature": [curvature[i] for i in upper],
        }
        return write_c(scalarise.graph, functions)

    def _library(self, comm: MPI.Comm) -> Any:
        self.code = recalled(("projected", self.kind), self._named)
        return jit.library(self.code, self._source, comm)

    def _named(self) -> str:
        slots = ",".join(map(str, self.terminals.values()))
        signature = self._signature(codegen.integrand(self.tangent))
        # the tangent has all of the form, but what is linear in e alone
        scalars = [compat.expression_signature(e, self._order) for e in self.scalars_now]
        kind = f"projected, with slopes, {self._waist}" if self._waist else "projected, with slopes"
        return jit.digest(generator_version(), kind, slots, signature, *scalars)

    @property
    def _order(self) -> dict[Any, int]:
        return {**{c: i for i, c in enumerate(self.terminals)}, self.space.domain: 0}

    def compile(self, comm: MPI.Comm) -> tuple[Kernel, Kernel]:
        """(L_z, L_z and upper triangle of L_zz). Collective."""
        if self.rotated and self.material.micropolar:
            self.packing(comm)
        nz, lib = self.layout.unknowns, self._library(comm)
        size = nz + nz * (nz + 1) // 2
        return Kernel(lib, "residual", self.inputs, nz), Kernel(lib, "blocks", self.inputs, size)

    def compile_scalars(self, comm: MPI.Comm) -> ScalarKernels:
        """Kernels of the stiff scalars, compiled when they are asked for first. Collective."""
        if self._kernels is None:
            self._kernels = self._compile_scalars(comm)
        return self._kernels

    def _compile_scalars(self, comm: MPI.Comm) -> ScalarKernels:
        nz, m, n, lib = self.layout.unknowns, self.scalars, self.inputs, self._library(comm)
        moved = compile_expressions(
            lambda: [self.moved.F], self.terminals, n, self.space.domain, comm, of=("moved", self.kind)
        )
        return ScalarKernels(
            Kernel(lib, "measure", n, m * (1 + nz)),
            Kernel(lib, "slopes", n, m),
            Kernel(lib, "conjugate", n, m * (1 + nz + m)),
            Kernel(lib, "curvature", n, nz * (nz + 1) // 2),
            moved,
        )
