"""Stresses that a body has before its first load step."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np

from ..conditions.ground import K0
from ..errors import InputError
from ..materials.base import Material
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from .changes import Changeable

_APART = 0.2  # forces out of balance over all of them

Stress = K0 | Callable[[np.ndarray], np.ndarray] | np.ndarray


class Initial(Changeable):
    """Initial stresses. All methods are collective.

    Attributes:
        at_rest: the body had an initial stress before the first load step: the loads and supports of load
            factor 0 hold it.
    """

    at_rest = False
    _initial_energy = 0.0  # J, that the stress has stored

    @collective("initial_stress", compare=True)
    def initial_stress(self, stress: Stress, *, overconsolidation: float | None = None) -> None:
        """Give the undeformed body a stress, in equilibrium with the loads at load factor 0.

        The points get an elastic deformation at which their material has this stress; it isn't felt in F, in
        displacements or in the volume. Elastic materials keep it as one that never yields (`Prestressed`).
        The stress needs loads that act from the beginning on: functions of the load factor that aren't zero
        there, such as `body_load(force=ground.force)`. What of it the points can't balance is carried along
        as by a balanced reset, so that nothing moves; if it is more than a small share, the first step
        refuses it.

        Before the first load step, and before `load_restart`, which puts the saved state in its place.

        Args:
            stress: Cauchy stress (Pa), tension positive: `pm.K0(...)`, a function of initial positions (n, d)
                that returns (n, 3, 3), an array (3, 3) or (np, 3, 3) of the local points. In plane strain
                with the stress across the plane.
            overconsolidation: of `CamClay`: the pressure of consolidation over that of the ellipse through
                the stress, >= 1; sets the points' hardening. Default: the material's own p_c.

        Raises:
            InputError: not such stresses; asymmetric ones; out of the plane; beyond the yield surface, or one
                that the elastic law doesn't bear: the worst point is named; after the first step, or of a
                body that is deformed; materials with second gradients.
        """
        self._check_outside("initial_stress")
        self.check_open()
        if self.progress.step:
            raise InputError(f"initial_stress: after {self.progress.step} load step(s); give it before the first")
        if self.points.second_gradient:
            raise InputError("initial_stress: materials with second gradients have none yet")
        if overconsolidation is not None:
            overconsolidation = checks.number("overconsolidation", overconsolidation, least=1.0)
        with errors_on_all_ranks(self.comm):
            self._check_undeformed()
            found = self._stresses(stress)
        self.whole(lambda: self._put_stress(found, overconsolidation))

    def _check_undeformed(self) -> None:
        if not np.array_equal(self.points.F, np.broadcast_to(np.eye(3), self.points.F.shape)):
            raise InputError("initial_stress: the body is deformed already; it has the stress of that")

    def _stresses(self, given: Any) -> np.ndarray:
        """Stresses (np, 3, 3) of the local points. Local."""
        p, d = self.points, self.points.dim
        if isinstance(given, K0):
            given = given.stress
        if callable(given):
            with checks.evaluating("initial_stress: stress"):
                given = given(p.X.copy())
        allowed = "stresses (3, 3), or one for each of the local points"
        found = checks.numeric("initial_stress: stress", given, allowed)
        if found.shape not in ((3, 3), (len(p), 3, 3)):
            raise InputError(f"initial_stress: stress of shape {found.shape}: {allowed}, are needed")
        found = np.array(np.broadcast_to(found, (len(p), 3, 3)), dtype=float)
        if not np.isfinite(found).all():
            raise InputError("initial_stress: stresses that aren't finite")
        size = np.abs(found).max(initial=0.0)
        if np.abs(found - np.swapaxes(found, 1, 2)).max(initial=0.0) > 1e-9 * size:
            raise InputError("initial_stress: stresses that aren't symmetric; couple stresses need a wryness")
        if d == 2 and np.abs(found[:, 2, :2]).max(initial=0.0) > 1e-9 * size:
            raise InputError("initial_stress: shear stresses out of the plane, which plane strain doesn't have")
        return 0.5 * (found + np.swapaxes(found, 1, 2))

    def _put_stress(self, stress: np.ndarray, overconsolidation: float | None) -> None:
        from ..forms.initialstate import InitialState  # lazy import: most scenes need no plasticity
        from ..materials.prestressed import Prestressed

        p = self.points
        p.materials = tuple(m if m.plastic else Prestressed(m) for m in p.materials)
        self.first_materials = self._settled = p.materials
        p.add_state()
        plastic, hardening = p.plastic_F.copy(), p.hardening.copy()
        for row, material in enumerate(p.materials):
            with self.timer("compile"):
                state = InitialState(material, p.dim, self.comm)
            at = np.flatnonzero(p.material == row)
            deformation, lost = state.invert(stress[at])
            self._refuse(at, lost, stress, np.zeros(len(at)), material, "its elastic law doesn't bear it")
            if overconsolidation is not None:
                with errors_on_all_ranks(self.comm):
                    hardening[at] = _hardening(material, stress[at], overconsolidation)
            beyond = state.outside(deformation, hardening[at])
            what = "it is outside of the yield surface"
            self._refuse(at, ~(beyond <= 0.0), stress, beyond, material, what)
            plastic[at] = np.linalg.inv(deformation)
        p.plastic_F, p.hardening = plastic, hardening
        self._renew_forms()
        self.at_rest = True
        stored = self.energy()  # type: ignore[attr-defined]
        self.progress.external_work += stored - self._initial_energy
        self._initial_energy = stored

    def _refuse(
        self, rows: np.ndarray, bad: np.ndarray, stress: np.ndarray, by: np.ndarray, material: Material, why: str
    ) -> None:
        """Raise InputError where stresses are bad, naming the worst point. Collective."""
        p, mine = self.points, (-np.inf, -1, "", 0)
        if np.any(bad):
            k = int(np.flatnonzero(bad)[np.argmax(np.nan_to_num(by[bad], nan=np.inf))])
            at = int(rows[k])
            place = ", ".join(f"{c:.6g}" for c in p.X[at])
            s = stress[at]
            shown = ", ".join(f"{v:.4g}" for v in (s[0, 0], s[1, 1], s[2, 2], s[0, 1], s[1, 2], s[0, 2]))
            text = f"point {p.id[at]} at ({place}) m has (xx, yy, zz, xy, yz, xz) = ({shown}) Pa"
            mine = (float(by[k]), int(p.id[at]), text, int(bad.sum()))
        found = self.comm.allgather(mine)
        count = sum(one[3] for one in found)
        if count:
            worst = max((one for one in found if one[3]), key=lambda one: (one[0], -one[1]))
            kind = type(material.elastic_part if not material.yields else material).__name__
            raise InputError(f"initial_stress: {worst[2]}: {why} ({kind}); {count} point(s) in all")

    @abstractmethod
    def _renew_forms(self) -> None:
        """Make the forms of the points' materials, which have changed. Collective."""


def _hardening(material: Any, stress: np.ndarray, ratio: float) -> np.ndarray:
    fitted = getattr(material, "consolidated", None)
    if fitted is None:
        return np.zeros(len(stress))
    found: np.ndarray = fitted(stress, ratio)
    return found


def check_equilibrium(system: Any) -> None:
    """Raise InputError where an initial stress is far from an equilibrium with the loads that are set; what
    the points' places leave of it is a small share. Collective."""
    left, forces = system.imbalance(), system.assemble(False).forces
    own, scale = slice(0, system.nodes.owned), system.as_force
    sums = np.array([np.sum((f[own] * scale) ** 2) for f in (left, forces, system.loads)])
    system.comm.Allreduce(MPI.IN_PLACE, sums)
    share = float(np.sqrt(sums[0] / max(sums[1] + sums[2], 1e-300)))
    if share > _APART:
        raise InputError(
            f"initial_stress: it isn't in equilibrium: {100 * share:.3g} % of the nodes' forces at load "
            "factor 0 are out of balance. Loads that hold it have to act from the beginning on: functions of "
            "the load factor, such as body_load(force=ground.force)"
        )
