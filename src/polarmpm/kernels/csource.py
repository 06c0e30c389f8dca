"""C code of scalar graphs."""

from __future__ import annotations

from collections.abc import Sequence

from .graph import Graph

LANES = 8  # points in one kernel call; one AVX-512 register, two of AVX2


def _used(graph: Graph, outputs: Sequence[int]) -> list[int]:
    seen: set[int] = set()
    stack = list(outputs)
    while stack:
        i = stack.pop()
        if i not in seen:
            seen.add(i)
            node = graph.nodes[i]
            if node[0] not in ("const", "in"):
                stack.extend(a for a in node[1:] if isinstance(a, int))
    return sorted(seen)  # operands always have smaller numbers than their results


_COMPARE = {"<", ">", "<=", ">=", "==", "!="}


def _statement(graph: Graph, i: int) -> str:
    def scalar(k: int) -> str:  # a constant stays a C double: GCC spreads it over the lanes
        value = graph.value(k)
        return f"t{k}" if value is None else f"({value!r})"

    def vector(k: int) -> str:
        return f"t{k}" if graph.value(k) is None else f"splat{scalar(k)}"

    op, *args = graph.nodes[i]
    if op == "in":
        return f"v t{i} = in[{args[0]}];"
    if op == "neg":
        return f"v t{i} = -{scalar(args[0])};"
    if op == "select":
        return f"v t{i} = select(t{args[0]}, {vector(args[1])}, {vector(args[2])});"
    if op == "call":
        function, names = args[0], [vector(k) for k in args[1:]]
        if function in _COMPARE or function in ("&", "|"):
            return f"m t{i} = {names[0]} {function} {names[1]};"
        if function == "!":
            return f"m t{i} = ~{names[0]};"
        return f"v t{i} = v_{function}({', '.join(names)});"
    return f"v t{i} = {scalar(args[0])} {op} {scalar(args[1])};"


_PRELUDE = f"""#include <math.h>
typedef double v __attribute__((vector_size({8 * LANES})));
typedef long long m __attribute__((vector_size({8 * LANES})));
static inline v splat(double a) {{ return (v){{}} + a; }}
static inline v select(m c, v a, v b) {{ return (v)((c & (m)a) | (~c & (m)b)); }}
"""


def _helpers(functions: set[str]) -> str:
    lines = []
    for f in sorted(functions):
        args = ("v a, v b", "a[i], b[i]") if f in ("pow", "fmin", "fmax", "atan2") else ("v a", "a[i]")
        lines.append(
            f"static inline v v_{f}({args[0]})"
            f" {{ v r; for (int i = 0; i < {LANES}; ++i) r[i] = {f}({args[1]}); return r; }}"
        )
    return "\n".join(lines)


def write_c(graph: Graph, functions: dict[str, Sequence[int]]) -> str:
    """C code of the named functions; each writes its list of graph nodes to `out`."""
    bodies, called = [], set()
    for name, outputs in functions.items():
        used = _used(graph, outputs)
        lines = [_statement(graph, i) for i in used if graph.nodes[i][0] != "const"]
        for i in used:
            node = graph.nodes[i]
            if node[0] == "call" and node[1] not in _COMPARE and node[1] not in ("&", "|", "!"):
                called.add(node[1])
        for k, i in enumerate(outputs):
            value = graph.value(i)
            lines.append(f"out[{k}] = " + (f"t{i};" if value is None else f"splat({value!r});"))
        body = "\n  ".join(lines)
        bodies.append(f"void {name}(const v *restrict in, v *restrict out)\n{{\n  {body}\n}}\n")
    return _PRELUDE + _helpers(called) + "\n" + "\n".join(bodies)
