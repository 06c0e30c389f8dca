"""Bodies and closed forms of which parameters are sought; other processes import them from here."""

from __future__ import annotations

from typing import Any

import numpy as np

import polarmpm as pm
from polarmpm.study.exact import twisted_bar

BAR = {"E": 2.6, "n": 0.5, "l_t": 0.3, "psi": 1.2}  # GPa, -, mm, -
BAR_START = {"E": 2.0, "n": 0.3, "l_t": 0.15, "psi": 1.0}
BAR_FREE = {"E": "log", "n": pm.Bounds(0, 1), "l_t": "log", "psi": pm.Bounds(0, 1.5)}
RADII = np.array((0.3, 0.5, 0.9, 1.6, 3.0))


def bars(p: dict[str, float], at: np.ndarray) -> dict[str, np.ndarray]:
    """Torsional rigidity of elastic bars of radii `at`."""
    m = pm.MicropolarElastic.from_engineering(
        E=p["E"], nu=0.3, n=p["n"], l_b=p["l_t"], l_t=p["l_t"], psi=p["psi"]
    )
    ratios = [twisted_bar(radius=r, mu=m.mu, kappa=m.kappa, alpha=m.alpha, gamma=m.gamma) for r in at]
    return {"rigidity": m.mu * np.array(ratios)}


def line(p: dict[str, float], at: np.ndarray) -> dict[str, np.ndarray]:
    return {"y": p["a"] + p["b"] * at}


def decay(p: dict[str, float], at: np.ndarray) -> dict[str, np.ndarray]:
    """Two numbers of which only the product shows."""
    return {"y": p["a"] * p["b"] * np.exp(-p["c"] * at)}


def sheet(p: dict[str, float], height: float = 1.0, places: Any = None) -> tuple[Any, dict[str, Any]]:
    """A micropolar cantilever of 4 x height, its deflection and the displacements at places."""
    material = pm.MicropolarElastic(
        lam=3e3, mu=p["mu"], kappa=p["kappa"], alpha=0.0, beta=0.0, gamma=p["gamma"]
    )
    grid = pm.Grid.box((0, -3), (6, 3), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (4, height)), material=material)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    tip = points.farthest((1, 0))
    problem.load(tip, force=(0, -40.0 * height**3))
    found: dict[str, Any] = {"deflection": lambda: points.mean_displacement(tip)[1]}
    if places is not None:
        found["field"] = pm.Places(points, places).displacement
    return problem, found


SHEET = {"mu": 2e3, "kappa": 700.0, "gamma": 170.0}
