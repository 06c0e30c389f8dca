"""From a UFL integrand or expression to C code that treats several points in one call.

FFCx compiles forms for cells; a material point has no cell of its own, only values at one quadrature
point. Here UFL expands all derivatives, and what is left is evaluated *symbolically*: every UFL node
becomes an array of scalar graph nodes. The graph shares common subexpressions, folds constants, and
keeps for every scalar the coefficients of the test and trial functions' components. The C code written
from it works on vectors of `LANES` points, with no loop and no branch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import ufl
from ufl import classes as uc
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives

from ..errors import KernelError
from .graph import Graph

Key = tuple[int, int]  # component of the test and of the trial function, -1 where there is none
Linear = dict[Key, int]  # a scalar, linear in test and trial function: graph node of every coefficient
FREE: Key = (-1, -1)
_BUNDLES = 1 << 20  # numbers from here on stand for bundles of components


@dataclass
class _Array:
    """Values of one UFL node: tensor axes first, then an axis for each free index."""

    data: np.ndarray
    free: tuple[int, ...] = ()


@dataclass
class Scalariser:
    """Evaluates expanded UFL into graph nodes.

    `slots` gives for each UFL terminal (coefficient, constant) the first input slot of its components, or all
    of them where they don't stand one after the other.

    A derivative in many directions is carried through a long expression of few scalars (a power series, say)
    as a combination of the derivatives of these scalars: with a positive `waist`, a derivative of more terms
    than that becomes one term, a bundle, before it is multiplied. `flat` undoes it.
    """

    slots: Mapping[Any, int | tuple[int, ...]]
    graph: Graph = field(default_factory=Graph)
    waist: int = 0

    def __post_init__(self) -> None:
        self._memo: dict[int, tuple[Any, _Array]] = {}
        self._bundles: list[dict[int, int]] = []  # graph nodes of the trial function's components
        self._known_bundles: dict[frozenset, int] = {}

    # bundles of derivatives -----------------------------------------------------------------------
    def _bundled(self, a: Linear) -> Linear:
        """A derivative as one term where it has more than `waist` of them."""
        if not self.waist or len(a) <= self.waist or any(i >= 0 or j < 0 for i, j in a):
            return a
        key = frozenset(a.items())
        if key not in self._known_bundles:
            self._known_bundles[key] = _BUNDLES + len(self._bundles)
            self._bundles.append({j: node for (_, j), node in self.flat(a).items()})
        return {(-1, self._known_bundles[key]): self.graph.one}

    def flat(self, a: Linear) -> Linear:
        """Coefficients of the components of test and trial functions themselves."""
        out: Linear = {}
        for (i, j), node in a.items():
            parts = self._bundles[j - _BUNDLES] if j >= _BUNDLES else {j: self.graph.one}
            out = self._ladd(out, {(i, k): self.graph.mul(node, part) for k, part in parts.items()})
        return out

    # scalars, linear in test and trial function -------------------------------------------------
    def lin(self, node: int) -> Linear:
        return {} if node == self.graph.zero else {FREE: node}

    def _ladd(self, a: Linear, b: Linear) -> Linear:
        if not a or not b:
            return a or b
        out = dict(a)
        for key, node in b.items():
            total = self.graph.add(out[key], node) if key in out else node
            if total == self.graph.zero:
                out.pop(key, None)
            else:
                out[key] = total
        return out

    def _lmul(self, a: Linear, b: Linear) -> Linear:
        out: Linear = {}
        a, b = self._bundled(a), self._bundled(b)
        for (i, j), x in a.items():
            for (k, l), y in b.items():
                if (i >= 0 and k >= 0) or (j >= 0 and l >= 0):
                    raise KernelError("the form is not linear in its test and trial functions")
                out = self._ladd(out, {(max(i, k), max(j, l)): self.graph.mul(x, y)})
        return out

    def plain(self, a: Linear) -> int:
        """The graph node of a scalar that contains neither test nor trial function."""
        if any(key != FREE for key in a):
            raise KernelError("a nonlinear function is applied to a test or trial function")
        return a.get(FREE, self.graph.zero)

    # UFL nodes ----------------------------------------------------------------------------------
    def scalar(self, expr: Any) -> Linear:
        """Evaluate a scalar expression."""
        value: Linear = self(expr).data.item()
        return value

    def __call__(self, expr: Any) -> _Array:
        """Evaluate an expression, operands first (without recursion: UFL graphs are deep)."""
        stack = [expr]
        while stack:
            e = stack[-1]
            if id(e) in self._memo:
                stack.pop()
                continue
            waiting = [o for o in self._operands(e) if id(o) not in self._memo]
            if waiting:
                stack.extend(waiting)
            else:
                self._memo[id(e)] = (e, self._evaluate(e))  # keeps e alive, so its id stays unique
                stack.pop()
        return self._memo[id(expr)][1]

    @staticmethod
    def _operands(e: Any) -> Sequence[Any]:
        if isinstance(e, uc.Variable):
            return e.ufl_operands[:1]
        if isinstance(e, (uc.Indexed, uc.ComponentTensor, uc.IndexSum)):
            return e.ufl_operands[:1]
        return e.ufl_operands

    def _get(self, e: Any) -> _Array:
        return self._memo[id(e)][1]

    def _evaluate(self, e: Any) -> _Array:
        for kind, method in _HANDLERS:
            if isinstance(e, kind):
                return method(self, e)
        raise KernelError(f"UFL's {type(e).__name__} can't be used at material points: {str(e)[:80]}")

    def _terminal(self, e: Any) -> _Array:
        if e not in self.slots:
            raise KernelError(f"{e} is not an input of this kernel")
        slots = self.slots[e]

        def value(n: int) -> Linear:
            return self.lin(self.graph.input(slots + n if isinstance(slots, int) else slots[n]))

        return self._fill(e.ufl_shape, value)

    @staticmethod
    def _fill(shape: tuple[int, ...], make: Callable[[int], Linear]) -> _Array:
        data = np.empty(shape, dtype=object)
        for n, index in enumerate(np.ndindex(*shape)):
            data[index] = make(n)
        return _Array(data)

    def _argument(self, e: Any) -> _Array:
        number = e.number()
        return self._fill(e.ufl_shape, lambda n: {((n, -1) if number == 0 else (-1, n)): self.graph.one})

    def _zero(self, e: Any) -> _Array:
        data = np.empty(e.ufl_shape + tuple(e.ufl_index_dimensions), dtype=object)
        for index in np.ndindex(*data.shape):
            data[index] = {}
        return _Array(data, tuple(e.ufl_free_indices))

    def _number(self, e: Any) -> _Array:
        return self._fill((), lambda n: self.lin(self.graph.constant(float(e))))

    def _identity(self, e: Any) -> _Array:
        dim = e.ufl_shape[0]
        return self._fill(e.ufl_shape, lambda n: self.lin(self.graph.constant(n // dim == n % dim)))

    def _indexed(self, e: Any) -> _Array:
        a = self._get(e.ufl_operands[0])
        fixed: list[int | slice] = []
        labels: list[int] = []
        for index in e.ufl_operands[1]:
            if isinstance(index, uc.FixedIndex):
                fixed.append(int(index))
            else:
                fixed.append(slice(None))
                labels.append(index.count())
        return self._sorted(a.data[(*fixed, Ellipsis)], labels + list(a.free), 0)

    @staticmethod
    def _sorted(data: np.ndarray, labels: list[int], rank: int) -> _Array:
        """Sort the free axes (after `rank` tensor axes) by label; a repeated label is a diagonal."""
        while len(set(labels)) < len(labels):
            label = next(l for l in labels if labels.count(l) > 1)
            i, j = [k for k, l in enumerate(labels) if l == label][:2]
            data = np.diagonal(data, axis1=rank + i, axis2=rank + j)  # the diagonal becomes the last axis
            labels = [l for k, l in enumerate(labels) if k not in (i, j)] + [label]
        order = sorted(range(len(labels)), key=labels.__getitem__)
        axes = list(range(rank)) + [rank + k for k in order]
        out = np.empty(tuple(data.shape[k] for k in axes), dtype=object)
        out[...] = np.transpose(data, axes) if data.ndim else data
        return _Array(out, tuple(labels[k] for k in order))

    def _component_tensor(self, e: Any) -> _Array:
        a = self._get(e.ufl_operands[0])
        bound = [index.count() for index in e.ufl_operands[1]]
        rest = [l for l in a.free if l not in bound]
        axes = [a.free.index(l) for l in bound + rest]
        return _Array(np.transpose(a.data, axes), tuple(rest))

    def _index_sum(self, e: Any) -> _Array:
        a = self._get(e.ufl_operands[0])
        label = e.ufl_operands[1][0].count()
        axis = a.data.ndim - len(a.free) + a.free.index(label)
        rest = tuple(l for l in a.free if l != label)
        moved = np.moveaxis(a.data, axis, 0)
        out = np.empty(moved.shape[1:], dtype=object)
        for index in np.ndindex(*out.shape):
            total: Linear = {}
            for k in range(moved.shape[0]):
                total = self._ladd(total, moved[(k, *index)])
            out[index] = total
        return _Array(out, rest)

    def _list_tensor(self, e: Any) -> _Array:
        parts = [self._get(o) for o in e.ufl_operands]
        out = np.empty((len(parts), *parts[0].data.shape), dtype=object)
        for k, part in enumerate(parts):
            out[k, ...] = part.data  # the Ellipsis unpacks arrays without axes
        return _Array(out, parts[0].free)

    def _variable(self, e: Any) -> _Array:
        return self._get(e.ufl_operands[0])

    def _pointwise(self, operands: Sequence[Any], function: Callable[..., Linear]) -> _Array:
        """Apply a function of scalars; operands with different free indices are multiplied out.

        Equal tensor axes (a sum of tensors) go along unchanged.
        """
        arrays = [self._get(o) for o in operands]
        labels = sorted({l for a in arrays for l in a.free})
        rank = max(a.data.ndim - len(a.free) for a in arrays)
        views = []
        for a in arrays:
            shape = list(a.data.shape[: a.data.ndim - len(a.free)])
            shape = [1] * (rank - len(shape)) + shape
            sizes = dict(zip(a.free, a.data.shape[a.data.ndim - len(a.free) :], strict=True))
            views.append(a.data.reshape(shape + [sizes.get(l, 1) for l in labels]))
        out = np.empty(np.broadcast_shapes(*(v.shape for v in views)), dtype=object)
        views = [np.broadcast_to(v, out.shape) for v in views]
        for index in np.ndindex(*out.shape):
            out[index] = function(*(v[index] for v in views))
        return _Array(out, tuple(labels))

    def _sum(self, e: Any) -> _Array:
        return self._pointwise(e.ufl_operands, self._ladd)

    def _product(self, e: Any) -> _Array:
        return self._pointwise(e.ufl_operands, self._lmul)

    def _division(self, e: Any) -> _Array:
        g = self.graph

        def divide(a: Linear, b: Linear) -> Linear:
            return {key: g.div(node, self.plain(b)) for key, node in self._bundled(a).items()}

        return self._pointwise(e.ufl_operands, divide)

    def _function(self, name: str) -> Callable[[Any], _Array]:
        def evaluate(e: Any) -> _Array:
            return self._pointwise(
                e.ufl_operands, lambda *args: self.lin(self.graph.call(name, *map(self.plain, args)))
            )

        return evaluate

    def _math(self, e: Any) -> _Array:
        name = {"ln": "log"}.get(e._name, e._name)
        return self._function(name)(e)

    def _conditional(self, e: Any) -> _Array:
        g = self.graph

        def select(c: Linear, a: Linear, b: Linear) -> Linear:
            out: Linear = {}
            for key in {**a, **b}:
                node = g._add(("select", self.plain(c), a.get(key, g.zero), b.get(key, g.zero)))
                out[key] = node
            return out

        return self._pointwise(e.ufl_operands, select)


def _named(name: str) -> Callable[[Scalariser, Any], _Array]:
    return lambda self, e: self._function(name)(e)


_HANDLERS: list[tuple[Any, Callable[[Scalariser, Any], _Array]]] = [
    ((uc.Coefficient, uc.Constant), Scalariser._terminal),
    (uc.Argument, Scalariser._argument),
    (uc.Zero, Scalariser._zero),
    (uc.ScalarValue, Scalariser._number),
    (uc.Identity, Scalariser._identity),
    (uc.Indexed, Scalariser._indexed),
    (uc.ComponentTensor, Scalariser._component_tensor),
    (uc.IndexSum, Scalariser._index_sum),
    (uc.ListTensor, Scalariser._list_tensor),
    ((uc.Variable, uc.Conj, uc.Real), Scalariser._variable),  # real arithmetic only
    (uc.Sum, Scalariser._sum),
    (uc.Product, Scalariser._product),
    (uc.Division, Scalariser._division),
    (uc.Power, _named("pow")),
    (uc.Abs, _named("fabs")),
    (uc.MathFunction, Scalariser._math),
    (uc.Atan2, _named("atan2")),
    (uc.MinValue, _named("fmin")),
    (uc.MaxValue, _named("fmax")),
    (uc.Conditional, Scalariser._conditional),
    (uc.LT, _named("<")),
    (uc.GT, _named(">")),
    (uc.LE, _named("<=")),
    (uc.GE, _named(">=")),
    (uc.EQ, _named("==")),
    (uc.NE, _named("!=")),
    (uc.AndCondition, _named("&")),
    (uc.OrCondition, _named("|")),
    (uc.NotCondition, _named("!")),
]


def expand(expr: Any) -> Any:
    """Let UFL lower tensor algebra and carry out every derivative."""
    return apply_derivatives(apply_algebra_lowering(apply_derivatives(apply_algebra_lowering(expr))))


def coefficients(scalar: Linear, shape: tuple[int, ...], zero: int) -> list[int]:
    """Graph nodes of the coefficients of the test (and trial) functions' components, row by row."""
    if len(shape) == 1:
        return [scalar.get((i, -1), zero) for i in range(shape[0])]
    return [scalar.get((i, j), zero) for i in range(shape[0]) for j in range(shape[1])]


def integrand(form: ufl.Form) -> Any:
    """The integrand of a form with a single integral."""
    integrals = form.integrals()
    if len(integrals) != 1:
        raise KernelError(f"a point form has one integral, not {len(integrals)}")
    return integrals[0].integrand()
