"""Scenes that several benchmarks share, bodies and closed forms.

Scenes take every default of `pm.seed`, `pm.QuasiStatic` and `march` unless a caller says otherwise: they are
what somebody gets who has read the first page only.
"""

from __future__ import annotations

import functools
import importlib.util
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx import mesh as dmesh

import polarmpm as pm

COMM = MPI.COMM_SELF
DEMOS = Path(__file__).parents[1] / "demos"
YOUNG = 1e6  # Pa, of scenes whose stiffness doesn't matter


@functools.cache
def demo(name):
    """A demo's module."""
    spec = importlib.util.spec_from_file_location(name, DEMOS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def has_basis(name):
    """Whether this version has a basis of that name."""
    from polarmpm.basis.registry import BASES

    return name in BASES


# bodies -------------------------------------------------------------------------------------------
class Block:
    """A rectangle, or a box whose z stays upright, turned by an angle (rad) about its corner."""

    def __init__(self, corner, size, angle=0.0):
        self.corner, self.size = np.array(corner, float), np.array(size, float)
        self.dim, c, s = len(self.size), np.cos(angle), np.sin(angle)
        self.axes = np.eye(self.dim)
        self.axes[:2, :2] = [[c, s], [-s, c]]  # rows: along, across
        ends = np.stack(np.meshgrid(*[(0, v) for v in self.size], indexing="ij"), -1).reshape(-1, self.dim)
        corners = self.corner + ends @ self.axes
        self.bounds = tuple(map(tuple, (corners.min(0), corners.max(0))))

    def local(self, x):
        """Distances from the corner along the edges."""
        return (x - self.corner) @ self.axes.T

    def __call__(self, x):
        y = self.local(x)
        return np.all((y >= 0) & (y <= self.size), axis=1)


class Disc:
    """A disc, or a cylinder along z from `low` to `high`; with an inner radius a ring."""

    def __init__(self, centre, radius, inner=0.0, low=None, high=None):
        self.centre, self.radius, self.inner = np.array(centre, float), radius, inner
        self.ends = None if low is None else (low, high)
        lower, upper = self.centre - radius, self.centre + radius
        if self.ends:
            lower, upper = np.append(lower, low), np.append(upper, high)
        self.bounds = (tuple(lower), tuple(upper))

    def __call__(self, x):
        r = np.linalg.norm(x[:, :2] - self.centre, axis=1)
        found = (r <= self.radius) & (r >= self.inner)
        if self.ends:
            found &= (x[:, 2] >= self.ends[0]) & (x[:, 2] <= self.ends[1])
        return found


class Arch:
    """An arch of a square section, its centre of curvature at (0, centre), as in the demo."""

    def __init__(self, centre, bottom, radius=100.0, side=1.0, angle=np.pi / 4):
        self.centre, self.bottom, self.radius, self.side, self.angle = centre, bottom, radius, side, angle
        outer, inner = radius + side / 2, radius - side / 2
        self.bounds = (
            (0, centre + inner * np.cos(angle), bottom),
            (outer * np.sin(angle), centre + outer, bottom + side),
        )

    def __call__(self, x):
        across, along = x[:, 0], x[:, 1] - self.centre
        radius, angle = np.hypot(across, along), np.arctan2(across, along)
        section = (np.abs(radius - self.radius) <= self.side / 2) & (
            np.abs(x[:, 2] - self.bottom - self.side / 2) <= self.side / 2
        )
        return section & (angle >= 0) & (angle <= self.angle)

    @property
    def direction(self):
        """Towards the free end."""
        return (np.cos(self.angle), -np.sin(self.angle), 0)

    def mesh(self, along, across):
        """Hexahedra that fit it."""
        made = dmesh.create_box(
            COMM, [np.zeros(3), np.ones(3)], [along, across, across], dmesh.CellType.hexahedron
        )
        s, r, z = made.geometry.x.T.copy()
        angle, radius = s * self.angle, self.radius + (r - 0.5) * self.side
        x = [radius * np.sin(angle), radius * np.cos(angle) + self.centre, self.bottom + self.side * z]
        made.geometry.x[:] = np.stack(x, axis=1)
        return made

    def end_face(self, number):
        """The free end as a surface of number x number points."""
        inner = np.array([np.sin(self.angle), np.cos(self.angle), 0.0])
        corner = (self.radius - self.side / 2) * inner + (0, self.centre, self.bottom)
        return pm.Surface.rectangle(corner, (0, 0, self.side), self.side * inner, number)


# scenes -------------------------------------------------------------------------------------------
def arch_grid(arch, cell):
    """Room for the arch to bend out of its plane; the root is on the plane x = 0."""
    (_, low, bottom), (right, top, _) = arch.bounds
    lower = (0, np.floor(low - 5) // 2 * 2, np.floor(bottom - 6) // 2 * 2)
    upper = (right + 6, top + 6, bottom + 0.85 * arch.radius)
    return pm.Grid.box(
        lower, [a + cell * np.ceil((b - a) / cell) for a, b in zip(lower, upper, strict=True)], cell, COMM
    )


def arch(body, cell, number=None, degree=None, force=600.0, surface=False):
    """The arch under an out-of-plane force at its end, and the end's displacement (m). With a `degree`, a
    number or "default", points of a mesh that fits; `surface`: the force acts on the end face."""
    material = demo("curved_cantilever").MATERIAL
    grid = arch_grid(body, cell)
    if degree is None:
        options = {} if number is None else {"points_per_cell": number}
        points = pm.seed(grid, body, material=material, **options)
    else:
        length = body.radius * body.angle
        mesh = body.mesh(round(length / min(cell, body.side)), max(1, round(body.side / cell)))
        options = {} if degree == "default" else {"degree": degree}
        points = pm.seed_mesh(grid, mesh, material=material, **options)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    tip = points.farthest(body.direction)
    if surface:
        problem.traction(body.end_face(4), force=(0, 0, force / body.side**2))
    else:
        problem.load(tip, force=(0, 0, force))

    def read():
        if not surface:
            return points.mean_displacement(tip)
        rows = points.rows(tip)  # carried on to the end face
        along = np.array(body.direction)
        end = np.array([np.sin(body.angle), np.cos(body.angle), 0]) * body.radius + (
            0,
            body.centre,
            body.bottom + body.side / 2,
        )
        gap = ((end - points.X[rows]) @ along)[:, None] * along
        return np.mean(
            points.displacement[rows] + np.einsum("nij,nj->ni", points.F[rows] - np.eye(3), gap), 0
        )

    return problem, read


def arch_elements(body, along, across, force=600.0):
    """The same by finite elements of degree 2."""
    made = pm.Elements(
        body.mesh(along, across), material=demo("curved_cantilever").MATERIAL, degree=2, comm=COMM
    )
    problem = pm.QuasiStaticFEM(made)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    end = made.farthest(body.direction)
    problem.load(end, force=(0, 0, force))
    return problem, lambda: made.mean_displacement(end)


def classical(nu=0.3, E=YOUNG):
    return pm.NeoHookean.from_engineering(E=E, nu=nu)


def micropolar(nu=0.3, n=0.5, l_b=0.3, E=YOUNG):
    return pm.MicropolarElastic.from_engineering(E=E, nu=nu, n=n, l_b=l_b, l_t=l_b, psi=1.0)


def bending_stiffness(material, E, nu, thickness):
    """Of a strip in plane strain (N m^2 per m): E'I, and in micropolar solids (gamma + beta) t."""
    stiffness = E / (1 - nu**2) * thickness**3 / 12
    if material.micropolar:
        stiffness += (material.gamma + material.beta) * thickness
    return stiffness


def strip(
    thickness,
    angle,
    number,
    *,
    material=None,
    nu=0.3,
    basis=None,
    share=1e-4,
    offset=(0.13, 0.27),
    layout="uniform",
    **options,
):
    """A strip in plane strain on unit cells, held at one end, a small transverse force at the other.

    Twenty times as long as thick, at least ten cells. Nodes within a cell of the root are held; the force
    is shared by the points of the last half cell. The reading is the amplitude of the beam's deflection
    P/(E'I) (s_P s^2/2 - s^3/6) in that of the points between 0.25 and 0.9 of the length, fitted together
    with a displacement and a rotation: neither the way of holding nor shear enters. 1 is exact.
    """
    material = material or classical(nu)
    length = max(20 * thickness, 10.0)
    body = Block(offset if angle else (0.0, 0.0), (length, thickness), angle)
    lower, upper = np.floor(np.array(body.bounds[0])) - 2, np.ceil(np.array(body.bounds[1])) + 2
    if not angle:
        lower[0] = 0.0
    grid = pm.Grid.box(lower, upper, 1.0, COMM)
    points = pm.seed(grid, body, material=material, points_per_cell=number, layout=layout)
    problem = pm.QuasiStatic(grid, points, **({"basis": basis} if basis else {}), **options)
    theta = {"theta": 0} if material.micropolar else {}
    if angle:
        problem.fix(lambda x: body.local(x)[:, 0] <= 1.0, u=0, **theta)
    else:
        problem.fix(pm.plane(x=0.0), u=0, **theta)
    across = body.axes[1]
    last = body.local(points.X)[:, 0].max() - 0.5
    tip = points.where(lambda x: body.local(x)[:, 0] >= last)
    stiffness = bending_stiffness(material, YOUNG, nu, thickness)
    force = 3 * stiffness * share / length**2
    problem.load(tip, force=tuple(force * across))

    def read():
        s = body.local(points.X)[:, 0]
        loaded = points.mean(s, tip)
        inner = (s > 0.25 * length) & (s < 0.9 * length)
        s, v = s[inner], (points.displacement @ across)[inner]
        beam = force / stiffness * (loaded * s**2 / 2 - s**3 / 6)
        fit = np.stack([beam, np.ones_like(s), s], axis=1)
        weight = np.sqrt(points.volume0[inner])[:, None]
        return float(np.linalg.lstsq(weight * fit, weight[:, 0] * v, rcond=None)[0][0])

    return problem, read


def column(cells, number, basis=None, height=10.0, E=1e4, weight=800.0):
    """A column of one row of cells that settles by half under its own weight, nu = 0 (Coombs and Augarde
    2020). The reading is the mean error of the vertical stress over the weight: exact is -w (H - Y)."""
    h = height / cells
    grid = pm.Grid.box((0, 0), (h, height + 2 * h), h, COMM)
    stuff = pm.Hencky.from_engineering(E=E, nu=0.0)
    points = pm.seed(grid, bounds=((0, 0), (h, height)), material=stuff, points_per_cell=number)
    problem = pm.QuasiStatic(grid, points, **({"basis": basis} if basis else {}))
    for x in (0.0, h):
        problem.fix(pm.plane(x=x), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.body_load(force=(0, -weight))

    def read():
        exact = -weight * (height - points.X[:, 1])
        wrong = np.abs(problem.fields("stress").stress[:, 1, 1] - exact)
        return float(wrong @ points.volume0 / points.volume0.sum() / (weight * height))

    return problem, read


def beam(cell, number, reset=None, E=12e6, nu=0.2, force=100e3, length=10.0):
    """AMPLE's elastic cantilever: 10 x 1 m, Hencky, a dead end force; the end's mean displacement (m)."""
    grid = pm.Grid.box((0, -10), (12, 2), cell, COMM)
    stuff = pm.Hencky.from_engineering(E=E, nu=nu)
    points = pm.seed(grid, bounds=((0, 0), (length, 1)), material=stuff, points_per_cell=number)
    problem = pm.QuasiStatic(grid, points, **({} if reset is None else {"reset": reset}))
    problem.fix(pm.plane(x=0.0), u=0)
    tip = points.farthest((1, 0))
    problem.traction(pm.Surface.line((length, 0), (length, 1), max(8, round(4 / cell))), force=(0, -force))

    def read():
        rows = points.rows(tip)
        gap = np.stack([length - points.X[rows, 0], 0 * rows], axis=1)
        turned = np.einsum("nij,nj->ni", points.F[rows][:, :2, :2] - np.eye(2), gap)
        return np.mean(points.displacement[rows] + turned, axis=0)

    return problem, read


def rectangle_elements(size, cells, material, degree=2):
    made = dmesh.create_rectangle(COMM, [np.zeros(2), np.array(size)], cells, dmesh.CellType.quadrilateral)
    return pm.Elements(made, material=material, degree=degree, comm=COMM)


def beam_elements(cells=(80, 8), E=12e6, nu=0.2, force=100e3, length=10.0):
    made = rectangle_elements((length, 1.0), cells, pm.Hencky.from_engineering(E=E, nu=nu))
    problem = pm.QuasiStaticFEM(made)
    problem.fix(pm.plane(x=0.0), u=0)
    end = made.farthest((1, 0))
    problem.load(end, force=(0, -force))
    return problem, lambda: made.mean_displacement(end)


def cook(cell, number, nu, E=240.565, force=100.0):
    """Cook's membrane in plane strain at large strain, neo-Hookean; u_y of the upper corner (m)."""

    def inside(x):
        low, high = 44 / 48 * x[:, 0], 44 + 16 / 48 * x[:, 0]
        return (x[:, 0] >= 0) & (x[:, 0] <= 48) & (x[:, 1] >= low) & (x[:, 1] <= high)

    inside.bounds = ((0, 0), (48, 60))
    grid = pm.Grid.box((0, -12), (60, 84), cell, COMM)
    points = pm.seed(grid, inside, material=classical(nu, E), points_per_cell=number)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.traction(pm.Surface.line((48, 44), (48, 60), 64), force=(0, force / 16))
    corner = np.array((48.0, 60.0))
    near = points.nearest(corner)

    def read():
        row = points.rows(near)[0]
        u = points.displacement[row] + (points.F[row, :2, :2] - np.eye(2)) @ (corner - points.X[row])
        return float(u[1])

    return problem, read


def arc(centre, radius, begin, end, number, sign=1.0):
    """A surface on an arc; the normal points away from the centre, or with sign -1 towards it."""
    angle = begin + (np.arange(number) + 0.5) / number * (end - begin)
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    area = np.full(number, radius * (end - begin) / number)
    return pm.Surface(np.array(centre) + radius * ray, area, sign * ray)


def plate(cell, number, radius=1.0, size=4.0, nu=0.3, stress=1e-4 * YOUNG, lines=None):
    """A quarter of a plate with a hole (Kirsch) under tension along x, the exact displacements on its outer
    edges; the reading is the error of F - 1 in the L2 norm, relative. `lines`: of a graded grid, along both
    axes."""
    mu, kolosov = YOUNG / 2 / (1 + nu), 3 - 4 * nu

    def exact(x):
        r, t = np.hypot(x[:, 0], x[:, 1]) / radius, np.arctan2(x[:, 1], x[:, 0])
        scale = stress * radius / (8 * mu)
        ux = r * (kolosov + 1) * np.cos(t) + 2 / r * ((1 + kolosov) * np.cos(t) + np.cos(3 * t))
        ux -= 2 / r**3 * np.cos(3 * t)
        uy = r * (kolosov - 3) * np.sin(t) + 2 / r * ((1 - kolosov) * np.sin(t) + np.sin(3 * t))
        uy -= 2 / r**3 * np.sin(3 * t)
        u = scale * np.stack([ux, uy], axis=1)
        return np.where(np.abs(x) < 1e-12, 0.0, u)  # on the planes of symmetry to the last digit

    def inside(x):
        return np.hypot(x[:, 0], x[:, 1]) >= radius

    inside.bounds = ((0, 0), (size, size))
    grid = pm.Grid.box((0, 0), (size, size), cell, COMM)
    if lines is not None:
        grid = pm.Grid.graded(lines, lines, comm=COMM)
    points = pm.seed(grid, inside, material=classical(nu), points_per_cell=number)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    for axis in "xy":
        problem.fix(
            pm.plane(**{axis: size}),
            ux=lambda t, x: t * exact(x)[:, 0],
            uy=lambda t, x: t * exact(x)[:, 1],
        )

    def read():
        step = 1e-5
        gradient = np.stack(
            [(exact(points.X + step * e) - exact(points.X - step * e)) / (2 * step) for e in np.eye(2)], -1
        )
        wrong = points.F[:, :2, :2] - np.eye(2) - gradient
        square = [np.einsum("n,nij->", points.volume0, a**2) for a in (wrong, gradient)]
        return float(np.sqrt(square[0] / square[1]))

    return problem, read


def cylinder(cell, number, inner=1.0, outer=2.0, nu=0.3, pressure=1e-4 * YOUNG):
    """A quarter of a thick cylinder under a small inner pressure (Lame); the error of the radial displacement
    in the L2 norm, relative."""
    body = Disc((0, 0), outer, inner)
    body.bounds = ((0, 0), (outer, outer))
    size = outer + 2 * cell
    grid = pm.Grid.box((0, 0), (size, size), cell, COMM)
    points = pm.seed(grid, body, material=classical(nu), points_per_cell=number)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.pressure(arc((0, 0), inner, 0, np.pi / 2, round(16 / cell), -1.0), pressure)

    def read():
        r = np.linalg.norm(points.X, axis=1)
        factor = (1 + nu) / YOUNG * pressure * inner**2 / (outer**2 - inner**2)
        exact = factor * ((1 - 2 * nu) * r + outer**2 / r)
        wrong = np.einsum("ni,ni->n", points.displacement, points.X) / r - exact
        return float(np.sqrt(wrong**2 @ points.volume0 / (exact**2 @ points.volume0)))

    return problem, read


def hill(cell, number, inner=1.0, outer=2.0, strength=1e-3 * YOUNG, expansion=0.01):
    """The same cylinder of von Mises' material, expanded till it flows; the pressure over Hill's limit
    2/sqrt(3) strength ln(b/a) of the present radii."""
    body = Disc((0, 0), outer, inner)
    body.bounds = ((0, 0), (outer, outer))
    size = outer + 2 * cell
    grid = pm.Grid.box((0, 0), (size, size), cell, COMM)
    stuff = pm.VonMises(pm.Hencky.from_engineering(E=YOUNG, nu=0.3), k=strength)
    points = pm.seed(grid, body, material=stuff, points_per_cell=number)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    wall = problem.fix(arc((0, 0), inner, 0, np.pi / 2, round(16 / cell), -1.0), normal=-expansion * inner)

    def read():
        a = inner * (1 + expansion)
        b = np.sqrt(outer**2 + a**2 - inner**2)  # plastic flow keeps the volume
        p = abs(problem.reaction(wall)[0]).mean() / a
        return float(p / (2 / np.sqrt(3) * strength * np.log(b / a)))

    return problem, read


def footing(cells, number, settlement=0.02, cohesion=100.0):
    """A rough strip footing on weightless von Mises soil in plane strain, E = 1e4 c, half of it one metre
    wide on 5 x 2.5 m; load over c and the width to half way between the last held and the first free node.
    The limit is 2 + pi. `cells` in a metre."""
    h = 1.0 / cells
    grid = pm.Grid.box((0, 0), (5, 2.5), h, COMM)
    elastic = pm.Hencky.from_engineering(E=1e4 * cohesion, nu=0.3)
    stuff = pm.VonMises(elastic, k=np.sqrt(3) * cohesion)
    points = pm.seed(grid, material=stuff, points_per_cell=number)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(y=0.0), u=0)
    for x in (0.0, 5.0):
        problem.fix(pm.plane(x=x), ux=0)

    def under(x):
        return (np.abs(x[:, 1] - 2.5) < 1e-9) & (x[:, 0] <= 1.0 + 1e-9)

    foot = problem.fix(under, ux=0, uy=-settlement)

    def read():
        x = problem.system.nodes.position
        top = np.unique(np.round(x[np.abs(x[:, 1] - 2.5) < 1e-9, 0], 9))
        width = (top[top <= 1.0 + 1e-9].max() + top[top > 1.0 + 1e-9].min()) / 2
        return float(-problem.reaction(foot)[0][1] / (cohesion * width))

    return problem, read


def biaxial(number, cell=2.5e-3, dilatancy=10.0, **options):
    """The sand column of `demos/biaxial.py` with all defaults; peak and residual stress (kPa)."""
    sand = demo("biaxial")
    grid = pm.Grid.box((0, 0), (0.05, sand.HEIGHT), cell, COMM)
    bounds = ((0, 0), (sand.WIDTH, sand.HEIGHT))
    points = pm.seed(grid, bounds=bounds, material=sand.material(dilatancy), points_per_cell=number)
    problem = pm.QuasiStatic(grid, points, **options)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    platen = problem.fix(pm.plane(y=sand.HEIGHT, moving=True), ux=0, uy=-sand.SHORTENING)
    stress = []

    class Watch(pm.Observer):
        def after_commit(self, problem, new_base):
            stress.append(-problem.reaction(platen)[0][1] / sand.WIDTH / 1e3)

    problem.observers.append(Watch())
    return problem, lambda: (max(stress), stress[-1])


def shaft(number, material, radius=1.0, length=4.0, cell=0.5, twist=1e-3):
    """A round bar twisted by the displacements of its ends; the torsional stiffness from its energy
    (N m^2)."""
    half = radius + 2 * cell
    grid = pm.Grid.box((-half, -half, 0), (half, half, length), cell, COMM)
    body = Disc((0, 0), radius, low=0.0, high=length)
    points = pm.seed(grid, body, material=material, points_per_cell=number)
    problem = pm.QuasiStatic(grid, points)
    theta = {"theta_z": 0} if material.micropolar else {}
    problem.fix(pm.plane(z=0.0), u=0, **theta)
    theta = {"theta_z": twist * length} if material.micropolar else {}
    problem.fix(
        pm.plane(z=length),
        ux=lambda t, x: -t * twist * length * x[:, 1],
        uy=lambda t, x: t * twist * length * x[:, 0],
        uz=0,
        **theta,
    )
    return problem, lambda: 2 * problem.energy() / length / twist**2


def shaft_stiffness(material, mu, radius=1.0):
    """Torsional stiffness of a round bar; micropolar: Gauthier and Jahsman 1975."""
    GJ = mu * np.pi * radius**4 / 2
    if not material.micropolar:
        return GJ
    from scipy.special import iv

    m = material
    p = np.sqrt(4 * m.kappa / (m.alpha + 2 * m.gamma))
    share, chi = 2 * m.gamma / (m.alpha + 2 * m.gamma), iv(1, p * radius) / (p * radius * iv(0, p * radius))
    length = m.gamma / m.mu
    return GJ * (1 + 6 * length / radius**2 * (1 - 4 / 3 * share * chi) / (1 - share * chi))
