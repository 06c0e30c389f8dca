"""The demos that find parameters, on coarse bodies."""

from __future__ import annotations

import pytest

from ..helpers.demos import demo_result


@pytest.mark.slow
def test_wires(folder):
    options = ["--cells", "2", "--diameters", "20", "--free", "l_p"]
    result = demo_result(folder, "identify_wires", *options)
    assert set(result) == {"E", "n", "l_t", "psi", "l_p"}
    for name in ("E", "l_p"):
        one = result[name]
        assert abs(one["value"] - one["true"]) < 3 * one["sd"], name
        assert one["sd"] < 0.05 * one["true"]


def test_column(folder):
    result = demo_result(folder, "identify_column", "--cell", "0.0125", "--noise", "0.05", "--most", "2")
    for name, one in result.items():
        assert abs(one["value"] - one["true"]) < 3.5 * one["sd"], name
        assert one["sd"] < 0.125 * abs(one["true"]), name
