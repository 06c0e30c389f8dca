"""A problem in a line, for a prompt or a log: nothing in it asks other ranks."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI


def of_rank(comm: MPI.Comm) -> str:
    """What counts are of."""
    return "" if comm.size == 1 else f" of rank {comm.rank}"


def described(problem: Any, body: str) -> str:
    """A problem's kind, body, conditions and progress.

    Args:
        body: what it is made of, with counts of this rank.
    """
    given = (("support", problem.supports), ("load", loads_of(problem)), ("term", problem.terms))
    counts = ", ".join(f"{len(some)} {name}{'' if len(some) == 1 else 's'}" for name, some in given)
    materials = ", ".join(dict.fromkeys(type(m).__name__ for m in problem.points.materials))
    p, system = problem.progress, problem.system
    unknowns = "" if system is None else f", {problem.unknowns} unknowns"
    return (
        f"{type(problem).__name__}({problem.layout.dim}D, {body}, {materials}; {counts}; load factor "
        f"{p.factor:.6g} after {p.step} step{'' if p.step == 1 else 's'}{unknowns})"
    )


def loads_of(problem: Any) -> tuple[Any, ...]:
    """Dead loads, and those on facets."""
    return (*problem.loads, *getattr(problem, "surface_loads", ()))
