"""What a run says by itself, a line each on standard error (logger "polarmpm"): settings that aren't the
recommended ones, and at its end how far the answer can be trusted."""

from __future__ import annotations

import logging
from typing import Any

from ..solvers.stepping import Step, clock_of
from ..tools.saying import say, say_once


def note_settings(problem: Any) -> None:
    """Name settings of material points that aren't those of the least error for their time, once."""
    unusual = [f"basis={problem.basis.name!r}"] if problem.basis.costly else []
    if problem.basis.fills_boxes and not problem.boxes:
        unusual.append("boxes=False")
    if not problem.balanced_reset and clock_of(problem) != "time":
        unusual.append("balanced_reset=False")
    if unusual and problem.comm.rank == 0:
        say_once(
            logging.INFO,
            f"{', '.join(unusual)}: not the recommended settings, which have less error for their time "
            "(docs/accuracy.md)",
        )


def report(problem: Any, steps: list[Step]) -> None:
    """Say at the end of a march how far it has come, and how far the answer can be trusted."""
    if not steps or problem.comm.rank:
        return
    count, cuts = len(steps), sum(step.cuts for step in steps)
    tried = f", {cuts} cut{'' if cuts == 1 else 's'}" if cuts else ""
    iterations = sum(step.iterations for step in steps)
    unit = " s" if clock_of(problem) == "time" else ""
    say(
        logging.INFO,
        f"{count} step{'' if count == 1 else 's'} to {clock_of(problem)} {problem.progress.factor:.6g}{unit} "
        f"({iterations} iterations{tried}); {problem.trust()}",
    )
