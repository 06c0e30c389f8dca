"""Conditions that are taken away again: at once, or by a load that fades."""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..assembly.system import NodalSystem
from ..assembly.transfer import point_values
from ..conditions.amplitudes import Fade
from ..conditions.loads import HandedOver
from ..conditions.prescribed import Prescribed
from ..conditions.supports import Support
from ..errors import InputError
from ..geometry.nodes import Nodes
from ..kinematics import rotations
from ..solvers.stepping import Restored
from ..terms.base import Term
from ..tools import checks
from ..tools.checks import shown
from ..tools.meetings import collective
from .contact import Contact
from .given import Given
from .observer import Observer
from .reactions import Equilibrium
from .whole import Changing, Undo


def fading(factor: float, over: float | None, until: float | None, what: str = "release") -> Fade | None:
    """How a condition that is released at a load factor fades; None: it is gone at once.

    Raises:
        InputError: both are given, or no time at all. Where the load factor falls, `until` tells the end.
    """
    if over is not None and until is not None:
        raise InputError(f"{what}: over = {shown(over)} and until = {shown(until)}: one of them")
    if over is None and until is None:
        return None
    allowed = "a finite load factor"
    if over is not None:
        end = factor + checks.number(
            f"{what}: over", over, least=0.0, allowed="finite load factors, not negative"
        )
    else:
        end = checks.number(f"{what}: until", until, allowed=allowed)
    if end == factor:
        raise InputError(f"{what}: nothing can fade between the load factors {factor:g} and {end:g}")
    return Fade(factor, end)


def hand_over(
    support: Support,
    still: tuple[Support, ...],
    equilibrium: Equilibrium,
    system: NodalSystem | None,
    fade: Fade,
) -> list[HandedOver]:
    """Dead forces and couples on the points that do what a support did in the last step. Collective.

    Raises:
        InputError: the support, or the state of the nodes, isn't that of the last step any more.
    """
    if system is None or system.nodes is not equilibrium.nodes or equilibrium.points_moved:
        raise InputError(
            f"release: {support.name}: the grid has been reset, or a restart file read, since the last "
            "converged step; release it at once, without over and until, or after another step"
        )
    turned = np.pad(equilibrium.w, ((0, 0), (system.layout.dim, 0)))
    forces = equilibrium.free_residual(support, still)
    return handed_forces(f"{support.name}, released", system, forces, turned, fade)


def handed_forces(
    name: str, system: NodalSystem, forces: np.ndarray, x: np.ndarray, fade: Fade
) -> list[HandedOver]:
    """Dead forces and couples on the points that fade, in the place of forces (nodes, block) on the nodes at
    increments x (nodes, block), of which rotations count. Collective."""
    d, r = system.layout.dim, system.layout.rotations
    values = point_values(system, forces)
    if r == 3:  # a dead couple m at a point does the work J_r(Dw) m
        w = system.at_points(x)[:, d:]
        values[:, d:] = rotations.couples_on_spins(w, values[:, d:])
    out = []
    for couple, part in ((False, values[:, :d]), (True, values[:, d:])):
        if system.comm.allreduce(float(np.abs(part).max(initial=0.0))) > 0.0:
            out.append(HandedOver(name, couple, fade, np.ascontiguousarray(part)))
    return out


def described(condition: Any) -> str:
    """A condition's name, for messages."""
    return str(getattr(condition, "name", shown(condition)))


