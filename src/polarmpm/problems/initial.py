"""Stresses that a body has before its first load step."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.carrying import closing
from ..assembly.system import NodalSystem
from ..bodies.points import Points
from ..conditions.ground import K0
from ..errors import InputError
from ..materials.base import Material
from ..terms.base import Piece
from ..terms.nitsche import ConsistentSupport
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from ..tools.timing import Timer
from .changes import Changeable

_PASSES = 12  # means over nearby nodes
_APART = 0.09  # forces out of balance over the loads
_OF_ELEMENTS = 0.4  # the same of elements, whose middle nodes see more of the mean pressures of a cell

Stress = K0 | Callable[[np.ndarray], np.ndarray] | np.ndarray


class Initial(Changeable):
    """Initial stresses. All methods are collective.

    Attributes:
        at_rest: the body had an initial stress before the first load step.
        balanced_at_rest: loads and supports at load factor 0 hold it.
        typical_force: force (N/m^3) that changes it over the size of the body.
    """

    timer: Timer
    at_rest = balanced_at_rest = False
    typical_force = 0.0
    carried_is_found = False  # what elements carry along isn't looked for again
    _initial_energy = 0.0  # J, that the stress has stored

    @collective("initial_stress", compare=True)
    def initial_stress(
        self, stress: Stress, *, overconsolidation: float | None = None, balanced: bool = True
    ) -> None:
        """Give the undeformed body a stress, in equilibrium with the loads at load factor 0.

        The points get an elastic deformation at which their material has this stress; it isn't felt in F, in
        displacements or in the volume. Elastic materials keep it as one that never yields (`Prestressed`).
        The stress needs loads that act from the beginning on: functions of the load factor that aren't zero
        there, such as `body_load(force=ground.force)`. What of it the points can't balance is carried along
        as by a balanced reset, so that nothing moves; if it is more than a small share, the first step
        refuses it. `balanced=False` carries nothing: the first step moves the body into an equilibrium, such
        as below a slope, for which K0 isn't one.

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
            raise InputError(
                f"initial_stress: after {self.progress.step} load step(s); give it before the first"
            )
        if self.points.second_gradient:
            raise InputError("initial_stress: materials with second gradients have none yet")
        consistent = [term.name for term in self.terms if isinstance(term, ConsistentSupport)]
        if consistent:
            raise InputError(
                f"initial_stress: {consistent[0]} takes up the stress of the body behind it, which isn't "
                'known with an initial stress; hold nodes, or the surface with method="penalty"'
            )
        if overconsolidation is not None:
            overconsolidation = checks.number("overconsolidation", overconsolidation, least=1.0)
        balanced = checks.flag("balanced", balanced)
        with errors_on_all_ranks(self.comm):
            self._check_undeformed()
            found = stresses_of(self.points, stress)
        self.whole(lambda: self._put_stress(found, overconsolidation))
        self.at_rest, self.balanced_at_rest = True, balanced

    @collective("zero_displacements")
    def zero_displacements(self) -> None:
        """Let displacements count from the present state on: those of points and nodes, in output and tables,
        and what `counts="total"` of later supports means. Stresses, deformation and rotations stay, and so
        do the values of supports, which go on from where they are.

        Raises:
            InputError: within a load step, or of a closed problem.
        """
        self._check_outside("zero_displacements")
        self.check_open()
        self._count_from_here()
        self._stale = True  # supports know the nodes' motion

    def _count_from_here(self) -> None:
        self.points.counted_from = self.points.x.copy()

    def _check_undeformed(self) -> None:
        if not np.array_equal(self.points.F, np.broadcast_to(np.eye(3), self.points.F.shape)):
            raise InputError("initial_stress: the body is deformed already; it has the stress of that")

    def _put_stress(self, stress: np.ndarray, overconsolidation: float | None) -> None:
        self._stress_points(self.points, stress, overconsolidation)
        self.first_materials = self._settled = self.points.materials
        self._renew_forms()
        self.typical_force, self.carried_is_found = self._typical(stress), False
        stored = self.energy()  # type: ignore[attr-defined]
        self.progress.external_work += stored - self._initial_energy
        self._initial_energy = stored

    def _stress_points(self, p: Points, stress: np.ndarray, overconsolidation: float | None) -> None:
        """Give undeformed points stresses (np, 3, 3). Collective."""
        from ..forms.initialstate import InitialState  # lazy import: most scenes need no plasticity
        from ..materials.prestressed import Prestressed

        p.materials = tuple(m if m.plastic else Prestressed(m) for m in p.materials)
        p.add_state()
        plastic, hardening = p.plastic_F.copy(), p.hardening.copy()
        for row, material in enumerate(p.materials):
            with self.timer("compile"):
                state = InitialState(material, p.dim, self.comm)
            at = np.flatnonzero(p.material == row)
            deformation, lost = state.invert(stress[at])
            none = np.zeros(len(at))
            _refuse(p, at, lost, stress, none, material, "its elastic law doesn't bear it")
            if overconsolidation is not None:
                with errors_on_all_ranks(self.comm):
                    hardening[at] = _hardening(material, stress[at], overconsolidation)
            beyond = state.outside(deformation, hardening[at])
            outside = "it is outside of the yield surface"
            _refuse(p, at, ~(beyond <= 0.0), stress, beyond, material, outside)
            plastic[at] = np.linalg.inv(deformation)
        p.plastic_F, p.hardening = plastic, hardening

    def _typical(self, stress: np.ndarray) -> float:
        """Root of the mean square of stresses (np, 3, 3) over the size of the body. Collective."""
        p = self.points
        ends = np.concatenate([p.X.max(axis=0, initial=-np.inf), -p.X.min(axis=0, initial=np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        sums = np.array([p.volume0 @ np.einsum("nij,nij->n", stress, stress), p.volume0.sum()])
        self.comm.Allreduce(MPI.IN_PLACE, sums)
        size = float((ends[: p.dim] + ends[p.dim :]).max()) or 1.0
        return float(np.sqrt(sums[0] / sums[1])) / size

    @abstractmethod
    def _renew_forms(self) -> None:
        """Make the forms of the points' materials, which have changed. Collective."""


def stresses_of(points: Points, given: Any) -> np.ndarray:
    """Stresses (np, 3, 3) of points. Local."""
    p, d = points, points.dim
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
    even: np.ndarray = 0.5 * (found + np.swapaxes(found, 1, 2))
    return even


def _refuse(
    points: Points,
    rows: np.ndarray,
    bad: np.ndarray,
    stress: np.ndarray,
    by: np.ndarray,
    material: Material,
    why: str,
) -> None:
    """Raise InputError where stresses are bad, naming the worst point. Collective."""
    p, mine = points, (-np.inf, -1, "", 0)
    if np.any(bad):
        k = int(np.flatnonzero(bad)[np.argmax(np.nan_to_num(by[bad], nan=np.inf))])
        at = int(rows[k])
        place = ", ".join(f"{c:.6g}" for c in p.X[at])
        s = stress[at]
        shown = ", ".join(f"{v:.4g}" for v in (s[0, 0], s[1, 1], s[2, 2], s[0, 1], s[1, 2], s[0, 2]))
        text = f"point {p.id[at]} at ({place}) m has (xx, yy, zz, xy, yz, xz) = ({shown}) Pa"
        mine = (float(by[k]), int(p.id[at]), text, int(bad.sum()))
    found = points.comm.allgather(mine)
    count = sum(one[3] for one in found)
    if count:
        worst = max((one for one in found if one[3]), key=lambda one: (one[0], -one[1]))
        kind = type(material.elastic_part if material.never_yields else material).__name__
        raise InputError(f"initial_stress: {worst[2]}: {why} ({kind}); {count} point(s) in all")


def _hardening(material: Any, stress: np.ndarray, ratio: float) -> np.ndarray:
    fitted = getattr(material, "consolidated", None)
    if fitted is None:
        return np.zeros(len(stress))
    found: np.ndarray = fitted(stress, ratio)
    return found


def carried(problem: Any, system: NodalSystem, before: np.ndarray | None) -> np.ndarray | None:
    """Forces (nodes, block) on the nodes of elements that hold an initial stress, as far as the elements
    can't balance it; put into the system. Those of before the first step are found anew. Collective."""
    found = problem.progress.step or problem.carried_is_found
    if problem.at_rest and problem.balanced_at_rest and not found:
        problem._put_loads(system, problem.progress.factor)
        act_from_the_beginning(system.terms.pieces)
        check_equilibrium(problem, system, _OF_ELEMENTS)
        left = system.imbalance()
        before = left + closing(system, left)
    if before is not None:
        system.carried[:] = before
    return before


def act_from_the_beginning(pieces: Iterable[Piece]) -> None:
    """Let an initial stress bear what terms do at load factor 0."""
    for piece in pieces:
        piece.fresh = False


def check_equilibrium(problem: Any, system: NodalSystem, most: float = _APART) -> None:
    """Raise InputError where an initial stress is far from an equilibrium with the loads that are set. What
    the points' places leave out of balance varies from node to node, and is small as a mean over nearby
    nodes. Collective."""
    d, typical = system.layout.dim, problem.typical_force
    left, loads = (_density(system, f[:, :d]) for f in (system.imbalance(), system.loads))
    share = left / max(loads, typical, 1e-300)
    if share > most:
        raise InputError(
            f"initial_stress: it isn't in equilibrium: forces out of balance are {100 * share:.3g} % of the "
            "loads at load factor 0. Loads that hold it have to act from the beginning on: functions of the "
            "load factor, such as body_load(force=ground.force). Or let the first step find the equilibrium, "
            "balanced=False"
        )


def _density(system: NodalSystem, forces: np.ndarray) -> float:
    """Root of the mean square (N/m^3) of what nodal forces (nodes, d) are per volume, as means over nearby
    nodes. Collective."""
    volume, own = system.node_volumes()[:, None], slice(0, system.nodes.owned)
    most = system.comm.allreduce(float(volume[own].max(initial=0.0)), op=MPI.MAX)
    volume, d = np.maximum(volume, 0.2 * most), forces.shape[1]
    weight = system.point_volumes()[:, None]
    block = np.zeros((len(forces), system.layout.block))
    block[:, :d] = forces
    values = np.zeros((len(weight), d))
    for _ in range(_PASSES):
        density = block / volume
        system.nodes.update_ghosts(density)
        values = system.at_points(density)[:, :d]
        block = system.from_points(weight * system.at_points(density))
    sums = np.array([np.sum(weight * values**2), np.sum(weight)])
    system.comm.Allreduce(MPI.IN_PLACE, sums)
    return float(np.sqrt(sums[0] / sums[1]))
