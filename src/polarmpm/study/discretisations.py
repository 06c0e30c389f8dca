"""What a study is made of: discretisations, and rows of what they found and cost."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..errors import InputError
from ..problems.base import Problem
from ..tools import checks

# the order in which tables and figures have them; "rest" is what no phase has
PHASES = ("assembly", "factor", "solve", "update", "reset", "pattern", "conditions", "rest")


@dataclass
class Case:
    """What a discretisation's `build` returns.

    Attributes:
        problem: ready to march.
        result: function without arguments that gives a number or a vector after the last step.
        kernel: CPU seconds that the material's kernel needs at all points, for the residual alone (False) or
            with the tangent (True); None where the assembly can't be taken apart.

    Raises:
        InputError: not a problem, not functions.
    """

    problem: Problem
    result: Callable[[], Any]
    kernel: Callable[[bool], float] | None = None

    def __post_init__(self) -> None:
        checks.instance("problem", self.problem, Problem, "a problem, ready to march, is")
        checks.function("result", self.result, "a function without arguments is")
        if self.kernel is not None:
            checks.function("kernel", self.kernel, takes=("tangent",))


@dataclass(frozen=True)
class Discretisation:
    """Method, cell size and steps with which a study runs its problem.

    Attributes:
        method: its line in figures.
        label: names it within its method.
        h: cell size (m).
        build: function at the top level of a module or of the script; makes the `Case`.
        arguments: of `build`, by keyword.
        steps: number of load steps.
        adaptive: cut steps that fail.

    Raises:
        InputError: an argument is out of range, or can't be sent to another process.
    """

    method: str
    label: str
    h: float
    build: Callable[..., Case]
    arguments: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 10
    adaptive: bool = False

    def __post_init__(self) -> None:
        for name in ("method", "label"):
            checks.text(name, getattr(self, name), "a text is needed")
        h = checks.number("h", self.h, above=0.0, allowed="a positive cell size")
        object.__setattr__(self, "h", h)
        object.__setattr__(self, "steps", checks.whole("steps", self.steps, least=1))
        checks.flag("adaptive", self.adaptive)
        checks.function("build", self.build)
        named = isinstance(self.arguments, Mapping) and all(isinstance(name, str) for name in self.arguments)
        if not named:
            raise checks.refuse("arguments", self.arguments, "arguments of build by name are needed")
        try:
            pickle.dumps((self.build, dict(self.arguments)))
        except Exception as e:  # a script's classes may raise anything
            raise InputError(
                f"build = {checks.shown(self.build)}: it and its arguments must be known by name to another "
                f"process; functions at the top level of a module or script are ({e})"
            ) from None


@dataclass(frozen=True)
class Row:
    """What a discretisation found and cost; also a published result, with what is known of it.

    Attributes:
        result: number or vector after the last step.
        errors: distance of the result to each reference, by its name.
        unknowns, points: prescribed unknowns included; of finite elements quadrature points.
        steps, iterations, cuts: load steps, linear solves and failed attempts.
        cpu_s: CPU seconds of the load steps, but for compiling and files; None if not known.
        phases: parts of `cpu_s` (s), see `PHASES`.
        kernel_s: part of the assembly that the material's kernel needs (s); None if not known.
        startup_s: CPU seconds of all the rest before the last step: imports, set-up, compiling.
        peak_memory_mb: most memory in use (MB).
        failed_at: load factor at which there was no equilibrium; None for success.
        failure: why it failed, in words.
    """

    method: str
    label: str
    h: float
    result: tuple[float, ...] = ()
    errors: Mapping[str, float] = field(default_factory=dict)
    unknowns: int = 0
    points: int = 0
    steps: int = 0
    iterations: int = 0
    cuts: int = 0
    cpu_s: float | None = None
    phases: Mapping[str, float] = field(default_factory=dict)
    kernel_s: float | None = None
    startup_s: float | None = None
    peak_memory_mb: float | None = None
    failed_at: float | None = None
    failure: str = ""

    def __post_init__(self) -> None:
        for name in ("method", "label"):
            checks.text(name, getattr(self, name), "a text is needed")
        checks.number("h", self.h, above=0.0, allowed="a positive cell size")
