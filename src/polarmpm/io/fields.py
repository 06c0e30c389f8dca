"""Fields for output by name: what the points know by themselves, and what `forms.stresses.TABLE` computes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from ..bodies.points import Points
from ..errors import InputError
from ..forms.stresses import TABLE as OF_MATERIALS
from ..forms.stresses import MaterialField, check_field
from ..tools import checks
from ..tools.parallel import errors_on_all_ranks
from .paraview import padded

_NOT_IN_XML = re.compile(r"[<>&\"\x00-\x1f]")


@dataclass(frozen=True)
class Field:
    """A field of the points for output.

    Args:
        name: of the field in files.
        function: of `Points`; numbers (np,), vectors (np, d) or tensors (np, 3, 3) of this rank's points.
        unit: of its values.
        plastic: only there when one of the materials can yield.
        moving: only there of bodies in motion, of which a dynamic problem has been made.

    Raises:
        InputError: no name, or not a function of one argument.

    Example:
        >>> pm.Recorder("a.pvd", problem, fields=("stress", pm.Field("J", lambda p: np.linalg.det(p.F))))
    """

    name: str
    function: Callable[[Points], np.ndarray]
    unit: str = ""
    plastic: bool = False
    moving: bool = False

    def __post_init__(self) -> None:
        check_field(self, "a function of the points is", "points")

    def __repr__(self) -> str:
        return f"<Field {self.name!r}{f' in {self.unit}' if self.unit else ''}>"


OF_POINTS: dict[str, Field] = {
    field.name: field
    for field in (
        Field("displacement", lambda p: p.displacement, "m"),
        Field("rotation", lambda p: p.rotation_vector, "rad"),
        Field("F", lambda p: p.F),
        Field("stretch", lambda p: p.stretch),
        Field("wryness", lambda p: p.wryness, "1/m"),
        Field("grad_F", lambda p: p.grad_F, "1/m"),
        Field("volume", lambda p: p.volume, "m^3"),
        Field("unresolved", lambda p: p.unresolved),
        Field("id", lambda p: p.id),
        Field("material", lambda p: p.material),
        Field("hardening", lambda p: p.hardening, plastic=True),
        Field("dissipation", lambda p: p.dissipation, "Pa", plastic=True),
        Field("velocity", lambda p: p.velocity, "m/s", moving=True),
        Field("spin", lambda p: p.spin, "rad/s", moving=True),
    )
}

AnyField = Field | MaterialField


def choose(fields: str | AnyField | Iterable[str | AnyField], points: Points) -> tuple[AnyField, ...]:
    """Fields of a body by their names, in the order given; a user's own as they are.

    Raises:
        InputError: an unknown name, a field of plastic materials where there are none, or a name twice.
    """
    known: dict[str, AnyField] = {**OF_POINTS, **OF_MATERIALS}
    allowed = [
        name
        for name, field in known.items()
        if (points.plastic or not field.plastic)
        and (points.second_gradient or not _second(field))
        and (points.moving or not _of_motion(field))
    ]
    out: list[AnyField] = []
    several = isinstance(fields, Iterable) and not isinstance(fields, str)
    for given in cast("Iterable[str | AnyField]", fields if several else (fields,)):
        if not isinstance(given, str | AnyField):
            raise InputError(f"fields: {given!r} is neither a name nor a Field or MaterialField")
        if isinstance(given, str) and given not in known:
            raise InputError(f"fields: {given!r} is unknown; allowed are {', '.join(allowed)}")
        field = known[given] if isinstance(given, str) else given
        if _NOT_IN_XML.search(checks.text("fields: name", field.name)):
            raise InputError(f"fields: {field.name!r} has signs that ParaView's files can't hold as a name")
        if field.plastic and not points.plastic:
            raise InputError(f"fields: {field.name!r}, but none of the materials is plastic")
        if _second(field) and not points.second_gradient:
            raise InputError(f"fields: {field.name!r}, but none of the materials has second gradients")
        if _of_motion(field) and not points.moving:
            raise InputError(f"fields: {field.name!r}, but no dynamic problem has been made of the body")
        if known.get(field.name, field) is not field:
            raise InputError(f"fields: {field.name!r} is the name of one of the package's fields")
        if field.name in (other.name for other in out):
            raise InputError(f"fields: {field.name!r} is there twice")
        out.append(field)
    return tuple(out)


def _second(field: AnyField) -> bool:
    return field.name == "grad_F" or (isinstance(field, MaterialField) and field.second_gradient)


def _of_motion(field: AnyField) -> bool:
    return isinstance(field, Field) and field.moving


def field_arrays(problem: Any, fields: Sequence[AnyField], pad: bool = True) -> dict[str, np.ndarray]:
    """The local points' values of these fields by name. Collective.

    Args:
        pad: vectors get three components in the plane, too.

    Raises:
        InputError: a user's function doesn't give a row for each point; on every rank.
    """
    computed = [field for field in fields if isinstance(field, MaterialField)]
    found: dict[str, np.ndarray] = dict(problem.fields(*computed)) if computed else {}
    with errors_on_all_ranks(problem.comm):
        for field in fields:
            if isinstance(field, Field):
                found[field.name] = _values(field, problem.points, pad)
    return {field.name: found[field.name] for field in fields}


def field_values(problem: Any, field: str | AnyField) -> np.ndarray:
    """The local points' values of one field of `Recorder`'s, for tables and scripts. Collective.

        pm.Table("a.csv", p=lambda: points.mean(field_values(problem, "mean_pressure"), tip))

    Raises:
        InputError: an unknown name.
    """
    (chosen,) = choose(field, problem.points)
    return field_arrays(problem, (chosen,))[chosen.name]


def _values(field: Field, points: Points, pad: bool) -> np.ndarray:
    with checks.evaluating(f"field {field.name!r}"):
        values = np.asarray(field.function(points))
    if values.dtype.kind not in "biuf":
        raise InputError(f"field {field.name!r}: values of type {values.dtype} are given; numbers are needed")
    if values.shape[:1] != (len(points),):
        raise InputError(
            f"field {field.name!r}: the shape {values.shape} is given; a row for each of the {len(points)} "
            "points is needed"
        )
    if 0 in values.shape[1:]:
        raise InputError(f"field {field.name!r}: the shape {values.shape} has no values")
    return padded(values) if pad and values.ndim == 2 and values.shape[1] == points.dim else values
