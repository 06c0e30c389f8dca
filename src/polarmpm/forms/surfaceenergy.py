"""The weak form at a point of a surface from a user's energy, or virtual work, per undeformed area."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import ufl

from ..errors import InputError
from ..kernels.kernel import matrix
from ..kinematics.layout import Layout
from .surfaces import SurfaceForm


@dataclass(frozen=True)
class SurfacePoint:
    """What an energy on a surface is a function of, in UFL; d dimensions, r rotations.

    Attributes:
        X: undeformed position (m), (d,).
        normal: of the undeformed surface, outward, (d,).
        u: displacement (m), (d,).
        F: deformation gradient (d, d).
        theta: sum of the increments of the rotation vector (rad), (r,); in the plane the microrotation
            itself.
        u0, F0, theta0: the same when increments began to count.
        variation: of u and theta; None for an energy.
    """

    X: Any
    normal: Any
    u: Any
    F: Any
    theta: Any
    u0: Any
    F0: Any
    theta0: Any
    variation: tuple[Any, Any] | None = None


class SurfaceEnergyForm(SurfaceForm):
    """The derivative of an energy, or a virtual work as it is given.

    Data: X, N, u~, F~ row by row, theta~ (rad; none without rotations), numbers of the function.

    Args:
        function: (point, numbers) -> UFL scalar (J/m^2); the names of `numbers` are attributes.
        conservative: it is an energy; else it is a virtual work, linear in the point's `variation`.
    """

    def __init__(
        self, layout: Layout, function: Callable[..., Any], names: Sequence[str], conservative: bool
    ):
        d, r = layout.dim, layout.rotations
        self._function, self._names, self._energy = function, tuple(names), conservative
        self.symmetric = conservative
        # at least one number: UFL has no vectors of length zero
        super().__init__(layout, d, d, d, d * d, max(r, 1), max(len(names), 1))

    def virtual_work(self) -> Any:
        at = self._point()
        numbers = SimpleNamespace(**{n: self.coefficients[5][k] for k, n in enumerate(self._names)})
        value = ufl.as_ufl(self._function(at, numbers))
        if value.ufl_shape or value.ufl_free_indices:
            raise InputError(
                f"surface term: its function has the shape {value.ufl_shape}; a scalar is needed"
            )
        return ufl.derivative(value, self.y, self.test) if self._energy else value

    def _point(self) -> SurfacePoint:
        d, r = self.layout.dim, self.layout.rotations
        x, n, u0, f0, theta0, _ = self.coefficients
        u0, theta0 = (
            ufl.as_vector([c[i] for i in range(k)]) if k else None for c, k in ((u0, d), (theta0, r))
        )
        before = matrix(f0, d, d)
        now = ufl.dot(ufl.Identity(d) + self.slots.derivative(self.y, "displacement"), before)
        variation = None
        if not self._energy:
            variation = self._displacement(self.test), self._rotation(self.test) if r else None
        return SurfacePoint(
            X=ufl.as_vector([x[i] for i in range(d)]),
            normal=ufl.as_vector([n[i] for i in range(d)]),
            u=u0 + self._displacement(self.y),
            F=now,
            theta=theta0 + self._rotation(self.y) if r else None,
            u0=u0,
            F0=before,
            theta0=theta0,
            variation=variation,
        )
