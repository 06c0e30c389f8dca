"""C code of scalar graphs."""

from __future__ import annotations

from collections.abc import Sequence

from .graph import Graph

LANES = 8  # points in one kernel call
# statements from which a function is divided, and of each part: compilers take time with their squares, while
# the code hardly gets slower (docs/performance.md)
_LONG, _PART = 2000, 250


def _steps(graph: Graph, outputs: Sequence[int]) -> list[int]:
    """Nodes of the outputs but constants, operands before their results: one output after the other, and of
    operands the one with the most operations in a row first. So terms of a sum stand together, and far less
    goes through memory than in the order in which UFL was evaluated, term by term of all sums."""
    depth: dict[int, int] = {}  # operations one after the other up to a node
    waiting = list(outputs)
    while waiting:
        i = waiting[-1]
        operands = _operands(graph, i)
        open_ones = [a for a in operands if a not in depth]
        if i in depth or not open_ones:
            waiting.pop()
            depth.setdefault(i, 1 + max((depth[a] for a in operands), default=0))
        waiting += open_ones
    steps: dict[int, None] = {}
    waiting = [i for i in reversed(outputs) if graph.value(i) is None]
    while waiting:
        i = waiting[-1]
        open_ones = [a for a in _operands(graph, i) if a not in steps]
        if i in steps or not open_ones:
            steps.setdefault(waiting.pop())
        waiting += sorted(open_ones, key=depth.__getitem__)
    return list(steps)


_COMPARE = {"<", ">", "<=", ">=", "==", "!="}


def _statement(graph: Graph, i: int) -> str:
    def scalar(k: int) -> str:  # a constant stays a C double: GCC spreads it over the lanes
        value = graph.value(k)
        return f"t{k}" if value is None else f"({value!r})"

    def vector(k: int) -> str:
        return f"t{k}" if graph.value(k) is None else f"splat{scalar(k)}"

    op, *args = graph.nodes[i]
    if op == "in":
        return f"v t{i} = in[{args[0]} * PARTS];"
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


# Vectors are as wide as a register: wider ones take thrice the time to compile, and their tangents a
# quarter longer, as gcc keeps them in memory (docs/performance.md). Half of the lanes at once: two calls.
_PRELUDE = f"""#include <math.h>
#ifdef __AVX512F__
enum {{ WIDTH = {LANES}, PARTS = 1 }};
#else
enum {{ WIDTH = {LANES // 2}, PARTS = 2 }};
#endif
typedef double v __attribute__((vector_size(8 * WIDTH)));
typedef long long m __attribute__((vector_size(8 * WIDTH)));
static inline v splat(double a) {{ return (v){{}} + a; }}
static inline v select(m c, v a, v b) {{ return (v)((c & (m)a) | (~c & (m)b)); }}
"""


def _helpers(functions: set[str]) -> str:
    lines = []
    for f in sorted(functions):
        args = ("v a, v b", "a[i], b[i]") if f in ("pow", "fmin", "fmax", "atan2") else ("v a", "a[i]")
        lines.append(
            f"static inline v v_{f}({args[0]})"
            f" {{ v r; for (int i = 0; i < WIDTH; ++i) r[i] = {f}({args[1]}); return r; }}"
        )
    return "\n".join(lines)


def _is_mask(graph: Graph, i: int) -> bool:
    node = graph.nodes[i]
    return node[0] == "call" and (node[1] in _COMPARE or node[1] in ("&", "|", "!"))


def write_c(graph: Graph, functions: dict[str, Sequence[int]]) -> str:
    """C code of the named functions; each writes its list of graph nodes to `out`."""
    bodies, called = [], set()
    for name, outputs in functions.items():
        steps = _steps(graph, outputs)
        for i in steps:
            node = graph.nodes[i]
            if node[0] == "call" and not _is_mask(graph, i):
                called.add(node[1])
        if len(steps) > _LONG:
            bodies.append(_in_parts(graph, name, steps, outputs))
            continue
        lines, written = [], _written(graph, outputs)
        for i in steps:
            lines += [_statement(graph, i), *written.get(i, ())]
        lines += _constants(graph, outputs)
        bodies.append(_whole(name, lines))
    return _PRELUDE + _helpers(called) + "\n" + "\n".join(bodies)


