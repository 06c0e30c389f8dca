"""Forms whose integrands are given as numbers at quadrature points.

The virtual work at a point is s . z(test), its derivative z(test) . A z(trial), with z = (du/dx, w, dw/dx) as
in `forms.points`. s and A are computed elsewhere and put into quadrature functions; dolfinx assembles them.
"""

from __future__ import annotations

from typing import Any

import ufl

from ..kinematics.layout import Layout
from ..tools import compat
from .elements import point_unknowns


def tangent_size(layout: Layout, symmetric: bool) -> int:
    """Numbers in A at a point: all rows, or the rows of its upper triangle."""
    n = layout.unknowns
    return n * (n + 1) // 2 if symmetric else n * n


class QuadratureForms:
    """Linear and bilinear form of s and A at the quadrature points of a mesh.

    Args:
        space: of the unknowns, (u, w) at each node.
        degree: of the quadrature rule.
        symmetric: A is symmetric and its upper triangle is stored.
        turn: of a body of revolution, length of a turn, see `Elements.turn`.

    Attributes:
        residual_values: s, a quadrature function of `layout.unknowns` components.
        tangent_values: A row by row, a quadrature function of `tangent_size` components.
        residual, tangent: the compiled forms.
    """

    def __init__(self, space: Any, layout: Layout, degree: int, symmetric: bool, turn: Any = 1):
        from dolfinx import fem

        mesh, n = space.mesh, layout.unknowns
        self.residual_values = fem.Function(compat.quadrature_space(mesh, n, degree))
        size = tangent_size(layout, symmetric)
        self.tangent_values = fem.Function(compat.quadrature_space(mesh, size, degree))
        dx = ufl.Measure(
            "dx", domain=mesh, metadata={"quadrature_degree": degree, "quadrature_rule": "default"}
        )
        test = point_unknowns(layout, ufl.TestFunction(space))
        trial = point_unknowns(layout, ufl.TrialFunction(space))
        s, a = self.residual_values, self.tangent_values

        def entry(i: int, j: int) -> Any:
            if not symmetric:
                return a[n * i + j]
            i, j = min(i, j), max(i, j)
            return a[n * i - i * (i + 1) // 2 + j]

        # one product with the trial function a column: FFCx then finds the product A z in two cheap steps
        columns = [sum(entry(i, j) * test[i] for i in range(n)) for j in range(n)]
        self.residual = compat.compile_form(sum(s[i] * test[i] for i in range(n)) * turn * dx)
        # hundreds of sums in one loop: GCC takes minutes over them with -O2, for code that is no faster
        self.tangent = compat.compile_form(sum(columns[j] * trial[j] for j in range(n)) * turn * dx, "-O1")
