"""Tractions, pressures and supports on surfaces of a body of material points."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..basis.base import Basis
from ..conditions import supports as conditions
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.surfaces import Surface
from ..materials.base import Material
from ..terms.base import TermSource
from ..terms.surfaces import Pressure, SurfaceSupport, Traction
from ..terms.surfaceterms import SurfaceCondition
from ..tools.checks import require_finite
from .base import Problem

_PENALTY = 1e3  # default springs: a layer of a thousandth of a cell, of the body's stiffness


class SurfaceProblem(Problem):
    """Conditions on surfaces that the grid doesn't follow. All methods are collective.

    A condition that is added to a run resets the grid before the next step.

    Attributes:
        surfaces: tractions, pressures and supports on surfaces.
    """

    grid: Grid
    basis: Basis
    assembly: str

    def __init__(self, *arguments: Any):
        super().__init__(*arguments)
        self.surfaces: list[SurfaceCondition] = []
        self._sources: list[TermSource] = []

    # conditions -------------------------------------------------------------------------------------
    def traction(self, surface: Surface, *, force: Any = None, couple: Any = None) -> None:
        """A dead traction (N/m^2) and couple traction (N/m; one number in plane strain) per undeformed area
        on a surface that the body carries. Values as in `fix`, functions of positions get the undeformed
        ones.

        Raises:
            InputError: neither is given, values of the wrong size, a surface of another dimension; at the
            next
                step: points of the surface outside of the body.
        """
        self._check_assembly_of("traction")
        self._add_surface(Traction, self._surface_name("traction"), surface, force=force, couple=couple)

    def pressure(self, surface: Surface, p: Any) -> None:
        """A pressure (Pa) against the current normal of a surface that the body carries, -p cof(F) N dA.

        Raises:
            InputError: as `traction`.
        """
        self._check_assembly_of("pressure")
        self._add_surface(Pressure, self._surface_name("pressure"), surface, pressure=p)

    def fix_surface(
        self,
        surface: Surface,
        *,
        stiffness: float | None = None,
        rotation_stiffness: float | None = None,
        augment: bool = False,
        normal: Any = None,
        **components: Any,
    ) -> SurfaceSupport:
        """Prescribe displacements and rotations of a line or surface within the body by springs.

        The virtual work per undeformed area is stiffness (u - prescribed u) . du, and the same for rotations.

        Args:
            surface: any line or surface, also one that doesn't follow the grid; the body carries it.
            stiffness: of the springs (Pa/m). Default: 1000 times the stiffest material's lam + 2 mu over the
                size of a cell: they give way like a layer of a thousandth of a cell.
            rotation_stiffness: (N/m); default: 1000 times gamma over the size of a cell, plus mu times it.
            augment: keep the springs' forces after each converged step and let the springs start anew, so
                that what they give way under a load that stays vanishes over steps (augmented Lagrange
                method).
            normal: displacement along the undeformed normals (m): rollers. Not together with other
                displacements.
            **components: as in `fix`; functions of positions get the undeformed ones of the surface.

        Returns:
            The support, for `surface_reaction`; `support.gap` (n,) tells by how much (m) the prescribed
            displacements were missed in the last step.

        Raises:
            InputError: unknown component or no component, a stiffness that isn't positive, materials that
                don't name their moduli, and as in `traction`.
        """
        self._check_assembly_of("fix_surface")
        name = self._surface_name("surface support")
        displaced = [c for c in components if not c.startswith("theta")]
        if normal is not None and displaced:
            raise InputError(f"{name}: normal is given together with {', '.join(displaced)}")
        support = None
        if components or normal is None:
            support = conditions.make_support(_nowhere, name, components, self.layout, len(self.surfaces) + 1)
        if not isinstance(augment, bool):
            raise InputError(f"{name}: augment = {augment!r}: True or False")
        springs = self._stiffness(name, "stiffness", stiffness, 0)
        turning = 0.0
        if _turns(support, self):
            turning = self._stiffness(name, "rotation_stiffness", rotation_stiffness, 1)
        made = self._add_surface(
            SurfaceSupport,
            name,
            surface,
            support=support,
            normal=normal,
            stiffness=springs,
            rotation_stiffness=turning,
            augment=augment,
        )
        assert isinstance(made, SurfaceSupport)
        return made

    def surface_reaction(self, support: SurfaceSupport) -> tuple[np.ndarray, np.ndarray]:
        """Force (N), shape (d,), and couple (N m), shape (r,), with which a support from `fix_surface` holds
        the body. The couple sums the points' couples; it has no moment of the forces.

        Raises:
            InputError: nothing has been solved yet, or not such a support.
        """
        if not isinstance(support, SurfaceSupport):
            raise InputError(f"surface_reaction: support = {support!r} is not what fix_surface returned")
        if support.reaction is None:
            raise InputError("surface_reaction: no load step has been solved yet")
        return support.reaction

    # restart ------------------------------------------------------------------------------------------
    def surface_state(self) -> dict[str, np.ndarray]:
        """What a restart needs of the surfaces, the same on every rank, by names such as "0/u"."""
        return {f"{k}/{name}": a for k, s in enumerate(self.surfaces) for name, a in s.state().items()}

    def restore_surfaces(self, arrays: dict[str, np.ndarray]) -> None:
        """Put in what `surface_state` gave, before `restore`; the problem has the same surfaces.

        Raises:
            InputError: other surfaces.
        """
        saved = len({key.split("/")[0] for key in arrays})
        if saved != len(self.surfaces):
            raise InputError(f"the saved state has {saved} surface(s), the problem has {len(self.surfaces)}")
        for k, condition in enumerate(self.surfaces):
            start = f"{k}/"
            of_this = {key[len(start) :]: a for key, a in arrays.items() if key.startswith(start)}
            condition.restore(of_this)

    # for the problem ----------------------------------------------------------------------------------
    def _set_surfaces(self, factor: float, carrying: bool = False) -> None:
        for condition in self.surfaces:
            condition.set_factor(factor, carrying)

    def _surface_name(self, kind: str) -> str:
        return f"{kind} {len(self.surfaces) + 1}"

    def _check_assembly_of(self, name: str) -> None:
        if self.assembly != "direct":
            raise InputError(f"{name}: assembly = {self.assembly!r} has no surfaces; allowed is 'direct'")

    def _add_surface(self, kind: Any, name: str, surface: Surface, **options: Any) -> SurfaceCondition:
        made: SurfaceCondition = kind(name, surface, self.layout, self.basis, self.comm, **options)
        self.surfaces.append(made)
        self._sources.append(made)
        self._stale = self.progress.reset_due = True
        return made

    def _stiffness(self, name: str, argument: str, value: float | None, rotation: int) -> float:
        if value is None:
            size, materials = min(self.grid.smallest), self.points.materials
            return max(_springs(name, argument, m, size, rotation) for m in materials)
        require_finite(f"{name}: {argument}", value)
        if value <= 0:
            raise InputError(f"{name}: {argument} = {value:g} is not positive")
        return float(value)


def _turns(support: conditions.Support | None, problem: Problem) -> bool:
    """Whether a support prescribes rotations."""
    return support is not None and any(column >= problem.layout.dim for column in support.columns)


def _nowhere(x: np.ndarray) -> np.ndarray:
    return np.zeros(len(x), dtype=bool)


def _springs(name: str, argument: str, material: Material, size: float, rotation: int) -> float:
    """Default stiffness of a surface's springs."""
    p = getattr(material, "elastic", material).parameters()
    needed = ("mu", "gamma") if rotation else ("lam", "mu")
    if any(n not in p for n in needed):
        raise InputError(
            f"{name}: {type(material).__name__} has no parameters named {' and '.join(needed)}; "
            f"give {argument}"
        )
    if rotation:
        return _PENALTY * (p["gamma"] / size + p["mu"] * size)
    return _PENALTY * (p["lam"] + 2 * p["mu"]) / size
