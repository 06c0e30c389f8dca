"""The weak form on a mesh, in UFL; dolfinx assembles it.

Unknowns are the nodal increments (Du, Dw) since the last converged state, and that state, F~, Q~ and Gamma~,
lives in quadrature spaces. On a mesh that moves with its nodes d(.)/dx~ F~ = d(.)/dX holds exactly, so that
the updated Lagrangian integrals of T (3.145)-(3.146) are taken over the undeformed mesh and its geometry
never has to be changed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import ufl

from ..bodies.elements import Elements
from ..bodies.facets import Facets
from ..kinematics import tensors as kin
from ..kinematics.layout import Layout
from ..materials.base import Material, parameter_values
from ..tools import compat
from .strains import strains, tangent_work, virtual_work


def point_unknowns(layout: Layout, x: Any) -> list[Any]:
    """The scalars z = (dDu/dX, Dw, dDw/dX) of a function x of block size."""
    return layout.scalars(x, ufl.grad(x))


def _components(f: Any) -> list[Any]:
    return [f[i] for i in range(len(f))] if f.ufl_shape else [f]


class ElementForms:
    """Residual and tangent of a body's energy as compiled forms.

    Attributes:
        x: nodal increments.
        before, correction: what they were before the last correction, and x less that.
        state: of the points, in a quadrature space, in the order of `forms.strains.strains`.
        total: displacement of the last converged state in the space of the unknowns, for surfaces.
        symmetric: the tangent is symmetric.
        held: what holds slopes, by support.
        point_forms: forms of the materials at a point, where compiled loops sum them.
    """

    point_forms: Sequence[Any] = ()
    symmetric = True

    def __init__(self, elements: Elements):
        from dolfinx import fem

        self.elements, self.layout = elements, elements.layout
        self.x, self.total = fem.Function(elements.space), fem.Function(elements.space)
        self.held: dict[Any, Any] = {}
        self.test = ufl.TestFunction(elements.space)
        self.trial = ufl.TrialFunction(elements.space)

    @cached_property
    def before(self) -> Any:
        return self._function()

    @cached_property
    def correction(self) -> Any:
        return self._function()

    def _function(self) -> Any:
        from dolfinx import fem

        return fem.Function(self.elements.space)

    @cached_property
    def state(self) -> Any:
        from dolfinx import fem

        e = self.elements
        return fem.Function(compat.quadrature_space(e.mesh, self.layout.state().size, e.quadrature_degree))

    @cached_property
    def _numbers(self) -> list[Any]:
        from dolfinx import fem

        e = self.elements
        return [fem.Constant(e.mesh, parameter_values(m)) for m in e.points.materials]

    takes_numbers = True  # of materials that change

    def put_materials(self, materials: Sequence[Material]) -> None:
        """Go on with materials of the same forms and other numbers. Local."""
        for constant, material in zip(self._numbers, materials, strict=True):
            constant.value = parameter_values(material)

    @property
    def uncured(self) -> list[Material]:
        """Materials whose stiff scalars aren't projected."""
        return list(self.elements.points.materials)

    # state --------------------------------------------------------------------------------------
    def pack(self) -> None:
        """Write the points' current state into the quadrature function."""
        p = self.elements.points
        layout, radii = self.layout.state(), np.stack([p.X[:, 0], p.x[:, 0]], axis=1)
        self.put_at_points(self.state, layout.put_radii(layout.pack(p.F, p.wryness, p.q), radii))

    def put_at_points(self, function: Any, values: np.ndarray) -> None:
        """Set a quadrature function from values (np, c) at the points."""
        rows = compat.cell_dofs(function.function_space)[self.elements.live].ravel()
        if self.elements.staged:
            function.x.array[:] = 0.0  # of elements that aren't in the body
        function.x.array.reshape(-1, values.shape[1])[rows] = values

    def dissipate(self, share: float) -> None:
        """See `assembly.system.NodalSystem`."""

    def start_elastic(self, on: bool) -> bool:
        """See `assembly.system.NodalSystem`."""
        return False

    def changing(self) -> list[Any]:
        """What a load step changes besides this."""
        return []

    def flow(self, base: np.ndarray) -> None:
        """Put plastic flow into the points' plastic state; there is none here."""

    def update(self, tangent: bool) -> None:
        """Make ready for the assembly at the present unknowns; compiled forms of an energy need nothing."""

    def slopes(self, facets: Facets, columns: Sequence[int]) -> Any:
        """What holds slopes on facets, see `forms.interiorpenalty`."""
        raise NotImplementedError("no slopes without second gradients")

    # forms ----------------------------------------------------------------------------------------
    def _volume_measures(self) -> list[Any]:
        """Volume measure of each material."""
        e = self.elements
        degree = {"quadrature_degree": e.quadrature_degree, "quadrature_rule": "default"}
        if len(e.points.materials) == 1:
            return [ufl.Measure("dx", domain=e.mesh, metadata=degree)]
        dx = ufl.Measure("dx", domain=e.mesh, subdomain_data=e.region_tags(), metadata=degree)
        return [dx(row + 1) for row in range(len(e.points.materials))]

    def _parts(self) -> Iterator[tuple[Material, Any, Any]]:
        """Each material with its parameters and its part of the volume."""
        return zip(self.elements.points.materials, self._numbers, self._volume_measures(), strict=True)

    def _strains(self, material: Material, x: Any) -> tuple[Any, ...]:
        return strains(material, self.layout, point_unknowns(self.layout, x), self.state, rotated=False)

    @cached_property
    def residual_form(self) -> ufl.Form:
        """Virtual work of the stresses, T (3.145)-(3.146)."""
        return sum(
            virtual_work(m, self._strains(m, self.x), self.x, self.test, numbers) * self.elements.turn * dx
            for m, numbers, dx in self._parts()
        )

    @cached_property
    def tangent_form(self) -> ufl.Form:
        """The iterations' tangent, see `forms.strains.tangent_work`; symmetric, being a Hessian."""
        form = 0
        for m, numbers, dx in self._parts():
            at = [self._strains(m, x) for x in (self.x, self.before)]
            unknowns = self.x, self.before, self.correction
            form += tangent_work(m, at, unknowns, (self.test, self.trial), numbers) * self.elements.turn * dx
        return form

    @cached_property
    def residual(self) -> Any:
        return compat.compile_form(self.residual_form)

    @cached_property
    def tangent(self) -> Any:
        return compat.compile_form(self.tangent_form)

    @property
    def residuals(self) -> list[Any]:
        """Compiled forms whose sum is the residual, but for `own_forces`."""
        return [self.residual]

    @property
    def tangents(self) -> list[Any]:
        """Compiled forms whose sum is the tangent, but for `dense`; the first has the whole pattern."""
        return [self.tangent]

    def own_forces(self) -> np.ndarray | None:
        """Internal forces (nodes, block) that aren't those of forms, on this rank. Collective."""
        return None

    def dense(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Local nodes (n,) and parts (n block, n block) of the tangent that isn't that of forms."""
        return iter(())

    def second_gradient(self) -> np.ndarray:
        """H (np, 3, 3, 3) at the quadrature points in the last converged state, zero where the material has
        no second gradients."""
        raise NotImplementedError("no second gradients")

    def face_energy(self) -> float:
        """Energy (J) between elements in the last converged state. Collective."""
        return 0.0

    def held_forces(self, held: Any) -> np.ndarray:
        """Forces (nodes, block) of what holds slopes, on this rank."""
        raise NotImplementedError("no slopes without second gradients")

    @cached_property
    def point_values(self) -> compat.Evaluator:
        """(Du, Dw) and their gradients with respect to X at the quadrature points."""
        gradient = ufl.grad(self.x)
        d, block = self.layout.dim, self.layout.block
        values = [self.x[i] for i in range(block)] + [gradient[i, j] for i in range(block) for j in range(d)]
        return compat.Evaluator(self.elements.mesh, ufl.as_vector(values), self.elements.reference_points)

    def values_at_points(self) -> tuple[np.ndarray, np.ndarray]:
        """(Du, Dw) (n, block) and their gradients by X (n, block, d) at the quadrature points."""
        d, block, n = self.layout.dim, self.layout.block, len(self.elements.points)
        values = self.point_values(self.elements.body.owned_cells).reshape(n, block * (1 + d))
        return values[:, :block], values[:, block:].reshape(n, block, d)

    def load_code(self) -> None:
        """Load compiled code that a step would load otherwise. Collective."""
        _ = self.point_values

    # loads ----------------------------------------------------------------------------------------
    def body_work(self, density: Any) -> Any:
        """Virtual work of forces and couples per reference volume (a quadrature function of block size)."""
        degree = {"quadrature_degree": self.elements.quadrature_degree, "quadrature_rule": "default"}
        dx = ufl.Measure("dx", domain=self.elements.mesh, metadata=degree)
        return self._work([density[i] for i in range(self.layout.block)]) * self.elements.turn * dx

    def _work(self, load: list[Any]) -> Any:
        """f . dv + m . (spin): couples in space do work on the spin J_l(Dw) d(Dw) (docs/theory.md)."""
        d, rows = self.layout.dim, self.layout.rows("rotation")
        work = sum(load[i] * self.test[i] for i in range(d))
        if rows:
            m, w, dw = (ufl.as_vector([f[i] for i in rows]) for f in (load, self.x, self.test))
            work += kin.couple_work(m, w, dw)
        return work

    def traction_work(self, facets: Facets, load: Any, couple: bool, follows: bool) -> Any:
        """Virtual work of a traction or couple traction.

        Args:
            load: function of d or r components per undeformed area; with `follows` per current area, its
                components measured on the undeformed body: the part along the normal follows the normal, the
                part in the surface is convected with it and keeps its size.
        """
        ds, values = self._surface(facets), _components(load)
        if follows:
            normal = ufl.FacetNormal(self.elements.mesh)
            now = kin.convected(ufl.as_vector(values), normal, self._deformation())
            values = [self._hoop() * c for c in _components(now)]
        if couple:
            return self._work([0.0] * self.layout.dim + values) * self.elements.turn * ds
        return sum(f * self.test[i] for i, f in enumerate(values)) * self.elements.turn * ds

    def pressure_work(self, facets: Facets, pressure: Any) -> Any:
        """Virtual work of a pressure (a scalar function) against the current normal."""
        area = ufl.dot(kin.cofactor(self._deformation()), ufl.FacetNormal(self.elements.mesh))
        force = [-pressure * self._hoop() * area[i] for i in range(self.layout.dim)]
        ds = self._surface(facets)
        return sum(f * self.test[i] for i, f in enumerate(force)) * self.elements.turn * ds

    def _surface(self, facets: Facets) -> Any:
        return self.elements.surface_measure(self.elements.live_facets(facets.facets))

    def _hoop(self) -> Any:
        """Stretch along the hoop on surfaces of a body of revolution."""
        if not self.layout.axial:
            return 1.0
        return 1 + (self.total[0] + self.x[0]) / ufl.SpatialCoordinate(self.elements.mesh)[0]

    def _deformation(self) -> Any:
        """F on surfaces, from the total displacement."""
        d = self.layout.dim
        g0, g = ufl.grad(self.total), ufl.grad(self.x)
        gradient = ufl.as_tensor([[g0[i, j] + g[i, j] for j in range(d)] for i in range(d)])
        return ufl.Identity(d) + gradient