class Releasable(Contact):
    """Conditions that can be released, and go on after a restart. All methods are collective."""

    restored: Restored | None = None  # of a run that goes on from a restart file
    step_sizes: tuple[str, list[float]] | None = None  # of the last march, see `solvers.stepping.sizes_of`
    _equilibrium: Equilibrium | None = None  # the last converged step
    observers: list[Observer]

    def _changing(self) -> Iterator[Changing]:
        yield from super()._changing()
        if self._equilibrium is not None:
            yield self._equilibrium, None
        for thing in self.observers if isinstance(self.observers, list) else ():
            if isinstance(thing, Observer):
                yield thing, None
        if self.system is not None:
            yield from self.system.changing()

    def _put_back(self, undo: Undo) -> None:
        tried = self.system
        super()._put_back(undo)
        if self.system is not None:
            self.system.put_back()
            self._stale = True  # the solver may have been left in the middle of its work
        for system in {tried, self.system} if self.comm.size == 1 else ():
            if system is not None:
                system.destroy()

    @collective("release", compare=True)
    def release(self, condition: Any, *, over: float | None = None, until: float | None = None) -> None:
        """Take a condition away: a support, load, traction, pressure or term.

        At once: from the next step on it does nothing any more. Or evenly over load factors: a load keeps its
        present value and fades; the reaction of a support, or the springs' forces of a surface, become dead
        forces (and couples) on the body, which fade. After that nothing is left of it; until then `loads` has
        what a support has handed over.

        Args:
            condition: what `fix`, `load`, `body_load`, `traction` or `pressure` has returned, or a term.
            over: load factors over which it fades.
            until: load factor at which it has faded, instead of `over`.

        Raises:
            InputError: not a condition of this problem, or released already; both `over` and `until`, or no
                time at all; a term that can't fade; nothing has been solved yet that could fade.
        """
        self._check_outside("release")
        fade, given = fading(self.progress.factor, over, until), self.given.of(condition)
        if given is None:
            raise InputError(f"release: {described(condition)} is no condition of this problem")
        if not self._can_go(given.condition):
            raise InputError(
                f"release: {given.name} is no condition that can be released; another change puts numbers "
                "back, and another fill points"
            )
        if given.released is not None:
            raise InputError(f"release: {given.name} was released at load factor {given.released:g} already")
        if fade is not None and not self.progress.step:
            raise InputError(
                f"release: {given.name}: before the first load step there is nothing that could fade"
            )

        def let_go() -> None:
            self._let_go(given, fade)
            given.released, given.until = self.progress.factor, None if fade is None else fade.end

        self.whole(let_go)

    def _can_go(self, condition: Any) -> bool:
        """Whether a condition is one that can be released."""
        return True

    def _let_go(self, given: Given, fade: Fade | None) -> None:
        self._stale = True
        for part in getattr(given.condition, "parts", (given.condition,)):
            if isinstance(part, Support):
                if fade is not None:
                    self._take_over(part, fade)
                elif self.progress.step:
                    self._leaving.append(part)
                self._supports = [s for s in self._supports if s is not part]
                self._dismiss(part)
            elif not isinstance(part, Term):
                if fade is None:
                    self._remove_load(part)
                part.amplitude.fade = fade
            elif fade is not None:
                part.fade(fade.begin, fade.end)
                if fade.over:
                    part.end_at(fade.end)
            else:
                if self.progress.step:
                    self._leaving.append(part)
                self._terms = [t for t in self._terms if t is not part]

    def _take_over(self, support: Support, fade: Fade) -> None:
        """Put loads that fade in the place of a support's reaction."""
        if self._equilibrium is None or support not in self._equilibrium.supports:
            raise InputError(f"release: no load step has been solved yet with {support.name}")
        handed = hand_over(support, self.supports, self._equilibrium, self.system, fade)
        self._loads += handed
        self._note_handed(handed, fade.begin)

    @property
    @abstractmethod
    def system(self) -> NodalSystem | None:
        """Nodes, their increments and residual as of the last step; None before the first one."""

    def _left(self, nodes: Nodes) -> np.ndarray:
        """Unknowns (nodes, block) of supports that have been released since the last converged step."""
        left = [s for s in self._leaving if isinstance(s, Support)]
        if not left:
            return np.zeros((len(nodes), self.layout.block), dtype=bool)
        return Prescribed(nodes, left, self.layout, self.comm).touched

    def _note_handed(self, handed: list[HandedOver], factor: float) -> None:
        """The loads of the last converged step include what was handed over then."""

    def _dismiss(self, support: Support) -> None:
        """A support has been released."""

    def _remove_load(self, load: Any) -> None:
        self._loads = [one for one in self._loads if one is not load]

    def _check_fades(self, factor: float) -> None:
        """Raise InputError where a step to a load factor leads away from where a condition has faded."""
        fades = [(f"{given.name}, released,", given.fade) for given in self.given if given.fade is not None]
        for name, fade in [*fades, *((h.name, h.fade) for h in self._handed)]:
            if fade.leaves(self.progress.factor, factor):
                raise InputError(
                    f"{name} fades from load factor {fade.begin:g} to {fade.end:g}: on the way from "
                    f"{self.progress.factor:g} to {factor:g} it would never vanish, but come back. March to "
                    f"{fade.end:g} first, or release it at once, without over and until"
                )

    def _settle(self) -> None:
        """A step has converged."""
        for support in self._supports:
            support.committed = True
        self._leaving = []
        for given in self.given:
            given.faded = given.fade is not None and given.fade.after(self.progress.factor).over
            for part in getattr(given.condition, "parts", ()):
                if part.amplitude.fade is not None:
                    part.amplitude.fade = part.amplitude.fade.after(self.progress.factor)
        gone = [h for h in self._handed if not h.fade.share(self.progress.factor)]
        self._loads = [load for load in self._loads if load not in gone]

    def equilibrium_state(self) -> tuple[dict[str, list[str]], dict[str, np.ndarray]] | None:
        """What reactions and balance of the last converged step need, see `Equilibrium.saved`."""
        return None if self._equilibrium is None else self._equilibrium.saved()

    def restore_equilibrium(self, names: dict[str, list[str]], rows: dict[str, np.ndarray]) -> None:
        """Put in what `equilibrium_state` gave, after `restore`."""
        supports = [g.condition for g in self.given if isinstance(g.condition, Support)]
        self._equilibrium = Equilibrium.read(self.comm, supports, names, rows)

    def condition_state(self) -> dict[str, str]:
        """What a restart file holds of the conditions: which there are, since when, and what was handed
        over."""
        handed = [[h.name, h.couple, h.fade.begin, h.fade.end] for h in self._handed]
        return {"given": self.given.saved(), "handed": json.dumps(handed)}

    def check_conditions(self, state: dict[str, str], fewer: bool = False) -> bool:
        """Whether some of the conditions that `condition_state` told of haven't been given.

        Raises:
            InputError: there are such, and there may not be `fewer`.
        """
        missing = self.given.match(state["given"])[1]
        if missing and not fewer:
            raise InputError(
                f"the saved state has {', '.join(missing)}, which the script hasn't given; it is to give all "
                "conditions again before it reads the file, in the same order, those that it released too "
                "(allow={'conditions'} goes on without them)"
            )
        return bool(missing)

    def terms_after(self, state: dict[str, str]) -> list[Term]:
        """The terms that will be left by `restore_conditions`."""
        known, _ = self.given.match(state["given"])
        let_go = [(g.condition, row["until"]) for g, row in known if row and row["released"] is not None]
        gone = [condition for condition, until in let_go if until is None]
        return [term for term in self._terms if not any(term is one for one in gone)]

    def restore_conditions(self, state: dict[str, str], factor: float) -> None:
        """Go on with conditions as `condition_state` has told; before `restore_terms` and `restore`. New ones
        count from the load factor of the saved state; see `check_conditions`."""
        known, _ = self.given.match(state["given"])
        # what the script has released again: only since the last step it may still be felt
        late = [g.condition for g, row in known if row and row["released"] == factor and row["until"] is None]
        self._leaving = [one for one in self._leaving if any(one is condition for condition in late)]
        empty = np.zeros((0, 0))
        self._loads = [load for load in self._loads if not isinstance(load, HandedOver)]
        self._loads += [
            HandedOver(name, couple, Fade(*ends), empty)
            for name, couple, *ends in json.loads(state.get("handed", "[]"))
        ]
        for given, row in known:
            if row is None:
                given.begun = factor
                self._begin_again(given)
                continue
            if row:
                given.begun, given.counts = row["begun"], row["counts"]
                given.faded = row.get("faded", False)
                self._was_applied(given, row.get("applied"))
                self._begin_again(given, row["met"])
            elif isinstance(given.condition, Support):
                given.condition.committed = True
            if row.get("released") is not None and given.released is None:
                given.released, given.until = row["released"], row["until"]
                self._let_go_again(given, factor)

    def _begin_again(self, given: Given, met: Any = None) -> None:
        condition = given.condition
        if isinstance(condition, Support):
            condition.committed, condition.met = met is not None, met and tuple(met)
            condition.total = condition.total and (met is not None or given.counts == "total")
        elif isinstance(condition, Term):
            condition.begin_at(given.begun, given.counts)
        else:
            for part in condition.parts:
                part.amplitude.begin(given.begun, given.counts)

    def _was_applied(self, given: Given, applied: bool | None) -> None:
        """Put in whether a step had converged with a change, and since when it counts."""

    def _let_go_again(self, given: Given, factor: float) -> None:
        """Release what had been released when the state was saved."""
        assert given.released is not None
        if isinstance(given.condition, Support):
            self._supports = [s for s in self._supports if s is not given.condition]
            self._dismiss(given.condition)
            if (
                given.until is None and given.released == factor
            ):  # since the last step, as far as one can tell
                self._leaving.append(given.condition)
            return
        self._let_go(given, given.fade)
