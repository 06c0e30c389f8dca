"""The compiled loops belong to the package that calls them, and are handed what their C text declares."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from polarmpm.kernels import native, structures


def test_a_stale_build_is_refused(monkeypatch):
    """Another interface would crash in the middle of a run."""
    assert native.library().polarmpm_interface() == native.INTERFACE
    native.library.cache_clear()
    monkeypatch.setattr(native, "INTERFACE", native.INTERFACE + 1)
    with pytest.raises(ImportError, match="install it again"):
        native.library()


def test_a_build_of_another_structure_is_refused(monkeypatch):
    """A field more, without another interface number."""

    class PointKernels(ctypes.Structure):
        _fields_ = (*native.PointKernels._fields_, ("more", ctypes.c_void_p))

    native.library.cache_clear()
    monkeypatch.setattr(native, "STRUCTURES", (native.Batch, PointKernels))
    size = ctypes.sizeof(native.PointKernels)
    told = f"has a PointKernels of {size} bytes, the headers declare {size + 8};"
    with pytest.raises(ImportError, match=told):
        native.library()


@pytest.mark.parametrize("structure", native.STRUCTURES, ids=lambda s: s.__name__)
def test_structures_are_as_large_as_in_c(structure):
    size = ctypes.c_int64.in_dll(native.library(), f"polarmpm_size_{structure.__name__}").value
    assert ctypes.sizeof(structure) == size > 0


def test_fields_are_those_of_the_header():
    """Several fields a line, comments, pointers, const, kernels."""
    fields = native.Batch.declared
    assert list(fields)[:7] == ["dim", "rot", "second", "slots", "orders", "nstate", "nparam"]
    assert fields["count"].dtype == np.int32
    assert fields["weights"].pointer
    assert native.PointKernels.declared["kernel"].kind == "kernel_t"
    assert native.Matrix.declared["fixed"].dtype == np.uint8
    assert sum(len(s.declared) for s in native.STRUCTURES) == 118


@pytest.mark.parametrize(
    ("field", "value", "error", "message"),
    [
        ("nodez", np.zeros(3, dtype=np.int32), TypeError, "Batch has no field nodez; it has dim, rot"),
        (
            "nodes",
            np.zeros(3, dtype=np.int64),
            TypeError,
            "Batch.nodes is an array of int64; int32 is needed",
        ),
        ("state", np.zeros(3, dtype=np.float32), TypeError, "of float32; float64 is needed"),
        ("state", np.zeros((4, 6))[:, ::2], ValueError, "Batch.state is an array that is not contiguous"),
        ("state", [1.0], TypeError, r"Batch.state = \[1.0\]: an array of float64 or None"),
        ("dim", 2.0, TypeError, "Batch.dim = 2.0: a whole number is needed"),
        ("dim", None, TypeError, "whole number"),
        ("dim", np.zeros(1, dtype=np.int32), TypeError, "whole number"),
        ("dim", 2**31, ValueError, "Batch.dim = 2147483648: int32_t holds -2147483648 to 2147483647"),
    ],
)
def test_what_a_field_does_not_hold_is_refused(field, value, error, message):
    batch = native.Batch()
    with pytest.raises(error, match=message):
        native.fill(batch, **{field: value})
    assert not batch.kept


def test_numbers_of_other_kinds_are_refused():
    controls = native.Return()
    native.fill(controls, tolerance=1, most=np.int64(7), local=None)
    assert (controls.tolerance, controls.most) == (1.0, 7)
    with pytest.raises(TypeError, match=r"Return.tolerance = 'small': a number is needed"):
        native.fill(controls, tolerance="small")
    with pytest.raises(TypeError, match=r"Return.local = 0.5: a whole number"):
        native.fill(controls, local=0.5)


def test_arrays_live_as_long_as_they_are_pointed_to():
    batch, state = native.Batch(), np.arange(3.0)
    native.fill(batch, state=state)
    assert batch.kept["state"] is state
    assert batch.state == state.ctypes.data
    native.fill(batch, state=None)
    assert batch.state is None
    assert not batch.kept


def test_arguments_are_checked():
    """What a prototype says of its pointers holds for the arrays that are passed."""
    mark = native.library().polarmpm_couple_nodes
    batch = native.Batch()
    mark(ctypes.byref(batch), 1, np.zeros(9, dtype=np.uint8))
    with pytest.raises(TypeError, match="mark is an array of float64; uint8 is needed"):
        mark(ctypes.byref(batch), 1, np.zeros(9))
    with pytest.raises(ctypes.ArgumentError):
        mark(ctypes.byref(native.Matrix()), 1, np.zeros(9, dtype=np.uint8))


def test_what_the_headers_lack_is_named():
    with pytest.raises(KeyError, match=r"_points.h has no structure Nothing"):
        structures.declared_in("_points.h")(type("Nothing", (structures.Structure,), {}))
    with pytest.raises(KeyError, match=r"_points.h has no constant NOTHING"):
        structures.constant("_points.h", "NOTHING")


@pytest.mark.parametrize("text", ["double X[3]", "short x", "double", "double (*f)(int)", "int32_t a:3"])
def test_declarations_that_cannot_be_read_are_refused(text):
    with pytest.raises(ValueError, match=r"Owner: the declaration .* can't be read"):
        structures._declarations("Owner", text)


def test_addresses():
    a = np.arange(6.0).reshape(2, 3)
    fixed = a.copy()
    fixed.flags.writeable = False
    for array in (a, a[1], a[:0], fixed, np.zeros(4, dtype=bool)):
        assert native.address(array) == array.ctypes.data


def test_rows_are_those_of_wider_arrays_too():
    wide = np.arange(12.0).reshape(3, 4)
    addresses, step = native.rows([wide, wide[:, 1:3], np.zeros((0, 4))])
    assert addresses[1] - addresses[0] == 8
    assert list(step[:2]) == [4, 4]
    with pytest.raises(ValueError, match="one after the other"):
        native.rows([wide.T])
