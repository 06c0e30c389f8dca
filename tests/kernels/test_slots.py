"""The table of a point's unknowns in Python and the one of the compiled loops are the same."""

from __future__ import annotations

import pytest

from polarmpm.kernels import native, structures
from polarmpm.kinematics.layout import AXIAL, SECOND, Layout

LAYOUTS = [Layout(2, 0), Layout(3, 0), Layout(2, 1), Layout(3, 3), Layout(2, 0, SECOND), Layout(3, 0, SECOND)]
LAYOUTS += [Layout(2, 0, AXIAL), Layout(2, 1, AXIAL)]


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_every_slot_is_where_c_has_it(layout):
    lib, d, r, second = native.library(), layout.dim, layout.rotations, layout.kind
    assert lib.polarmpm_unknowns(d, r, second) == layout.unknowns
    derivatives = [(), *layout.axes(1), *layout.axes(2)]
    in_c = {
        lib.polarmpm_slot(d, r, second, component, number): (component, axes)
        for component in range(layout.block)
        for number, axes in enumerate(derivatives, -1)
    }
    in_c.pop(-1)
    in_python = {k: (layout.rows(s.field)[s.component], s.axes) for k, s in enumerate(layout.slots)}
    assert in_c == in_python


def test_there_is_room_for_every_layout():
    assert structures.constant("_layout.h", "UNKNOWNS_MAX") == max(layout.unknowns for layout in LAYOUTS)
