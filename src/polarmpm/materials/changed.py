"""Materials with other numbers: what changes during a run without another compiled form."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

from ..errors import InputError
from ..tools import checks
from .base import Material, check_material

_KINDS = ("micropolar", "isotropic", "plastic", "second_gradient", "measure", "stress_prediction")


def numbers_of(material: Material) -> Iterator[str]:
    """Names of the numbers that `with_number` can change: arguments of the material, of its elastic part, or
    a user's own values."""
    if not dataclasses.is_dataclass(material):
        return
    for field in dataclasses.fields(material):
        value = getattr(material, field.name)
        if field.name == "values" and isinstance(value, Mapping):
            yield from value
        elif field.init and isinstance(value, float | int) and not isinstance(value, bool):
            yield field.name
    for _, part in _parts(material):
        yield from numbers_of(part)


def number_of(material: Material, name: str) -> float:
    """The value of such a number."""
    for field in dataclasses.fields(material):  # type: ignore[arg-type]
        value = getattr(material, field.name)
        if field.name == name:
            return float(value)
        if field.name == "values" and isinstance(value, Mapping) and name in value:
            return float(value[name])
    return next(number_of(part, name) for _, part in _parts(material) if name in numbers_of(part))


def _parts(material: Material) -> Iterator[tuple[str, Material]]:
    """Materials that a material is made of, with the arguments' names."""
    for field in dataclasses.fields(material):  # type: ignore[arg-type]
        value = getattr(material, field.name)
        if isinstance(value, Material):
            yield field.name, value


def with_numbers(material: Material, numbers: Mapping[str, float]) -> Material:
    """A material like another one, with other numbers; its checks are made, not its warnings.

    Raises:
        InputError: a number out of range.
    """
    own: dict[str, Any] = {}
    left = dict(numbers)
    for field in dataclasses.fields(material):  # type: ignore[arg-type]
        value = getattr(material, field.name)
        if field.name in left and not isinstance(value, Material):
            own[field.name] = left.pop(field.name)
        elif field.name == "values" and isinstance(value, Mapping):
            mine = {name: left.pop(name) for name in list(left) if name in value}
            if mine:
                own[field.name] = {**value, **mine}
    for name, part in _parts(material):
        mine = {n: left.pop(n) for n in list(left) if n in numbers_of(part)}
        if mine:
            own[name] = with_numbers(part, mine)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made: Material = dataclasses.replace(material, **own)  # type: ignore[type-var]
    return made


def check_form(old: Material, new: Any) -> Material:
    """Raise InputError unless a material has the same compiled form as another one, and differs in numbers
    alone."""
    check_material(new)
    for one, other in ((old, new), (old.elastic_part, new.elastic_part)):
        if type(one) is not type(other):
            raise InputError(_refused(f"{type(other).__name__} in the place of {type(one).__name__}"))
        for name in _KINDS:
            if getattr(one, name) != getattr(other, name):
                raise InputError(_refused(f"{name} = {getattr(other, name)}, it was {getattr(one, name)}"))
    here, there = list(old.parameters()), list(new.parameters())
    if here != there:
        odd = ", ".join(sorted(set(here) ^ set(there)))
        raise InputError(_refused(f"its numbers are others: {odd or 'their order'}"))
    if old.elastic_part.choices() != new.elastic_part.choices() or old.choices() != new.choices():
        raise InputError(_refused("its choices are others"))
    for one, other in zip(_functions(old), _functions(new), strict=True):
        if one is not other and one != other:
            raise InputError(_refused("its functions are others"))
    if old.plastic:
        both: tuple[Any, Any] = old, new
        before, after = ([region.name for region in m.regions] for m in both)
        if before != after:
            raise InputError(
                _refused(f"its yield surface has the regions {', '.join(after)}, it had {', '.join(before)}")
            )
    return new  # type: ignore[no-any-return]


def _refused(what: str) -> str:
    return f"{what}: that is another form of material; only its numbers can change during a run"


def _functions(material: Material) -> list[Any]:
    """Functions of a script's that a material is made of."""
    parts = [material] if material.elastic_part is material else [material, material.elastic_part]
    found = []
    for part in parts:
        names: list[str] = (
            [f.name for f in dataclasses.fields(part)] if dataclasses.is_dataclass(part) else []
        )
        for value in (getattr(part, name) for name in names):
            if callable(value):
                found.append(value)
            elif isinstance(value, Mapping):
                found += [v for v in value.values() if callable(v)]
    return found


def check_name(what: str, material: Material, name: str) -> None:
    """Raise InputError unless a material has a number of this name."""
    known = list(dict.fromkeys(numbers_of(material)))
    if name not in known:
        if not known:
            allowed = f"{type(material).__name__} is no data class; give the changed material as `to`"
        else:
            allowed = f"the numbers of {type(material).__name__} are {', '.join(known)}"
        raise InputError(f"{what}: {name}: {allowed}")


def evaluated(what: str, value: Any, factor: float) -> Any:
    """A value, or that of a function at a load factor."""
    if not callable(value):
        return value
    with checks.evaluating(f"{what} at load factor {factor:g}"):
        return value(factor)
