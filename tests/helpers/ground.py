"""Ground whose parts are removed and added."""

from __future__ import annotations

from typing import Any

import numpy as np

import polarmpm as pm
from tests.conftest import COMM

LAM, MU = 6e6, 4e6
HENCKY = pm.Hencky(lam=LAM, mu=MU)
MICROPOLAR = pm.MicropolarElastic.bounded_stiffness(lam=LAM, mu=MU, kappa=4e6, l_b=0.2)
SOIL = pm.MohrCoulomb(HENCKY, phi=0.5, psi=0.1, c=2e3)
COSSERAT = pm.DruckerPrager(MICROPOLAR, phi=0.5, psi=0.1, c=2e3, cone="plane strain", l_p=0.2)
WEIGHT = 18e3  # N/m^3


def run(problem: Any, steps: int, to: float) -> None:
    for _ in problem.march(steps, to=to, progress=False):
        pass


def largest(values: np.ndarray) -> float:
    return float(max(COMM.allgather(np.abs(values).max(initial=0.0))))
