"""The table of the values at a point: what stands where in its vector of unknowns and in its state.

The unknowns of a material point are z = (du/dx, w, dw/dx), those of one with second gradients z = (du/dx,
d^2u/dx^2), those of one in a body of revolution z = (du/dx, w, dw/dx, u_r). `POINT`, `SECOND` and `AXIAL`
say so, and all that reads or writes z in Python asks a `Layout`; the sums over points in C ask
`kernels/_layout.h`, which a test holds against it.
Another field, or another derivative, is another part of a table; it takes the weights that supply it.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, NamedTuple, Protocol

import numpy as np
import ufl

from ..kernels.kernel import matrix
from . import tensors as kin


class Kind(Protocol):
    """A material, as far as it decides on the unknowns."""

    @property
    def micropolar(self) -> bool: ...

    @property
    def second_gradient(self) -> bool: ...


class Part(NamedTuple):
    """A field ("displacement", "rotation", or "radial", the displacement along the radius) with order 0, or
    all of its derivatives of an order."""

    field: str
    order: int


class Slot(NamedTuple):
    """A scalar of a part: the component of a field, differentiated along `axes` (none, one, ...)."""

    field: str
    component: int
    axes: tuple[int, ...]


POINT = (Part("displacement", 1), Part("rotation", 0), Part("rotation", 1))  # z of a material point
SECOND = (Part("displacement", 1), Part("displacement", 2))  # z of one with second gradients
AXIAL = (*POINT, Part("radial", 0))  # z of one in a body of revolution, x along the radius
SURFACE = (Part("displacement", 0), Part("rotation", 0), Part("displacement", 1))  # y of a point on a surface
STRESSED_SURFACE = (*SURFACE, Part("rotation", 1))  # where the stresses there are asked for


@dataclasses.dataclass(frozen=True)
class Layout:
    """Sizes and slots of the values at a point, for a space dimension and a number of rotations.

    A part's scalars stand one after the other, component by component, each with all its derivatives.
    """

    dim: int
    rotations: int
    parts: tuple[Part, ...] = dataclasses.field(default=POINT, repr=False)

    @staticmethod
    def of(material: Kind, dim: int, axial: bool = False) -> Layout:
        """Unknowns of the nodes, and first gradients: what all materials of a body share; `axial`: of a body
        of revolution."""
        parts = AXIAL if axial else POINT
        return Layout(dim, (1 if dim == 2 else 3) if material.micropolar else 0, parts)

    @staticmethod
    def of_points(material: Kind, dim: int, axial: bool = False) -> Layout:
        """Unknowns of the material's points."""
        return Layout.of(material, dim, axial).with_second(material.second_gradient)

    def with_second(self, there: bool = True) -> Layout:
        """The same with, or without, second gradients."""
        return Layout(self.dim, self.rotations, SECOND if there else AXIAL if self.axial else POINT)

    @property
    def second(self) -> bool:
        """Whether there are second gradients."""
        return Part("displacement", 2) in self.parts

    @property
    def axial(self) -> bool:
        """Whether the body is one of revolution."""
        return Part("radial", 0) in self.parts

    @property
    def kind(self) -> int:
        """What `kernels/_layout.h` calls `second`."""
        return 1 if self.second else 2 if self.axial else 0

    @property
    def stretched(self) -> int:
        """Along how many axes the body is stretched."""
        return 3 if self.axial else self.dim

    # sizes ----------------------------------------------------------------------------------------
    @property
    def block(self) -> int:
        """Unknowns of a node: displacements, then rotations."""
        return self.dim + self.rotations

    def rows(self, field: str) -> range:
        """A field's components among the unknowns of a node."""
        if field == "radial":
            return range(1)
        return range(self.dim) if field == "displacement" else range(self.dim, self.block)

    def axes(self, order: int) -> list[tuple[int, ...]]:
        """Different derivatives of an order."""
        return list(combinations_with_replacement(range(self.dim), order))

    @cached_property
    def slots(self) -> tuple[Slot, ...]:
        """The table, in the order of z."""
        return tuple(
            Slot(field, component, axes)
            for field, order in self.parts
            for component in range(len(self.rows(field)))
            for axes in self.axes(order)
        )

    @property
    def unknowns(self) -> int:
        """Length of z."""
        return len(self.slots)

    def where(self, field: str, order: int = 0) -> slice:
        """A part's place in z; an empty one of a field that isn't there."""
        return self._places.get((field, order), slice(0, 0))

    @cached_property
    def _places(self) -> dict[tuple[str, int], slice]:
        """Each part's place in z."""
        kinds = [(s.field, len(s.axes)) for s in self.slots]
        return {kind: slice(kinds.index(kind), kinds.index(kind) + kinds.count(kind)) for kind in kinds}

    @cached_property
    def gradients(self) -> list[slice]:
        """The place of each component's gradient."""
        d, starts = self.dim, [k for k, s in enumerate(self.slots) if s.axes == (0,)]
        return [slice(first, first + d) for first in starts]

    @property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """The axes of each second derivative."""
        first, second = np.array(self.axes(2)).T
        return first, second

    # numbers --------------------------------------------------------------------------------------
    def pack(self, *derivatives: np.ndarray) -> np.ndarray:
        """z (n, unknowns) of the nodal unknowns at points: values (n, block), gradients (n, block, d), ..."""
        n, columns = len(derivatives[0]), []
        for field, order in self.parts:
            rows, axes = self.rows(field), np.array(self.axes(order), dtype=int).T
            of_field = derivatives[order][:, rows.start : rows.stop]
            columns.append(of_field[(slice(None), slice(None), *axes)].reshape(n, len(rows) * axes.shape[-1]))
        return np.concatenate(columns, axis=1)

    def part(self, z: np.ndarray, field: str, order: int = 0) -> np.ndarray:
        """A part of z (n, unknowns): values (n, components) or derivatives (n, components, `axes`)."""
        components = len(self.rows(field))
        shape = (components, len(self.axes(order))) if order else (components,)
        return z[:, self.where(field, order)].reshape(len(z), *shape)

    def symmetric(self, second: np.ndarray) -> np.ndarray:
        """Second derivatives (n, d, `axes`) as (n, d, d, d)."""
        i, j = self.pairs
        out = np.empty((len(second), self.dim, self.dim, self.dim))
        out[:, :, i, j] = out[:, :, j, i] = second
        return out

    # UFL ------------------------------------------------------------------------------------------
    def scalars(self, value: Any, gradient: Any) -> list[Any]:
        """z of a function of block size and its gradient."""
        found = []
        for field, component, axes in self.slots:
            row = self.rows(field)[component]
            found.append(gradient[(row, *axes)] if axes else value[row])
        return found

    def vector(self, z: Any, field: str) -> Any:
        """A field's components, as many as there are."""
        at = self.where(field)
        return ufl.as_vector([z[i] for i in range(at.start, at.stop)])

    def value(self, z: Any, field: str) -> Any:
        """A field's vector in space: in plane strain the rotation is about the third axis."""
        v = self.vector(z, field)
        if self.dim == 3:
            return v
        return ufl.as_vector([0, 0, v[0]] if field == "rotation" else [v[0], v[1], 0])

    def derivative(self, z: Any, field: str) -> Any:
        """A field's gradient, as many rows and columns as there are."""
        return matrix(z, len(self.rows(field)), self.dim, self.where(field, 1).start)

    def gradient(self, z: Any, field: str, hoop: Any = None) -> Any:
        """A field's gradient in space, 3 x 3; `hoop`: in a body of revolution, what the displacement along
        the radius is multiplied by."""
        g = self.derivative(z, field)
        if self.dim == 3:
            return g
        if field == "rotation":
            return kin.plane_wryness([g[0, 0], g[0, 1]])
        return kin.plane_gradient(g, z[self.where("radial").start] * hoop if self.axial else 0)

    def second_gradient(self, c: Any, start: int | None = None) -> Any:
        """A displacement's second gradient in space, 3 x 3 x 3, of its different scalars: those of z, or
        those that begin at `start` in another vector."""
        start = self.where("displacement", 2).start if start is None else start
        place = {axes: k for k, axes in enumerate(self.axes(2))}

        def entry(i: int, j: int, k: int) -> Any:
            if max(i, j, k) >= self.dim:
                return 0
            return c[start + i * len(place) + place[min(j, k), max(j, k)]]

        return ufl.as_tensor([[[entry(i, j, k) for k in range(3)] for j in range(3)] for i in range(3)])

    # state ----------------------------------------------------------------------------------------
    def state(self, *, rotated: bool = False) -> StateLayout:
        """What stands where in a point's state."""
        return StateLayout(self, rotated)

    @property
    def in_space(self) -> Layout:
        """The layout in which nothing is left out for a plane, the one of `Points`."""
        return Layout(3, 3 if self.rotations else 0, POINT if self.axial else self.parts)


