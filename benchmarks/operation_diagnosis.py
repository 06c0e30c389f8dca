"""Scenes whose load step has to fail, and what the message has to say of it: the cause, and no other one."""

import gc
import warnings

from mpi4py import MPI

import numpy as np
import ufl
from operation_cases import Case

import polarmpm as pm

MICROPOLAR = pm.MicropolarElastic(lam=3e3, mu=2e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=17.0)
NEO = pm.NeoHookean(lam=3e3, mu=2e3)
# of the words of a cause one has to be there, of the others none
FREE, SINGULAR = ("can move", "can turn"), (" resist", "no stiffness")
FEW, INVERTED, LIMIT = ("too few",), ("inside out",), ("limit",)
LARGE, STEPS, FINITE = ("times its size",), ("adaptive",), ("not finite",)
ENOUGH = ("max_iterations",)


def block(dim=2, material=MICROPOLAR, *, per_cell=2, inside=None, upper=None, **options):
    """A bar of 4 x 1 (x 1) cells on a grid of its own, without supports."""
    grid = pm.Grid.box((-2.0, -3.0, -2.0)[:dim], (9.0, 4.0, 3.0)[:dim], 1.0, MPI.COMM_WORLD)
    bounds = np.zeros(dim), np.array((4.0, 1.0, 1.0)[:dim]) if upper is None else upper
    points = pm.seed(grid, inside, material=material, points_per_cell=per_cell, bounds=bounds)
    return pm.QuasiStatic(grid, points, **options)


def hold(problem, **components):
    """At the end x = 0, clear of what a basis calls a node."""
    problem.fix(lambda x: x[:, 0] < 0.3, **components)
    return problem


def clamp(problem):
    theta = {"theta": 0} if problem.points.materials[0].micropolar else {}
    return hold(problem, u=0, **theta)


def push(problem, *force):
    """At the other end."""
    tip = problem.points.farthest((1.0, 0.0, 0.0)[: problem.points.dim])
    problem.load(tip, force=force)
    return problem


def mesh(cell="quadrilateral", cells=(4, 1), size=(4.0, 1.0), material=MICROPOLAR):
    from dolfinx import mesh as dm

    make = dm.create_rectangle if len(cells) == 2 else dm.create_box
    made = make(
        MPI.COMM_WORLD, [np.zeros(len(cells)), np.array(size)], list(cells), getattr(dm.CellType, cell)
    )
    return pm.QuasiStaticFEM(pm.Elements(made, material=material, degree=1))


def pull(problem, *force):
    problem.traction(problem.elements.farthest((1.0, 0.0, 0.0)[: problem.layout.dim]), force=force)
    return problem


def pieces(x):
    """Two pieces, three cells apart."""
    return (x[:, 0] < 2) | (x[:, 0] > 5)


def on_springs(normal_only):
    problem = block()
    end = pm.Surface.plane(x=0.0, bounds=((0.0,), (1.0,))) if hasattr(pm.Surface, "plane") else None
    if end is None:
        y = (np.arange(4) + 0.5) / 4
        x = np.column_stack([np.full(4, 1e-6), y])
        end = pm.Surface(x, np.full(4, 0.25), np.tile([-1.0, 0.0], (4, 1)))
    if normal_only:
        problem.fix(end, normal=0)
    else:
        problem.fix(end, u=0, theta=0)
    return problem


def released():
    problem = block()
    support = problem.fix(lambda x: x[:, 0] < 0.3, u=0, theta=0)
    push(problem, 0.0, 1.0)
    list(problem.march(1, to=0.5, progress=False))
    problem.release(support)
    return problem


def plastic(strength=1.0):
    material = pm.VonMises(pm.Hencky(lam=3e3, mu=2e3), k=strength, H=0.0)
    return clamp(block(material=material))


def user(energy, **values):
    return clamp(block(material=pm.UserEnergy(energy, values or {"a": 1.0})))


def hinge():
    """Two squares that meet in a corner; one is held."""
    from dolfinx import mesh as dm

    x = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [2, 1], [1, 2], [2, 2]], float)
    cells = np.array([[0, 1, 2, 3], [3, 4, 5, 6]], dtype=np.int64)
    if MPI.COMM_WORLD.rank:
        x, cells = x[:0], cells[:0]
    cell = ufl.Cell("quadrilateral")
    try:
        domain = ufl.Mesh(ufl.VectorElement("Lagrange", cell, 1))
        made = dm.create_mesh(MPI.COMM_WORLD, cells, x, domain)
    except AttributeError:
        import basix.ufl

        element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
        made = dm.create_mesh(MPI.COMM_WORLD, cells, x, ufl.Mesh(element))
    problem = pm.QuasiStaticFEM(pm.Elements(made, material=NEO, degree=1))
    problem.fix(lambda x: x[:, 1] < 0.5, u=0)
    problem.fix(lambda x: x[:, 0] < 0.5, u=0)
    problem.traction(problem.elements.farthest((0.0, 1.0)), force=(1.0, 0.0))
    return problem


