"""Does the measure of trust warn of wrong answers in runs that its limits weren't chosen with?

    python benchmarks/unseen.py [--json F]

Twenty scenes that were made after the limits: strips of other thicknesses and angles, a ring under a large
pressure with three bases, stiff inclusions, a plastic cantilever whose load turns back, a strip that is bent
into an arc, Cook's membrane at another ratio of Poisson, a hollow sphere. References are beams, Lame's sphere
and elements of degree 2. A minute.
"""

import argparse
from functools import partial

import numpy as np
import scenes
from records import add_to_json, record, report, run
from scenes import COMM
from strangers import verdict

import polarmpm as pm

SOFT = scenes.classical()
YIELDS = pm.VonMises(pm.Hencky.from_engineering(E=scenes.YOUNG, nu=0.3), k=2e3, H=1e5)
LOW = np.array((0.137, 0.061))  # of bodies that lie anywhere in the grid


def bar(size, cell, material=SOFT, low=LOW):
    """A rectangle by points."""
    grid = pm.Grid.box((np.floor(low[0]) - 1 if low[0] else 0.0, -2), (6, 3), cell, COMM)
    return grid, pm.seed(grid, bounds=(low, np.add(low, size)), material=material)


def ring(cell, basis="bspline", inner=1.0, outer=2.0, pressure=0.2 * scenes.YOUNG):
    """A quarter of a ring that is blown up by two thirds; mean radial displacement. cell=None: elements."""
    if cell is None:
        made = scenes.dmesh.create_rectangle(
            COMM, [np.zeros(2), np.ones(2)], (16, 16), scenes.dmesh.CellType.quadrilateral
        )
        angle, radius, _ = made.geometry.x.T.copy()
        radius, angle = inner + (outer - inner) * radius, angle * np.pi / 2
        made.geometry.x[:, 0], made.geometry.x[:, 1] = radius * np.sin(angle), radius * np.cos(angle)
        body = pm.Elements(made, material=SOFT, degree=2, comm=COMM)
        problem = pm.QuasiStaticFEM(body)
        wall = body.surface(lambda x: np.hypot(x[:, 0], x[:, 1]) < 1.001 * inner)
    else:
        shape = scenes.Disc((0, 0), outer, inner)
        shape.bounds = ((0, 0), (outer, outer))
        grid = pm.Grid.box((0, 0), (outer + 2, outer + 2), cell, COMM)
        problem = pm.QuasiStatic(grid, pm.seed(grid, shape, material=SOFT), basis=basis)
        wall = scenes.arc((0, 0), inner, 0, np.pi / 2, 80, -1.0)
    points = problem.points
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.pressure(wall, pressure)
    radius = np.linalg.norm(points.X, axis=1)
    return problem, lambda: float(points.mean(np.sum(points.displacement * points.X, axis=1) / radius))


def inclusion(cell, ratio):
    """A bar of 3 x 1 m with a stiff block of 1 x .5 m in its middle, pulled; mean displacement along it."""

    def inside(x):
        y = x - LOW
        return (np.abs(y[:, 0] - 1.5) < 0.5) & (np.abs(y[:, 1] - 0.5) < 0.25)

    size = (3.0, 1.0)
    if cell is None:
        body = scenes.rectangle_elements(size, (48, 16), SOFT)
        body.mesh.geometry.x[:, :2] += LOW
        body = pm.Elements(body.mesh, material=SOFT, degree=2, comm=COMM)
        points, make = body.points, partial(pm.QuasiStaticFEM, body)
        left = body.surface(lambda x: x[:, 0] < LOW[0] + 1e-9)
        right = body.surface(lambda x: x[:, 0] > LOW[0] + 3 - 1e-9)
    else:
        grid, points = bar(size, cell)
        make, end = partial(pm.QuasiStatic, grid, points), np.add(LOW, (3.0, 0.0))
        left = pm.Surface.line(np.add(LOW, (0.0, 1.0)), LOW, 32)
        right = pm.Surface.line(end, np.add(end, (0.0, 1.0)), 32)
    points.assign(points.where(inside), scenes.classical(E=ratio * scenes.YOUNG))
    problem = make()
    problem.fix(left, u=0)
    problem.traction(right, force=(1e4, 0))
    return problem, lambda: float(points.mean_displacement()[0])


