"""The weak form at a site in contact with a rigid obstacle: UFL in, compiled residual and tangent out.

The unknown of a site is y = (u, w): the increments of its displacement and of its rotation vector. All forces
are per undeformed area. Places are seen in the obstacle's frame, xi = R^T (x - c) + a, in which it is at
rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..errors import InputError
from ..geometry.shapes import Level, Shape
from ..kernels.kernel import Kernel, compile_expressions, matrix
from ..kinematics import tensors as kin
from ..kinematics.layout import Layout, Part
from ..tools import checks
from .surfaces import SurfaceForm

SITE = (Part("displacement", 0), Part("rotation", 0))
_TINY = 1e-200
CONSTANTS = ("stiffness", "tangential", "friction", "turning", "rolling", "drilling", "distance")


@dataclass(frozen=True)
class Law:
    """What a site's forces are made of.

    Attributes:
        friction, rolling, drilling: whether there is such a resistance.
        barrier: the gap stays positive, else it gives way like a spring.
    """

    friction: bool = False
    rolling: bool = False
    drilling: bool = False
    barrier: bool = False

    @property
    def turning(self) -> bool:
        return self.rolling or self.drilling


class ContactForm(SurfaceForm):
    """Normal force from a potential of the gap; friction and resistance to rolling by return mapping.

    Data: place (m) at y = 0; pose of the obstacle: c, a, R row by row, t, its turn in this step (rad);
    `CONSTANTS`; multiplier (Pa), elastic slip and place xi at the end of the last step (m); elastic turn and
    w then (rad);
    numbers of the shape.

    `distance` is that at which a pressure sets in: of a barrier, or the skin of the surface.
    """

    parts = SITE

    def __init__(self, layout: Layout, shape: Shape, law: Law):
        self.shape, self.law = shape, law
        d, r = layout.dim, layout.rotations
        self.symmetric = not (law.friction or law.turning)
        turn = max(r, 1)
        super().__init__(
            layout,
            *(d, 2 * d + d * d + 1 + turn, len(CONSTANTS), 1 + 2 * d, 2 * turn),
            max(1, len(shape.numbers())),
        )

    # geometry -------------------------------------------------------------------------------------------
    def _pose(self) -> tuple[Any, Any, Any, Any]:
        pose, d = self.coefficients[1], self.layout.dim
        centre, about = (ufl.as_vector([pose[k * d + i] for i in range(d)]) for k in (0, 1))
        return centre, about, matrix(pose, d, d, 2 * d), pose[2 * d + d * d]

    def _gap(self) -> tuple[Any, Any, Any, Any]:
        """Gap (m), its normal and the place in the obstacle's frame, R."""
        d, place = self.layout.dim, self.coefficients[0]
        centre, about, turn, t = self._pose()
        x = ufl.as_vector([place[i] for i in range(d)]) + self._displacement(self.y)
        xi = ufl.variable(ufl.dot(turn.T, x - centre) + about)
        if isinstance(self.shape, Level):
            value = _level(self.shape, xi, t)
            gradient = ufl.diff(value, xi)
            size = ufl.sqrt(ufl.dot(gradient, gradient))
            return value / size, gradient / size, xi, turn
        sign = -1.0 if self.shape.hollow else 1.0
        value = sign * self.shape.distance(xi, self.coefficients[5])
        return value, ufl.diff(value, xi), xi, turn

    # forces ---------------------------------------------------------------------------------------------
    def _normal(self, gap: Any) -> tuple[Any, Any]:
        """Energy per area (J/m^2) and pressure (Pa) of a gap."""
        constants, multiplier = self.coefficients[2], self.coefficients[3][0]
        k = constants[CONSTANTS.index("stiffness")]
        if self.law.barrier:
            most = constants[CONSTANTS.index("distance")]
            near, short = ufl.lt(gap, most), gap - most
            energy = ufl.conditional(near, -k * short**2 * ufl.ln(gap / most), 0.0)
            pressure = ufl.conditional(near, k * (2 * short * ufl.ln(gap / most) + short**2 / gap), 0.0)
            return energy, pressure
        # the skin lets a body that lies on an obstacle feel it from the start
        force = multiplier - k * (gap - constants[CONSTANTS.index("distance")])
        pressure = ufl.conditional(ufl.gt(force, 0.0), force, 0.0)
        return pressure**2 / (2 * k), pressure

    def _friction(self, pressure: Any, normal: Any, xi: Any) -> Any:
        """Traction (Pa) against the slip, in the obstacle's frame."""
        constants, history, d = self.coefficients[2], self.coefficients[3], self.layout.dim
        k, mu = (constants[CONSTANTS.index(name)] for name in ("tangential", "friction"))
        before, last = (ufl.as_vector([history[1 + k * d + i] for i in range(d)]) for k in (0, 1))
        slip = before + xi - last
        trial = k * (slip - ufl.dot(slip, normal) * normal)
        return capped(trial, mu * pressure)

    def _turned(self) -> Any:
        """The obstacle's turn in this step (rad)."""
        pose, d = self.coefficients[1], self.layout.dim
        first = 2 * d + d * d + 1
        return [pose[first + i] for i in range(self.layout.rotations)]

    def _couple(self, pressure: Any, normal: Any) -> Any:
        """Couple traction (N/m) against turns relative to the obstacle."""
        constants, turns, r = self.coefficients[2], self.coefficients[4], self.layout.rotations
        k, rolling, drilling = (constants[CONSTANTS.index(n)] for n in ("turning", "rolling", "drilling"))
        w, turned = self._rotation(self.y), self._turned()
        turn = ufl.as_vector([turns[i] + w[i] - turns[r + i] - turned[i] for i in range(r)])
        if r == 1:
            return capped(k * turn, rolling * pressure)
        about_normal = ufl.dot(turn, normal) * normal
        out = ufl.as_vector([0.0 * pressure] * r)
        if self.law.rolling:
            out = out + capped(k * (turn - about_normal), rolling * pressure)
        if self.law.drilling:
            out = out + capped(k * about_normal, drilling * pressure)
        return out

    def virtual_work(self) -> Any:
        gap, normal, xi, turn = self._gap()
        energy, pressure = self._normal(gap)
        work = ufl.derivative(energy, self.y, self.test)
        if self.law.friction:
            moved = ufl.dot(turn.T, self._displacement(self.test))
            work += ufl.dot(self._friction(pressure, normal, xi), moved)
        if self.law.turning:
            couple = self._couple(pressure, ufl.dot(turn, normal))
            work += kin.couple_work(couple, self._rotation(self.y), self._rotation(self.test))
        return work

    # what is told of a site -----------------------------------------------------------------------------
    @property
    def told(self) -> dict[str, int]:
        """Names and sizes of what `teller` computes."""
        d, r = self.layout.dim, self.layout.rotations
        sizes = {"gap": 1, "pressure": 1, "normal": d, "seen": d, "traction": d, "slip": d}
        return {**sizes, **({"couple": r, "turn": r} if r else {})}

    def teller(self, comm: MPI.Comm) -> Kernel:
        """Kernel (y, data...) -> gap (m), pressure (Pa), normal, place in the obstacle's frame, traction
        on the body (Pa), elastic slip (m), couple traction on it (N/m), elastic turn (rad). Collective."""
        constants, d, r = self.coefficients[2], self.layout.dim, self.layout.rotations
        gap, normal, xi, turn = self._gap()
        _, pressure = self._normal(gap)
        outward, slope = ufl.dot(turn, normal), ufl.dot(turn, ufl.diff(gap, xi))
        friction = ufl.as_vector([0.0 * pressure] * d)
        if self.law.friction:
            friction = self._friction(pressure, normal, xi)
        traction = pressure * slope - ufl.dot(turn, friction)
        slip = friction / constants[CONSTANTS.index("tangential")]
        values = [gap, pressure, outward, xi, traction, slip]
        if r:
            couple = self._couple(pressure, outward) if self.law.turning else 0.0 * self._rotation(self.y)
            values += [-couple, couple / constants[CONSTANTS.index("turning")]]
        terminals: Any = self._terminals()
        inputs = self.size + sum(self.data)
        return compile_expressions(values, terminals, inputs, self.space.domain, comm)


