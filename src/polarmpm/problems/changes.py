"""Materials whose numbers change during a run, as in a reduction of strength.

Numbers of materials are inputs of the compiled kernels: a change compiles nothing. Materials themselves stay
as they are; a load step puts others, with other numbers, in their place.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..conditions.amplitudes import Fade
from ..errors import InputError
from ..materials.base import Material
from ..materials.changed import check_form, check_name, evaluated, number_of, with_numbers
from ..terms.nitsche import ConsistentSupport
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from .given import Given
from .release import Releasable, fading
from .whole import Changing, Undo


@dataclass(eq=False)
class Change:
    """A change of a material, as a script has given it.

    Attributes:
        rows: of the body's materials.
        to: a material, or a function of the load factor; None: numbers change.
        numbers: by name, numbers or functions of the load factor.
        fade: over which load factors numbers change; None: at once, or by functions.
        length: of these, where it was given so.
        applied: a step has converged with it.
    """

    name: str
    rows: tuple[int, ...]
    to: Material | Callable[[float], Material] | None
    numbers: dict[str, Any] = field(default_factory=dict)
    fade: Fade | None = None
    length: float | None = None
    applied: bool = False

    parts = ()  # it is no load

    @property
    def at_once(self) -> bool:
        """It doesn't depend on the load factor."""
        return self.fade is None and not callable(self.to) and not any(map(callable, self.numbers.values()))

    def at(self, factor: float, before: Callable[[float], Material]) -> Material:
        """The changed material at a load factor; `before` gives what it is without this change.

        Raises:
            InputError: a number out of range, or another form of material; the message names the factor.
        """
        old = before(factor)
        try:
            if self.to is not None:
                made = self.to if isinstance(self.to, Material) else evaluated(self.name, self.to, factor)
                if old.never_yields and isinstance(made, Material) and not made.plastic:
                    made = type(old)(made)  # type: ignore[call-arg]
                return check_form(old, made)
            found = {}
            for name, value in self.numbers.items():
                found[name] = checks.number(name, evaluated(f"{self.name}: {name}", value, factor))
                if self.fade is not None:
                    start, left = number_of(before(self.fade.begin), name), self.fade.share(factor)
                    found[name] += left * (start - found[name])
            return check_form(old, with_numbers(old, found))
        except InputError as e:
            if str(e).startswith(self.name):
                raise
            raise InputError(f"{self.name}: at load factor {factor:g}: {e}") from e


