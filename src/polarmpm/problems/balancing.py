"""Initial stresses of a problem's systems, and forces in their place where a step fails with them."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from mpi4py import MPI

import numpy as np

from ..assembly import carrying
from ..assembly.initialstress import InitialStress
from ..assembly.loadedpoints import LoadedPoints
from ..forms.initialstress import InitialKernels, InitialStressForm
from ..kinematics.layout import Layout
from ..tools.timing import Timer


class BalancedResets:
    """What balanced resets need of a problem. All methods are collective.

    Attributes:
        layouts: of the points of all materials.
        kernels: of the initial stresses, by layout; compiled at the first of these resets.
    """

    def __init__(self, layouts: Iterable[Layout], comm: MPI.Comm, timer: Timer):
        self.layouts, self.comm, self.timer = tuple(dict.fromkeys(layouts)), comm, timer
        self.kernels: dict[Layout, InitialKernels] = {}
        # initial stresses and forces, while a step is tried with forces alone
        self._before: tuple[np.ndarray, np.ndarray] | None = None

    def equip(self, system: LoadedPoints) -> LoadedPoints:
        """Let a system take along the initial stresses that its points have, if there are any."""
        there = bool(np.any(system.interpolation.reference.initial_stress))
        if self.comm.allreduce(there, op=MPI.LOR):
            self._put(system)
        return system

    def _put(self, system: LoadedPoints) -> None:
        for layout in self.layouts:
            if layout not in self.kernels:
                with self.timer("compile"):
                    self.kernels[layout] = InitialStressForm(layout).compile(self.comm)
        system.initial = InitialStress(system.interpolation, self.kernels)

    def carry(self, system: LoadedPoints) -> None:
        """Take the state at a reset, with the loads that are set, as an equilibrium."""
        with self.timer("carry"):
            if system.layout.axial:  # such a body can't turn: dead forces stay in balance
                return carrying.carry_forces(system)
            self._put(system)
            carrying.carry_stress(system)

    def fall_back(self, system: LoadedPoints, put_loads: Callable[[], None]) -> bool:
        """Put forces in the place of initial stresses, to balance the loads of the reset; False where there
        are none."""
        if system.initial is None or not system.initial.active():
            return False
        self._before = system.interpolation.reference.initial_stress.copy(), system.carried
        put_loads()
        carrying.carry_forces(system)
        return True

    def return_to_stresses(self, system: LoadedPoints) -> None:
        """Put back what was there before `fall_back`."""
        assert system.initial is not None
        assert self._before is not None
        system.initial.replace(self._before[0])
        system.carried = self._before[1]
