"""The numbers of a field that a picture shows, and what they are called."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..forms.stresses import TABLE as OF_MATERIALS
from ..forms.stresses import MaterialField
from ..io.fields import OF_POINTS, Field, choose, field_values
from ..io.naming import component_names
from ..problems.base import Problem
from ..problems.elements import QuasiStaticFEM
from ..tools import checks
from ..tools.rows import flat

_NODAL = ("displacement", "rotation")


@dataclass(frozen=True)
class Shown:
    """What is shown of a field.

    Args:
        field: its name, a field of your own, or None.
        component: by its name; None: the size of a vector or tensor.
    """

    field: Any
    component: str | None

    def of(self, problem: Any) -> tuple[np.ndarray | None, str]:
        """Numbers of this rank, and where they are: at "nodes" or "points". Collective.

        Raises:
            InputError: an unknown field or component; on every rank alike.
        """
        if self.field is None:
            if self.component is not None:
                raise checks.refuse("component", self.component, "there is no field that has one")
            return None, "points"
        nodal = isinstance(problem, QuasiStaticFEM) and self.field in _NODAL
        if nodal:
            elements = problem.elements
            values = elements.displacement if self.field == "displacement" else elements.rotation_vector
        else:
            (chosen,) = choose(self.field, problem.points)
            values = field_values(problem, chosen)
        return self._component(values), "nodes" if nodal else "points"

    def _component(self, values: np.ndarray) -> np.ndarray:
        names = component_names(self.name, values.shape[1:])
        rows = flat(values.astype(float))
        if self.component is None:
            return rows[:, 0] if len(names) == 1 else np.linalg.norm(rows, axis=1)
        if self.component not in names or names == [""]:
            allowed = f"of {self.name!r}: {', '.join(names)}" if names != [""] else f"{self.name!r} has none"
            raise checks.refuse("component", self.component, allowed)
        found: np.ndarray = rows[:, names.index(self.component)]
        return found

    @property
    def name(self) -> str:
        return self.field if isinstance(self.field, str) else str(self.field.name)

    @property
    def label(self) -> str | None:
        """With its unit, for a colour bar; None without a field."""
        if self.field is None:
            return None
        known: dict[str, Field | MaterialField] = {**OF_POINTS, **OF_MATERIALS}
        field = known.get(self.field) if isinstance(self.field, str) else self.field
        plain = self.name.replace("_", " ").replace("mises", "Mises")
        words = f"{plain} {self.component}" if self.component else plain
        unit = "" if field is None else field.unit.replace("^2", "²").replace("^3", "³")
        return f"{words} ({unit})" if unit else words


def check_problem(problem: Any) -> Problem:
    return checks.instance("problem", problem, Problem, "a problem, such as a QuasiStatic, is")


def shown(field: Any, component: Any) -> Shown:
    """Raise InputError unless a field, or None, and the name of a component, or None, are given."""
    if component is not None:
        checks.text(
            "component", component, 'the name of a component, such as "x" or "xy", or None, is needed'
        )
    if field is not None and not isinstance(field, str | Field | MaterialField):
        raise InputError(f"field: {checks.shown(field)} is neither a name nor a Field or MaterialField")
    return Shown(field, component)
