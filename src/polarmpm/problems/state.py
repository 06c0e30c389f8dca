"""How far a run has come, and the fields of its state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..bodies.points import Points
from ..errors import InputError
from ..forms.stresses import MECHANICAL, TABLE, FieldForm, MaterialField
from ..kernels.kernel import Kernel
from ..materials.base import parameter_values
from ..tools.checks import shown
from ..tools.parallel import errors_on_all_ranks


@dataclass
class Progress:
    """How far a run has come.

    Attributes:
        factor: load factor of the last converged state.
        step: number of converged steps.
        since_reset: converged steps since the last reset.
        reset_factor, rotation_factor: load factor at the last reset and rotation base.
        reset_due: the grid is to be reset before the next step.
        factor_change: of the last step.
        external_work, carried_work, ghost_work, patch_work, term_work, damped_work, reset_work: work (J) so
            far, see `Problem.energies`.
        box_solutions: see `BoxTangent`.
    """

    factor: float = 0.0
    step: int = 0
    since_reset: int = 0
    reset_factor: float = 0.0
    rotation_factor: float = 0.0
    reset_due: bool = True
    factor_change: float = 0.0
    external_work: float = 0.0
    carried_work: float = 0.0
    ghost_work: float = 0.0
    patch_work: float = 0.0
    term_work: float = 0.0
    damped_work: float = 0.0
    reset_work: float = 0.0
    box_solutions: int = 0


class Fields(Mapping[str, np.ndarray]):
    """Fields of the current state at the local points, by name: `fields["p"]` and `fields.p` are the same."""

    def __init__(self, values: dict[str, np.ndarray]):
        self._values = values

    def __getattr__(self, name: str) -> np.ndarray:
        values = self.__dict__.get("_values", {})  # none yet while it is unpickled
        if name not in values:
            raise AttributeError(f"{name}: fields() was asked for {', '.join(values)}")
        found: np.ndarray = values[name]
        return found

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._values:
            raise KeyError(f"{name}: fields() was asked for {', '.join(self._values)}")
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"Fields({', '.join(f'{name} {a.shape}' for name, a in self._values.items())})"

    @property
    def energy(self) -> np.ndarray:
        """Strain energy per reference volume (Pa), (np,)."""
        return self["energy"]

    @property
    def stress(self) -> np.ndarray:
        """Cauchy stress (Pa), (np, 3, 3)."""
        return self["stress"]

    @property
    def couple_stress(self) -> np.ndarray:
        """Cauchy couple stress (N/m), (np, 3, 3)."""
        return self["couple_stress"]

    @property
    def double_stress(self) -> np.ndarray:
        """Cauchy double stress (N/m), (np, 3, 3, 3), of bodies with second-gradient materials."""
        return self["double_stress"]


def check_rows(name: Any, rows: Any, count: int) -> None:
    """Raise InputError unless these are rows of a script's own, one for each local point."""
    if not isinstance(name, str) or not isinstance(rows, np.ndarray) or rows.shape[:1] != (count,):
        raise InputError(
            f"rows[{shown(name)}] = {shown(rows)}: an array with {count} rows, one a point, is needed"
        )


class StateFields:
    """The kernels of fields, compiled when they are asked for first. Collective."""

    def __init__(self, comm: MPI.Comm):
        self.comm = comm
        self._kernels: dict[tuple[int, tuple[MaterialField, ...]], tuple[FieldForm, Kernel]] = {}

    def evaluate(self, points: Points, fields: Sequence[MaterialField]) -> Fields:
        """Values at the local points. Energy and stresses are one kernel, every other field has its own."""
        groups = [MECHANICAL] if any(f in MECHANICAL for f in fields) else []
        groups += [(field,) for field in fields if field not in MECHANICAL]
        found: dict[str, np.ndarray] = {}
        for group in groups:
            found |= self._group(points, group)
        return Fields({field.name: found[field.name] for field in fields})

    def _group(self, points: Points, fields: tuple[MaterialField, ...]) -> dict[str, np.ndarray]:
        out: dict[str, np.ndarray] = {}
        for m, material in enumerate(points.materials):
            if any(field.plastic for field in fields) and not material.plastic:
                continue
            if any(field.second_gradient for field in fields) and not material.second_gradient:
                continue
            if (m, fields) not in self._kernels:
                made = FieldForm(material, fields)
                self._kernels[m, fields] = made, made.compile(self.comm)
            form, kernel = self._kernels[m, fields]
            rows = np.flatnonzero(points.material == m)
            numbers = np.tile(parameter_values(material), (len(rows), 1))
            plastic = points.plastic_state(rows) if material.plastic else ()
            second = (points.grad_F[rows],) if material.second_gradient else ()
            state = points.F[rows], points.q[rows], points.wryness[rows], *second, *plastic
            values = kernel(*state, numbers)
            if any(field.after is not None for field in fields):
                with errors_on_all_ranks(self.comm):  # which may be a script's function
                    parts = form.split(values)
            else:
                parts = form.split(values)
            for name, part in parts.items():
                whole = out.setdefault(name, np.zeros((len(points), *part.shape[1:])))
                whole[rows] = part
        return out


def choose_fields(names: Sequence[str | MaterialField], points: Points) -> list[MaterialField]:
    """Fields of a body by their names; energy and stresses without any.

    Raises:
        InputError: an unknown name, a user's field with the name of another one, or one of plastic, or of
            second-gradient, materials where there are none.
    """
    out = []
    usual = [field.name for field in MECHANICAL] + ["double_stress"] * points.second_gradient
    for given in names or usual:
        if not isinstance(given, MaterialField) and not (isinstance(given, str) and given in TABLE):
            allowed = f"{', '.join(TABLE)} and a MaterialField"
            raise InputError(f"fields: {shown(given)} is unknown; allowed are {allowed}")
        field = given if isinstance(given, MaterialField) else TABLE[given]
        if TABLE.get(field.name, field) is not field:
            raise InputError(f"fields: {field.name!r} is the name of one of the package's fields")
        if field.plastic and not points.plastic:
            raise InputError(f"fields: {field.name!r}, but none of the materials is plastic")
        if field.second_gradient and not points.second_gradient:
            raise InputError(f"fields: {field.name!r}, but none of the materials has second gradients")
        out.append(field)
    return out
