"""The weak form at a point of a surface: UFL in, compiled residual and tangent out.

The unknown of a point is y = (u, w, G): the increments of displacement and rotation vector since the last
reset (rotations: since their last base) and the displacement's gradient G = du/dx~. Everything is per
undeformed area.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import ufl

from ..kernels import codegen, jit
from ..kernels.codegen import Scalariser
from ..kernels.csource import write_c
from ..kernels.kernel import Kernel, PointSpace, generator_version, matrix
from ..kinematics import tensors as kin
from ..kinematics.layout import SURFACE, Layout, Part
from ..tools import compat


class SurfaceForm:
    """Virtual work of a surface point and its derivative by y, as UFL forms and compiled.

    Attributes:
        slots: of y.
        size: length of y.
        parts: of y, in the words of `kinematics.layout`.
        data: numbers of each of the form's coefficients.
        symmetric: the derivative is symmetric.
    """

    parts: tuple[Part, ...] = SURFACE
    data: tuple[int, ...]
    symmetric = True

    def __init__(self, layout: Layout, *data: int):
        self.layout, self.data = layout, data
        self.space = PointSpace(compat.point_domain())
        self.slots = Layout(layout.dim, layout.rotations, self.parts)
        self.size = self.slots.unknowns + self.further()
        self.y = self.space.coefficient(self.size)
        self.coefficients = [self.space.coefficient(n) for n in data]
        space = self.space.function_space(self.size)
        self.test, self._trial = ufl.TestFunction(space), ufl.TrialFunction(space)
        self.dx = ufl.dx(domain=self.space.domain, degree=1)
        self.residual = self.virtual_work() * self.dx
        self.tangent = self.linearised()

    def further(self) -> int:
        """How many unknowns y has after those of the point."""
        return 0

    def virtual_work(self) -> Any:
        """Residual: what the point adds to the internal virtual work, a UFL scalar linear in `test`."""
        raise NotImplementedError

    def linearised(self) -> ufl.Form:
        """Tangent: the derivative of the residual by y."""
        return ufl.derivative(self.residual, self.y, self._trial)

    # parts of y -------------------------------------------------------------------------------------
    def _displacement(self, y: Any) -> Any:
        return self.slots.vector(y, "displacement")

    def _rotation(self, y: Any) -> Any:
        return self.slots.vector(y, "rotation")

    def _hoop(self) -> tuple[Any, list[Any]]:
        """Stretch along the hoop in a body of revolution, and the coefficients after those that give it."""
        if not self.layout.axial:
            return 1.0, self.coefficients
        before, *others = self.coefficients
        return before[0] + before[1] * self._displacement(self.y)[0], others

    def _values(self, y: Any) -> list[Any]:
        return [y[k] for k, slot in enumerate(self.slots.slots) if not slot.axes]

    # code -------------------------------------------------------------------------------------------
    def _terminals(self) -> dict[Any, int]:
        slots, at = {self.y: 0}, self.size
        for c, n in zip(self.coefficients, self.data, strict=True):
            slots[c] = at
            at += n
        return slots

    def _source(self) -> str:
        scalarise, n = Scalariser(self._terminals()), self.size
        zero = scalarise.graph.zero
        nodes, tangent = self._entries(scalarise, self.residual, (n,)), [zero] * n**2
        if not self.tangent.empty():
            tangent = self._entries(scalarise, self.tangent, (n, n))
        if self.symmetric:  # code for one half only
            tangent = [tangent[min(i, j) * n + max(i, j)] for i in range(n) for j in range(n)]
        return write_c(scalarise.graph, {"surface": nodes + tangent})

    def _entries(self, scalarise: Scalariser, form: Any, shape: tuple[int, ...]) -> list[int]:
        scalar = scalarise.scalar(codegen.expand(codegen.integrand(form)))
        return codegen.coefficients(scalar, shape, scalarise.graph.zero)

    def compile(self, comm: MPI.Comm) -> Kernel:
        """Kernel (y, data...) -> residual (size) and tangent (size x size). Collective."""
        order = {c: i for i, c in enumerate(self._terminals())}
        signature = compat.expression_signature(
            codegen.integrand(self.residual), {**order, self.space.domain: 0}
        )
        kind = "surface" if self.symmetric else "surface, unsymmetric"
        key = jit.digest(generator_version(), kind, f"{self.layout}", signature)
        lib = jit.library(key, self._source, comm, few_rows=True)
        return Kernel(lib, "surface", self.size + sum(self.data), self.size + self.size**2)


class DeadTraction(SurfaceForm):
    """A force (N/m^2) and a couple (N/m) that keep their directions: -f . du - m . J_l(w) dw.

    In space couples do work on the spin (`forms.couples.CoupleForm`), which makes the tangent unsymmetric.
    """

    def __init__(self, layout: Layout, couples: bool):
        self.couples = couples
        self.symmetric = not couples or layout.rotations != 3
        super().__init__(layout, layout.dim, *([layout.rotations] if couples else []))

    def virtual_work(self) -> Any:
        force, *couple = self.coefficients
        work = -sum(force[i] * self.test[i] for i in range(self.layout.dim))
        if not self.couples:
            return work
        m = ufl.as_vector([couple[0][i] for i in range(self.layout.rotations)])
        return work - kin.couple_work(m, self._rotation(self.y), self._rotation(self.test))


class FollowerTraction(SurfaceForm):
    """A force (N/m^2) and a couple (N/m) per current area that follow the surface, see
    `kinematics.tensors.convected`.

    Data: F~ row by row, N, the force, and with `couples` the couple; before them, in a body of revolution,
    F~_33 and 1 / R.
    """

    symmetric = False

    def __init__(self, layout: Layout, couples: bool):
        self.couples = couples
        d = layout.dim
        hoop = [2] if layout.axial else []
        super().__init__(layout, *hoop, d * d, d, d, *([layout.rotations] if couples else []))

    def virtual_work(self) -> Any:
        d, (hoop, (before, n, *loads)) = self.layout.dim, self._hoop()
        f = ufl.dot(ufl.Identity(d) + self.slots.derivative(self.y, "displacement"), matrix(before, d, d))
        normal = ufl.as_vector([n[i] for i in range(d)])
        sizes = (d, self.layout.rotations)
        given = [ufl.as_vector([c[i] for i in range(k)]) for c, k in zip(loads, sizes, strict=False)]
        now = [hoop * kin.convected(load, normal, f) for load in given]
        work = -ufl.dot(now[0], self._displacement(self.test))
        if self.couples:
            work -= kin.couple_work(now[1], self._rotation(self.y), self._rotation(self.test))
        return work


class FollowerPressure(SurfaceForm):
    """A pressure p (Pa) on the current surface, p cof(F) N . du with F = (I + G) F~.

    Data: p, F~ row by row, N; before them, in a body of revolution, F~_33 and 1 / R. In plane strain the
    stretch across the plane is one.
    """

    symmetric = False

    def __init__(self, layout: Layout):
        super().__init__(layout, *([2] if layout.axial else []), 1, layout.dim**2, layout.dim)

    def virtual_work(self) -> Any:
        hoop, (p, before, n) = self._hoop()
        d = self.layout.dim
        f = ufl.dot(ufl.Identity(d) + self.slots.derivative(self.y, "displacement"), matrix(before, d, d))
        normal = ufl.as_vector([n[i] for i in range(d)])
        area = ufl.dot(kin.cofactor(f), normal)
        return p[0] * hoop * ufl.dot(area, self._displacement(self.test))


class Penalty(SurfaceForm):
    """Springs towards given values t, with a given force l: the derivative of 1/2 g . P g + l . g with
    g = (u, w) - t.

    Data: P row by row, t, l.
    """

    def __init__(self, layout: Layout):
        b = layout.block
        super().__init__(layout, b * b, b, b)

    def virtual_work(self) -> Any:
        p, t, force = self.coefficients
        b = self.layout.block
        g = [value - t[i] for i, value in enumerate(self._values(self.y))]
        energy = sum(0.5 * g[i] * p[b * i + j] * g[j] for i in range(b) for j in range(b))
        energy += sum(force[i] * g[i] for i in range(b))
        return ufl.derivative(energy, self.y, self.test)
