"""Round and square excavations under outer pressure, with second gradients and without. Metres, MPa.

S 6.3.3. A quarter in plane strain between two planes of symmetry, on which the slope of the tangential
displacement vanishes, too. The round one, of 4 m in a disc of 10 m, has a closed form: with an internal length
of 4 m the wall is pressed together by a quarter less, and remains axisymmetric. In the corner of the square
one the classical stress grows with every refinement, that of the second gradient doesn't.
"""

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import mesh

import polarmpm as pm
from polarmpm.study import commandline as demo
from polarmpm.study.exact import GradientRing

INNER, OUTER, LENGTH = 2.0, 5.0, 4.0  # m; of the square half the sides
YOUNG, POISSON = 20e3, 0.0  # MPa
SHARE=1e-3
PRESSURE = {"round": 54.0189*SHARE, "square": 60.0}  # MPa


def energy(F, H, p):
    """psi(E) + l^2/12 (psi(E,1) + psi(E,2)) with Green's strain E."""

    def psi(strain):
        return p.lam / 2 * ufl.tr(strain) ** 2 + p.mu * ufl.inner(strain, strain)

    w = psi((ufl.dot(F.T, F) - ufl.Identity(3)) / 2)
    for a in range(2):
        change = ufl.dot(F.T, ufl.as_matrix([[H[i, j, a] for j in range(3)] for i in range(3)]))
        w += p.l**2 / 12 * psi((change + change.T) / 2)
    return w


def classical(F, p):
    strain = (ufl.dot(F.T, F) - ufl.Identity(3)) / 2
    return p.lam / 2 * ufl.tr(strain) ** 2 + p.mu * ufl.inner(strain, strain)


def material(length):
    moduli = {"lam": YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON)), "mu": YOUNG / (2 * (1 + POISSON))}
    if length == 0:
        return pm.UserEnergy(classical, moduli, micropolar=False, isotropic=True)
    return pm.UserEnergy(energy, {**moduli, "l": length}, micropolar=False, second_gradient=True)


# scenes -----------------------------------------------------------------------------------------
def rings(cell):
    """Quadrilaterals between the radii, of about the size of a cell; as many chords as circles have area."""
    along, around = round((OUTER - INNER) / cell), round(np.pi / 2 * (INNER + OUTER) / 2 / cell)
    corners = [(INNER, 0.0), (OUTER, np.pi / 2)]
    body = mesh.create_rectangle(MPI.COMM_WORLD, corners, [along, around], mesh.CellType.quadrilateral)
    radius, angle = body.geometry.x[:, :2].T.copy()
    step = np.pi / 2 / around
    radius *= np.sqrt(step / np.sin(step))
    body.geometry.x[:, :2] = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return body


def rim(cell):
    """The outer boundary of the round one as a surface, with its exact length."""
    n = 4 * round(np.pi / 2 * OUTER / cell)
    angle = (np.arange(n) + 0.5) / n * np.pi / 2
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return pm.Surface(OUTER * normal, np.full(n, OUTER * np.pi / 2 / n), normal)


def of_points(shape, length, cell, args):
    """Material points with splines."""
    upper = np.ceil((OUTER + cell) / cell) * cell
    grid = pm.Grid.box((0, 0), (upper, upper), cell)
    if shape == "square":
        points = pm.seed(
            grid,
            lambda x: x.max(axis=1) > INNER,
            bounds=((0, 0), (OUTER, OUTER)),
            material=material(length),
            points_per_cell=args.points_per_cell,
        )
    elif args.seeding == "mesh":
        points = pm.seed_mesh(grid, rings(cell), material=material(length), points_per_cell=args.points_per_cell)
    else:
        points = pm.seed(
            grid,
            lambda x: (np.hypot(*x.T) > INNER) & (np.hypot(*x.T) < OUTER),
            bounds=((0, 0), (OUTER, OUTER)),
            material=material(length),
            points_per_cell=args.points_per_cell,
        )
    problem = pm.QuasiStatic(grid, points, reset=None)
    if args.symmetry == "held":
        for axis in "xy":
            problem.symmetry(pm.plane(**{axis: 0.0}))
    else:
        problem.fix(pm.plane(x=0.0), ux=0)
        problem.fix(pm.plane(y=0.0), uy=0)
    if shape == "round":
        problem.pressure(rim(cell), PRESSURE[shape])
    else:
        n = 4 * round(OUTER / cell)
        corner = (OUTER, OUTER)
        for ends in (((OUTER, 0), corner), (corner, (0, OUTER))):
            problem.pressure(pm.Surface.line(*ends, n), PRESSURE[shape])
    return problem


