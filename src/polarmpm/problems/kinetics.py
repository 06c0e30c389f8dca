"""Bodies with inertia: masses and moments of inertia of the points, velocities, momenta, energies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np

from ..bodies.selection import Selection
from ..errors import InputError
from ..geometry.surfaces import Surface
from ..kinematics import rotations
from ..kinematics.moments import moments
from ..kinematics.timesteps import check_rho
from ..terms.absorbing import Absorbing
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from . import gyration
from .base import Problem

Given = float | Sequence[float] | Callable[[np.ndarray], Any]


class WithInertia(Problem):
    """A body whose points have masses and velocities. All methods are collective.

    Attributes:
        rho_inf: by what a step multiplies motions whose period is much shorter than it.
        drag, viscosity: see `Dynamic`.
    """

    def _set_motion(
        self, density: Any, microinertia: Any, rho_inf: float, drag: float, viscosity: float
    ) -> None:
        """Check, and keep, what a user gives."""
        self.rho_inf = rho_inf
        self.drag = checks.number("drag", drag, least=0.0)
        self.viscosity = checks.number("viscosity", viscosity, least=0.0)
        if self.layout.rotations and microinertia is None:
            raise InputError(
                "microinertia = None: of a body with microrotations it is needed, j (m^2) of the moment of "
                "inertia rho j"
            )
        if not self.layout.rotations and microinertia is not None:
            raise checks.refuse("microinertia", microinertia, "the material has no microrotation")
        self._density, self._microinertia = density, microinertia
        self._has_tensors = self.layout.rotations == 3 and gyration.is_tensor(microinertia)
        with errors_on_all_ranks(self.comm):
            self._of_points("density", density, positive=True)
            if microinertia is not None:
                self._gyration_of_points()
        self.points.set_moving()

    @property
    def rho_inf(self) -> float:
        return self._rho_inf

    @rho_inf.setter
    def rho_inf(self, value: float) -> None:
        self._rho_inf = check_rho(value)

    def _of_points(self, name: str, given: Any, *, positive: bool) -> np.ndarray:
        """A number for each local point (np,)."""
        p, materials = self.points, self.points.materials
        if callable(given):
            raw = checks.function(name, given, takes=("positions",))(p.X.copy())
            values = checks.numeric(name, raw, "one number for each position")
            if values.shape not in ((), (len(p),)):
                raise checks.refuse(name, raw, f"one number for each of {len(p)} positions is needed")
            values = np.broadcast_to(values, (len(p),))
        elif isinstance(given, Mapping) or checks.several(given):
            of_material = given.values() if isinstance(given, Mapping) else given
            if isinstance(given, Mapping) and list(given) != list(materials):
                found = [given[m] for m in materials if m in given]
                if len(found) != len(materials) or len(given) != len(materials):
                    raise checks.refuse(name, given, "one number for each of the body's materials")
                of_material = found
            numbers = checks.sequence(name, of_material, len(materials), "numbers, one a material,")
            values = np.array([checks.number(name, v) for v in numbers])[p.material]
        else:
            values = np.full(len(p), checks.number(name, given))
        least = values.min(initial=np.inf)
        if not np.isfinite(values).all() or least < 0.0 or (positive and least == 0.0):
            bad = values[~np.isfinite(values)]
            allowed = "positive numbers" if positive else "numbers that aren't negative"
            raise InputError(f"{name} = {bad[0] if len(bad) else least:g} of a point: {allowed} are allowed")
        return values

    def _masses(self) -> np.ndarray:
        """Masses and moments of inertia of the local points (np, block)."""
        d, r, volume = self.layout.dim, self.layout.rotations, self.points.volume0
        with errors_on_all_ranks(self.comm):
            mass = self._of_points("density", self._density, positive=True) * volume
            turned = mass * np.trace(self._gyration_of_points(), axis1=1, axis2=2) / 3.0 if r else mass
        return np.column_stack([*[mass] * d, *[turned] * r])

    def _gyration_of_points(self) -> np.ndarray:
        """J / rho (np, 3, 3) of the local points in the undeformed body (m^2); local."""
        if self._has_tensors:
            return gyration.of_points("microinertia", self._microinertia, self.points)
        j = self._of_points("microinertia", self._microinertia, positive=False)
        found: np.ndarray = j[:, None, None] * np.eye(3)
        return found

    def _tensors(self) -> np.ndarray:
        """Moments of inertia (kg m^2) of the local points (np, 3, 3), as they are turned now. Collective."""
        mass, turn = self._masses()[:, 0], rotations.to_tensor(self.points.q)
        with errors_on_all_ranks(self.comm):
            turned = turn @ self._gyration_of_points() @ np.swapaxes(turn, 1, 2)
        found: np.ndarray = mass[:, None, None] * turned
        return found

    def _spin_momenta(self) -> np.ndarray:
        """Of the local points' microrotations (np, r) (N m s). Collective."""
        d, r = self.layout.dim, self.layout.rotations
        if self._has_tensors:
            momenta: np.ndarray = np.einsum("nij,nj->ni", self._tensors(), self.points.spin)
            return momenta
        found: np.ndarray = self._masses()[:, d:] * self.points.spin[:, 3 - r :]
        return found

    def inertia(self) -> dict[str, float]:
        """The body's mass (kg) and, with microrotations, the sum of their moments of inertia (kg m^2).
        Collective."""
        mass, d = self._masses(), self.layout.dim
        sums = self.comm.allreduce(np.array([mass[:, 0].sum(), mass[:, d:].sum()]))
        found = {"mass": float(sums[0])}
        return found | (
            {"moment of inertia": float(sums[1]) / self.layout.rotations} if mass.shape[1] > d else {}
        )

    # motion ---------------------------------------------------------------------------------------
    @property
    def time(self) -> float:
        """Time of the last converged state (s)."""
        return self.progress.factor

    @collective("velocity", compare=True)
    def velocity(
        self, where: Selection | None = None, *, v: Given | None = None, spin: Given | None = None
    ) -> None:
        """Give points a velocity, and a spin of their microrotation: before the first step, or later as by a
        blow. The energy that it brings counts as external work.

        Args:
            where: a selection of points; None: all.
            v: (m/s), (d,); or a function of their positions (n, d) now, which gives (n, d).
            spin: (rad/s), one number in plane strain, (3,) in space; or a function of the positions.

        Raises:
            InputError: neither is given, or values of the wrong size; a spin of a body without
                microrotations.
        """
        self._check_outside("velocity")
        self.check_open()
        if v is None and spin is None:
            raise InputError("velocity: neither v nor spin is given")
        if spin is not None and not self.layout.rotations:
            raise checks.refuse("velocity: spin", spin, "the material has no microrotation")
        if where is not None:
            self.points.check(where)
        p, d, r, before = self.points, self.layout.dim, self.layout.rotations, self._kinetic()
        with errors_on_all_ranks(self.comm):
            rows = p.rows(where)
            given = [(v, "v", d, "velocity", slice(0, d)), (spin, "spin", r, "spin", slice(3 - r, 3))]
            made = []
            for value, name, size, field, columns in given:
                if value is not None:
                    new = getattr(p, field).copy()
                    new[rows, columns] = _values(f"velocity: {name}", value, p.x[rows], size)
                    made.append((field, new))
        for field, new in made:
            setattr(p, field, new)
        self.progress.external_work += self._kinetic() - before

    @collective("absorb", compare=True)
    def absorb(
        self, where: Any, *, normal: float | None = None, tangential: float | None = None
    ) -> Absorbing:
        """Let waves leave the body through a surface: dashpots with the impedances of the body beyond it.
        Plane waves at right angles leave wholly, others in part; a rigid motion is slowed down.

        Args:
            where: a `Surface`, or group of facets, of points; of elements what `elements.surface` takes.
            normal, tangential: rho c_p and rho c_s (Pa s/m). Default: of the body's density and moduli,
                sqrt(rho (lam + 2 mu)) and sqrt(rho mu).

        Returns:
            The term, for `release`.

        Raises:
            InputError: not a surface; impedances that are negative, or missing where the body has several
                densities or materials, or moduli of other names.
        """
        self._check_outside("absorb")
        surface = checks.instance(
            "absorb: where", self._surface_of(self._named(where)), Surface, "a Surface is"
        )
        given, found = {"normal": normal, "tangential": tangential}, []
        for name, value in given.items():
            found.append(self._impedance(name) if value is None else checks.number(name, value, least=0.0))
        made = Absorbing(self.surface_name("absorbing boundary"), surface, *found)
        self.add(made)
        return made

    def _impedance(self, name: str) -> float:
        materials = self.points.materials
        moduli = materials[0].moduli("lam", "mu")
        if len(materials) > 1 or not isinstance(self._density, Real) or len(moduli) < 2:
            raise InputError(
                f"absorb: {name} = None: one material with lam and mu, and one density, give an impedance"
            )
        modulus = moduli["mu"] + (moduli["lam"] + moduli["mu"] if name == "normal" else 0.0)
        return math.sqrt(float(self._density) * modulus)

    def _kinetic(self) -> float:
        p, d, r, mass = self.points, self.layout.dim, self.layout.rotations, self._masses()
        twice = np.sum(mass[:, :d] * p.velocity**2)
        if r:
            twice += np.sum(self._spin_momenta() * p.spin[:, 3 - r :])
        return 0.5 * float(self.comm.allreduce(float(twice)))

    @collective("momentum")
    def momentum(self) -> np.ndarray:
        """Linear momentum (N s), (d,)."""
        sums: np.ndarray = np.sum(self._masses()[:, : self.layout.dim] * self.points.velocity, axis=0)
        return np.asarray(self.comm.allreduce(sums))

    @collective("angular_momentum", compare=True)
    def angular_momentum(self, about: Any = None) -> np.ndarray:
        """Angular momentum (N m s) about a point (default: the origin), with that of the microrotations: (1,)
        in the plane, (3,) in space."""
        d, r, p, mass = self.layout.dim, self.layout.rotations, self.points, self._masses()
        point = np.zeros(d) if about is None else checks.vector("about", about, d)
        turning = self._spin_momenta() if r else np.zeros((len(p), 0))
        sums: np.ndarray = moments(p.x - point, mass[:, :d] * p.velocity, turning).sum(axis=0)
        return np.asarray(self.comm.allreduce(sums))

    @collective("energies")
    def energies(self) -> dict[str, float]:
        """As of `QuasiStatic`, with

        - external: also the kinetic energy that `velocity` has given;
        - kinetic: of the points, with that of their microrotations;
        - dissipated: by the stresses at which forces are in balance, within the step;
        - damped: work against drag and viscosity;
        - reset: what resets have let go, the energy in the variation over the points' boxes;
        - residue: also what the method in time damps (`rho_inf` below 1), and its error.
        """
        found, progress = super().energies(), self.progress
        own = {"kinetic": self._kinetic(), "damped": progress.damped_work, "reset": progress.reset_work}
        return {**found, **own, "residue": found["residue"] - sum(own.values())}


def _values(name: str, value: Any, x: np.ndarray, size: int) -> np.ndarray:
    """What a user gives for positions (n, d), as (n, size)."""
    if callable(value):
        value = checks.function(name, value, takes=("positions",))(x.copy())
    found = checks.numeric(name, value, f"{size} number{'s' * (size > 1)}")
    n = len(x)
    if found.shape == (n,) and size == 1:
        found = found[:, None]
    if found.shape not in ((size,), (n, size)) and not (size == 1 and found.shape == ()):
        allowed = f"{size} number{'s' * (size > 1)}, or a function of positions that gives ({n}, {size}),"
        raise checks.refuse(name, value, f"{allowed} needed")
    if not np.isfinite(found).all():
        raise checks.refuse(name, value, "finite numbers are needed")
    return np.broadcast_to(found, (n, size))
