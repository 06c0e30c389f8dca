"""Studies: which discretisation gives this error in the least time?

A list of discretisations is run, each in a process of its own, and what each found and cost becomes a row of
a table:

    from polarmpm import study

    def build(cell):  # at the top level of a module or script, so that the other process finds it
        ...
        return study.Case(problem, result=lambda: points.mean_displacement(tip))

    if __name__ == "__main__":
        discretisations = [
            study.Discretisation("GIMPM", f"{h:g} m", h, build, {"cell": h}, steps=10) for h in (1.0, 0.5)
        ]
        rows = study.run(discretisations, {"beam": (0.0, -6.8)})
        study.write(rows, "results/beam", unit="m")
"""

from __future__ import annotations

import os
from collections.abc import Sequence

from ..tools import checks
from . import figures
from .discretisations import PHASES, Case, Discretisation, Row
from .running import compare, run
from .tables import (
    check_rows,
    digits,
    error_names,
    markdown,
    markdown_orders,
    markdown_phases,
    markdown_times,
    methods,
    orders,
    read_csv,
    time_for_error,
    write_csv,
    write_text,
)


def write(
    rows: Sequence[Row],
    folder: str | os.PathLike[str],
    *,
    name: str = "study",
    unit: str = "",
    published: Sequence[Row] = (),
) -> None:
    """Write <name>.csv, <name>.md, and figures of errors over cell size and over CPU time, and of phases.

    Args:
        unit: of result and errors.
        published: results from elsewhere, with errors and cost; open markers in the figures.

    Raises:
        InputError: the files can't be written.
    """
    path = checks.path("folder", folder, "the name of a folder")
    checks.text("name", name)
    write_csv(rows, path / f"{name}.csv")
    published = check_rows("published", published)
    text = markdown([*rows, *published], unit=unit) + "\n" + markdown_phases(rows)
    write_text(path / f"{name}.md", text)
    for over in ("h", "cpu_s"):
        figures.save_errors(rows, path / f"{name}_{over}.png", over=over, unit=unit, published=published)
    figures.save_phases(rows, path / f"{name}_phases.png")


__all__ = [
    "PHASES",
    "Case",
    "Discretisation",
    "Row",
    "compare",
    "digits",
    "error_names",
    "figures",
    "markdown",
    "markdown_orders",
    "markdown_phases",
    "markdown_times",
    "methods",
    "orders",
    "read_csv",
    "run",
    "time_for_error",
    "write",
    "write_csv",
    "write_text",
]