def solve(problem, args, file):
    """March to the pressure, with files for ParaView."""
    with pm.Recorder(file, problem, fields=("displacement", "stress")) as record:
        for step in problem.march(args.steps, progress=False):
            if step.factor == 1.0:
                record(step)
    return problem


# results ----------------------------------------------------------------------------------------
def wall(problem, cell):
    """Hoop and radial stress (MPa, compression positive) and inward displacement (mm) at the hole: each the
    mean around it, and how far it spreads (the largest less the smallest, over the mean).

    In sectors of a cell a cubic of the distance from the wall is fitted to the points next to it.
    """
    points, comm = problem.points, problem.comm
    stress, volume = problem.fields("stress").stress, points.volume0
    radius, angle = np.hypot(*points.X.T), np.arctan2(points.X[:, 1], points.X[:, 0])
    radial = np.zeros((len(points), 3))
    radial[:, :2] = points.X / radius[:, None]
    around = np.stack([-radial[:, 1], radial[:, 0], radial[:, 2]], axis=1)
    values = np.stack(
        [
            *(-np.einsum("ni,nij,nj->n", e, stress, e) for e in (around, radial)),
            -1e3 * np.einsum("ni,ni->n", points.displacement, radial[:, :2]),
        ],
        axis=1,
    )
    near = max(0.75, 2 * cell)  # m
    rows = np.concatenate(comm.allgather(np.column_stack([radius - INNER, angle, volume, values])))
    rows = rows[rows[:, 0] < near]
    sectors = max(3, int(np.pi / 2 * INNER / cell))
    sector = np.minimum((rows[:, 1] / (np.pi / 2) * sectors).astype(int), sectors - 1)
    found = []
    for k in range(sectors):
        x, _, weight = rows[sector == k, :3].T
        root = np.sqrt(weight)[:, None]
        fit = np.linalg.lstsq(root * (x[:, None] / near) ** np.arange(4), root * rows[sector == k, 3:], rcond=None)
        found.append(fit[0][0])
    mean = np.mean(found, axis=0)
    spread = np.ptp(found, axis=0) / np.abs(mean).max(initial=1e-300, where=mean != 0)
    names = ("hoop", "radial", "displacement")
    return dict(zip(names, map(float, mean))), dict(zip(names, map(float, spread)))


def profile(problem):
    """Radius (m), and hoop and radial stress (MPa) of the points; on rank 0."""
    from polarmpm.plot import figures as plot

    points, stress = problem.points, problem.fields("stress").stress
    radial = points.X / np.hypot(*points.X.T)[:, None]
    around = np.stack([-radial[:, 1], radial[:, 0]], axis=1)
    parts = [-np.einsum("ni,nij,nj->n", e, stress[:, :2, :2], e) for e in (around, radial)]
    return [plot.gather(problem.comm, a) for a in (np.hypot(*points.X.T), *parts)]


def principal(problem):
    """Largest compressive principal stress at the local points (MPa)."""
    return -np.linalg.eigvalsh(problem.fields("stress").stress)[:, 0]


def peak(problem):
    return problem.comm.allreduce(principal(problem).max(initial=-np.inf), op=MPI.MAX)
