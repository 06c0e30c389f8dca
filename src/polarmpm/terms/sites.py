"""What is known of an obstacle's sites: their arrays, results and restart."""

from __future__ import annotations

from typing import Any

import numpy as np

from .surfaceterms import SurfaceCondition, undeformed_area

_KEPT = (
    "u",
    "F",
    "seen_area",
    "next_area",
    "multiplier",
    "slip",
    "seen",
    "turn",
    "w",
    "gap",
    "pressure",
    "traction",
    "couple",
    "sums",
)


class Sites(SurfaceCondition):
    """Sites of contact, and what the last converged step has left at them. Attributes are described at
    `Obstacle`."""

    parents: np.ndarray | None
    w: np.ndarray
    turn: np.ndarray
    multiplier: np.ndarray
    pressure: np.ndarray
    slip: np.ndarray
    seen: np.ndarray
    traction: np.ndarray
    couple: np.ndarray
    gap: np.ndarray
    sums: np.ndarray
    seen_area: np.ndarray
    next_area: np.ndarray
    area_now: np.ndarray
    _u_at: np.ndarray
    _F_at: np.ndarray
    _trial: np.ndarray
    tolerance: float | None
    _factor: float
    _checked = False

    def _put_arrays(self) -> None:
        """Those of a body at rest."""
        n, d, r = len(self.surface), self.layout.dim, self.layout.rotations
        self.w, self.turn = np.zeros((n, r)), np.zeros((n, r))
        self.multiplier, self.pressure = np.zeros(n), np.zeros(n)
        self.slip, self.seen, self.traction = np.zeros((n, d)), np.full((n, d), np.nan), np.zeros((n, d))
        self.couple, self.gap = np.zeros((n, r)), np.full(n, np.nan)
        self.sums = np.full(d + r + (1 if d == 2 else 3), np.nan)
        self.seen_area = self.next_area = self.area_now = undeformed_area(self.surface, self.layout).copy()
        self._u_at, self._F_at, self._trial = self.u, self.F, self.multiplier

    def _improved(self, gap: np.ndarray, pressure: np.ndarray, rows: np.ndarray) -> bool:
        """Let the pressures of sites `rows` be their multipliers where a gap is beyond the tolerance; whether
        one is."""
        if self.tolerance is None:
            return False
        off = np.where(pressure > 0.0, np.abs(gap), np.maximum(-gap, 0.0))
        if not np.any(off > self.tolerance):
            return False
        self._trial = self._trial.copy()
        self._trial[rows] = pressure
        return True

    # results ------------------------------------------------------------------------------------------
    @property
    def x(self) -> np.ndarray:
        place: np.ndarray = self.surface.x + self.u
        return place

    @property
    def area(self) -> np.ndarray:
        area: np.ndarray = self.seen_area
        return area

    @property
    def touching(self) -> np.ndarray:
        touching: np.ndarray = self.pressure > 0.0
        return touching

    @property
    def reaction(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Force and couple; None before the first step."""
        d, r = self.layout.dim, self.layout.rotations
        return None if np.isnan(self.sums[0]) else (self.sums[:d], self.sums[d : d + r])

    @property
    def force(self) -> np.ndarray:
        return self.sums[: self.layout.dim].copy()

    @property
    def moment(self) -> np.ndarray:
        return self.sums[self.layout.dim + self.layout.rotations :].copy()

    @property
    def penetration(self) -> float:
        """How deep sites are in the obstacle at most (m)."""
        return float(np.max(-np.nan_to_num(self.gap), initial=0.0))

    def as_dict(self) -> dict[str, Any]:
        """Columns of a table: force, moment, couple, number of sites that touch, deepest penetration."""
        out: dict[str, Any] = {
            "force": self.force,
            "moment": self.moment,
            "touching": int(self.touching.sum()),
        }
        if self.layout.rotations:
            out["couple"] = self.sums[self.layout.dim : self.layout.dim + self.layout.rotations].copy()
        return {**out, "penetration": self.penetration}

    @property
    def displacement(self) -> np.ndarray:
        return self._u_at

    @property
    def deformation(self) -> np.ndarray:
        return self._F_at

    def begin(self) -> None:
        self._u_at, self._F_at = self.u, self.F
        self.w = np.zeros_like(self.w)

    def rebase_rotations(self) -> None:
        self.w = np.zeros_like(self.w)

    # restart ------------------------------------------------------------------------------------------
    def state(self) -> dict[str, np.ndarray]:
        parents = {} if self.parents is None else {"parents": self.parents}
        kept = {name: getattr(self, name) for name in _KEPT}
        return {**kept, **parents, "u_at": self._u_at, "F_at": self._F_at, "factor": np.array([self._factor])}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self.check_saved(arrays)
        for name in _KEPT:
            setattr(self, name, np.array(arrays[name], dtype=float))
        if self.parents is not None:
            self.parents = np.array(arrays["parents"], dtype=np.int64)
        self._u_at, self._F_at = (np.array(arrays[name], dtype=float) for name in ("u_at", "F_at"))
        self._factor = float(arrays["factor"][0])
        self._trial, self._checked = self.multiplier, True
