"""Elastoplastic points in UFL: trial state, stresses, and the local problem of each region.

The state of a `PlasticForm` is that of a `PointForm`, followed by the plastic state at the last converged
step: P = Fp^-1, Gp and chi (plane strain: the entries that aren't zero). Local unknowns X are
(Ue, Ge, chi, Dgamma), T (4.61), for classical materials (Fe, chi, Dgamma), with one multiplier Dgamma for
each active yield surface. In the rotated frame all of it is turned by Q~, which changes neither tau nor nu.

The local residuals r(X, z) = 0 are those of the material's regions (`materials.regions`). With the stresses
s(X, z), that multiply the variations of z in the virtual work, the consistent tangent is
ds/dz - ds/dX (dr/dX)^-1 dr/dz; every derivative in it is UFL's.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..errors import InputError
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..materials.base import Material, named_parameters
from ..materials.plastic import Plastic, check_regions
from ..materials.regions import LocalState, Region, Scales
from . import plastickinds
from .points import PointForm
from .returns import LocalProblem, Program, Return, compile_functions, compile_return
from .strains import elastic_stress, motion, pushed, strain_measures

_PLANE = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 2))  # entries of deformations in plane strain
_PLANE_WRYNESS = ((0, 2), (1, 2), (2, 0), (2, 1))  # plastic flow brings in the third column
_SPACE = tuple((i, j) for i in range(3) for j in range(3))


def entries(layout: Layout) -> tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]:
    """Entries of deformations, and of wrynesses, that may differ from those of the undeformed state."""
    if layout.dim == 3:
        return _SPACE, (_SPACE if layout.rotations else ())
    return _PLANE, (_PLANE_WRYNESS if layout.rotations else ())


def plastic_size(layout: Layout) -> int:
    """Scalars of P, Gp and chi."""
    return sum(map(len, entries(layout))) + 1


def pack_plastic_state(layout: Layout, P: np.ndarray, Gp: np.ndarray, chi: np.ndarray) -> np.ndarray:
    """Plastic state (n, plastic_size) of tensors (n, 3, 3) and chi (n,)."""
    deformation, wryness = entries(layout)
    columns = [P[:, i, j] for i, j in deformation] + [Gp[:, i, j] for i, j in wryness] + [chi]
    return np.column_stack(columns)


def _tensor(c: Any, first: int, places: tuple[tuple[int, int], ...]) -> Any:
    rows: list[list[Any]] = [[0.0] * 3 for _ in range(3)]
    for k, (i, j) in enumerate(places):
        rows[i][j] = c[first + k]
    return ufl.as_tensor(rows)


class PlasticForm(PointForm):
    """Elastic predictor (the inherited kernels, with plastic deformation frozen) and return mapping.

    Attributes:
        regions: of the material's yield surface, in the order of attempts.
        surfaces: its yield surfaces.
    """

    material: Plastic

    def __init__(self, material: Material, dim: int, axial: bool = False):
        super().__init__(material, dim, axial)
        self.regions, self.surfaces = check_regions(self.material)
        self._trial_kernel: Kernel | None = None
        self._returns: dict[str, Return] = {}

    # sizes ----------------------------------------------------------------------------------------
    @property
    def elastic_size(self) -> int:
        """Scalars of the state before the plastic part."""
        return self.layout.state(rotated=self.material.isotropic).size

    @property
    def state_size(self) -> int:
        return self.elastic_size + plastic_size(self.layout)

    @property
    def hardening_column(self) -> int:
        """Where chi is in X; the multipliers follow."""
        return plastic_size(self.layout) - 1

    @property
    def local_size(self) -> int:
        """Length of the longest X, that of the region with the most multipliers."""
        return plastic_size(self.layout) + max(region.multipliers for region in self.regions)

    def pack(
        self,
        F: np.ndarray,
        q: np.ndarray,
        wryness: np.ndarray,
        plastic: Sequence[np.ndarray],
        grad_F: np.ndarray | None = None,
        radii: np.ndarray | None = None,
    ) -> np.ndarray:
        elastic = super().pack(F, q, wryness, plastic, radii=radii)
        return np.hstack([elastic, self.pack_flow(q, plastic)])

    def pack_flow(self, q: np.ndarray, plastic: Sequence[np.ndarray]) -> np.ndarray:
        """What follows the elastic state in the packed one, (n, plastic_size)."""
        plastic_F, plastic_wryness, chi = plastic
        try:
            P = np.linalg.inv(plastic_F)
        except np.linalg.LinAlgError:  # `check_state` says so at the next reset
            P = np.full_like(plastic_F, np.nan)
        if self.material.isotropic and self.material.micropolar:
            turn = rotations.to_tensor(q)
            back = np.swapaxes(turn, 1, 2)
            P, plastic_wryness = turn @ P @ back, turn @ plastic_wryness @ back
        return pack_plastic_state(self.layout, P, plastic_wryness, chi)

    def _made_of(self) -> Hashable:
        regions = tuple((region.name, region.multipliers) for region in self.regions)
        return super()._made_of(), regions, plastickinds.of_yielding(self.material, self.surfaces)

    # trial state ----------------------------------------------------------------------------------
    @cached_property
    def _plastic_state(self) -> tuple[Any, Any, Any]:
        """P, Gp and chi."""
        deformation, wryness = entries(self.layout)
        first = self.elastic_size
        P = _tensor(self.state, first, deformation)
        Gp = _tensor(self.state, first + len(deformation), wryness)
        return P, Gp, self.state[self.elastic_size + plastic_size(self.layout) - 1]

    @cached_property
    def _motion(self) -> tuple[Any, Any, Any]:
        """F, Q and Gamma in the frame of the state; Q and Gamma are None of classical materials."""
        now = motion(self.layout, self.z, self.state, rotated=self.material.isotropic)
        return now.F, now.Q, now.wryness

    @property
    def _stretch(self) -> Any:
        """Q^T F."""
        f, q, _ = self._motion
        return ufl.dot(ufl.transpose(q), f)

    @cached_property
    def _trial(self) -> tuple[Any, Any]:
        """Ue (Fe of a classical material) and Ge if nothing flowed, T (4.42)-(4.44)."""
        f, q, wryness = self._motion
        P, Gp, _ = self._plastic_state
        fe = ufl.dot(f, P)
        return (fe, None) if q is None else (ufl.dot(ufl.transpose(q), fe), wryness - Gp)

    def strains(self) -> tuple[Any, ...]:
        """Measures of the elastic energy in the trial state."""
        return strain_measures(self.material, *self._trial)

    @cached_property
    def energy(self) -> Any:
        """Strain energy of the trial state; evaluates all functions, so that a mistake in one shows."""
        tau, nu = self.kirchhoff(*self._trial)
        chi, owner = self._plastic_state[2], type(self.material).__name__
        for surface in self.surfaces:
            surface.value(owner, tau, nu, chi, self._numbers)
            surface.flow_potential(owner, tau, nu, chi, self._numbers)
        self._hardening_energy(chi)
        return super().energy

    # stresses -------------------------------------------------------------------------------------
    @property
    def _numbers(self) -> Any:
        return named_parameters(self.material, self.parameters)

    def _elastic_stress(self, deformation: Any, wryness: Any) -> tuple[Any, Any]:
        """B and S of Ue and Ge; dW/dFe of a classical material."""
        return elastic_stress(self.material, deformation, wryness, self._numbers)

    def kirchhoff(self, deformation: Any, wryness: Any) -> tuple[Any, Any]:
        """tau = Q B Fe^T and nu = Q S F^T (T (4.26)-(4.27) times J); nu is None of classical materials."""
        f, q, _ = self._motion
        b, s = self._elastic_stress(deformation, wryness)
        if wryness is None:
            return pushed(b, None, deformation), None
        return pushed(b, q, ufl.dot(q, deformation)), pushed(s, q, f)

    def _hardening_energy(self, chi: Any) -> Any:
        return plastickinds.hardening_energy(self.material, chi, self._numbers)

    # local problem --------------------------------------------------------------------------------
    def local_state(self, X: Any, multipliers: int) -> LocalState:
        """The state at local unknowns X, a coefficient."""
        deformation, wryness = entries(self.layout)
        f, q, _ = self._motion
        P, _, before = self._plastic_state
        last = self.hardening_column
        return LocalState(
            dim=self.layout.dim,
            F=f,
            Q=q,
            Fe_trial=ufl.dot(f, P),
            Ge_trial=self._trial[1],
            chi_before=before,
            Ue=_tensor(X, 0, deformation),
            Ge=_tensor(X, len(deformation), wryness) if wryness else None,
            chi=X[last],
            multipliers=tuple(X[last + 1 + k] for k in range(multipliers)),
            p=self._numbers,
            elastic_stress=self._elastic_stress,
            stress_at=self.kirchhoff,
            hardening_energy=self._hardening_energy,
            entries=entries(self.layout),
            owner=type(self.material).__name__,
        )

    def _work(self, state: LocalState) -> Any:
        """s(X, z), a linear form in variations of z.

        tau = Q B Fe^T does the work of Q B (F^-1 Fe)^T on the variation of Q^T F.
        """
        f, q, wryness = self._motion
        test = ufl.TestFunction(self.space.function_space(self.unknowns))
        b, s = self._elastic_stress(state.Ue, state.Ge)
        total = ufl.dot(b, ufl.transpose(ufl.dot(ufl.inv(f), state.Fe)))
        if q is None:
            return ufl.inner(total, ufl.derivative(f, self.z, test))
        work = ufl.inner(total, ufl.derivative(self._stretch, self.z, test))
        return work + ufl.inner(s, ufl.derivative(wryness, self.z, test))

    def local_problem(self, region: Region) -> LocalProblem:
        """A region's equations, the stresses at their solution, and what its flow dissipates."""
        size = plastic_size(self.layout) + region.multipliers
        X = self.space.coefficient(size)
        state = self.local_state(X, region.multipliers)
        active = {surface.name for surface in region.surfaces}
        others = [surface.at(state) for surface in self.surfaces if surface.name not in active]
        return LocalProblem(
            name=region.name,
            z=self.z,
            X=X,
            terminals={**self.terminals, X: self.inputs},
            inputs=self.inputs + size,
            residual=region.residual(state),
            flow=[*region.flow(state), *others],
            work=self._work(state),
            space=self.space,
        )

    @property
    def _scales(self) -> Scales:
        m, (deformation, wryness) = self.material, map(len, entries(self.layout))
        couple = m.couple_modulus if wryness else 1.0
        return Scales(self.layout.dim, deformation, wryness, m.modulus, couple, m.length)

    # compiled -------------------------------------------------------------------------------------
    def trial_kernel(self, comm: MPI.Comm) -> Kernel:
        """Kernel inputs -> X of the trial state, the yield functions, and for each region but the first how
        likely the state is to return there (> 0), see `Plastic.first_region`. Compiled when it is asked for
        first; collective."""
        if self._trial_kernel is None:
            self._trial_kernel = compile_functions("trial", self._trial_program, comm, of=self.kind)["trial"]
        return self._trial_kernel

    def return_kernels(self, region: Region, comm: MPI.Comm) -> Return:
        """Kernels of a region. Compiled when they are asked for first; collective."""
        if region.name not in self._returns:
            equations = plastickinds.of_region(self.material, region, self.layout.dim, entries(self.layout))
            self._returns[region.name] = compile_return(
                region.name,
                lambda: self.local_problem(region),
                region.row_scale(self._scales),
                comm,
                of=(self.kind, equations),
            )
        return self._returns[region.name]

    def _trial_program(self) -> Program:
        return Program({"trial": self._trial_rows()}, self.terminals, self.inputs, self.space)

    def _trial_rows(self) -> list[Any]:
        ue, ge = self._trial
        chi, p, owner = self._plastic_state[2], self._numbers, type(self.material).__name__
        tau, nu = self.kirchhoff(ue, ge)
        deformation, wryness = entries(self.layout)
        rows = [ue[i, j] for i, j in deformation] + [ge[i, j] for i, j in wryness]
        rows += [chi, *([ufl.as_ufl(0.0)] * (self.local_size - self.hardening_column - 1))]
        rows += [surface.value(owner, tau, nu, chi, p) for surface in self.surfaces]
        likely, others = self.material.first_region(tau, nu, chi, p), [r.name for r in self.regions[1:]]
        for name in likely:
            if name not in others:
                allowed = ", ".join(others) or "none"
                raise InputError(
                    f"material: first_region of {owner}: {name!r} is none of its others: {allowed}"
                )
        never = ufl.as_ufl(-1.0)
        return rows + ([ufl.as_ufl(likely.get(name, never)) for name in others] or [never])
