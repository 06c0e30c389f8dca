"""How far a run has come, and the fields of its state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
        external_work, carried_work, ghost_work, term_work: work (J) so far, see `Problem.energies`.
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
    term_work: float = 0.0


@dataclass
class Fields:
    """Stresses of the current state, for output.

    Attributes:
        energy: strain energy per reference volume (Pa), scalar.
        stress: Cauchy stress (Pa), tensor.
        couple_stress: Cauchy couple stress (N/m), tensor.
    """

    energy: np.ndarray
    stress: np.ndarray
    couple_stress: np.ndarray
