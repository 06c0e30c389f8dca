"""Copies and pickles of grids, points and what goes with them; what they say of themselves."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import ufl

import polarmpm as pm
from tests.conftest import COMM, HENCKY, MICROPOLAR


def grid() -> pm.Grid:
    return pm.Grid.box((-1, -1), (3, 2), 0.5, COMM)


def body(material: pm.Material = MICROPOLAR) -> pm.Points:
    return pm.seed(grid(), bounds=((0, 0), (2, 1)), material=material)


def bent(points: pm.Points, tip: pm.Selection, force: float = 5.0) -> np.ndarray:
    problem = pm.QuasiStatic(grid(), points)
    problem.fix(lambda x: x[:, 0] < 1e-6, u=0, theta=0)
    problem.load(tip, force=(0, force))
    list(problem.march(2, progress=False))
    return points.mean_displacement(tip)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))])
def test_a_copy_is_a_body_of_its_own(copied):
    """Two problems run beside each other; selections and their ids are valid for both bodies."""
    points = body()
    tip = points.farthest((1, 0))
    twin, plain = copied(points), body()
    assert twin.comm == points.comm
    first = bent(points, tip)
    assert np.all(twin.mean_displacement() == 0)
    second = bent(twin, tip)
    np.testing.assert_allclose(first, second, rtol=1e-12)
    np.testing.assert_allclose(bent(plain, plain.farthest((1, 0))), first, rtol=1e-12)


def test_a_copy_in_mid_run_has_the_state():
    points = body(pm.VonMises(MICROPOLAR, k=5.0, H=100.0, l_p=0.1))
    bent(points, points.farthest((1, 0)), 1.0)
    twin = copy.deepcopy(points)
    assert points.comm.allreduce(float(points.hardening.sum())) > 0
    for name, array in points.arrays().items():
        assert getattr(twin, name) is not array
        np.testing.assert_array_equal(getattr(twin, name), array)


def test_private_attributes_of_others_stay_behind():
    """Such as the problem that a body belongs to; a script's own attributes go along."""
    points = body()
    points._owner, points.label = [], "left"  # type: ignore[attr-defined]
    for twin in (copy.copy(points), copy.deepcopy(points), pickle.loads(pickle.dumps(points))):
        assert not hasattr(twin, "_owner")
        assert twin.label == "left"


def test_pickles_of_other_communicators_are_refused():
    part = COMM.Dup()
    lattice = pm.Grid.box((0, 0), (1, 1), 0.5, part)
    points = pm.seed(lattice, material=HENCKY)
    for one in (lattice, points):
        with pytest.raises(pm.InputError, match="COMM_WORLD"):
            pickle.dumps(one)
    assert copy.deepcopy(points).comm == part
    assert copy.deepcopy(lattice) is lattice
    part.Free()


def test_pickles_know_how_many_ranks_there_were():
    state = body().__getstate__()
    with pytest.raises(pm.InputError, match="save_restart"):
        object.__new__(pm.Points).__setstate__({**state, "ranks": COMM.size + 1})


def test_descriptions():
    """One line with counts and units, which no rank has to ask others for."""
    points = body()
    assert repr(grid()) == "<Grid: 8 x 6 cells of 0.5 x 0.5 m, from (-1, -1) to (3, 2) m>"
    if COMM.size == 1:
        assert repr(points) == "<Points: 32 point(s) in the plane, 2 m^2, MicropolarElastic>"
        assert repr(points.farthest((1, 0))) == "<Selection: 4 point(s), ids 26, 27, 30, 31>"
    elif COMM.rank == 0:
        assert "of rank 0" in repr(points)
    assert repr(pm.Selection([3, 5])) == "<Selection: 2 point(s), given by hand, ids 3, 5>"
    assert repr(points.where(lambda x: x[:, 0] > 9)) == "<Selection: no point>"
    assert repr(pm.plane(y=0.5, moving=True)) == "<plane y = 0.5 m, moving>"
    assert repr(pm.Surface.line((0, 0), (3, 0), 6)) == "<Surface: 6 point(s), 3 m>"
    assert repr(HENCKY) == "Hencky(lam = 3000 Pa, mu = 2000 Pa)"
    yielding = pm.VonMises(HENCKY, k=40.0)
    assert repr(yielding) == "VonMises(k = 40 Pa; Hencky(lam = 3000 Pa, mu = 2000 Pa))"
    cone = pm.DruckerPrager(MICROPOLAR, phi=0.5, c=3.0, l_p=0.1)
    assert repr(cone).startswith("DruckerPrager(phi = 0.5 rad, c = 3 Pa, l_p = 0.1 m; MicropolarElastic(lam")
    energy = pm.UserEnergy(lambda F, p: p.a * ufl.tr(F), {"a": 2}, micropolar=False)
    assert repr(energy) == "UserEnergy(<lambda>, a = 2, classical)"
    assert repr(pm.Field("J", lambda p: p.volume, "m^3")) == "<Field 'J' in m^3>"
