"""Whatever values are given to follow the load factor, there is an error of the package or numbers."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from polarmpm.conditions.amplitudes import Amplitude, check_counts
from tests.helpers.weird import anything, arrays, attempt, thorough, vectors

POSITIONS = np.arange(8.0).reshape(4, 2)


def _values() -> st.SearchStrategy:
    fixed = vectors(2) | anything
    of_factor = fixed.map(lambda value: lambda t: value)
    of_positions = (arrays(4, 2) | arrays(4) | fixed).map(lambda value: lambda t, X: value)
    other = st.sampled_from([lambda: 0.0, lambda a, b, c: 0.0, lambda t, X: X.__imul__(0.0), np.exp, id])
    return fixed | of_factor | of_positions | other


@thorough(150)
@given(_values(), st.sampled_from([1, 2, 3]), anything | st.sampled_from(["from now", "total"]))
def test_amplitudes(value, size, counts):
    def amplitude() -> np.ndarray:
        made = Amplitude("load 1, force", value, size)
        made.begin(0.5, check_counts("load 1", counts))
        return made.at(1.0, POSITIONS)

    before = POSITIONS.copy()
    found = attempt(amplitude)
    assert np.array_equal(POSITIONS, before)
    assert found is None or (found.shape == (4, size) and np.all(np.isfinite(found)))
