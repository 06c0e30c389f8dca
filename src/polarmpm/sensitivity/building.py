"""Problems that a script's function builds of numbers: called, checked and compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..assembly.pointboxes import has_boxes
from ..errors import InputError, TrustWarning
from ..forms.elementkernels import NativeElementForms
from ..materials.base import parameter_values
from ..problems.elements import QuasiStaticFEM
from ..problems.motion import Moving
from ..problems.points import QuasiStatic
from ..solvers.resetting import Never
from ..terms.ghost import Ghost
from ..terms.obstacles import Obstacle
from ..tools import checks
from ..tools.checks import shown
from ..tools.parallel import warn_on_one_rank
from .surfacechanges import follows
from .twins import quiet as quiet

Observables = Mapping[str, Callable[[], Any]]
Build = Callable[..., tuple[Any, Observables]]
_GEOMETRY = ("id", "X", "volume0", "half_length0", "half_axes0", "material")  # of points, what has to stay


def checked_values(values: Any) -> dict[str, float]:
    """Parameters by name; any texts are names."""
    if not isinstance(values, Mapping) or not values:
        raise checks.refuse("values", values, 'parameters by name are needed, such as {"E": 1e6}')
    return {checks.text("values: name", k): checks.number(str(k), v) for k, v in values.items()}


def names_of(parameters: Sequence[str] | None, values: Mapping[str, float]) -> list[str]:
    """Names by which to differentiate.

    Raises:
        InputError: unknown names, or none; a value that is zero.
    """
    if parameters is None:
        names = list(values)
    else:
        allowed = f"names of {', '.join(values)} are"
        if isinstance(parameters, str) or not isinstance(parameters, Sequence):
            raise checks.refuse("parameters", parameters, allowed)
        names = [checks.choice("parameters", name, list(values)) for name in parameters]
    if not names or len(set(names)) < len(names):
        raise checks.refuse("parameters", parameters, f"different names of {', '.join(values)} are needed")
    for name in names:
        if values[name] == 0.0:
            raise InputError(
                f"{name} = 0: steps are shares of a parameter, and there is none of zero; leave it out of "
                "`parameters`, or give a small value that counts as nothing"
            )
    return names


def built(build: Build, values: Mapping[str, float], arguments: Mapping[str, Any]) -> tuple[Any, Observables]:
    """What build gives. Collective.

    Raises:
        InputError: not a problem and observables.
    """
    found = build(dict(values), **arguments)
    if not (isinstance(found, tuple) and len(found) == 2):
        raise InputError(
            f"build returned {shown(found)}; a problem and observables are needed: "
            'return problem, {"name": function}'
        )
    problem, observables = found
    if not isinstance(observables, Mapping) or not observables:
        raise checks.refuse(
            "observables", observables, "functions without arguments by name are needed, from build"
        )
    for name, function in observables.items():
        checks.text("observables", name)
        checks.function(f"observables: {name}", function, "a function without arguments is")
    checks.instance(
        "build: problem",
        problem,
        (QuasiStatic, QuasiStaticFEM),
        "a polarmpm.QuasiStatic or QuasiStaticFEM is",
    )
    return problem, dict(observables)


def check_problem(problem: Any) -> None:
    """Raise InputError unless twins of a problem can be made."""
    if isinstance(problem, Moving):
        name = type(problem).__name__
        raise InputError(f"build: {name} can't be differentiated; allowed are QuasiStatic and QuasiStaticFEM")
    if problem.progress.step:
        raise InputError(
            f"build: the problem has taken {problem.progress.step} step(s) already; one without any is needed"
        )
    for term in problem.terms:
        if isinstance(term, Obstacle) or getattr(term, "kinked", False):
            raise InputError(
                f"{term.name}: contact begins and ends with kinks, which have no derivative; runs with "
                "contact aren't differentiated"
            )
    if isinstance(problem, QuasiStatic):
        if problem.assembly != "direct":
            raise InputError(
                f"assembly = {problem.assembly!r}: runs are differentiated with assembly 'direct'"
            )
        if problem.regridding.repeats:
            raise InputError(
                "regrid: runs whose steps may be taken again in another grid aren't differentiated; let a "
                "first run end, and give its lines (problem.grid.lines) from the start"
            )
    elif not isinstance(problem.forms, NativeElementForms):
        raise InputError(
            "elements of assembly 'dolfinx', which those with second gradients take, aren't differentiated; "
            "allowed is assembly = 'native'"
        )


def check_carried(problem: Any) -> None:
    """Raise InputError for what the tangent-linear run doesn't carry."""
    apart = ""
    grid = isinstance(problem, QuasiStatic)
    if problem.at_rest and not grid:
        apart = "initial stresses of elements"
    elif problem.at_rest and any(follows(t) for t in problem.terms):
        apart = "initial stresses of bodies with conditions on surfaces"
    elif problem._changes:
        apart = "materials that change"
    elif not grid:
        apart = ""
    elif problem.layout.axial and problem.boxes and has_boxes(problem.points):
        apart = "the boxes of points of a body of revolution (boxes=False: carried)"
    elif problem.regridding.policy is not None:
        apart = "other grids in the course of the run"
    elif any(form.layout.second for form in problem.forms):
        apart = "second gradients"
    others = [t.name for t in problem.terms if not (isinstance(t, Ghost) or follows(t))]
    apart = apart or (others[0] if others else "")
    if apart:
        raise _not_carried(apart)


