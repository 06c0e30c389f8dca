"""Runs with the derivatives of their answers by the numbers that they are built of."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

import numpy as np

from ..errors import InputError, NotDifferentiable
from ..problems.boxes import UNRESISTED, unresisted
from ..solvers.stepping import Step
from ..tools import checks
from . import building, readers
from .building import Build, Observables
from .elementtangents import LinearisedElements
from .leading import Along, Leader
from .tangents import Linearised
from .twins import Apart, Twin

METHODS = ("twins", "exact")
_STEPS = {2: 3e-5, 1: 1e-6}  # of ln m, by the number of sides
_SMALLEST = 1e-9


@dataclass
class _Pair:
    """The twins of a parameter.

    Attributes:
        step: of ln m.
        twins: with more of it and, on two sides, with less.
        over: by what differences of answers are divided.
        check: largest imbalance of the last step.
    """

    name: str
    step: float
    twins: list[Twin]
    over: float
    check: float = 0.0

    def close(self) -> None:
        for twin in self.twins:
            twin.close()


class Sensitivity:
    """A run, and the derivatives of its answers by numbers that it is built of.

        def wire(p, diameter):
            material = pm.VonMises(elastic(p["n"]), k=p["k"], H=p["H"], l_p=p["l_p"])
            problem, top = ...
            return problem, {"torque": lambda: problem.reaction(top).moment[2]}

        run = pm.Sensitivity(wire, {"n": 0.25, "k": 150e6, "H": 75e6, "l_p": 3.7e-6}, diameter=20e-6)
        for step in run.march(steps=12):
            run.values["torque"], run.rates["torque"]["l_p"]

    Beside the run go twins, whose parameters are a little larger or smaller, through its own resets and load
    factors, with its own factors (docs/sensitivity.md). The run itself is the same to the last bit as
    without. Points and elements in statics; not with contact, in dynamics, or with assemblies "projection"
    and "dolfinx". With method="exact" derivatives are solved for. All calls are collective.

    Args:
        build: called with a dict of parameters, and `arguments`; returns a problem, with its supports and
            loads, that has taken no step yet, and observables by name: functions without arguments that give
            a number or an array of the problem's last converged step. The same numbers have to give the same
            problem, and other ones the same points or nodes.
        values: parameters by name; any names of the script's own.
        parameters: names of those by which to differentiate; default: all.
        method: "twins"; or "exact", the tangent-linear run: UFL's derivatives of the points' forms, with
            more digits. What it doesn't carry (of points the boxes of bodies of revolution, second gradients,
            rotations that get a new base; initial stresses of elements; surfaces along the path; observables
            such as energies) raises an InputError that says so. `sides` and `step` are those of twins.
        sides: 2: twins with a larger and a smaller value; 1: with a larger one only, at half the cost, and
            to fewer digits.
        step: of ln m between twin and run; default 3e-5, on one side 1e-6. Where it turns out to be too
            large, smaller ones are taken.
        arguments: of build.

    Attributes:
        problem: of the run; to look at, not to change.
        values: observables of the last step by name, numbers or arrays.
        rates: their derivatives by the parameters themselves: `rates[observable][parameter]`.
        check: by parameter: how much of a twin's imbalance its last step has left, at most 1e-3; derivatives
            of the step have about so large an error. 0: rounding is reached. With "exact": what the linear
            solution of the last step leaves.
        steps: of ln m by parameter, of twins.

    Raises:
        InputError: an argument isn't so; a parameter by which to differentiate is zero; a build that gives
            something else, isn't deterministic, or whose points or nodes change with a parameter; what
            method="exact" doesn't carry, then also in the course of a run.
    """

    def __init__(
        self,
        build: Build,
        values: Mapping[str, float],
        parameters: Sequence[str] | None = None,
        method: str = "twins",
        *,
        sides: int = 2,
        step: float | None = None,
        **arguments: Any,
    ):
        self._build = checks.function("build", build, "a function of the parameters is")
        self.given = building.checked_values(values)
        self.names = building.names_of(parameters, self.given)
        self.method = checks.choice("method", method, METHODS)
        self.sides = checks.whole("sides", sides, least=1, most=2)
        if step is not None:
            step = checks.number("step", step, least=_SMALLEST, most=1e-3)
        self._arguments = arguments
        self.steps = dict.fromkeys(self.names, step or _STEPS[self.sides])
        problem, self._observables = self._built(self.given)
        building.check_problem(problem)
        building.warn_of_resets(problem)
        self._check_deterministic(problem)
        self._leader = Leader(problem)
        self._linear: Linearised | None = None
        self._pairs: dict[str, _Pair] = {}
        if self.method == "exact":
            self._linear = self._linearised()
        else:
            self._pairs = {name: self._pair(self._leader, name) for name in self.names}
        self._given = building.conditions(problem)
        self._taken: list[float | Along] = []
        self._broken = ""
        self.values: dict[str, Any] = {}
        self.rates: dict[str, dict[str, Any]] = {}
        self.check: dict[str, float] = dict.fromkeys(self.names, 0.0)

    @property
    def problem(self) -> Any:
        """Of the run."""
        return self._leader.problem

    # building ---------------------------------------------------------------------------------------
    def _built(self, values: Mapping[str, float]) -> tuple[Any, Observables]:
        return building.built(self._build, values, self._arguments)

    def _check_deterministic(self, problem: Any) -> None:
        with building.quiet():
            other, _ = self._built(self.given)
        apart = building.difference(problem, other) or building.numbers_apart(problem, other)
        other.close()
        if problem.comm.allreduce(int(bool(apart))):
            raise InputError(
                f"build: called twice with the same numbers it gives two problems ({apart or 'elsewhere'} "
                "differ); it has to be deterministic: seed random numbers"
            )

    def _linearised(self) -> Linearised:
        """What solves for the derivatives."""
        building.check_carried(self.problem)
        kind = Linearised if self._leader.on_grid else LinearisedElements
        run, self.steps = kind(self._leader), {}
        for name in self.names:
            pair = [self._beside(self._leader, name, sign * readers.STEP)[:2] for sign in (1.0, -1.0)]
            run.add(name, readers.Reader(self._leader, name, pair))
        return run

    def _pair(self, leader: Leader, name: str) -> _Pair:
        twins, used = [], []
        for sign in (1.0, -1.0)[: self.sides]:
            problem, observables, value = self._beside(leader, name, sign * self.steps[name])
            twins.append(Twin(leader, problem, observables))
            used.append(value)
        if len(twins) == 2:
            twins[1].search.mirror = twins[0].search
        over = used[0] - (used[1] if self.sides == 2 else self.given[name])
        return _Pair(name, self.steps[name], twins, over)

    def _beside(self, leader: Leader, name: str, step: float) -> tuple[Any, Observables, float]:
        """The problem of another value, its observables, and the value."""
        value = self.given[name] * (1.0 + step)
        try:
            with building.quiet():
                problem, observables = self._built({**self.given, name: value})
        except InputError as e:
            raise InputError(
                f"{name}: twins have {value!r} beside {self.given[name]!r}, and build fails: {e}. At an "
                "edge of its range sides=1 has a larger value only; or leave it out of `parameters`"
            ) from e
        apart = building.difference(leader.problem, problem)
        if leader.problem.comm.allreduce(int(bool(apart))):
            raise InputError(
                f"{name}: {apart or 'points'} of the body change with it; parameters are differentiated "
                "by whose points, nodes and conditions stay: not a geometry. Compare two runs instead"
            )
        return problem, observables, value

    # running ----------------------------------------------------------------------------------------
    def march(self, steps: int | None = None, **options: Any) -> Iterator[Step]:
        """As `problem.march`; yields each step when its derivatives are known.

        Raises:
            NotDifferentiable: a twin can't go along, however small its step is; or its imbalance stays.
            As of `problem.march`.
        """
        self._check_whole()
        return self._followed(self.problem.march(steps, **options))

    def march_arc_length(self, first: float, **options: Any) -> Iterator[Step]:
        """As `problem.march_arc_length`. Derivatives are those at the same lengths along the path; load
        factors have derivatives, too."""
        self._check_whole()
        if self._linear is not None:
            building.check_path(self.problem)
        return self._followed(self.problem.march_arc_length(first, **options))

    def _check_whole(self) -> None:
        if self._broken:
            raise InputError(f"this run has ended early, make a new one: {self._broken}")
        if building.conditions(self.problem) != self._given:
            raise InputError(
                "problem: conditions have been added or released since the run was made; give all of them in "
                "build, as functions of the load factor if need be"
            )

    def _followed(self, steps: Iterator[Step]) -> Iterator[Step]:
        while True:
            self._check_whole()
            try:
                step = next(steps, None)
                if step is None:
                    return
                self._follow(step)
            except BaseException as e:
                self._broken = f"{type(e).__name__}: {e}"
                raise
            yield step

    def _follow(self, step: Step) -> None:
        """Let the twins take the step that the run has just taken."""
        building.check_kinks(self.problem)
        share = self.problem.system.unresisted if self._leader.on_grid else 0.0
        if share > UNRESISTED:
            trouble = f"{unresisted(share)} take more points a cell, fewer resets, or another basis"
            size = self.steps.get(self.names[0], 0.0)
            raise NotDifferentiable(self.names[0], step.number, step.factor, size, trouble)
        path = self._leader.record.path
        if self._linear is not None:
            self._linear.follow(self.problem)
            self.check = {name: t.check for name, t in zip(self.names, self._linear.tangents, strict=True)}
            return self._read()
        self._taken.append(self.problem.progress.factor if path is None else path)
        for name in self.names:
            pair = self._pairs[name]
            trouble = _take(pair, step)
            while trouble:
                pair, trouble = self._once_more(pair, trouble, step)
            self._pairs[name], self.check[name] = pair, pair.check
        self._read()

    def _once_more(self, pair: _Pair, trouble: str, step: Step) -> tuple[_Pair, str]:
        """Twins of a smaller step, taken from the beginning to where the run is; what is wrong with them."""
        pair.close()
        if 0.1 * pair.step < _SMALLEST:
            raise NotDifferentiable(pair.name, step.number, step.factor, pair.step, trouble)
        self.steps[pair.name] = 0.1 * pair.step
        followers = self._leader.followers
        followers[:] = [f for f in followers if f not in pair.twins]
        with building.quiet():
            problem, _ = self._built(self.given)
            leader = Leader(problem)
            made, trouble = self._pair(leader, pair.name), ""
            for taken in self._taken:
                self._repeat(problem, taken)
                trouble = _take(made, step)
                if trouble:
                    break
        problem.close()
        if not trouble:
            for twin in made.twins:
                twin.follow_on(self._leader)
        return made, trouble

    def _repeat(self, problem: Any, taken: float | Along) -> None:
        """Take a step of the run once more."""
        if isinstance(taken, Along):
            outcome, _ = problem.attempt_along(taken.length, taken.to, taken.kink)
        else:
            outcome = problem.attempt(taken)
        if not outcome.converged:
            raise InputError(f"build: a step of the run can't be repeated ({outcome.reason})")

    def _read(self) -> None:
        """Observables and their derivatives."""
        self.values = building.read(self._observables)
        rates: dict[str, dict[str, Any]] = {name: {} for name in self.values}
        for name, tangent in () if self._linear is None else self._linear.by_name():
            found = [building.read(o) for o in tangent.reader.observables]
            for observable, rate in tangent.reader.rates(self.values, found, self.given[name]).items():
                rates[observable][name] = rate
        for pair in self._pairs.values():
            found = [building.read(twin.observables) for twin in pair.twins]
            for name, value in self.values.items():
                other = found[1][name] if len(found) == 2 else value
                if np.shape(found[0][name]) != np.shape(value):
                    raise InputError(f"observables: {name} has another shape with another {pair.name}")
                rates[name][pair.name] = (found[0][name] - other) / pair.over
        self.rates = rates

    # end --------------------------------------------------------------------------------------------
    def close(self) -> None:
        """Free the memory of the run and its twins. Collective."""
        for pair in self._pairs.values():
            pair.close()
        if self._linear is not None:
            self._linear.close()
        self.problem.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: Any, error: Any, trace: TracebackType | None) -> None:
        if kind is None or self.problem.comm.size == 1:
            self.close()

    def __repr__(self) -> str:
        step = self.problem.progress.step
        return f"Sensitivity({', '.join(self.names)}; {step} steps of {self.problem!r})"


def _take(pair: _Pair, step: Step) -> str:
    """Let the twins of a parameter take the run's last step; what is wrong with them, empty if nothing."""
    pair.check = 0.0
    for twin in pair.twins:
        try:
            twin.follow()
        except Apart as e:
            return str(e)
        pair.check = max(pair.check, twin.check)
        twin.problem.steps.append(replace(step, factor=twin.problem.progress.factor))
    return ""
