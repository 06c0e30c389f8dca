"""Whatever is given to bases and amplitudes, there is an error of the package or what was asked for."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import polarmpm as pm
from polarmpm.basis.registry import BASES, basis_of
from tests.helpers.weird import anything, arrays, attempt, numbers, thorough

OPTIONS = thorough(60)


@OPTIONS
@given(arrays(3, 2) | st.just(np.zeros((3, 2), dtype=int)), arrays(3, 2) | st.just(np.ones((3, 2), int)),
       arrays(3, 2, 2, 2))  # fmt: skip
def test_weights(lowest, count, table):
    found = attempt(pm.Weights, lowest, count, table)
    if found is not None:
        assert np.all(np.asarray(found.count) <= np.shape(found.table)[3])


@OPTIONS
@given(
    st.just("own") | anything, st.just(1) | numbers | anything, numbers, anything, st.sampled_from(range(5))
)
def test_bases(name, degree, sliver, flag, kind):
    class Own(pm.Basis):
        """Tents, if they are."""

        def lines(self, grid, x, cells):
            r, slope = grid.within(x, cells), 1.0 / grid.sizes(cells)
            table = np.stack([np.stack([1.0 - r, -slope], axis=2), np.stack([r, slope], axis=2)], axis=3)
            return (table, 2 * table, table[..., 0], None, table / 0)[kind]

    Own.name, Own.degree, Own.sliver, Own.locks = name, degree, sliver, flag
    known = dict(BASES)
    try:
        with np.errstate(all="ignore"):
            attempt(pm.register_basis, Own())
            assert len(BASES) == len(known) or (degree, kind) == (1, 0)
            attempt(basis_of, Own())
        attempt(pm.register_basis, name)
        attempt(basis_of, flag)
    finally:
        BASES.clear()
        BASES.update(known)