def _output(graph: Graph, k: int, i: int) -> str:
    value = graph.value(i)
    return f"out[{k} * PARTS] = " + (f"t{i};" if value is None else f"splat({value!r});")


def _written(graph: Graph, outputs: Sequence[int]) -> dict[int, list[str]]:
    """Statements that write a node to its outputs, at once: until then it would take a register."""
    lines: dict[int, list[str]] = {}
    for k, i in enumerate(outputs):
        lines.setdefault(i, []).append(_output(graph, k, i))
    return lines


def _constants(graph: Graph, outputs: Sequence[int]) -> list[str]:
    return [_output(graph, k, i) for k, i in enumerate(outputs) if graph.value(i) is not None]


def _function(head: str, lines: Sequence[str]) -> str:
    body = "\n  ".join(lines)
    return f"{head}\n{{\n  {body}\n}}\n"


def _whole(name: str, lines: Sequence[str]) -> str:
    """A function of some statements, called for each part of the lanes."""
    arguments = "(const v *restrict in, v *restrict out)"
    once = _function(f"static __attribute__((noinline)) void {name}_once{arguments}", lines)
    each = [f"for (int i = 0; i < PARTS; ++i) {name}_once(in + i, out + i);"]
    return once + _function(f"void {name}{arguments}", each)


def _in_parts(graph: Graph, name: str, steps: Sequence[int], outputs: Sequence[int]) -> str:
    """A long function as several, one after the other; what later ones need is handed on in memory.

    The time that GCC takes to give values their registers goes with the square of a function's length.
    """
    parts = [steps[k : k + _PART] for k in range(0, len(steps), _PART)]
    ends, written = _last_parts(graph, parts), _written(graph, outputs)
    slots: dict[int, int] = {}  # of what is handed on
    free: list[int] = []
    size, pieces = 0, []
    for p, part in enumerate(parts):
        here, lines = set(), []
        for i in part:
            for a in dict.fromkeys(a for a in _operands(graph, i) if a not in here):  # from an earlier part
                kind = "m" if _is_mask(graph, a) else "v"
                known = graph.nodes[a][0] == "in"
                lines.append(_statement(graph, a) if known else f"{kind} t{a} = ({kind})kept[{slots[a]}];")
                here.add(a)
            lines += [_statement(graph, i), *written.get(i, ())]
            here.add(i)
            if ends.get(i, p) > p and graph.nodes[i][0] != "in":
                if not free:
                    free, size = [size], size + 1
                slots[i] = free.pop()
                lines.append(f"kept[{slots[i]}] = (v)t{i};")
        for i in [i for i in slots if ends[i] == p]:
            free.append(slots.pop(i))
        head = f"static __attribute__((noinline)) void {name}_{p}"
        pieces.append(_function(f"{head}(const v *restrict in, v *restrict out, v *restrict kept)", lines))
    calls = [f"v kept[{max(size, 1)}];", *(f"{name}_{p}(in, out, kept);" for p in range(len(parts)))]
    return "\n".join([*pieces, _whole(name, calls + _constants(graph, outputs))])


def _operands(graph: Graph, i: int) -> list[int]:
    """Nodes that a statement reads, but constants."""
    node = graph.nodes[i]
    arguments = () if node[0] in ("const", "in") else node[1:]
    return [a for a in arguments if isinstance(a, int) and graph.value(a) is None]


def _last_parts(graph: Graph, parts: Sequence[Sequence[int]]) -> dict[int, int]:
    """The last part that reads each node."""
    return {a: p for p, part in enumerate(parts) for i in part for a in _operands(graph, i)}
