"""Triaxial compression of clay and sand, drained and undrained, against closed forms. Metres, Pa.

A cylinder between smooth plates, by its section: x is the radius, y the height. It stays a cylinder, so that
the path of its stresses has a closed form at finite strain. Clay is modified Cam-Clay with Houlsby's energy,
normally consolidated to 1.5 times the pressure of the cell; drained (the cell's pressure on its side stays)
and undrained (its volume stays; the pressure of the water is what the cell bears beyond the grains). Sand is
Drucker-Prager's cone through Mohr-Coulomb's strength in triaxial compression, with dilatancy. p is the mean
pressure of the grains, q the axial less the radial one, and the volumetric strain is -ln J.
"""

import math

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.plot.drawing import finish_curves
from polarmpm.study import commandline as demo

RADIUS, HEIGHT, SHORTER = 0.05, 0.1, 0.2  # m; by how much the height shrinks, over itself
CELL = 1e5  # Pa, pressure
SWELLING, COMPRESSION, SLOPE, CONSOLIDATED, SHEAR = 0.02, 0.1, 1.0, 1.5e5, 4e6  # of the clay
YOUNG, POISSON, COHESION = 4e7, 0.3, 5e3  # of the sand
FRICTION, DILATANCY = math.radians(30.0), math.radians(10.0)
NAMES = {"drained": "clay, drained", "undrained": "clay, undrained", "sand": "sand, drained"}
PLATE = pm.plane(y=HEIGHT)
NODE, SHARE = np.polynomial.legendre.leggauss(60)


def clay():
    elastic = pm.Houlsby(p_0=CELL, swelling=SWELLING, mu=SHEAR)
    return pm.CamClay(elastic, M=SLOPE, compression=COMPRESSION, p_c=CONSOLIDATED)


def sand():
    elastic = pm.Hencky.from_engineering(E=YOUNG, nu=POISSON)
    return pm.DruckerPrager(elastic, phi=FRICTION, psi=DILATANCY, c=COHESION, cone="compression")


# the specimen -------------------------------------------------------------------------------------------
def specimen(material, args):
    """The problem, and what stands for the specimen's side and its top."""
    if args.basis.startswith("fem"):
        corners, counts = [(0, 0), (RADIUS, HEIGHT)], [args.cells, 2 * args.cells]
        body = mesh.create_rectangle(MPI.COMM_WORLD, corners, counts, mesh.CellType.quadrilateral)
        body = pm.Elements(body, material=material, degree=int(args.basis[-1]), axisymmetric=True)
        return pm.QuasiStaticFEM(body), pm.plane(x=RADIUS), PLATE
    grid = pm.Grid.box((0, 0), (2 * RADIUS, HEIGHT), RADIUS / args.cells)
    points = pm.seed(grid, bounds=((0, 0), (RADIUS, HEIGHT)), material=material, axisymmetric=True)
    side = pm.Surface.line((RADIUS, 0.0), (RADIUS, HEIGHT), 8 * args.cells)
    top = pm.Surface.line((RADIUS, HEIGHT), (0.0, HEIGHT), 8 * args.cells)
    return pm.QuasiStatic(grid, points, basis=args.basis, reset=None), side, top


def everywhere(x):
    return np.full(len(x), True)


def bulge(factor, x):
    """Radial displacement (m) that keeps the volume."""
    return x[:, :1] * ((1 - SHORTER * factor) ** -0.5 - 1)


def compress(kind, args):
    """The problem, ready to be compressed."""
    problem, side, top = specimen(sand() if kind == "sand" else clay(), args)
    problem.fix(pm.plane(y=0.0), uy=0)
    begin = 0.0
    if kind == "sand":  # it comes to its pressure first
        begin = 0.1
        for face in (side, top):
            problem.pressure(face, lambda f: CELL * min(f / begin, 1.0))
        for _ in problem.march(1, to=begin, progress=False):
            pass
    elif kind == "drained":
        problem.pressure(side, lambda f: CELL)
    else:
        problem.fix(everywhere, ux=bulge)

    def lowered(f):
        return -SHORTER * HEIGHT * (f - begin) / (1 - begin)

    problem.fix(PLATE, uy=lowered)
    return problem


