"""Curved cantilever by finite elements: an arch of 45 degrees bends out of its plane. SI units.

Thesis 3.5.4, paper 4.4: what `curved_cantilever.py` does with material points, on a mesh of the arch with
`--elements` N along it and N / 64, at least one, in either direction of the section. The force is spread
evenly over the end face, and its mean displacement is compared with the classical beam solution and the
published one of the same mesh.
"""

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

RADIUS, SIDE, ANGLE = 100.0, 1.0, np.pi / 4  # m, m, rad
FORCE = 600.0  # N
BEAM = np.array((-23.30, 13.64, 53.21))  # m, classical beam theory
PUBLISHED = {64: (-14.40, 8.52, 43.40), 128: (-20.04, 11.64, 50.05), 256: (-22.18, 12.83, 52.14)}  # m

MATERIAL = pm.MicropolarElastic(lam=0.0, mu=5e6, kappa=50505.1, alpha=0.0, gamma=12.5e3, beta=37.5e3)  # Pa, N


def arch(elements):
    """Hexahedra in the arch, whose centre of curvature lies at (0, -100)."""
    across = max(1, elements // 64)
    corners = [(0, RADIUS - SIDE / 2, 0), (ANGLE, RADIUS + SIDE / 2, SIDE)]  # angle, radius, z
    cells = (elements, across, across)
    body = mesh.create_box(MPI.COMM_WORLD, np.array(corners), cells, mesh.CellType.hexahedron)
    angle, radius, z = body.geometry.x.T.copy()
    body.geometry.x[:] = np.stack([radius * np.sin(angle), radius * np.cos(angle) - RADIUS, z], axis=1)
    return body


def build(args):
    """The problem, and the facets of the free end."""
    body = pm.Elements(arch(args.elements), material=MATERIAL, degree=args.degree)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    tip = body.farthest((1, -1, 0))
    problem.load(tip, force=(0, 0, FORCE))
    return problem, tip


def main(argv=None):
    args = demo.element_arguments(
        __doc__.splitlines()[0],
        output="curved_cantilever_fem",
        elements=64,
        degree=1,
        steps=15,
        argv=argv,
    )
    problem, tip = build(args)
    body = problem.elements
    folder = demo.output_folder(args, problem.comm)
    path = [np.zeros(3)]
    with (
        pm.Recorder(folder / "arch.pvd", problem, fields=("displacement", "rotation")) as record,
        pm.Table(folder / "arch.csv", tip=lambda: body.mean_displacement(tip)) as table,
    ):
        for step in problem.march(args.steps):
            record(step)
            table.record(step)
            path.append(body.mean_displacement(tip))
    draw(problem, np.array(path), folder / "arch.png")
    found = path[-1]
    result = {"displacement": found, "reference": BEAM, "error": float(np.linalg.norm(found - BEAM))}
    if args.degree == 1 and args.elements in PUBLISHED:
        result["published"] = np.array(PUBLISHED[args.elements])
    return demo.report(args, "curved_cantilever_fem", problem, result)


@styled()
def draw(problem, path, file):
    """The bent arch coloured by u_z, and the end's path with the beam solution."""
    from polarmpm.plot import figures as plot

    body = problem.elements
    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(11, 4.6), solid=[0])
    plot.plot_mesh(body, body.displacement[:, 2], axes[0], label="$u_z$ (m)", edges=False)
    force = np.linspace(0, FORCE, len(path))
    curves = {f"$u_{c}$": (path[:, i], force) for i, c in enumerate("xyz")}
    beam = {"classical beam": (BEAM, np.full(3, FORCE))}
    plot.load_displacement(curves, axes[1], reference=beam, xlabel="end displacement (m)", ylabel="force (N)")
    plot.save(figure, file, comm=problem.comm)


if __name__ == "__main__":
    main()
