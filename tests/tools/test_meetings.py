"""What goes wrong on one rank is raised on all of them, and they can go on.

This file is also the script that the ranks run: `mpirun -n 3 python test_meetings.py CASE OUTPUT`.
"""

from __future__ import annotations

import functools
import pickle
import random
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.tools import meetings
from polarmpm.tools.alike import described, told
from polarmpm.tools.parallel import errors_on_all_ranks
from tests.helpers.ranks import on_ranks, report

COMM = MPI.COMM_WORLD
LAST = COMM.size - 1
BAD = COMM.rank == LAST  # the accident is on this rank
MATERIAL = pm.NeoHookean(lam=3e3, mu=2e3)


class Failure(Exception):
    """What the script's functions raise."""


def fails() -> bool:
    if BAD:
        raise Failure("of the script")
    return False


def body(comm: MPI.Comm = COMM, **options) -> pm.QuasiStatic:
    grid = pm.Grid.box((-1, -1), (4, 2), 0.5, comm)
    points = pm.seed(grid, material=MATERIAL, bounds=((0, 0), (3, 1)))
    problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, "reset": None, **options})
    problem.fix(pm.plane(x=0.0), u=0)
    return problem


def pulled(**options) -> pm.QuasiStatic:
    problem = body(**options)
    problem.body_load(force=(0.0, -3.0))
    return problem


def go_on(problem: pm.QuasiStatic) -> None:
    """The last converged state is intact: the problem goes on like one that nothing has happened to."""
    list(problem.march(2, progress=False))
    other = pulled()
    list(other.march(2, progress=False))
    np.testing.assert_allclose(
        problem.points.mean_displacement(), other.points.mean_displacement(), rtol=1e-6, atol=0
    )


def everywhere(kind: type[Exception], match: str = ""):
    """The script's own error on the rank where it has happened, and ErrorOnAnotherRank elsewhere."""
    return pytest.raises(kind if BAD else pm.ErrorOnAnotherRank, match=match)


def tabled(problem: pm.QuasiStatic, path: Path, columns: dict[str, Callable], steps: int) -> None:
    with pm.Table(path, **columns) as table:
        for step in problem.march(steps, to=problem.progress.factor + 0.25, progress=False):
            table.record(step)


# accidents, each on all ranks -------------------------------------------------------------------------
def in_a_selection() -> None:
    points = body().points
    with everywhere(Failure, "of the script"):
        points.where(lambda x: fails() or x[:, 0] > 1)
    assert len(points.where(lambda x: x[:, 0] > 2)) == 16


def before_a_collective_call_of_a_function() -> None:
    problem = body()
    failing = True

    def force(t, X):
        if failing and t == 0.75:
            fails()
        return np.tile([0.0, -3.0 * t], (len(X), 1)) * problem.points.mean(np.ones(len(problem.points)))

    problem.body_load(force=force)
    with everywhere(Failure):
        list(problem.march(1, to=0.75, progress=False))
    failing = False
    go_on(problem)


def in_a_column(tmp_path) -> None:
    problem = pulled()
    columns = {
        "a": problem.energy,
        "b": lambda: fails() or problem.energies(),
        "c": lambda: problem.points.mean_displacement(),
    }
    with everywhere(Failure):
        tabled(problem, tmp_path / "a.csv", columns, 1)
    other = {"a": lambda: {"x": 1.0} if BAD and problem.progress.step > 2 else 1.0}
    with pytest.raises(pm.InputError, match="columns: were"):
        tabled(problem, tmp_path / "b.csv", other, 2)
    go_on(problem)


def in_an_observer_and_a_policy() -> None:
    class Own(pm.Observer):
        def after_convergence(self, problem, factor):
            fails()
            problem.energies()

    problem = pulled()
    problem.observers.append(Own())
    with everywhere(Failure):
        list(problem.march(1, progress=False))

    class Policy:
        def due(self, steps, gradient, comm):
            return BAD

    with pytest.raises(pm.InputError, match=r"the reset policy.*rank"):
        list(pulled(reset=Policy()).march(2, progress=False))


def in_until() -> None:
    problem = pulled()
    with everywhere(ZeroDivisionError):
        list(problem.march_arc_length(0.02, until=lambda step: bool(1 / (not BAD)), progress=False))


