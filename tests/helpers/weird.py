"""Values that nobody should give, and those that somebody will: strategies of Hypothesis for property tests.

A property calls something with such values and asks that it raises an error of the package or keeps its
promise: `answer = attempt(f, ...)`, None after an error. Any other exception is a failure.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

import polarmpm as pm

INF, NAN = float("inf"), float("nan")


def thorough(examples: int) -> settings:
    """Settings of the suite's properties: the same examples in every run, and on every rank."""
    return settings(
        max_examples=examples,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )


def attempt(function: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """What a call returns; None after an error of the package, whose message must say something."""
    try:
        return function(*args, **options)
    except pm.PolarMPMError as e:
        if len(str(e)) < 10:
            raise AssertionError(f"{e!r} says nothing") from e
        return None


class Rude:
    """Raises whatever is asked of it."""

    def __array__(self, *args: Any, **options: Any) -> np.ndarray:
        raise RuntimeError("no")

    def __len__(self) -> int:
        raise RuntimeError("no")

    def __float__(self) -> float:
        raise RuntimeError("no")


sizes = st.sampled_from(
    [0, 1, -1, 2, 3, 5, 0.5, 1.0, -0.5, 1e-12, 1e-300, 1e12, 1e300, 1e308, -1e300, INF, NAN]
)
numbers = st.one_of(
    sizes,
    st.integers(-3, 10),
    st.floats(-10, 10),
    st.sampled_from([np.float32(0.5), np.float64(2), np.int8(3), np.int64(2), np.uint16(1), np.array(1.5)]),
    st.sampled_from([10**30, 10**400, Fraction(1, 2), True, np.bool_(1), np.float16(NAN)]),
)
objects: st.SearchStrategy[Any] = st.one_of(
    st.sampled_from(
        [None, "", "x", "1", "auto", b"a", 1j, np.complex64(1), {}, {"a": 1.0}, set(), ..., range(2)]
    ),
    st.builds(object),
    st.builds(Rude),
    st.sampled_from([str, pm.Points, id, np.exp, np.array("a"), np.array(None), np.datetime64("2020")]),
    st.builds(lambda: lambda *args: None),
)
short_lists: st.SearchStrategy[Any] = st.one_of(
    st.lists(numbers, max_size=4),
    st.lists(st.one_of(numbers, objects), max_size=3).map(tuple),
    st.sampled_from(
        [[[1, 2], [3]], [[1.0, 2.0]], np.zeros(0), np.zeros((0, 2)), np.ones(2), np.ones((2, 2))]
    ),
    st.sampled_from(
        [np.array([NAN, 1.0]), np.array(["a", "b"]), np.ones(3, dtype=complex), np.ones(2, bool)]
    ),
)
anything = st.one_of(numbers, objects, short_lists)
flags = st.one_of(st.sampled_from([True, False, np.bool_(1)]), anything)


def vectors(dim: int) -> st.SearchStrategy[Any]:
    """Of so many components, mostly."""
    plain = st.tuples(*[st.floats(-5, 5)] * dim)
    wild = st.tuples(*[numbers] * dim)
    return st.one_of(plain, plain.map(np.array), plain.map(list), wild, anything)


def arrays(*shape: int) -> st.SearchStrategy[Any]:
    """Numbers of a shape, mostly; some of them may be no numbers."""
    random = st.integers(0, 99).map(lambda seed: np.random.default_rng(seed).uniform(0.1, 1.0, shape))

    def spoiled(array: np.ndarray, value: Any) -> Any:
        out = array.astype(object)
        if out.size:
            out.flat[out.size // 2] = value
        return out.tolist()

    one_less = random.map(lambda a: a[:-1])
    types = st.sampled_from([np.float32, np.int64, bool, complex, str, object])
    other = st.builds(lambda a, t: a.astype(t), random, types)
    return st.one_of(
        random, random.map(np.ndarray.tolist), st.builds(spoiled, random, anything), one_less, other, anything
    )


def predicates(plain: Callable[[np.ndarray], np.ndarray]) -> st.SearchStrategy[Any]:
    """Functions of positions that give a bool for each, mostly."""

    def changes(x: np.ndarray) -> np.ndarray:
        found = plain(x)
        x[:] = NAN
        return found

    return st.one_of(
        st.sampled_from(
            [
                plain,
                changes,
                lambda x: plain(x).tolist(),
                lambda x: plain(x).astype(int),
                lambda x: plain(x)[:-1],
                lambda x: plain(x)[:, None],
                lambda x: np.flatnonzero(plain(x)),
                lambda x: np.zeros(len(x), dtype=bool),
                lambda x: np.full(len(x), NAN),
                lambda x, y: plain(x),
                lambda: True,
                lambda x: Rude(),
                lambda x: [[1], [1, 2]],
            ]
        ),
        anything.map(lambda value: lambda x: value),
        anything,
    )
