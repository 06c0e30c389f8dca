"""Graph of scalar operations: what is left of a UFL expression when tensors and derivatives are gone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

# numpy's functions by C's names, and other operations
_NUMPY: dict[str, Any] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide, "neg": np.negative,
    "<": np.less, ">": np.greater, "<=": np.less_equal, ">=": np.greater_equal, "==": np.equal,
    "!=": np.not_equal, "&": np.logical_and, "|": np.logical_or, "!": np.logical_not,
    "pow": np.power, "fabs": np.abs, "fmin": np.fmin, "fmax": np.fmax, "atan2": np.arctan2,
    "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "erf": np.vectorize(math.erf),
}  # fmt: skip


class Graph:
    """Scalar expression graph; equal nodes are stored once."""

    def __init__(self) -> None:
        self.nodes: list[tuple] = []
        self._known: dict[tuple, int] = {}
        self.zero, self.one = self.constant(0.0), self.constant(1.0)

    def _add(self, node: tuple) -> int:
        index = self._known.get(node)
        if index is None:
            index = self._known[node] = len(self.nodes)
            self.nodes.append(node)
        return index

    def constant(self, value: float) -> int:
        return self._add(("const", float(value) + 0.0))  # -0.0 and 0.0 are one node

    def input(self, slot: int) -> int:
        return self._add(("in", slot))

    def value(self, i: int) -> float | None:
        return self.nodes[i][1] if self.nodes[i][0] == "const" else None

    def neg(self, a: int) -> int:
        node = self.nodes[a]
        if node[0] == "const":
            return self.constant(-node[1])
        if node[0] == "-":  # -(x - y) = y - x
            return self._add(("-", node[2], node[1]))
        return node[1] if node[0] == "neg" else self._add(("neg", a))

    def add(self, a: int, b: int) -> int:
        va, vb = self.value(a), self.value(b)
        if va is not None and vb is not None:
            return self.constant(va + vb)
        if va == 0.0:
            return b
        if vb == 0.0:
            return a
        if self.nodes[b][0] == "neg":
            return self.sub(a, self.nodes[b][1])
        if self.nodes[a][0] == "neg":
            return self.sub(b, self.nodes[a][1])
        return self._add(("+", *sorted((a, b))))

    def sub(self, a: int, b: int) -> int:
        if a == b:
            return self.zero
        if self.value(a) == 0.0:
            return self.neg(b)
        if self.value(b) == 0.0:
            return a
        return self._add(("-", a, b))

    def mul(self, a: int, b: int) -> int:
        va, vb = self.value(a), self.value(b)
        if va is not None and vb is not None:
            return self.constant(va * vb)
        if va is not None:
            a, b, va, vb = b, a, vb, va
        if vb == 0.0:
            return self.zero
        if vb == 1.0:
            return a
        if vb == -1.0:
            return self.neg(a)
        if self.nodes[a][0] == "neg":
            return self.neg(self.mul(self.nodes[a][1], b))
        if self.nodes[b][0] == "neg":
            return self.neg(self.mul(a, self.nodes[b][1]))
        if vb is not None and self.nodes[a][0] == "*":  # 2*(3*x) = 6*x
            inner = self.value(self.nodes[a][1])
            if inner is not None:
                return self.mul(self.constant(vb * inner), self.nodes[a][2])
        if vb is not None:
            return self._add(("*", b, a))
        return self._add(("*", *sorted((a, b))))

    def div(self, a: int, b: int) -> int:
        va, vb = self.value(a), self.value(b)
        if va == 0.0 and vb != 0.0:
            return self.zero
        if vb is not None and vb != 0.0:
            return self.constant(va / vb) if va is not None else self.mul(a, self.constant(1.0 / vb))
        return self._add(("/", a, b))

    def call(self, name: str, *args: int) -> int:
        values = [self.value(a) for a in args]
        if name == "pow":
            return self._power(args[0], args[1])
        if all(v is not None for v in values) and hasattr(math, name):
            try:
                return self.constant(getattr(math, name)(*values))
            except (ValueError, OverflowError):  # compiled code says nan or inf
                pass
        return self._add(("call", name, *args))

    def _power(self, base: int, exponent: int) -> int:
        n = self.value(exponent)
        if n == 0.5:
            return self.call("sqrt", base)
        if n is None or n != int(n) or abs(n) > 16:
            return self._add(("call", "pow", base, exponent))
        result, factor, k = self.one, base, abs(int(n))
        while k:
            if k & 1:
                result = self.mul(result, factor)
            factor, k = (self.mul(factor, factor) if k > 1 else factor), k >> 1
        return result if n >= 0 else self.div(self.one, result)

    def values(self, outputs: Sequence[int], inputs: np.ndarray) -> np.ndarray:
        """Values (len(outputs), m) of nodes at m columns of inputs (slots, m), without a compiler; for a few
        columns. A function that it doesn't know gives not-a-number."""
        found: list[Any] = [None] * (max(outputs, default=-1) + 1)
        with np.errstate(all="ignore"):
            for i in range(len(found)):
                op, *args = self.nodes[i]
                if op in ("const", "in"):
                    found[i] = args[0] if op == "const" else inputs[args[0]]
                elif op == "select":
                    found[i] = np.where(*(found[a] for a in args))
                else:
                    name, *args = args if op == "call" else (op, *args)
                    function = _NUMPY.get(name) or getattr(np, name, None)
                    found[i] = np.nan if function is None else function(*(found[a] for a in args))
        columns = inputs.shape[1]
        return np.array([np.broadcast_to(found[i], columns) for i in outputs], dtype=float)

    def depends(self, output: int, slots: range) -> bool:
        """Whether a node depends on one of the inputs."""
        waiting, seen = [output], set()
        while waiting:
            i = waiting.pop()
            op, *args = self.nodes[i]
            if op == "in" and args[0] in slots:
                return True
            if op not in ("in", "const") and i not in seen:
                seen.add(i)
                waiting += [a for a in args if isinstance(a, int)]
        return False
