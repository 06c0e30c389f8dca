"""Plastic points whose stiff scalars are averages over patches, see `projected`."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import ufl

from .plastic import PlasticForm
from .projected import ProjectedForm


class ProjectedPlasticForm(ProjectedForm, PlasticForm):
    """The trial state and the return mapping are those of Fbar, and have t among their unknowns."""

    @cached_property
    def _motion(self) -> tuple[Any, Any, Any]:
        now = self.moved
        return now.F, now.Q, now.wryness

    @property
    def _stretch(self) -> Any:
        return self._turned_stretch if self.turns == 3 else super()._stretch

    @cached_property
    def _trial(self) -> tuple[Any, Any]:
        if self.turns < 3:
            return super()._trial
        P, Gp, _ = self._plastic_state
        return ufl.dot(self._stretch, P), self._motion[2] - Gp

    @cached_property
    def plain(self) -> PlasticForm:
        return PlasticForm(self.material, self.layout.dim, self.layout.axial)

    def strains(self) -> tuple[Any, ...]:
        return PlasticForm.strains(self)