def turning_back(cell):
    """A plastic cantilever of 3 x .5 m under its weight, then under three quarters of it upwards."""
    if cell is None:
        problem = pm.QuasiStaticFEM(scenes.rectangle_elements((3.0, 0.5), (24, 4), YIELDS))
    else:
        problem = pm.QuasiStatic(*bar((3.0, 0.5), cell, YIELDS, low=np.array((0.0, 0.061))))
    problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=lambda t: (0.0, -60.0 * (t if t < 1 else 2.0 - t)))
    return problem, lambda: float(problem.points.mean_displacement()[1])


def arc_strip(cell, angle=np.pi / 3, length=4.0, thickness=0.5):
    """A strip of nu = 0 that its ends bend into an arc; the moment."""
    stuff = scenes.classical(nu=0.0)

    def moved(t, x):
        y, turn = x[:, 1] - LOW[1] - thickness / 2, max(t * angle, 1e-9)
        centre = length / turn * np.array([np.sin(turn) - turn, 0.0]) + (
            0.0,
            length / turn * (1 - np.cos(turn)),
        )
        return centre + y[:, None] * np.array([-np.sin(turn), np.cos(turn) - 1.0])

    if cell is None:
        body = scenes.rectangle_elements((length, thickness), (32, 4), stuff)
        body.mesh.geometry.x[:, :2] += LOW
        body = pm.Elements(body.mesh, material=stuff, degree=2, comm=COMM)
        problem = pm.QuasiStaticFEM(body)
        ends = (
            body.surface(lambda x: x[:, 0] < LOW[0] + 1e-9),
            body.surface(lambda x: x[:, 0] > LOW[0] + length - 1e-9),
        )
    else:
        problem, up, far = pm.QuasiStatic(*bar((length, thickness), cell, stuff)), (0, thickness), (length, 0)
        ends = (
            pm.Surface.line(LOW + up, LOW, 12),
            pm.Surface.line(LOW + far, LOW + far + up, 12),
        )
    held = problem.fix(ends[0], u=0)
    problem.fix(ends[1], u=moved)
    middle = tuple(np.add(LOW, (0.0, thickness / 2)))
    return problem, lambda: float(problem.reaction(held, about=middle).moment[0])


def sphere(cell, inner=1.0, outer=2.0, nu=0.3, pressure=100.0, middle=0.07):
    """A hollow sphere as a body of revolution, its centre anywhere on the axis; error of the mean radial
    displacement."""

    def exact(r):
        factor = pressure * inner**3 / (scenes.YOUNG * (outer**3 - inner**3))
        return factor * ((1 - 2 * nu) * r + (1 + nu) * outer**3 / (2 * r**2))

    def radius(x):
        return np.hypot(x[:, 0], x[:, 1] - middle)

    grid = pm.Grid.box((0, -2.4), (2.4, 2.4), cell, COMM)
    points = pm.seed(
        grid,
        lambda x: (radius(x) >= inner) & (radius(x) <= outer),
        material=scenes.classical(),
        axisymmetric=True,
    )
    problem = pm.QuasiStatic(grid, points)
    angle = (np.arange(120) + 0.5) / 120 * np.pi
    ray = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    wall = pm.Surface(inner * ray + (0, middle), np.full(120, inner * np.pi / 120), -ray)
    problem.pressure(wall, pressure)
    row = 0.5 * cell  # of control positions
    problem.fix(
        lambda x: (np.abs(x[:, 1] - row) < 0.1 * cell) & (np.abs(x[:, 0] - 1.5) < 0.3 * cell),
        uy=lambda t, x: t * exact(radius(x)) * (x[:, 1] - middle) / radius(x),
    )

    def read():
        r = radius(points.X)
        along = np.sum(points.displacement * (points.X - (0, middle)), axis=1) / r
        return float(points.mean(along) / points.mean(exact(r)) - 1)

    return problem, read