# measured -----------------------------------------------------------------------------------------------
def means(problem):
    """Logarithmic axial strain, p, q, volumetric strain, and the radial pressure, means over the body."""
    points, comm = problem.points, problem.comm
    stress = problem.fields("stress").stress
    axial, radial, hoop = (-stress[:, k, k] for k in (1, 0, 2))
    J = np.linalg.det(points.F)
    p, q = (axial + radial + hoop) / 3, axial - 0.5 * (radial + hoop)
    rows = np.stack([-np.log(points.F[:, 1, 1]), p, q, -np.log(J), radial])
    sums = comm.allreduce(np.append(rows @ points.volume0, points.volume0.sum()))
    return sums[:-1] / sums[-1]


# closed forms -------------------------------------------------------------------------------------------
def shear_by_flow(ratio, log_pressure, weight):
    """Integral of the plastic shear 2 eta/(M^2 - eta^2) weight d(log_pressure) along a path of eta = q/p,
    with the derivative of the logarithm at eta."""
    first, last = ratio
    eta = first + 0.5 * (1 + NODE) * (last - first)
    return 0.5 * (last - first) * np.sum(SHARE * 2 * eta / (SLOPE**2 - eta**2) * weight * log_pressure(eta))


def clay_at(kind, eta, first):
    """(axial strain, p, q, volumetric strain) of clay at eta = q/p, yielding from eta = `first` on."""
    plastic = COMPRESSION - SWELLING
    if kind == "undrained":  # p_c (p/p_0)^(swelling/plastic) stays
        power = 1 + SWELLING / plastic
        volume = 0.0
        p = CELL if eta <= first else CELL * (CONSOLIDATED / CELL / (1 + (eta / SLOPE) ** 2)) ** (1 / power)
        kirchhoff = p

        def slope(e):  # of ln p_c = -swelling/plastic ln p
            return SWELLING / plastic * 2 * e / (SLOPE**2 + e**2) / power
    else:  # q = 3 (p - p_0); the yield surface is one of stresses times J
        p = 3 * CELL / (3 - eta)
        p_c = p * (1 + (eta / SLOPE) ** 2)
        if eta <= first:
            volume = SWELLING * math.log(p / CELL) / (1 + SWELLING)
        else:
            volume = SWELLING * math.log(p / CELL) + plastic * math.log(p_c / CONSOLIDATED)
            volume /= 1 + COMPRESSION
        kirchhoff = p * math.exp(-volume)

        def slope(e):
            of_p, of_ratio = 1 / (3 - e), 2 * e / (SLOPE**2 + e**2)
            shrinking = (COMPRESSION * of_p + plastic * of_ratio) / (1 + COMPRESSION)
            return of_p - shrinking + of_ratio

    shear = eta * kirchhoff / (3 * SHEAR)
    if eta > first:
        shear += shear_by_flow((first, eta), slope, plastic)
    return volume / 3 + shear, p, eta * p, volume


def yields_at(kind):
    """eta = q/p at which clay begins to yield."""

    def beyond(eta):
        volume, p = clay_at(kind, eta, math.inf)[3], clay_at(kind, eta, math.inf)[1]
        return p * math.exp(-volume) * (1 + (eta / SLOPE) ** 2) - CONSOLIDATED

    return bisected(beyond, 0.0, SLOPE)


