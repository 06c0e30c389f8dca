"""From UFL to C: every operator, linear forms, constants, and errors that name the expression."""

from __future__ import annotations

import math

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.kernels import codegen, csource, jit
from polarmpm.kernels.codegen import FREE, Graph, Scalariser
from polarmpm.kernels.csource import write_c
from polarmpm.kernels.kernel import Kernel, PointSpace, compile_expressions
from polarmpm.tools import compat
from tests.conftest import COMM

ROWS = 11
SPACE = PointSpace(compat.point_domain())
C = SPACE.coefficient(18)
SLOTS = {C: 0}
VALUES = np.random.default_rng(0).uniform(0.2, 0.9, (ROWS, 18))


def A():
    return ufl.as_tensor([[C[3 * i + j] for j in range(3)] for i in range(3)])


def B():
    return ufl.as_tensor([[C[9 + 3 * i + j] for j in range(3)] for i in range(3)])


def evaluate(*expressions, values: np.ndarray = VALUES) -> np.ndarray:
    return compile_expressions(list(expressions), SLOTS, 18, SPACE.domain, COMM)(values)


a, b = VALUES[:, :9].reshape(-1, 3, 3), VALUES[:, 9:].reshape(-1, 3, 3)
x, y = VALUES[:, 0], VALUES[:, 1]

SCALARS = {
    "sqrt": (lambda u, v: ufl.sqrt(u), np.sqrt(x)),
    "exp": (lambda u, v: ufl.exp(u), np.exp(x)),
    "ln": (lambda u, v: ufl.ln(u), np.log(x)),
    "sin": (lambda u, v: ufl.sin(u), np.sin(x)),
    "cos": (lambda u, v: ufl.cos(u), np.cos(x)),
    "tan": (lambda u, v: ufl.tan(u), np.tan(x)),
    "sinh": (lambda u, v: ufl.sinh(u), np.sinh(x)),
    "cosh": (lambda u, v: ufl.cosh(u), np.cosh(x)),
    "tanh": (lambda u, v: ufl.tanh(u), np.tanh(x)),
    "asin": (lambda u, v: ufl.asin(u), np.arcsin(x)),
    "acos": (lambda u, v: ufl.acos(u), np.arccos(x)),
    "atan": (lambda u, v: ufl.atan(u), np.arctan(x)),
    "atan2": (lambda u, v: getattr(ufl, "atan2", getattr(ufl, "atan_2", None))(u, v), np.arctan2(x, y)),
    "erf": (lambda u, v: ufl.erf(u), [math.erf(t) for t in x]),
    "abs": (lambda u, v: abs(u - v), abs(x - y)),
    "sign": (lambda u, v: ufl.sign(u - v), np.sign(x - y)),
    "min": (lambda u, v: ufl.min_value(u, v), np.minimum(x, y)),
    "max": (lambda u, v: ufl.max_value(u, 0.5), np.maximum(x, 0.5)),
    "division": (lambda u, v: u / v - 2 / u + v / 4, x / y - 2 / x + y / 4),
    "negative": (lambda u, v: -(u - v) * -v, (x - y) * y),
    "power": (lambda u, v: u**v, x**y),
    "square": (lambda u, v: u**2 + 3 * u**3 - u**5, x**2 + 3 * x**3 - x**5),
    "inverse power": (lambda u, v: u**-3 + u ** (-1), x**-3 + 1 / x),
    "root": (lambda u, v: u**0.5 + u**1.5 + u**-0.5, x**0.5 + x**1.5 + x**-0.5),
    "high power": (lambda u, v: u**16 + u**17 + u**40, x**16 + x**17 + x**40),
    "constant base": (lambda u, v: 2.0**u, 2.0**x),
    "zeroth power": (lambda u, v: (u * v) ** 0 + u, 1 + x),
    "lt": (lambda u, v: ufl.conditional(ufl.lt(u, v), u, 3 * v), np.where(x < y, x, 3 * y)),
    "gt": (lambda u, v: ufl.conditional(ufl.gt(u, v), 1, 0), 1.0 * (x > y)),
    "le": (lambda u, v: ufl.conditional(ufl.le(u, 0.5), u, 0), np.where(x <= 0.5, x, 0)),
    "ge": (lambda u, v: ufl.conditional(ufl.ge(0.5, v), 2, v), np.where(y <= 0.5, 2, y)),
    "eq": (lambda u, v: ufl.conditional(ufl.eq(u, u), u, v), x),
    "ne": (lambda u, v: ufl.conditional(ufl.ne(u, v), u, v), x),
    "and": (
        lambda u, v: ufl.conditional(ufl.And(ufl.lt(u, 0.7), ufl.gt(v, 0.4)), u, v),
        np.where((x < 0.7) & (y > 0.4), x, y),
    ),
    "or": (
        lambda u, v: ufl.conditional(ufl.Or(ufl.lt(u, 0.3), ufl.gt(v, 0.7)), u, v),
        np.where((x < 0.3) | (y > 0.7), x, y),
    ),
    "not": (lambda u, v: ufl.conditional(ufl.Not(ufl.lt(u, v)), u, v), np.maximum(x, y)),
    "constant condition": (lambda u, v: ufl.conditional(ufl.lt(ufl.as_ufl(1.0), 2.0), u, v), x),
    "nested": (
        lambda u, v: ufl.conditional(ufl.lt(u, v), ufl.conditional(ufl.lt(u, 0.4), 1.0, ufl.sqrt(v)), u * v),
        np.where(x < y, np.where(x < 0.4, 1.0, np.sqrt(y)), x * y),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SCALARS)
def test_scalar_operators(name):
    """Values by NumPy; derivatives by central differences (conditions are away from their thresholds)."""
    make, expected = SCALARS[name]
    np.testing.assert_allclose(evaluate(make(C[0], C[1]))[:, 0], expected, rtol=1e-13, atol=1e-14)
    v = ufl.variable(C[0])
    slope, h = evaluate(ufl.diff(make(v, C[1]), v))[:, 0], 1e-6
    shift = h * np.eye(18)[0]
    up, down = (evaluate(make(C[0], C[1]), values=VALUES + s * shift)[:, 0] for s in (1, -1))
    np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-7, atol=1e-7)