def a_warning_that_is_an_error() -> None:
    stiff = pm.NeoHookean.from_engineering(E=1e3, nu=0.499)
    grid = pm.Grid.box((-1, -1), (4, 2), 0.5)
    points = pm.seed(grid, material=stiff, bounds=((0, 0), (3, 1)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(pm.TrustWarning if COMM.rank == 0 else pm.ErrorOnAnotherRank):
            pm.QuasiStatic(grid, points, **pm.PUBLISHED)


def other_calls() -> None:
    problem = pulled()
    with pytest.raises(pm.RanksApart, match=rf"rank {LAST}: energies") as caught:
        problem.energies() if BAD else problem.attempt(0.5)
    assert caught.value.calls[LAST] == "energies"
    assert caught.value.calls[0] == "the step to load factor 0.5"
    assert problem.progress.step == 0
    again = pickle.loads(pickle.dumps(caught.value))
    assert again.calls == caught.value.calls
    assert str(again) == str(caught.value)
    with pytest.raises(pm.RanksApart, match=r"0\.5.*1|1.*0\.5"):
        list(problem.march(1 if BAD else 2, progress=False))
    go_on(problem)


def other_conditions() -> None:
    problem = body()
    with pytest.raises(pm.InputError, match=r"body_load.*-3.*-6|body_load.*-6.*-3"):
        problem.body_load(force=(0.0, -6.0 if BAD else -3.0))
    assert not problem.loads
    with pytest.raises(pm.InputError, match=rf"fix.*rank {LAST}: uy=0"):
        problem.fix(pm.plane(x=0.0), **({"uy": 0.0} if BAD else {"ux": 0.0}))
    with pytest.raises(pm.InputError, match=r"QuasiStatic.*max_iterations"):
        pm.QuasiStatic(problem.grid, problem.points, controls=pm.Controls(max_iterations=9 + BAD))
    problem.body_load(force=(0.0, -3.0))
    controls = problem.controls
    problem.controls = pm.Controls(max_iterations=7) if BAD else controls
    with pytest.raises(pm.InputError, match=r"step to load factor.*max_iterations"):
        problem.attempt(0.5)
    problem.controls = controls
    go_on(problem)


def other_functions() -> None:
    problem = body()
    problem.body_load(force=lambda t, X: np.full((len(X), 2), t * (1 + BAD)))
    with pytest.raises(pm.InputError, match=rf"body load 1, force is .* on rank {LAST}"):
        problem.attempt(0.5)
    problem = pulled()
    problem.fix(lambda x: x[:, 0] > 2.6, ux=lambda t: 0.1 * t * (1 + BAD))
    with pytest.raises(pm.InputError, match=r"support 2 .*, ux is"):
        problem.attempt(0.5)
    problem = pulled()
    problem.fix(lambda x: BAD & (x[:, 1] < 0.1), ux=0)
    with pytest.raises(pm.InputError, match=r"support 2 .*ranks that share it"):
        problem.attempt(0.5)


def functions_of_all_positions() -> None:
    """They can't be asked for a single place, and are trusted."""
    problem = body()
    number = len(problem.points)
    problem.body_load(force=lambda t, X: np.tile([0.0, -3.0 * t], (number, 1)))
    go_on(problem)


def an_error_that_a_script_swallows() -> None:
    points = body().points
    with pytest.raises(pm.InputError, match=r"values = .*a row for each of the"):
        points.mean(np.ones(1 if BAD else len(points)))
    assert points.mean(np.ones(len(points))) == 1.0


def our_own_errors() -> None:
    def local(error: Exception, here: bool) -> None:
        with errors_on_all_ranks(COMM):
            if here:
                raise error

    with pytest.raises(pm.InputError, match=f"from rank {LAST}"):
        local(pm.InputError(f"from rank {COMM.rank}"), BAD)
    with pytest.raises(pm.InputError, match="alike") as caught:
        local(pm.InputError("alike"), True)
    assert meetings.of(COMM).known(caught.value)
    assert not meetings.of(COMM).inside


def groups_of_ranks() -> None:
    half = COMM.Split(int(COMM.rank == 0))  # the first rank alone
    try:
        problem = body(half)
        problem.body_load(force=(0.0, -1.0 * (1 + (COMM.rank == 0))))
        list(problem.march(1 + (COMM.rank == 0), progress=False))
        if half.size > 1:
            assert meetings.of(half) is not meetings.of(COMM)
            with everywhere(Failure):
                problem.points.where(lambda x: fails() or x[:, 0] > 1)
    finally:
        known = len(meetings.known)
        half.Free()
        assert len(meetings.known) == known - (COMM.size > 2 and COMM.rank > 0)
    copy = COMM.Dup()
    assert meetings.of(copy) is meetings.of(COMM)
    copy.Free()


def drawn_at_random() -> None:
    """Each rank does as all expect, fails, or is in another call."""
    draw = random.Random(3)
    for _ in range(100):
        kinds = draw.choices(["ok", "user", "ours", "other"], [6, 1, 1, 1], k=COMM.size)
        failed = [rank for rank, kind in enumerate(kinds) if kind in ("user", "ours")]
        error = None
        try:
            meet_as(kinds[COMM.rank])
        except Exception as e:
            error = e
        if not failed and len(set(kinds)) == 1:
            assert error is None
        elif not failed:
            assert isinstance(error, pm.RanksApart)
            assert [call == "elsewhere" for call in error.calls.values()] == [k == "other" for k in kinds]
        elif kinds[failed[0]] == "ours":
            assert isinstance(error, pm.InputError)
            assert str(error) == f"rank {failed[0]} fails"
        elif kinds[COMM.rank] == "user":
            assert isinstance(error, Failure)
        else:
            assert isinstance(error, pm.ErrorOnAnotherRank)
            assert error.rank == failed[0]


def meet_as(kind: str) -> None:
    if kind == "other":
        with meetings.together(COMM, "elsewhere"):
            return
    with errors_on_all_ranks(COMM):
        if kind != "ok":
            raise (Failure if kind == "user" else pm.InputError)(f"rank {COMM.rank} fails")


ACCIDENTS = {
    f.__name__: f
    for f in (
        in_a_selection,
        before_a_collective_call_of_a_function,
        in_a_column,
        in_an_observer_and_a_policy,
        in_until,
        a_warning_that_is_an_error,
        other_calls,
        other_conditions,
        other_functions,
        functions_of_all_positions,
        an_error_that_a_script_swallows,
        our_own_errors,
        groups_of_ranks,
        drawn_at_random,
    )
}


@pytest.mark.skipif(COMM.size == 1, reason="takes several ranks")
@pytest.mark.parametrize("name", ACCIDENTS)
def test_accidents(name, folder):
    accident = ACCIDENTS[name]
    accident(folder) if accident is in_a_column else accident()


@pytest.mark.mpi
@pytest.mark.timeout(240)
@pytest.mark.parametrize("number", [2, 3])
def test_accidents_on_ranks(number):
    found = on_ranks(number, "all", __file__)
    assert found == [dict.fromkeys(ACCIDENTS, "")] * number


@pytest.mark.mpi
@pytest.mark.timeout(120)
def test_many_ranks():
    assert on_ranks(6, "drawn_at_random", __file__) == [{"drawn_at_random": ""}] * 6


# on one rank, too ------------------------------------------------------------------------------------
def test_what_is_given_alike_is_told_alike():
    one = (1, 2.0 / 3.0, np.float64(0.1), "a", None, np.arange(30.0), pm.Controls(), lambda x: x)
    array = np.arange(30.0) * (1 + 1e-15)
    other = (np.int64(1), 2.0 / 3.0 * (1 + 1e-15), 0.1, "a", None, array, pm.Controls(), len)
    assert described(one, {"b": 1, "a": 2}) == described(other, {"a": 2, "b": 1})
    for a, b in ((1, 2), (1.0, 1.0 + 1e-6), (np.arange(30), np.arange(30) + 1), ("a", "b"), (True, 1)):
        assert told(a) != told(b)
    assert told(pm.Controls(max_iterations=3)) != told(pm.Controls())
    assert told(pm.Selection(np.arange(100))) != told(pm.Selection(np.arange(101)))
    assert told(pm.Surface.line((0, 0), (1, 0), 40)) != told(pm.Surface.line((0, 0), (1, 0.1), 40))


def test_messages_show_what_differs():
    said = {
        meetings.Word("load", "Selection(ids=(1, 2)), force=(0, -1), counts=None"): [0, 2],
        meetings.Word("load", "Selection(ids=(1, 2)), force=(0, -2), counts=None"): [1],
    }
    assert str(meetings._apart(said)) == (
        "load: the same is needed on all ranks, but they give ranks 0, 2: force=(0, -1); "
        "rank 1: force=(0, -2)"
    )


def test_calls_hold_no_meeting_on_one_rank():
    before = [m.number for m in meetings.known]
    problem = body(MPI.COMM_SELF)
    list(problem.march(1, progress=False))
    problem.energies()
    assert [m.number for m in meetings.known] == before


def test_a_step_has_few_meetings():
    problem = pulled()
    list(problem.march(1, to=0.5, progress=False))
    before = meetings.of(COMM).number
    list(problem.march(1, progress=False))
    assert meetings.of(COMM).number - before <= 20 * (COMM.size > 1)


def solve(case: str) -> dict[str, str]:
    """What came of each accident on this rank; empty when all went as it should."""
    found = {}
    with tempfile.TemporaryDirectory() as here:
        folder = Path(COMM.bcast(here))
        for name, accident in ACCIDENTS.items():
            if case not in ("all", name):
                continue
            run = functools.partial(accident, folder) if accident is in_a_column else accident
            run()
            found[name] = ""
        COMM.Barrier()
    return found


if __name__ == "__main__":
    report(solve)
