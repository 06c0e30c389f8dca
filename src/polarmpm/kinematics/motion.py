"""How increments move the state of a point on, T 3.4.5, in UFL and compiled.

F = F~ + G, Q = exp(hat(w)) Q~, Gamma = Gamma~ + Q~^T J_r(w) Gw, with G = du/dX = du/dx~ F~ and Gw = dw/dx~ F~
of increments since the last reset. With second gradients, A = I + du/dx~ and H_A = d^2u/dx~^2,

    H_iJK = (H_A)_imn F~_mJ F~_nK + A_im H~_mJK = H~ + h.

In the rotated frame the same holds of V~ = F~ Q~^T and Q~ Gamma~ Q~^T,
with no rotation before and V~ in the place of F~.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from mpi4py import MPI

import numpy as np
import ufl

from ..kernels.kernel import Kernel, PointSpace, compile_expressions
from ..tools import compat
from . import tensors as kin
from .layout import Layout


class State(Protocol):
    """F (n, 3, 3), unit quaternions q (n, 4) and wryness (n, 3, 3) of points; with second gradients H (n,
    3, 3, 3)."""

    x: np.ndarray
    F: np.ndarray
    q: np.ndarray
    wryness: np.ndarray
    grad_F: np.ndarray


class Body(State, Protocol):
    """The same of points that know where they come from, X (n, d)."""

    X: np.ndarray


class Increments(Protocol):
    """At points: value (n, block), gradients (n, d, d) and (n, r, d), second gradients (n, d, d, d) or
    None.
    """

    value: np.ndarray
    gradient: np.ndarray
    rotation_gradient: np.ndarray
    second_gradient: np.ndarray | None


class Increment(NamedTuple):
    """Increments at a point in UFL: G, w and Gw, the latter two None of classical materials, and h, None
    without second gradients.

    plane: the rotation is about the third axis; nothing else of w and Gw is looked at.
    around: 1 / r in the frame of the gradients, of a micropolar body of revolution; else None.
    """

    gradient: Any
    rotation: Any = None
    rotation_gradient: Any = None
    plane: bool = False
    second: Any = None
    around: Any = None

    @staticmethod
    def of(layout: Layout, z: Any, hoop: tuple[Any, Any] = (None, None)) -> Increment:
        """Of a point's unknowns; in a body of revolution `hoop` is 1 / r in the frame of the gradients, for
        the displacement and for the rotation."""
        gradient = layout.gradient(z, "displacement", hoop[0])
        if layout.second:
            return Increment(gradient, second=layout.second_gradient(z))
        if not layout.rotations:
            return Increment(gradient)
        turning = layout.gradient(z, "rotation")
        return Increment(gradient, layout.value(z, "rotation"), turning, layout.dim == 2, around=hoop[1])

    def times(self, frame: Any, curved: Any = None) -> Increment:
        """With gradients times a tensor, such as those by x~ times F~; `curved`: its own gradient, such as
        H~, which second gradients need."""
        turning, second = self.rotation_gradient, self.second
        turning = None if turning is None else ufl.dot(turning, frame)
        if second is not None:
            i, j, k, m, n = ufl.indices(5)
            grown = second[i, m, n] * frame[m, j] * frame[n, k] + self.gradient[i, m] * curved[m, j, k]
            second = ufl.as_tensor(grown, (i, j, k))
        around = None if self.around is None else self.around * frame[2, 2]
        return Increment(ufl.dot(self.gradient, frame), self.rotation, turning, self.plane, second, around)


class Moved(NamedTuple):
    """State of a point in UFL: F, Q as the turn of the increments after a base (None: no rotation), Gamma,
    H (None without second gradients)."""

    F: Any
    turn: Any = None
    base: Any = None
    wryness: Any = None
    grad_F: Any = None

    @property
    def Q(self) -> Any:
        """The microrotation; None of classical materials."""
        return self.turn if self.base is None else ufl.dot(self.turn, self.base)

    @property
    def stretch(self) -> Any:
        """U = Q^T F; F of classical materials."""
        if self.turn is None:
            return self.F
        back = ufl.dot(ufl.transpose(self.turn), self.F)
        return back if self.base is None else ufl.dot(ufl.transpose(self.base), back)


def move(by: Increment, F: Any, base: Any = None, wryness: Any = None, grad_F: Any = None) -> Moved:
    """Move (F~, Q~, Gamma~) on, or (F~, H~); Q~ and Gamma~ are None where there is no rotation, and no
    wryness, before."""
    F = F + by.gradient
    if by.rotation is None:
        return Moved(F, grad_F=None if by.second is None else grad_F + by.second)
    change = by.rotation_gradient
    if by.plane:  # turns about one axis commute with each other, and leave the third row alone
        row = [change[2, j] if wryness is None else wryness[2, j] + change[2, j] for j in range(2)]
        turn = kin.plane_exp_map(by.rotation[2])
        return Moved(F, turn, base, kin.plane_wryness(row, _around_axis(by.around, turn, base, wryness)))
    change = ufl.dot(kin.right_tangent(by.rotation), change)
    if base is not None:
        change = ufl.dot(ufl.transpose(base), change)
    return Moved(F, kin.exp_map(by.rotation), base, change if wryness is None else wryness + change)


def _around_axis(around: Any, turn: Any, base: Any, before: Any) -> Any:
    """Gamma_13 and Gamma_23 of a body of revolution: what the rotation does to the axis, over the radius,
    Gamma e_3 = (e_2 - Q^T e_2) / R (docs/theory.md)."""
    if around is None:
        return (0, 0)
    axis = ufl.as_vector([0, 1, 0])
    change = around * (axis - ufl.dot(ufl.transpose(turn), axis))
    if base is not None:
        change = ufl.dot(ufl.transpose(base), change)
    return [change[i] if before is None else before[i, 2] + change[i] for i in range(2)]


class Motion:
    """Compiled update of points of a layout. Collective.

    Args:
        by_reference: gradients are taken by X, not by x~.
    """

    def __init__(self, layout: Layout, comm: MPI.Comm, *, by_reference: bool = False):
        self.layout, self.by_reference = layout, by_reference
        self._full = layout.in_space.state()
        space = PointSpace(compat.point_domain())
        size, unknowns = self._full.size, layout.unknowns + layout.axial
        self._state, self._z = space.coefficient(size), space.coefficient(unknowns)
        terminals = {self._state: 0, self._z: size}
        self._kernel: Kernel = compile_expressions(
            self._expressions,
            terminals,
            size + unknowns,
            space.domain,
            comm,
            of=("motion", layout, by_reference),
        )

    def _expressions(self) -> list[Any]:
        full, s = self._full, self._state
        F, H, z = full.frame(s), full.second_gradient(s), self._z
        around = z[self.layout.unknowns] if self.layout.axial else None
        by = Increment.of(self.layout, z, (around, around))
        if not self.by_reference:
            by = by.times(F, H)
        if by.second is not None:
            now = move(by, F, grad_F=H)
            pairs = self._full.layout.axes(2)
            return [now.F, ufl.as_vector([now.grad_F[i, j, k] for i in range(3) for j, k in pairs])]
        if by.rotation is None:
            return [move(by, F).F]
        q = full.quaternion(s)
        now = move(by, F, kin.quaternion_tensor(q), full.wryness(s))
        turned = kin.quaternion_product(kin.exp_quaternion(by.rotation), q)
        length = ufl.sqrt(sum(c * c for c in turned))
        return [now.F, ufl.as_vector([c / length for c in turned]), now.wryness]

    def __call__(self, state: tuple[np.ndarray, ...], z: np.ndarray) -> tuple[np.ndarray, ...]:
        """States (F, q, Gamma), of classical materials (F,), moved on by z = (du/dx, w, dw/dx) (n, nz);
        with second gradients (F, different scalars of H), of which come (F, H). In a body of revolution 1 / r
        (1 / R by X) is another column of z."""
        return self._full.unpack(self._kernel(*state, z))

    def move(self, points: Body, before: State, inc: Increments) -> None:
        """Set F, q and wryness, or H, of points to what increments make of an earlier state."""
        gradients = np.concatenate([inc.gradient, inc.rotation_gradient], axis=1)
        if self.layout.second:
            assert inc.second_gradient is not None
            z = self.layout.pack(inc.value, gradients, inc.second_gradient)
            points.F, points.grad_F = self((before.F, self._full.pack_second(before.grad_F)), z)
            return
        z = self.layout.pack(inc.value, gradients)
        if self.layout.axial:
            radius = points.X[:, 0] if self.by_reference else before.x[:, 0]
            z = np.column_stack([z, 1.0 / radius])
        if self.layout.rotations:
            points.F, points.q, points.wryness = self((before.F, before.q, before.wryness), z)
        else:
            (points.F,) = self((before.F,), z)