def _not_carried(what: str) -> InputError:
    return InputError(f'method = "exact": {what} aren\'t carried; take method="twins", which does')


def check_path(problem: Any) -> None:
    """Raise InputError for what the tangent-linear run doesn't carry along the path."""
    others = [term.name for term in problem.terms if not isinstance(term, Ghost)]
    if others:
        raise _not_carried(f"{others[0]}: conditions on surfaces along the path")


def check_whole_points(problem: Any) -> None:
    """Raise InputError at a reset that has split points, which the tangent-linear run doesn't carry."""
    if problem.regridding.split:
        raise _not_carried("points that a reset splits, with boxes as large as a cell,")


def check_step(problem: Any, leader: Any) -> None:
    """Raise InputError after a step that the tangent-linear run doesn't carry."""
    if leader.rebased and leader.on_grid:
        raise _not_carried("rotations that get a new base between resets (`rotation_limit`)")
    if any(s is not None and s.dilates for s in getattr(problem.system, "projected", ())):
        raise _not_carried(
            "plastic flow that dilates and shares the volumes of cells out (locking=None: carried)"
        )
    path = leader.record.path
    if path is not None and path.relaxed is not None:
        raise _not_carried("steps along the path that begin with much out of balance")


def warn_of_resets(problem: Any) -> None:
    """Where resets lose much of the stresses, a derivative isn't what a fit needs. Collective."""
    if not isinstance(problem, QuasiStatic) or problem.balanced_reset or isinstance(problem.policy, Never):
        return
    warn_on_one_rank(
        problem.comm,
        "balanced_reset = False: what resets lose makes answers a sawtooth in the parameters. Derivatives "
        "are those of its teeth, which may be off the trend by 10 % and more; with the default resets by "
        "less than 1 % (docs/sensitivity.md)",
        TrustWarning,
    )


def check_kinks(problem: Any) -> None:
    """Raise InputError where terms act whose forces have kinks."""
    kinked = [piece.name for piece in problem.system.terms.pieces if piece.kinked]
    if kinked:
        raise InputError(f"{kinked[0]}: its forces have kinks, which have no derivative")


def conditions(problem: Any) -> list[tuple[str, bool]]:
    """What acts on the body, and whether it has been released."""
    return [(given.name, given.released is not None) for given in problem.given.entries]


def difference(problem: Any, other: Any) -> str:
    """What of the body or its conditions differs in two problems; empty if nothing does. Local."""
    if type(problem) is not type(other):
        return "classes"
    for name, here, there in _geometry(problem, other):
        if here.shape != there.shape or not np.array_equal(here, there):
            return name
    if conditions(problem) != conditions(other):
        return "conditions"
    materials = ([type(m) for m in p.points.materials] for p in (problem, other))
    return "" if len({tuple(kinds) for kinds in materials}) == 1 else "materials"


def _geometry(problem: Any, other: Any) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    words = {"X": "positions", "volume0": "volumes", "id": "numbers"}
    for name in _GEOMETRY:
        arrays = [np.asarray(getattr(p.points, name)) for p in (problem, other)]
        yield f"{words.get(name, name)} of points", arrays[0], arrays[1]
    if isinstance(problem, QuasiStatic):
        grids = [p.initial_grid for p in (problem, other)]
        yield "grids", np.array(grids[0].shape), np.array(grids[1].shape)
        for axis in range(problem.initial_grid.dim):
            lines = [np.array([g.plane(axis, i) for i in range(g.shape[axis] + 1)]) for g in grids]
            yield "grids", lines[0], lines[1]
    else:
        yield "nodes", problem.elements.nodes.position, other.elements.nodes.position


def numbers_apart(problem: Any, other: Any) -> str:
    """Whether materials or loads of two problems have other numbers; empty if not. Collective."""
    pairs = zip(problem.points.materials, other.points.materials, strict=True)
    if any(not np.array_equal(parameter_values(a), parameter_values(b)) for a, b in pairs):
        return "numbers of materials"
    loads = [np.hstack(p._loads_at(1.0)) for p in (problem, other)]
    return "" if np.array_equal(loads[0], loads[1]) else "loads"


def read(observables: Observables) -> dict[str, Any]:
    """Values of observables: numbers, or arrays of their own. Collective.

    Raises:
        InputError: one is something else.
    """
    out: dict[str, Any] = {}
    for name, function in observables.items():
        found = function()
        array = checks.numeric(f"observables: {name}", found, "a number, or an array of numbers,")
        out[name] = float(array) if array.ndim == 0 else np.array(array, dtype=float)
    return out