def free():
    """Name, problem, of bodies that nothing holds."""
    for basis in ("mpm", "gimpm", "bspline", "bspline3"):
        yield f"no support, {basis}", lambda b=basis: push(block(basis=b), 0.0, 10.0)
    yield "no support, classical", lambda: push(block(material=NEO, basis="mpm"), 0.0, 10.0)
    yield "no support, in space", lambda: push(block(3, basis="mpm"), 0.0, 0.0, 10.0)
    yield "no support, splines in space", lambda: push(block(3), 0.0, 0.0, 10.0)
    yield "no support, elements", lambda: pull(mesh(), 0.0, 10.0)
    yield "only ux held", lambda: push(hold(block(basis="mpm"), ux=0), 0.0, 10.0)
    yield "only ux held, splines", lambda: push(hold(block(), ux=0), 0.0, 10.0)
    yield "only ux held, elements", lambda: pull(_fem(ux=0), 0.0, 10.0)
    yield "only theta held", lambda: push(hold(block(), theta=0), 3.0, 10.0)
    yield "a second piece floats", lambda: push(clamp(_two()), 10.0, 0.0)
    yield "a second piece floats, splines", lambda: push(clamp(_two(basis="bspline")), 10.0, 0.0)
    yield "classical body on a pin", lambda: push(_pinned(), 0.0, 10.0)
    yield "classical plate on a line", lambda: _on_a_line()
    yield "springs along the normal only", lambda: push(on_springs(True), 0.0, 10.0)
    yield "support released in mid-run", released


def _fem(**components):
    problem = mesh()
    problem.fix(pm.plane(x=0.0), **components)
    return problem


def _two(**options):
    return block(inside=pieces, upper=np.array([7.0, 1.0]), **{"basis": "mpm", **options})


def _pinned():
    problem = block(material=NEO, basis="mpm")
    problem.fix(lambda x: np.linalg.norm(x, axis=1) < 0.1, u=0)
    return problem


def _on_a_line():
    problem = mesh("hexahedron", (3, 3, 1), (3.0, 3.0, 1.0), NEO)
    problem.fix(lambda x: (np.abs(x[:, 0]) < 1e-9) & (np.abs(x[:, 2]) < 1e-9), u=0)
    return pull(problem, 0.0, 0.0, 10.0)


def scenes():
    """Name, problem, words of which one is needed, words of which none is allowed, options of march."""
    for name, make in free():
        yield name, make, FREE, LIMIT + FEW + INVERTED + LARGE, {}
    held = FREE + FINITE + SINGULAR + FEW
    yield "huge load", lambda: push(clamp(block()), 0.0, 1e7), LARGE + INVERTED, held, {}
    yield "huge load, mpm", lambda: push(clamp(block(basis="mpm")), 0.0, 1e7), LARGE + INVERTED, held, {}
    yield "huge load, elements", lambda: pull(_fem(u=0, theta=0), 0.0, 1e7), LARGE + INVERTED, held, {}
    yield "body on springs, huge load", lambda: push(on_springs(False), 0.0, 1e7), LARGE + INVERTED, held, {}
    yield "turned inside out", lambda: push(clamp(block(material=NEO)), -5e4, 0.0), INVERTED + LARGE, held, {}
    yield "one step where two go", lambda: _compressed(), STEPS, held, {"steps": 1}
    yield "limit load, flow", lambda: push(plastic(20.0), 45.0, 0.0), LIMIT, held, {"adaptive": True}
    yield "limit load, bending", lambda: push(plastic(20.0), 0.0, 45.0), LIMIT, held, {"adaptive": True}
    yield (
        "beyond the limit at once",
        lambda: push(plastic(20.0), 400.0, 0.0),
        STEPS + LARGE,
        held,
        {"steps": 1},
    )
    yield "shallow arch", _arch, LIMIT, held, {"adaptive": True}
    log = user, lambda E, G, p: p.a * ufl.ln(ufl.tr(E)) + ufl.inner(E, E) + ufl.inner(G, G)
    yield "energy not finite", lambda: push(log[0](log[1]), 0.0, 1.0), FINITE, FREE + LIMIT + LARGE, {}
    yield "no energy", lambda: push(user(lambda E, G, p: 0.0 * p.a), 0.0, 1.0), SINGULAR, FREE + LIMIT, {}
    yield (
        "no bending stiffness",
        lambda: push(user(lambda E, G, p: p.a * ufl.inner(ufl.sym(E), ufl.sym(E))), 0.0, 1.0),
        SINGULAR,
        FREE + LIMIT,
        {},
    )
    yield "linear energy", lambda: push(user(lambda E, G, p: p.a * ufl.tr(E)), 0.0, 1.0), SINGULAR, LIMIT, {}
    for basis in ("mpm", "gimpm"):
        sparse = {"material": NEO, "per_cell": 1, "basis": basis}
        yield f"one point a cell, {basis}", lambda s=sparse: _sparse(**s), FEW + SINGULAR, FREE + LIMIT, {}
    yield "hinge", hinge, SINGULAR, FREE + LIMIT, {}
    few = pm.Controls(max_iterations=5)
    yield "few iterations", lambda: push(clamp(block(controls=few)), 0.0, 30.0), ENOUGH, held, {"steps": 1}


