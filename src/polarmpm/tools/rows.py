"""Arrays with a row for each of something, of which a rank may have none."""

from __future__ import annotations

import math

import numpy as np


def flat(array: np.ndarray) -> np.ndarray:
    """What is in each row, one after the other (n, m); also where there is no row, unlike reshape(n, -1)."""
    found: np.ndarray = array.reshape(len(array), math.prod(array.shape[1:]))
    return found