@dataclasses.dataclass(frozen=True)
class StateLayout:
    """A point's state: its frame, its second gradient, its rotation as a quaternion, its wryness, without
    entries that are known.

    The frame is F~, or V~ = F~ Q~^T with `rotated`, where the rotation needs no slots. In a body of
    revolution the hoop follows the frame: the frame's stretch T_33; T_33 / r~, which times u_r is the
    gradient along the hoop; and with rotations 1 / R of the undeformed radius, and Gamma_13, Gamma_23.
    """

    layout: Layout
    rotated: bool

    @cached_property
    def _sizes(self) -> tuple[int, int, int, int]:
        d, r = self.layout.dim, self.layout.rotations
        second = d * len(self.layout.axes(2)) if self.layout.second else 0
        second += (2 + 3 * r) * self.layout.axial
        return d * d, second, 0 if self.rotated or r == 0 else (4 if d == 3 else 2), r * d

    @property
    def size(self) -> int:
        """Number of scalars."""
        return sum(self._sizes)

    @property
    def at_frame(self) -> slice:
        return slice(0, self._sizes[0])

    @property
    def at_second(self) -> slice:
        first = self._sizes[0]
        return slice(first, first + self._sizes[1])

    @property
    def at_hoop(self) -> slice:
        return self.at_second if self.layout.axial else slice(self.at_frame.stop, self.at_frame.stop)

    @property
    def at_rotation(self) -> slice:
        first = self.at_second.stop
        return slice(first, first + self._sizes[2])

    @property
    def at_wryness(self) -> slice:
        return slice(self.size - self._sizes[3], self.size)

    def frame(self, state: Any) -> Any:
        """3 x 3 tensor, in UFL."""
        frame = matrix(state, self.layout.dim, self.layout.dim, self.at_frame.start)
        if self.layout.dim == 3:
            return frame
        return kin.plane_tensor(frame, state[self.at_hoop.start] if self.layout.axial else 1)

    def hoop(self, state: Any) -> tuple[Any, Any]:
        """T_33 / r~ and 1 / R, in UFL; None where there is no such thing."""
        first, layout = self.at_hoop.start, self.layout
        around = state[first + 2] if layout.axial and layout.rotations else None
        return state[first + 1] if layout.axial else None, around

    def second_gradient(self, state: Any) -> Any:
        """3 x 3 x 3 tensor, in UFL; None without second gradients."""
        return self.layout.second_gradient(state, self.at_second.start) if self.layout.second else None

    def quaternion(self, state: Any) -> list[Any]:
        """Four components, in UFL."""
        at = self.at_rotation
        q = [state[i] for i in range(at.start, at.stop)]
        return q if self.layout.dim == 3 else [q[0], 0, 0, q[1]]

    def wryness(self, state: Any) -> Any:
        """3 x 3 tensor, in UFL."""
        g = matrix(state, self.layout.rotations, self.layout.dim, self.at_wryness.start)
        if self.layout.dim == 3:
            return g
        first, axial = self.at_hoop.start + 3, self.layout.axial
        return kin.plane_wryness([g[0, 0], g[0, 1]], [state[first], state[first + 1]] if axial else (0, 0))

    def scalars(self, frame: Any, wryness: Any) -> list[Any]:
        """A state without a quaternion, of 3 x 3 tensors in UFL; radii are zero, see `put_radii`."""
        d, r = self.layout.dim, self.layout.rotations
        found = [frame[i, j] for i in range(d) for j in range(d)]
        if self.layout.axial:
            zero = ufl.as_ufl(0.0)
            found += [frame[2, 2], zero, *([zero, wryness[0, 2], wryness[1, 2]] if r else [])]
        return found + [wryness[i, j] for i in range(3 - r, 3) for j in range(d)]

    def pack(
        self, frame: np.ndarray, wryness: np.ndarray, q: np.ndarray, grad_F: np.ndarray | None = None
    ) -> np.ndarray:
        """States (n, size) of tensors (n, 3, 3), quaternions (n, 4) and second gradients (n, 3, 3, 3)."""
        d, r, n = self.layout.dim, self.layout.rotations, len(frame)
        parts: list[np.ndarray] = [frame[:, :d, :d].reshape(n, d * d)]
        if self.layout.second:
            assert grad_F is not None
            parts.append(self.pack_second(grad_F))
        if self.layout.axial:
            none = np.zeros(n)
            hoop = [frame[:, 2, 2], none, *([none, wryness[:, 0, 2], wryness[:, 1, 2]] if r else [])]
            parts.append(np.column_stack(hoop))
        if self._sizes[2]:
            parts.append(q if d == 3 else q[:, [0, 3]])
        if r:
            parts.append(wryness[:, 3 - r :, :d].reshape(n, r * d))
        return np.concatenate(parts, axis=1)

    def put_radii(self, state: np.ndarray, radii: np.ndarray | None) -> np.ndarray:
        """Put radii (n, 2) (m) of the undeformed and of the present body into packed states, where they have
        any."""
        if self.layout.axial:
            assert radii is not None
            first = self.at_hoop.start
            state[:, first + 1] = state[:, first] / radii[:, 1]
            if self.layout.rotations:
                state[:, first + 2] = 1.0 / radii[:, 0]
        return state

    def pack_second(self, grad_F: np.ndarray) -> np.ndarray:
        """Different scalars (n, m) of second gradients (n, 3, 3, 3)."""
        d = self.layout.dim
        i, j = self.layout.pairs
        packed: np.ndarray = grad_F[:, :d, i, j].reshape(len(grad_F), d * len(i))
        return packed

    def unpack(self, state: np.ndarray) -> tuple[np.ndarray, ...]:
        """(F, q, Gamma) of states in space (n, size), of classical materials (F,), with second gradients (F,
        H)."""
        n = len(state)
        F = state[:, self.at_frame].reshape(n, 3, 3)
        if self.layout.second:
            return F, self.layout.symmetric(state[:, self.at_second].reshape(n, 3, 6))
        if not self.layout.rotations:
            return (F,)
        return F, state[:, self.at_rotation].copy(), state[:, self.at_wryness].reshape(n, 3, 3)