def bisected(function, low, high):
    """Where an increasing function vanishes."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if function(middle) > 0 else (middle, high)
    return 0.5 * (low + high)


def sand_at(axial):
    """(axial strain, p, q, volumetric strain) of sand at a logarithmic axial strain. All of it by stresses
    times J: q = A p + B on the cone, and the flow dilates by D times its shear."""
    bulk, shear = YOUNG / (3 - 6 * POISSON), YOUNG / (2 + 2 * POISSON)
    A = 6 * math.sin(FRICTION) / (3 - math.sin(FRICTION))
    B = 6 * COHESION * math.cos(FRICTION) / (3 - math.sin(FRICTION))
    D = 6 * math.sin(DILATANCY) / (3 - math.sin(DILATANCY))

    def pressure(q_of, flow):
        """p for a given shear by flow, with the radial pressure of the cell."""
        return bisected(lambda p: p - q_of(p) / 3 - CELL * math.exp(-p / bulk + D * flow), 0.0, 100 * CELL)

    at_rest = pressure(lambda p: 0.0, 0.0) / bulk / 3  # axial strain under the cell's pressure

    def elastic(q):
        p = pressure(lambda p: q, 0.0)
        return p / bulk / 3 + q / (3 * shear), p, q, p / bulk

    def flowing(flow):
        p = pressure(lambda p: A * p + B, flow)
        q, volume = A * p + B, p / bulk - D * flow
        return volume / 3 + q / (3 * shear) + flow, p, q, volume

    if axial <= at_rest:
        found = elastic(0.0)
    elif axial <= flowing(0.0)[0]:
        found = elastic(bisected(lambda q: elastic(q)[0] - axial, 0.0, 100 * CELL))
    else:
        found = flowing(bisected(lambda flow: flowing(flow)[0] - axial, 0.0, 1.0))
    J = math.exp(-found[3])
    return found[0], found[1] / J, found[2] / J, found[3]


def exact_at(kind, strains):
    """(axial strain, p, q, volumetric strain) at logarithmic axial strains, (n, 4)."""
    if kind == "sand":
        return np.array([sand_at(e) for e in strains])
    first, rows = yields_at(kind), []
    for e in strains:
        eta = bisected(lambda eta, e=e: clay_at(kind, eta, first)[0] - e, 0.0, SLOPE * (1 - 1e-13))
        rows.append((e, *clay_at(kind, eta, first)[1:]))  # beyond that eta the state is the critical one
    return np.array(rows)


# run ----------------------------------------------------------------------------------------------------
def path(kind, args, folder):
    """Curves of a test and of its closed form, the largest relative error, and the problem."""
    problem = compress(kind, args)
    rows = []
    with pm.Recorder(folder / f"{kind}.pvd", problem) as record:
        for step in problem.march(args.steps, adaptive=True, progress=False):
            rows.append(means(problem))
            if step.number % max(1, args.steps // 10) == 0:
                record(step)
    axial, p, q, volume, radial = np.array(rows).T
    exact = exact_at(kind, axial)
    found = {"axial strain": axial, "p": p, "q": q, "volumetric strain": volume}
    errors = [
        float(np.max(np.abs(values - exact[:, k])) / np.max(np.abs(exact[:, k])))
        for k, (name, values) in enumerate(found.items())
        if name in ("p", "q") or (name == "volumetric strain" and kind != "undrained")
    ]
    curve = {name: values.tolist() for name, values in found.items()}
    if kind == "undrained":  # the cell bears its pressure on the side, the plates that and q more
        curve["pore pressure"] = (CELL - radial).tolist()
        errors.append(float(np.max(np.abs(CELL - radial - (CELL + exact[:, 2] / 3 - exact[:, 1]))) / CELL))
    curve["exact"] = {name: exact[:, k].tolist() for k, name in enumerate(found)}
    curve["error"] = max(errors)
    return curve, problem


def main(argv=None):
    args = demo.scene_arguments(
        __doc__.splitlines()[0],
        output="triaxial",
        argv=argv,
        more={
            "--tests": {"nargs": "+", "choices": tuple(NAMES), "default": list(NAMES)},
            "--basis": {
                "choices": ("bspline", "mpm", "gimpm", "fem1", "fem2"),
                "default": "gimpm",
                "help": "weighting functions, or elements of degree 1 or 2",
            },
            "--cells": {"type": demo.count, "default": 2, "help": "along the radius"},
            "--steps": {"type": demo.count, "default": 200, "help": "number of load steps"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    curves = {}
    for kind in args.tests:
        curves[kind], problem = path(kind, args, folder)
    result = {"path": curves, "error": max(curve["error"] for curve in curves.values())}
    draw(curves, folder / "triaxial.png")
    parameters = {name: getattr(args, name) for name in ("tests", "basis", "cells", "steps")}
    return demo.report(args, "triaxial", problem, result, **parameters)


@styled()
def draw(curves, file):
    """q over the axial strain, over p, and the volumetric strain."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 3, figsize=plot.fitted(12, 4))
    if MPI.COMM_WORLD.rank == 0:
        scale = {"axial strain": 100, "p": 1e-3, "q": 1e-3, "volumetric strain": 100}
        names = {"axial strain": "axial strain (%)", "p": "p (kPa)", "q": "q (kPa)"}
        names["volumetric strain"] = "volumetric strain (%)"
        for ax, (x, y) in zip(
            axes, (("axial strain", "q"), ("p", "q"), ("axial strain", "volumetric strain")), strict=True
        ):
            for kind, curve in curves.items():
                a, b = (np.array(curve[name]) * scale[name] for name in (x, y))
                (line,) = ax.plot(a, b, ".", ms=3, label=NAMES[kind])
                a, b = (np.array(curve["exact"][name]) * scale[name] for name in (x, y))
                ax.plot(a, b, "-", lw=1, color=line.get_color())
            ax.plot([], [], "k-", lw=1, label="closed forms")
            ax.set_xlabel(names[x])
            ax.set_ylabel(names[y])
            finish_curves(ax)
            if ax is not axes[0]:
                ax.get_legend().remove()
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