def cases():
    """Names, builders, references (None: the value is the error) and numbers of steps."""
    found = []
    for thickness, angle, number, options in (
        (1.3, 0.3, 1, {}),
        (1.3, 0.3, 2, {}),
        (0.7, 1.0, 1, {}),
        (0.7, 1.0, 2, {}),
        (0.35, 0.3, 2, {}),
        (1.3, 0.3, 2, {"boxes": False}),
        (0.7, 1.0, 3, {"boxes": False}),
        (1.3, 0.3, 2, {"layout": "gauss"}),
    ):
        name = ", ".join([f"strip {thickness:g}, {angle:g} rad, {number} points", *map(str, options)])
        found.append((name, partial(scenes.strip, thickness, angle, number, **options), 1.0, 2))
    blown = run(partial(ring, None), 4).value
    for cell, basis in ((0.2, "bspline"), (0.5, "bspline"), (0.2, "mpm"), (0.2, "gimpm")):
        found.append((f"ring, {cell:g} m, {basis}", partial(ring, cell, basis), blown, 4))
    for cell, ratio in ((0.25, 1e3), (0.125, 1e3), (0.25, 10.0)):
        reference = run(partial(inclusion, None, ratio), 1).value
        found.append((f"inclusion {ratio:g} : 1, {cell:g} m", partial(inclusion, cell, ratio), reference, 1))
    back = run(partial(turning_back, None), 14, to=2.75).value
    for cell in (0.25, 0.125):
        found.append((f"plastic, turning back, {cell:g} m", partial(turning_back, cell), back, (14, 2.75)))
    bent = run(partial(arc_strip, None), 8).value
    found.append(("bent into an arc, 0.25 m", partial(arc_strip, 0.25), bent, 8))
    found.append(
        ("Cook, nu = 0.45, 6 m, 2 points", partial(scenes.cook, 6.0, 2, 0.45), cook_elements(), None)
    )
    found.append(("hollow sphere, 0.2 m", partial(sphere, 0.2), None, 1))
    return found


def cook_elements(nu=0.45, E=240.565, force=100.0):
    """Cook's membrane by elements of degree 2."""
    made = scenes.dmesh.create_rectangle(
        COMM, [np.zeros(2), np.ones(2)], (32, 32), scenes.dmesh.CellType.quadrilateral
    )
    s, t, _ = made.geometry.x.T.copy()
    made.geometry.x[:, 0], made.geometry.x[:, 1] = 48 * s, 44 * s + t * (44 - 28 * s)
    body = pm.Elements(made, material=scenes.classical(nu, E), degree=2, comm=COMM)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.traction(body.surface(lambda x: x[:, 0] > 48 - 1e-9), force=(0, force / 16))
    for _ in problem.march(5, adaptive=True, progress=False):
        pass
    corner = np.argmin(np.linalg.norm(body.nodes.position[:, :2] - (48, 60), axis=1))
    return float(body.displacement[corner, 1])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="FILE", help="put the results in, beside those of other groups")
    args, rows = parser.parse_args(), []
    for name, build, reference, steps in cases():
        steps, to = steps if isinstance(steps, tuple) else (steps, 1.0)
        made = run(build, steps, to=to)
        rows.append(record(name, made, reference, made.value if reference is None else None))
        print(name, rows[-1]["error"], rows[-1]["failure"], made.warned[:1], flush=True)
    report("unseen", rows)
    verdict(rows)
    add_to_json(args.json, "unseen", rows)


if __name__ == "__main__":
    main()
