"""Studies: fresh processes, rows, files, failures. Nothing here depends on how long anything takes."""

import math
import subprocess
import sys

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm import study
from polarmpm.study import figures

pytest.importorskip("matplotlib")

pytestmark = [
    pytest.mark.mpi,  # starts processes
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="a study runs on one rank"),
]

MATERIAL = pm.MicropolarElastic(lam=1e4, mu=1e4, kappa=2e3, alpha=0.0, gamma=50.0, beta=0.0)  # Pa, N
FORCE = 20.0  # N per metre of width


def points(cell, force=FORCE):
    """A cantilever of 2 x 1 m."""
    grid = pm.Grid.box((0, -4), (4, 4), cell)
    body = pm.seed(grid, bounds=((0, 0), (2, 1)), material=MATERIAL)
    problem = pm.QuasiStatic(grid, body, basis="mpm", reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    end = body.farthest((1, 0))
    problem.load(end, force=(0, -force))
    return study.Case(problem, lambda: body.mean_displacement(end), kernel=lambda tangent: 1e-6)


def elements(cells):
    """The same of quadrilaterals."""
    from dolfinx import mesh

    body = pm.Elements(
        mesh.create_rectangle(
            MPI.COMM_WORLD, [(0.0, 0.0), (2.0, 1.0)], [2 * cells, cells], mesh.CellType.quadrilateral
        ),
        material=MATERIAL,
    )
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    end = body.farthest((1, 0))
    problem.load(end, force=(0, -FORCE))
    return study.Case(problem, lambda: body.mean_displacement(end))


def dies(cell):
    """As a process does that the system has stopped for want of memory."""
    import os

    os._exit(9)


def no_case():
    return "nothing"


def discretisation(build, **changes):
    settings = {"method": "MPM", "label": "1 m", "h": 1.0, "arguments": {"cell": 1.0}, "steps": 2}
    return study.Discretisation(build=build, **(settings | changes))


@pytest.fixture(scope="module")
def rows():
    discretisations = [
        *(discretisation(points, label=f"{h:g} m", h=h, arguments={"cell": h}) for h in (1.0, 0.5)),
        *(
            discretisation(elements, method="FEM", label=f"{n}", h=1 / n, arguments={"cells": n})
            for n in (1, 2)
        ),
        discretisation(points, method="too much", arguments={"cell": 1.0, "force": 1e9}),
        discretisation(dies, method="dead"),
    ]
    seen = []
    found = study.run(
        discretisations, {"zero": (0.0, 0.0), "down": lambda u: abs(u[1] + 0.1)}, record=seen.append
    )
    assert seen == found
    return found


def test_rows_have_results_and_errors(rows):
    """The same numbers as of a run in this process; errors are distances, or what a function says."""
    first = rows[0]
    case = points(1.0)
    assert [step.iterations for step in case.problem.march(2, progress=False)]
    assert first.result == tuple(case.result())
    assert first.errors["zero"] == pytest.approx(np.hypot(*first.result))
    assert first.errors["down"] == pytest.approx(abs(first.result[1] + 0.1))
    assert (first.points, first.unknowns) == (8, case.problem.unknowns)
    assert (first.steps, first.cuts) == (2, 0)
    assert first.iterations == sum(step.iterations for step in case.problem.steps)
    assert rows[3].points == 4 * 8  # quadrature points


def test_phases_add_up_and_leave_out_compiling(rows):
    for row in rows[:4]:
        assert sum(row.phases.values()) == pytest.approx(row.cpu_s)
        assert {"assembly", "factor", "solve", "rest"} <= set(row.phases) <= set(study.PHASES)
        assert row.startup_s > 0
        assert row.peak_memory_mb > 10
    assert rows[0].kernel_s > 0
    assert rows[2].kernel_s is None


def test_failures_are_rows(rows):
    """One that finds no equilibrium and one whose process has died; the others aren't affected."""
    overload, dead = rows[4:]
    assert 0 < overload.failed_at <= 0.5
    assert "no equilibrium" in overload.failure
    assert dead.failed_at == 0.0
    assert "process ended" in dead.failure
    assert not overload.errors
    assert all(row.failed_at is None for row in rows[:4])


def test_files(rows, tmp_path):
    """Everything is written, the table can be read back, and a second time gives the same files."""
    published = [study.compare(study.Row("MPM", "paper", 0.5, (0.0, -0.2), cpu_s=5.0), {"zero": (0.0, 0.0)})]
    for folder in ("a", "b"):
        study.write(rows, tmp_path / folder, name="beam", unit="m", published=published)
    files = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert files == ["beam.csv", "beam.md", "beam_cpu_s.png", "beam_h.png", "beam_phases.png"]
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    again = study.read_csv(tmp_path / "a" / "beam.csv")
    for row, copy in zip(rows, again, strict=True):
        assert (row.method, row.label, row.iterations, row.failed_at) == (
            (copy.method, copy.label, copy.iterations, copy.failed_at)
        )
        np.testing.assert_allclose(copy.result, row.result, rtol=1e-8)
        assert copy.errors == pytest.approx(row.errors)
    text = (tmp_path / "a" / "beam.md").read_text()
    assert "| MPM | paper | 0.500 |" in text
    assert "no equilibrium at load factor" in text
    table = [line.count("|") for line in text.split("\n\n")[0].splitlines()]
    assert len(set(table)) == 1


def test_figures_leave_failures_out(rows):
    ax = figures.errors(rows, "zero", over="h", slopes=(1,))
    labels = [line.get_label() for line in ax.lines]
    assert labels == ["MPM", "FEM", "order 1"]
    np.testing.assert_allclose(ax.lines[0].get_xdata(), [1.0, 0.5])
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [r.errors["zero"] for r in rows[:2]])