class Changeable(Releasable):
    """Materials that change. All methods are collective.

    Attributes:
        first_materials: the body's materials when the problem was made of it.
    """

    first_materials: tuple[Material, ...]
    _settled: tuple[Material, ...]  # of the last converged state

    def _note_materials(self) -> None:
        self.first_materials = self._settled = self.points.materials

    @collective("change", compare=True)
    def change(
        self,
        material: Material,
        to: Material | Callable[[float], Material] | None = None,
        *,
        over: float | None = None,
        until: float | None = None,
        **numbers: Any,
    ) -> Change:
        """Let a material of the body have other numbers from the next step on; nothing is compiled.

        Numbers (c, phi, k, mu ... as the material's own arguments are called, or its elastic part's) are what
        they change to: at once, or evenly over load factors from their present values. Functions of the load
        factor give them at every step:

            problem.change(soil, c=lambda factor: 5e3 / factor)

        The stresses follow: what is beyond the yield surface then, or has another stiffness, is out of
        balance and moves in that step. The energy that a change of elastic or hardening numbers gives or
        takes is in `energies()["residue"]`.

        Args:
            material: as it was given to the body; all its points.
            to: instead of numbers a material with the same form, or a function of the load factor that
                returns such; it replaces what earlier changes have done.
            over, until: load factors over which, or until which, numbers change.

        Raises:
            InputError: not a material of the body; neither `to` nor numbers; unknown names; a number that is
                out of range, now or at the load factor of a step; another class or form of material; `over`
                or `until` with `to` or with functions.
        """
        self._check_outside("change")
        self.check_open()
        label = f"change {self.given.next('change')} ({type(material).__name__})"
        self._check_change(label)
        rows = _rows(material, self.first_materials) or _rows(material, self.points.materials)
        if not rows:
            raise InputError(f"{label}: material = {checks.shown(material)} is none of the body's")
        if (to is None) == (not numbers):
            raise InputError(f"{label}: give either numbers, such as c=..., or `to`")
        fade = fading(self.progress.factor, over, until, "change")
        if fade is not None and (to is not None or any(map(callable, numbers.values()))):
            raise InputError(f"{label}: over and until go with numbers; a function knows its load factors")
        made = Change(label, rows, to, numbers, fade, over)
        with errors_on_all_ranks(self.comm):
            for name in numbers:
                for row in rows:
                    check_name(label, self.first_materials[row], name)
            now = self.progress.factor if self.progress.step else 1.0  # as functions are asked at first
            self._materials_at(fade.end if fade else now, [*self._changes, made])
        self.given.add(Given(label, made, self.progress.factor), "change")
        return made

    @property
    def _changes(self) -> list[Change]:
        return [g.condition for g in self.given if isinstance(g.condition, Change)]

    def _materials_at(self, factor: float, changes: Sequence[Change]) -> tuple[Material, ...]:
        """The materials at a load factor. Local."""
        made = list(self.first_materials)
        for row in {row for change in changes for row in change.rows}:
            at: Callable[[float], Material] = _always(made[row])
            for change in changes:
                if row in change.rows:
                    at = _followed(change, at)
            made[row] = at(factor)
        return tuple(made)

    def _change_materials(self, factor: float) -> None:
        """Let the body have its materials at a load factor. Collective."""
        if self._changes:
            with errors_on_all_ranks(self.comm):
                materials = self._materials_at(factor, self._changes)
            self._use_materials(materials)

    def _check_fades(self, factor: float) -> None:
        super()._check_fades(factor)
        for change in self._changes:
            if change.fade is not None and change.fade.leaves(self.progress.factor, factor):
                raise InputError(
                    f"{change.name} is made from load factor {change.fade.begin:g} to {change.fade.end:g}: "
                    f"the way from {self.progress.factor:g} to {factor:g} leads away from there. March to "
                    f"{change.fade.end:g} first, or give a function of the load factor"
                )

    def _settle_materials(self, converged: bool) -> None:
        """A step has converged with the present materials, or hasn't, and they are those of before."""
        if converged:
            self._settled = self.points.materials
            for given in self.given:
                if isinstance(change := given.condition, Change):
                    change.applied = True
                    if change.fade is not None:
                        change.fade = change.fade.after(self.progress.factor)
                        given.faded = change.fade.over
        else:
            self._use_materials(self._settled)

    def _use_materials(self, materials: Sequence[Material]) -> None:
        """Put in materials of the same forms. Local."""
        now = self.points.materials
        if len(now) != len(materials):
            return  # `_prepare` says that others have joined
        if self._changes and any(a is not b for a, b in zip(now, materials, strict=True)):
            self.points.materials = tuple(materials)
            self._put_numbers()

    def _put_numbers(self) -> None:
        """Let terms, forms and kernels have the numbers of the points' materials. Local."""
        for term in self._terms:
            if isinstance(term, ConsistentSupport):
                term.take(self.points.materials)
        self._put_into_forms()

    @abstractmethod
    def _put_into_forms(self) -> None:
        """Let forms and kernels have them. Local."""

    def _check_change(self, name: str) -> None:
        """Raise InputError where no material can change."""

    def _changing(self) -> Iterator[Changing]:
        yield from super()._changing()
        for change in self._changes:
            yield change, None

    def _put_back(self, undo: Undo) -> None:
        super()._put_back(undo)
        if self._changes:
            self._put_numbers()

    def _check_changes_at_once(self) -> None:
        """Raise InputError where a material changes with the load factor, which that method finds."""
        for change in self._changes:
            if not change.at_once:
                raise InputError(f"{change.name}: the arc-length method takes changes at once only")

    def _can_go(self, condition: Any) -> bool:
        return not isinstance(condition, Change)

    def _was_applied(self, given: Given, applied: bool | None) -> None:
        change = given.condition
        if isinstance(change, Change):
            change.applied = bool(applied)
            if change.fade is not None:
                end = change.fade.end if change.length is None else given.begun + change.length
                change.fade = Fade(given.begun, end, given.faded)

    def restore_conditions(self, state: dict[str, str], factor: float) -> None:
        super().restore_conditions(state, factor)
        if self._changes:
            with errors_on_all_ranks(self.comm):
                made = self._materials_at(factor, [c for c in self._changes if c.applied])
            self._use_materials(made)
        self._settled = self.points.materials


def _rows(material: Any, materials: Sequence[Material]) -> tuple[int, ...]:
    """Rows of materials that are this one, or equal to it."""

    def same(one: Material) -> bool:
        given = one.elastic_part if one.never_yields else one  # with an initial stress
        try:
            return material in (one, given) if type(material) is type(given) else one is material
        except Exception:  # a user's class may compare arrays
            return False

    return tuple(row for row, one in enumerate(materials) if same(one))


def _always(material: Material) -> Callable[[float], Material]:
    return lambda factor: material


def _followed(change: Change, before: Callable[[float], Material]) -> Callable[[float], Material]:
    return lambda factor: change.at(factor, before)