def _compressed():
    problem = clamp(block(material=NEO))
    problem.fix(lambda x: x[:, 0] > 3.7, ux=-3.2, uy=0)
    return problem


def _sparse(**options):
    problem = block(upper=np.array([4.0, 2.0]), **options)
    problem.points.x += 0.13 * np.array([1.0, 0.7])
    return push(hold(problem, u=0), 3.0, 2e3)


def _arch():
    from dolfinx import mesh as dm

    made = dm.create_rectangle(
        MPI.COMM_WORLD, [np.zeros(2), np.array([10.0, 0.1])], [40, 2], dm.CellType.quadrilateral
    )
    x = made.geometry.x
    x[:, 1] += 0.5 * np.sin(np.pi * x[:, 0] / 10.0)
    problem = pm.QuasiStaticFEM(pm.Elements(made, material=NEO, degree=2))
    problem.fix(lambda x: x[:, 0] < 1e-6, u=0)
    problem.fix(lambda x: x[:, 0] > 10.0 - 1e-6, u=0)
    problem.body_load(force=(0.0, -60.0))
    return problem


def judged(name, make, needed, never, options):
    """The verdict on what a failed step says."""
    try:
        problem = make()
        for _ in problem.march(**{"steps": 4, "progress": False, **options}):
            pass
    except pm.NotConverged as e:
        text = str(e)
    except pm.InputError as e:  # refused before a step, such as an energy that isn't finite at rest
        return Case("diagnosis", name, "clear", str(e).splitlines()[0])
    except Exception as e:
        return Case("diagnosis", name, "raw", f"{type(e).__name__}: {e}".splitlines()[0])
    else:
        return Case("diagnosis", name, "silent", "the step has converged")
    said = text.split("Found:")[-1]  # what was tried tells no cause
    wrong = [word for word in never if word in said]
    good = any(word in said for word in needed) and not wrong
    said = said.strip().splitlines()[0].strip()
    return Case("diagnosis", name, "clear" if good else "unclear", f"{wrong or ''} {said}".strip())


def drawn(seed, number):
    """A body in space or in the plane whose wall holds some components, drawn at random, and what has to come
    of it: with all displacements held it stands, else it can move."""
    random = np.random.default_rng([seed, number])
    dim, basis = int(random.integers(2, 4)), str(random.choice(["mpm", "gimpm", "bspline"]))
    material = (MICROPOLAR, NEO)[random.integers(2)]
    names = [name for name in ("ux", "uy", "uz")[:dim] if random.random() < 0.7]
    size = np.where(np.arange(dim) == 0, random.uniform(2.2, 4.0), random.uniform(0.8, 1.6, dim))
    problem = block(dim, material, basis=basis, upper=size)
    held = dict.fromkeys(names, 0) | ({"theta": 0} if material.micropolar else {})
    if held:
        problem.fix(lambda x: x[:, 0] < 0.3, **held)
    problem.body_load(force=tuple(0.1 * random.normal(size=dim)))
    name = (
        f"{dim}D, {basis}, {type(material).__name__}, held: {', '.join(held) or 'nothing'} ({seed}.{number})"
    )
    if len(names) < dim:
        return judged(name, lambda: problem, FREE, LIMIT + FEW + INVERTED + LARGE, {"steps": 2})
    try:
        list(problem.march(2, progress=False))
    except Exception as e:
        return Case("diagnosis", name, "unclear", f"{type(e).__name__}: {e}".splitlines()[-1])
    return Case("diagnosis", name, "right")


def never_iterated():
    """A march that nobody iterates."""
    problem = push(clamp(block()), 0.0, 1.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem.march(2)
        gc.collect()
    told = any("march" in str(w.message) for w in caught)
    return Case("diagnosis", "march never iterated", "clear" if told else "silent", "")


def cases(quick, seed):
    """All scenes, and some that are drawn."""
    every = list(scenes())
    for scene in every[:: 6 if quick else 1]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield judged(*scene)
    for number in range(4 if quick else 20):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield drawn(seed, number)
    yield never_iterated()