def test_orders_and_times():
    """Exact powers: order 2, and times between two discretisations on the line through them."""
    made = [study.Row("A", f"{h}", h, errors={"e": 3 * h**2}, cpu_s=h**-3) for h in (1.0, 0.5, 0.25)]
    made.append(study.Row("B", "1", 1.0, errors={"e": 0.1}, cpu_s=2.0))
    assert study.orders(made, "e") == {"A": pytest.approx([2.0, 2.0]), "B": []}
    assert study.time_for_error(made, "e", 3 * 0.35**2) == {"A": pytest.approx(0.35**-3), "B": 2.0}
    assert study.time_for_error(made, "e", 0.15) == {"B": 2.0}
    assert "**2.0**" in study.markdown_times(made, "e", [0.3])
    assert study.markdown_orders(made).count("2.00") == 2


def test_input_errors(tmp_path):
    good = discretisation(points)
    for changes, name in (
        ({"method": ""}, "method"),
        ({"h": 0.0}, "h"),
        ({"h": math.nan}, "h"),
        ({"steps": 0}, "steps"),
        ({"build": 3}, "build"),
        ({"build": lambda cell: None}, "build"),
        ({"arguments": {"cell": lambda: 1}}, "build"),
    ):
        with pytest.raises(pm.InputError, match=f"^{name} = "):
            discretisation(**({"build": points} | changes))
    with pytest.raises(pm.InputError, match="discretisations"):
        study.run([], {})
    with pytest.raises(pm.InputError, match="two are named 'MPM', '1 m'"):
        study.run([good, good], {})
    with pytest.raises(pm.InputError, match=r"no_case.*not a study\.Case"):
        study.run([discretisation(no_case, arguments={})], {})
    row = study.Row("A", "1", 1.0, (1.0, 2.0))
    with pytest.raises(pm.InputError, match="'exact' has the shape"):
        study.compare(row, {"exact": (1.0, 2.0, 3.0)})
    with pytest.raises(pm.InputError, match="name = 'e'"):
        study.orders([row], "e")
    with pytest.raises(pm.InputError, match="level = 0"):
        study.time_for_error([study.compare(row, {"e": (0, 0)})], "e", 0)
    with pytest.raises(pm.InputError, match="over = 'time'"):
        figures.errors([row], "e", over="time")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(pm.InputError, match=r"other.csv"):
        study.read_csv(tmp_path / "other.csv")


def test_a_script_is_enough(tmp_path):
    """Builders may be in the script itself; importing the package loads neither studies nor matplotlib."""
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\n"
        "import polarmpm as pm\n"
        "assert not {'polarmpm.study', 'matplotlib'} & set(sys.modules)\n"
        "from polarmpm import study\n"
        "def build():\n"
        "    grid = pm.Grid.box((0, 0), (1, 1), 1.0)\n"
        "    body = pm.seed(grid, material=pm.NeoHookean(lam=1e3, mu=1e3))\n"
        "    problem = pm.QuasiStatic(grid, body)\n"
        "    problem.fix(pm.plane(x=0.0), u=0)\n"
        "    return study.Case(problem, lambda: len(body))\n"
        "if __name__ == '__main__':\n"
        "    print(study.run([study.Discretisation('A', '1', 1.0, build, steps=1)], {'e': 3})[0].errors)\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "{'e': 1.0}", done.stderr[-2000:]