i, j, k = ufl.indices(3)
TENSORS = {
    "transpose": (lambda: ufl.transpose(A()), np.swapaxes(a, 1, 2)),
    "dot": (lambda: ufl.dot(A(), B()), a @ b),
    "inner": (lambda: ufl.inner(A(), B()), np.sum(a * b, axis=(1, 2))),
    "outer": (lambda: ufl.outer(A()[0, :], B()[1, :]), a[:, 0, :, None] * b[:, 1, None, :]),
    "cross": (lambda: ufl.cross(A()[0, :], B()[1, :]), np.cross(a[:, 0], b[:, 1])),
    "trace": (lambda: ufl.tr(A()), np.trace(a, axis1=1, axis2=2)),
    "deviator": (lambda: ufl.dev(A()), a - np.trace(a, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3),
    "skew": (lambda: ufl.skew(A()), 0.5 * (a - np.swapaxes(a, 1, 2))),
    "sym": (lambda: ufl.sym(A()), 0.5 * (a + np.swapaxes(a, 1, 2))),
    "det": (lambda: ufl.det(A()), np.linalg.det(a)),
    "inverse": (lambda: ufl.inv(A() + 2 * ufl.Identity(3)), np.linalg.inv(a + 2 * np.eye(3))),
    "perp": (lambda: ufl.perp(ufl.as_vector((C[0], C[1]))), np.stack([-y, x], axis=1)),
    "elementwise": (lambda: ufl.elem_mult(A(), B()), a * b),
    "rows": (lambda: A()[1, :], a[:, 1]),
    "columns": (lambda: A()[:, 2], a[:, :, 2]),
    "diagonal sum": (lambda: A()[i, i], np.trace(a, axis1=1, axis2=2)),
    "double contraction": (lambda: A()[i, j] * B()[j, i], np.einsum("pij,pji->p", a, b)),
    "relabelled": (lambda: ufl.as_tensor(A()[i, j] * B()[k, j], (k, i)), np.einsum("pij,pkj->pki", a, b)),
    "third order": (
        lambda: ufl.as_tensor(A()[i, j] * B()[0, k], (k, i, j)),
        np.einsum("pij,pk->pkij", a, b[:, 0]),
    ),
    "zero": (lambda: 0 * A() + ufl.zero((3, 3)), np.zeros((ROWS, 3, 3))),
    "mixed": (
        lambda: ufl.as_tensor([[A()[0, i] * B()[i, 0], 0], [1, ufl.Identity(3)[2, 2]]]),
        np.stack([np.stack([np.sum(a[:, 0] * b[:, :, 0], axis=1), 0 * x], 1), np.ones((ROWS, 2))], 1),
    ),
    "fourth order": (
        lambda: ufl.as_tensor(A()[i, j] * B()[k, ufl.Index(99)], (i, j, k, ufl.Index(99))),
        np.einsum("pij,pkl->pijkl", a, b),
    ),
}


@pytest.mark.parametrize("name", TENSORS)
def test_tensor_operators(name):
    """Tensor algebra, with repeated, free and relabelled indices."""
    make, expected = TENSORS[name]
    found = evaluate(make())
    np.testing.assert_allclose(found, np.reshape(expected, (ROWS, -1)), rtol=1e-12, atol=1e-14)


def test_repeated_index_of_a_component_tensor():
    """T_ijj of a tensor of third order: one axis of the diagonal is summed, one index stays free."""
    T = ufl.as_tensor(A()[i, j] * B()[0, k], (i, j, k))
    found = evaluate(ufl.as_vector(T[i, j, j], i))
    np.testing.assert_allclose(found, np.einsum("pij,pj->pi", a, b[:, 0]), rtol=1e-13)


def test_second_derivatives():
    """diff of diff: the moduli of an energy, against the closed form of det."""
    v = ufl.variable(A())
    second = ufl.diff(ufl.diff(ufl.det(v), v), v)
    levi = np.zeros((3, 3, 3))
    for p, s in (
        ((0, 1, 2), 1),
        ((1, 2, 0), 1),
        ((2, 0, 1), 1),
        ((0, 2, 1), -1),
        ((2, 1, 0), -1),
        ((1, 0, 2), -1),
    ):
        levi[p] = s
    expected = np.einsum("ikm,jln,pmn->pijkl", levi, levi, a)
    np.testing.assert_allclose(evaluate(second), expected.reshape(ROWS, -1), atol=1e-14)


# linear in arguments ------------------------------------------------------------------------------
def scalarised(expr) -> codegen.Linear:
    return Scalariser(SLOTS)(codegen.expand(expr)).data[()]


def arguments(n: int = 3):
    space = SPACE.function_space(n)
    return ufl.TestFunction(space), ufl.TrialFunction(space)


def test_coefficients_of_arguments():
    """A bilinear form's coefficients, with a condition and a quotient, as a matrix."""
    test, trial = arguments()
    form = C[0] * test[0] * trial[1] / C[1] + ufl.conditional(
        ufl.lt(C[0], C[1]), test[2] * trial[2], test[1] * trial[0]
    )
    scalariser = Scalariser(SLOTS)
    linear = scalariser(codegen.expand(form)).data[()]
    nodes = codegen.coefficients(linear, (3, 3), scalariser.graph.zero)
    source = write_c(scalariser.graph, {"evaluate": nodes})
    kernel = Kernel(jit.library(jit.digest("test", source), lambda: source, COMM), "evaluate", 18, 9)
    expected = np.zeros((ROWS, 3, 3))
    expected[:, 0, 1] = x / y
    expected[:, 2, 2], expected[:, 1, 0] = x < y, x >= y
    np.testing.assert_allclose(kernel(VALUES), expected.reshape(ROWS, -1), rtol=1e-14)


@pytest.mark.parametrize("part", [1, 3, 10, 1000])
def test_long_functions_are_the_same_in_parts(part, monkeypatch):
    """What later parts need is handed on: values, masks, inputs, and constants among the outputs."""
    mask = ufl.lt(C[0], C[1])
    late = ufl.conditional(ufl.And(mask, ufl.gt(C[2], 0.1)), ufl.exp(C[3]), C[0] / C[4])
    expressions = [ufl.dot(A(), B()), ufl.inv(A()), ufl.det(A()) * late, ufl.as_ufl(2.5), C[17], late]

    def evaluated() -> np.ndarray:
        scalariser = Scalariser(SLOTS)
        nodes = []
        for e in expressions:
            data = scalariser(codegen.expand(e)).data
            nodes += [scalariser.plain(data[index]) for index in np.ndindex(*data.shape)]
        source = write_c(scalariser.graph, {"evaluate": nodes})
        assert ("kept[" in source) == (csource._LONG == 0)
        lib = jit.library(jit.digest("test", source), lambda: source, COMM)
        return Kernel(lib, "evaluate", 18, len(nodes))(VALUES)

    whole = evaluated()
    monkeypatch.setattr(csource, "_LONG", 0)
    monkeypatch.setattr(csource, "_PART", part)
    np.testing.assert_allclose(evaluated(), whole, rtol=1e-12)  # other products are fused with sums


def test_statements_stand_output_by_output():
    """Each node once, after its operands, and what only one output needs before the next output is begun."""
    graph = Graph()
    a, b, c = map(graph.input, range(3))
    shared = graph.mul(a, b)
    first = [graph.add(shared, graph.mul(c, graph.constant(k))) for k in (2.0, 3.0)]
    outputs = [graph.add(f, graph.mul(f, c)) for f in first] + [graph.one]
    graph.mul(c, c)  # nothing needs it
    steps = csource._steps(graph, outputs)
    for i in steps:
        assert all(steps.index(o) < steps.index(i) for o in csource._operands(graph, i))
    assert len(set(steps)) == len(steps) == 12
    end = steps.index(outputs[0])
    assert first[0] in steps[:end]
    assert first[1] not in steps[:end]
    lines = csource.write_c(graph, {"evaluate": outputs}).splitlines()
    written = next(k for k, line in enumerate(lines) if "out[0 * PARTS]" in line)
    assert f"v t{outputs[0]} =" in lines[written - 1]  # at once, in front of what the next one needs


def test_cancelling_arguments_leave_nothing():
    """v - v is no coefficient at all."""
    test, _ = arguments()
    assert scalarised(C[0] * test[0] - test[0] * C[0]) == {}


@pytest.mark.parametrize(
    "make",
    [
        lambda v: v[0] * v[1],
        lambda v: ufl.exp(v[0]),
        lambda v: 1 / v[0],
        lambda v: v[0] ** 2,
        lambda v: abs(v[0]),
        lambda v: ufl.max_value(v[0], 0),
        lambda v: ufl.conditional(ufl.lt(v[0], 1), 1.0, 2.0),
    ],
    ids=["product", "exp", "quotient", "square", "abs", "max", "condition"],
)
def test_nonlinear_in_an_argument(make):
    """Refused with a message, not compiled to nonsense."""
    test, _ = arguments()
    with pytest.raises(pm.KernelError, match="linear"):
        scalarised(make(test))


# errors -------------------------------------------------------------------------------------------
def test_operators_without_meaning_at_points():
    """Derivatives in space, jumps, coordinates: the message names the operator."""
    for expression, name in (
        (ufl.bessel_J(0, C[0]), "BesselJ"),
        (ufl.SpatialCoordinate(SPACE.domain)[0], "SpatialCoordinate"),
        (C("+")[0], "PositiveRestricted"),
    ):
        with pytest.raises(pm.KernelError, match=f"{name} can't be used at material points"):
            Scalariser(SLOTS)(expression)


def test_unknown_coefficient():
    """A coefficient that is no input is named."""
    other = SPACE.coefficient(2)
    with pytest.raises(pm.KernelError, match="is not an input of this kernel"):
        evaluate(other[0] + C[0])


def test_broken_energy_is_a_kernel_error():
    """A user's energy that can't be compiled: KernelError with the culprit, no traceback of a compiler."""
    material = pm.UserEnergy(lambda E, G, p: ufl.bessel_J(1, ufl.tr(E)) + ufl.inner(G, G))
    grid = pm.Grid.box((0, 0), (1, 1), 1.0)
    problem = pm.QuasiStatic(grid, pm.seed(grid, material=material), **pm.PUBLISHED)
    with pytest.raises(pm.KernelError, match="Bessel"):
        list(problem.march(1))


# graph --------------------------------------------------------------------------------------------
def random_graph_value(graph: Graph, node: int, inputs: list[float]) -> float:
    """Evaluate a node in Python, for comparison with folded results."""
    kind, *args = graph.nodes[node]
    if kind == "const":
        return args[0]
    if kind == "in":
        return inputs[args[0]]
    if kind == "call":
        function = {"pow": pow, "fabs": abs}.get(args[0]) or getattr(math, args[0])
        return function(*(random_graph_value(graph, n, inputs) for n in args[1:]))
    values = [random_graph_value(graph, n, inputs) for n in args]
    if kind == "neg":
        return -values[0]
    return {"+": values[0] + values[-1], "-": values[0] - values[-1], "*": values[0] * values[-1]}.get(
        kind, values[0] / values[-1] if kind == "/" else math.nan
    )


def test_folding_never_changes_a_value():
    """A thousand random operations on constants, inputs and their results, folded against plain Python."""
    rng = np.random.default_rng(6)
    graph, inputs = Graph(), [0.7, -1.3, 2.1]
    known = [(graph.constant(c), c) for c in (0.0, -0.0, 1.0, -1.0, 2.0, 0.5, 3.7)]
    known += [(graph.input(n), v) for n, v in enumerate(inputs)]
    for _ in range(1000):
        (na, va), (nb, vb) = (known[n] for n in rng.integers(0, len(known), 2))
        operation = rng.integers(0, 6)
        if operation == 0:
            node, value = graph.add(na, nb), va + vb
        elif operation == 1:
            node, value = graph.sub(na, nb), va - vb
        elif operation == 2:
            node, value = graph.mul(na, nb), va * vb
        elif operation == 3 and abs(vb) > 1e-3:
            node, value = graph.div(na, nb), va / vb
        elif operation == 4:
            node, value = graph.neg(na), -va
        else:
            n = int(rng.integers(-3, 5))
            if abs(va) < 1e-3 or not 1e-6 < abs(va**n) < 1e6:
                continue
            node, value = graph.call("pow", na, graph.constant(n)), va**n
        assert random_graph_value(graph, node, inputs) == pytest.approx(value, rel=1e-9, abs=1e-9)
        if abs(value) < 1e3:
            known.append((node, value))


def test_equal_nodes_are_shared():
    """Common subexpressions, in either order, are one node; what needs no arithmetic makes none."""
    g = Graph()
    p, q = g.input(0), g.input(1)
    assert g.add(p, q) == g.add(q, p)
    assert g.mul(p, q) == g.mul(q, p)
    assert g.neg(g.neg(p)) == g.mul(p, g.one) == g.add(p, g.zero) == g.sub(p, g.zero) == p
    assert g.sub(p, p) == g.mul(p, g.zero) == g.div(g.zero, p) == g.zero
    assert g.neg(g.sub(p, q)) == g.sub(q, p)
    assert g.mul(g.constant(2.0), g.mul(g.constant(3.0), p)) == g.mul(p, g.constant(6.0))
    assert g.call("pow", p, g.zero) == g.one
    assert g.value(g.call("sqrt", g.constant(9.0))) == 3.0


def test_constants_only():
    """Outputs that are constants, and functions of constants that C evaluates."""
    found = evaluate(ufl.as_ufl(2.5), ufl.zero(), ufl.min_value(ufl.as_ufl(1.0), 2.0), ufl.as_ufl(2.0) ** 0.3)
    np.testing.assert_allclose(found, np.tile([2.5, 0.0, 1.0, 2.0**0.3], (ROWS, 1)), rtol=1e-15)


def test_special_values_do_not_leak_between_points():
    """A point with NaN or division by zero spoils no other point of its call."""
    values = VALUES.copy()
    values[3, 0] = np.nan
    values[5, 0] = 0.0
    found = evaluate(1 / C[0] + ufl.conditional(ufl.lt(C[0], 0.5), ufl.ln(C[0]), C[1]), values=values)[:, 0]
    expected = 1 / x + np.where(x < 0.5, np.log(x), y)
    good = np.delete(np.arange(ROWS), [3, 5])
    np.testing.assert_allclose(found[good], expected[good], rtol=1e-14)
    assert np.isnan(found[3])
    assert not np.isfinite(found[5])


def test_deep_expressions():
    """No recursion limit: a chain of several thousand operations."""
    e = C[0]
    for _ in range(300):
        e = ufl.sin(e) + C[1] * e
    assert FREE == (-1, -1)
    assert np.all(np.isfinite(evaluate(e / 1e9)))


def test_integrand_needs_one_integral():
    """A form of two integrals is refused."""
    test, _ = arguments()
    dx = ufl.dx(domain=SPACE.domain, degree=1)
    with pytest.raises(pm.KernelError, match="one integral, not 2"):
        codegen.integrand(test[0] * dx + test[1] * ufl.dx(domain=SPACE.domain, degree=3))
