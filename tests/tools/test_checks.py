"""Checks of arguments take what is meant and refuse the rest, whatever it is."""

from __future__ import annotations

from fractions import Fraction

from mpi4py import MPI

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import polarmpm as pm
from polarmpm.tools import checks, machine
from tests.helpers.weird import anything, attempt, numbers, thorough

OPTIONS = thorough(200)


class Broken:
    """Raises whatever is asked of it, its description too."""

    def __repr__(self) -> str:
        raise RuntimeError("no")

    def __array__(self, *args: object) -> np.ndarray:
        raise RuntimeError("no")


@OPTIONS
@given(numbers | anything, st.sampled_from([{}, {"least": 0}, {"above": 0, "most": 5}, {"below": 2}]))
def test_numbers(value, limits):
    found = attempt(checks.number, "a", value, **limits)
    if found is not None:
        assert type(found) is float
        assert found == float(value)
        assert limits.get("least", -np.inf) <= found <= limits.get("most", np.inf)
    found = attempt(checks.whole, "a", value, least=0)
    assert found is None or (type(found) is int and found == value and found >= 0)


@OPTIONS
@given(anything)
def test_everything_else(value):
    for check in (
        checks.flag,
        checks.text,
        checks.path,
        checks.function,
        checks.communicator,
        checks.numeric,
        checks.numbers_by_name,
    ):
        attempt(check, "a", value)
    found = attempt(checks.array, "a", value, (None, 2))
    assert found is None or (found.dtype == float and found.shape == (len(found), 2))
    found = attempt(checks.mask, "a", value, 2)
    assert found is None or found.dtype == bool
    assert attempt(checks.choice, "a", value, ("auto", "never")) in (None, "auto")
    assert len(checks.shown(value)) <= 80
    attempt(checks.sequence, "a", value, 2)


@pytest.mark.parametrize("value", [10**400, -(10**400), Fraction(10**400), np.array([1.0]), "1", True, 1j])
def test_no_numbers(value):
    with pytest.raises(pm.InputError, match=r"^a = .*: a finite number"):
        checks.number("a", value)


@pytest.mark.parametrize("value", [np.float16(2), np.array(2), np.uint8(2), 2, Fraction(2), np.longdouble(2)])
def test_numbers_of_all_kinds(value):
    assert checks.number("a", value) == 2.0


def test_functions_and_their_arguments():
    checks.function("f", lambda x, y=1: x, takes=("x",))
    checks.function("f", lambda *args: 0, takes=("x", "t"))
    checks.function("f", np.exp, takes=("x",))
    checks.function("f", max, takes=("x",))
    for bad in (lambda: 0, lambda x, y: 0, lambda *, x: 0, int.__add__):
        with pytest.raises(pm.InputError, match=r"f = .*called with 1 argument"):
            checks.function("f", bad, takes=("x",))


def test_broken_descriptions():
    """A user's class may raise anything."""
    for check in (checks.number, checks.numeric, checks.flag, checks.text, checks.function):
        with pytest.raises(pm.InputError, match="a = an instance of Broken"):
            check("a", Broken())
    with pytest.raises(pm.InputError, match="returned an instance of Broken"):
        checks.mask("a", Broken(), 3)


def test_addresses_are_left_out():
    """They differ between ranks."""
    assert checks.shown(lambda: 0).endswith("<lambda>>")


def test_memory():
    machine.check_memory("points", 3, 10**6)
    with pytest.raises(pm.InputError, match=r"points = 3: at least .* GiB are needed, this machine has"):
        machine.check_memory("points", 3, 2**61)
    with pytest.raises(pm.InputError, match=r"points = 1000.*: at least"):
        pm.Surface.line((0, 0), (1, 0), 10**400)
    grid = pm.Grid.box((0, 0), (20000, 20000), 1.0)
    with pytest.raises(pm.InputError, match=r"points_per_cell = 3: at least .* GiB are needed"):
        pm.seed(grid, material=pm.NeoHookean(lam=1.0, mu=1.0), points_per_cell=3)
    everything = pm.Grid.box((0, 0), (1e9, 1e9), 1.0)
    with pytest.raises(pm.InputError, match=r"1e.18 cells.*`bounds`"):
        pm.seed(everything, lambda x: x[:, 0] < 1, material=pm.NeoHookean(lam=1.0, mu=1.0))


def test_communicators():
    assert checks.communicator("comm", MPI.COMM_SELF) == MPI.COMM_SELF
    for bad in (None, 0, "world", MPI.COMM_NULL, MPI.COMM_WORLD.Get_group()):
        with pytest.raises(pm.InputError, match="comm = "):
            checks.communicator("comm", bad)
