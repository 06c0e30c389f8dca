"""What scripts write into the arrays of points is seen, and said with the points' ids."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR

YIELDING = pm.VonMises(MICROPOLAR, k=5.0, H=100.0, l_p=0.1)


def problem(material: pm.Material = MICROPOLAR, **options) -> pm.QuasiStatic:
    grid = pm.Grid.box((-1, -1), (3, 2), 0.5, COMM)
    points = pm.seed(grid, bounds=((0, 0), (2, 1)), material=material)
    made = pm.QuasiStatic(grid, points, **options)
    made.fix(lambda x: x[:, 0] < 1e-6, u=0, theta=0)
    made.load(points.farthest((1, 0)), force=(0, 2.0))
    return made


def write(points: pm.Points, name: str, value: object) -> None:
    """Put a value in at the points 7 and 9, on the ranks that have them."""
    getattr(points, name)[np.isin(points.id, [7, 9])] = value


CHANGES = [
    ("F", np.nan, "points.F isn't finite"),
    ("F", -np.eye(3), "points.F has no positive determinant"),
    ("q", 0.0, "points.q isn't a unit quaternion"),
    ("wryness", np.inf, "points.wryness isn't finite"),
    ("volume0", -1.0, "points.volume0 isn't positive"),
]
PLASTIC = [
    ("plastic_F", 0.0, "points.plastic_F has no positive determinant"),
    ("hardening", np.nan, "points.hardening isn't finite"),
]
FIXED = [("half_length0", -1.0, "points.half_length0 is negative"), ("X", np.nan, "points.X isn't finite")]


@pytest.mark.parametrize(("name", "value", "message"), CHANGES + PLASTIC)
def test_at_a_reset(name, value, message):
    """Of the last step's state everything that counts is looked at, wherever it was changed."""
    made = problem(YIELDING, reset=1)
    list(made.march(1, to=0.5, progress=False))
    write(made.points, name, value)
    with pytest.raises(pm.InputError, match=rf"{message}: 2 point\(s\), ids 7, 9"):
        list(made.march(1, progress=False))


@pytest.mark.parametrize(("name", "value", "message"), CHANGES + PLASTIC + FIXED)
def test_before_a_problem(name, value, message):
    made = problem(YIELDING)
    write(made.points, name, value)
    with pytest.raises(pm.InputError, match=rf"{message}: 2 point\(s\), ids 7, 9"):
        pm.QuasiStatic(made.grid, made.points)


@pytest.mark.parametrize("name", ["x", "F", "q", "wryness"])
@pytest.mark.parametrize("change", ["written", "replaced"])
def test_between_two_resets(name, change):
    """The next step would overwrite it."""
    made = problem(reset=None)
    list(made.march(1, to=0.5, progress=False))
    array = getattr(made.points, name)
    if change == "written":
        array += 0.1
    else:
        setattr(made.points, name, array + 0.1)
    with pytest.raises(pm.InputError, match=rf"points\.{name} was changed between two steps"):
        list(made.march(1, progress=False))
    if change == "written":
        array -= 0.1
    setattr(made.points, name, array)


def test_what_was_put_back_is_no_change():
    made = problem(reset=None)
    list(made.march(1, to=0.5, progress=False))
    before = made.points.F
    made.points.F = before + 1.0
    made.points.F = before
    list(made.march(1, progress=False))


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("F", lambda a: a[:-1]),
        ("q", lambda a: a.astype(np.float32)),
        ("x", lambda a: a.tolist()),
        ("volume0", lambda a: a[:, None]),
    ],
)
def test_arrays_of_another_kind(name, changed):
    made = problem()
    if COMM.rank == 0:
        setattr(made.points, name, changed(getattr(made.points, name)))
    with pytest.raises(pm.InputError, match=rf"points\.{name}: .* is needed"):
        pm.QuasiStatic(made.grid, made.points)


def test_arrangements_after_the_problem():
    """Materials that were known already, and points that join."""
    stiff = pm.MicropolarElastic(**{**MICROPOLAR.parameters(), "lam": 6e3})
    grid = pm.Grid.box((-1, -1), (3, 2), 0.5, COMM)
    for late in (
        lambda points: points.assign(points.where(lambda x: x[:, 0] < 1), stiff),
        lambda points: points.join(pm.seed(grid, bounds=((0, 1), (2, 2)), material=MICROPOLAR)),
    ):
        points = pm.seed(grid, bounds=((0, 0), (2, 1)), material=MICROPOLAR)
        points.assign(points.where(lambda x: x[:, 0] > 1), stiff)
        made = pm.QuasiStatic(grid, points)
        made.fix(lambda x: x[:, 0] < 1e-6, u=0, theta=0)
        list(made.march(1, to=0.5, progress=False))
        late(points)
        with pytest.raises(pm.InputError, match="after the problem had been made of them"):
            list(made.march(1, progress=False))
        pm.QuasiStatic(grid, points)  # of the new arrangement