def capped(trial: Any, most: Any) -> Any:
    """A vector, no longer than `most`."""
    length = ufl.sqrt(ufl.dot(trial, trial) + _TINY)
    scale = ufl.conditional(ufl.le(length, most), 1.0, most / length)
    return scale * trial


def _level(shape: Level, xi: Any, t: Any) -> Any:
    """Value of a script's level set.

    Raises:
        InputError: it fails, isn't a scalar, or doesn't depend on the place.
    """
    with checks.evaluating(
        "obstacle: phi", lambda error: "; write it in UFL (ufl.sqrt, ufl.sin), not in NumPy"
    ):
        raw = shape.function(xi, t) if shape.timed else shape.function(xi)
    try:
        value = ufl.as_ufl(raw)
    except Exception as e:
        raise checks.refuse("obstacle: phi", raw, "a UFL scalar has to be returned") from e
    if value.ufl_shape or value.ufl_free_indices:
        raise InputError(f"obstacle: phi returned the shape {value.ufl_shape}; a scalar is needed")
    gradient = ufl.algorithms.apply_derivatives.apply_derivatives(
        ufl.algorithms.apply_algebra_lowering.apply_algebra_lowering(ufl.diff(value, xi))
    )
    if isinstance(gradient, ufl.classes.Zero):
        raise InputError("obstacle: phi doesn't depend on the place x")
    return value


def pose_row(
    centre: np.ndarray, about: np.ndarray, turn: np.ndarray, t: float, turned: np.ndarray
) -> np.ndarray:
    """A row of the form's data about the obstacle's pose."""
    return np.concatenate([centre, about, turn.ravel(), [t], turned])
