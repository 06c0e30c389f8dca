"""How the curved cantilever's answer moves with resets, steps, cells, points and position, settings given.

Two errors make up the published agreement of material points: bending that locks, which stiffens, and resets
that let go what the new basis can't balance, which softens. The map shows both, method by method, against the
converged micropolar solution; then balanced splines with points at the Gauss positions of a mesh (recommended
before points integrated over their boxes) over positions in the grid, numbers of load steps and of points.
Each run has a process of its own. `--quick` leaves out the expensive ones. Default settings: `strangers.py`.
"""

import argparse
import itertools
import json
from pathlib import Path

import numpy as np
from mpm_versus_fem import LENGTH, REFERENCE, arch_mesh, demo, finite_elements

import polarmpm as pm
from polarmpm import study
from polarmpm.plot import styled

HERE = Path(__file__).parent
POSITIONS = [(-100.0, 0.0), (-99.5, 0.0), (-99.75, 0.25)]  # m, y of the centre of curvature, lowest z
RESETS = (1, 3, 5, 15, 30, 60)
WEIGHT = {"mpm": "MPM", "gimpm": "GIMPM", "bspline": "B-splines"}


# problems -----------------------------------------------------------------------------------------
def policy(steps, resets):
    """Reset policy with so many resets, the first grid included, in so many load steps; 0: when distorted."""
    if resets == 0:
        return pm.WhenDistorted()
    return None if resets == 1 else steps // resets


def uniform(basis, cell=1.0, number=4, centre=-100.0, bottom=0.0, steps=15, resets=15, balanced=False):
    """As published: points on the grid's own lattice, those outside the arch discarded."""
    arch = demo("curved_cantilever")
    grid = pm.Grid.box((0, -40, -8), (80, 40, 64), cell)
    body = arch.Arch(centre, bottom)
    points = pm.seed(grid, body, material=arch.MATERIAL, points_per_cell=number, cut=False)
    reset = policy(steps, resets)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=reset, balanced_reset=balanced)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    tip = points.farthest((1, -1, 0))
    problem.load(tip, force=(0, 0, arch.FORCE))
    return study.Case(problem, lambda: points.mean_displacement(tip))


def fitted(basis, cell=1.0, number=4, centre=-100.0, bottom=0.0, steps=15, resets=15, balanced=False):
    """Points at the Gauss positions, `number` a direction, of a mesh that fits the arch, with elements as
    large as the cells or the section.

    Load and displacement of the end face are extrapolated from the last two layers of points.
    """
    arch, side = demo("curved_cantilever"), min(cell, 1.0)
    along = round(LENGTH / side)
    mesh = arch_mesh(along, round(1 / side))
    mesh.geometry.x[:] += (0.0, centre + 100.0, bottom)
    grid = pm.Grid.box((0, -40, -8), (80, 40, 64), cell)
    points = pm.seed_mesh(grid, mesh, material=arch.MATERIAL, degree=2 * number - 1)
    reset = policy(steps, resets)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=reset, balanced_reset=balanced)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    layers, shares = end_layers(points, centre, along, number)
    for layer, share in zip(layers, shares, strict=True):
        problem.load(layer, force=(0, 0, share * arch.FORCE))

    def end():
        pairs = zip(layers, shares, strict=True)
        return sum(share * points.mean_displacement(layer) for layer, share in pairs)

    return study.Case(problem, end)


def end_layers(points, centre, along, number):
    """The last two layers of points, and the shares that extrapolate their means to the end face."""
    position = (1 + np.polynomial.legendre.leggauss(number)[0]) / 2  # in an element, from the end
    angle = np.pi / 4 - np.arctan2(points.X[:, 0], points.X[:, 1] - centre)
    at = angle / (np.pi / 4) * along
    edges = [-1.0, position[:2].mean(), position[1:3].mean() if number > 2 else 1.0]
    layers = [
        pm.Selection(np.sort(points.id[(low < at) & (at < high)])) for low, high in itertools.pairwise(edges)
    ]
    gap = position[1] - position[0]
    return layers, (position[1] / gap, -position[0] / gap)


# the map ------------------------------------------------------------------------------------------
def reset_discretisations(quick):
    """End displacement over the number of resets, let go and carried along."""
    discretisations = []
    kinds = [("uniform", "mpm"), ("uniform", "gimpm"), ("fitted", "bspline")]
    for (seeding, basis), balanced in [(k, b) for k in kinds for b in (False, True)]:
        method = f"{WEIGHT[basis]}, {'carried' if balanced else 'let go'}"
        for resets in (1, 5, 15) if quick else RESETS:
            steps = max(15, resets)
            arguments = {"basis": basis, "steps": steps, "resets": resets, "balanced": balanced}
            build = uniform if seeding == "uniform" else fitted
            discretisations.append(
                study.Discretisation(method, f"{resets} resets", 1.0, build, arguments, steps, adaptive=True)
            )
    return discretisations


def other_discretisations(quick):
    """Load steps without resets, cell sizes, points and positions."""
    discretisations = []

    def add(method, label, h, build, **arguments):
        steps = arguments.get("steps", 15)
        discretisations.append(study.Discretisation(method, label, h, build, arguments, steps, adaptive=True))

    for basis in ("mpm", "gimpm"):
        name = WEIGHT[basis]
        for steps in (30, 60):
            add(name, f"15 resets, {steps} steps", 1.0, uniform, basis=basis, steps=steps, resets=15)
        for cell in (2.0, 0.5)[: 1 if quick else 2]:
            add(name, f"cells of {cell:g} m", cell, uniform, basis=basis, cell=cell)
        for number in (3, 5, 6):
            add(name, f"{number}³ points a cell", 1.0, uniform, basis=basis, number=number)
        for centre, bottom in POSITIONS[1:]:
            label = f"centre y = {centre:g}, lowest z = {bottom:g} m"
            add(name, label, 1.0, uniform, basis=basis, centre=centre, bottom=bottom)
    for cell in (2.0, 0.5)[: 1 if quick else 2]:
        add(
            "B-splines, carried",
            f"cells of {cell:g} m",
            cell,
            fitted,
            basis="bspline",
            cell=cell,
            balanced=True,
        )
    for number in (2, 3, 4, 6):
        method = "B-splines, carried, points on the lattice"
        add(method, f"{number}³ points a cell", 1.0, uniform, basis="bspline", number=number, balanced=True)
    add("MPM, carried, fitted points", "15 resets", 1.0, fitted, basis="mpm", balanced=True)
    for degree, along in ((1, 64), (2, 32)):
        for steps in (15, 30, 60):
            method, arguments = f"FEM, degree {degree}", {"along": along, "across": 1, "degree": degree}
            label = f"{along} x 1 x 1, {steps} steps"
            discretisations.append(
                study.Discretisation(method, label, 1.0, finite_elements, arguments, steps, adaptive=True)
            )
    return discretisations


def recommended_discretisations(quick):
    """Splines and Gauss points, and the same with a reset after every step at the ends of the ranges."""
    discretisations = []
    for resets, method in ((0, "recommended"), (None, "reset every step")):
        for centre, bottom in POSITIONS:
            for steps in (15, 30, 60):
                for number in (3, 4, 5, 6):
                    if (quick and (steps, number) != (15, 4)) or (
                        resets is None and (steps == 30 or number in (4, 5))
                    ):
                        continue
                    arguments = {"number": number, "centre": centre, "bottom": bottom, "steps": steps}
                    arguments |= {"basis": "bspline", "resets": steps if resets is None else 0}
                    arguments |= {"balanced": True}
                    label = f"y = {centre:g}, z = {bottom:g} m, {steps} steps, {number}³ points"
                    discretisations.append(
                        study.Discretisation(method, label, 1.0, fitted, arguments, steps, adaptive=True)
                    )
    return discretisations


# results ------------------------------------------------------------------------------------------
def relative(row):
    """Error of each component (%)."""
    return 100 * (np.array(row.result) / np.array(REFERENCE) - 1) if row.result else np.full(3, np.nan)


def markdown(rows):
    lines = [
        "| method | setting | u_x | u_y | u_z (m) | error of each (%) | cuts | CPU (s) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        if r.failed_at is not None:
            lines.append(
                f"| {r.method} | {r.label} | no equilibrium at load factor {r.failed_at:.3g} | | | | | |"
            )
            continue
        u, e = (" | ".join(f"{v:.2f}" for v in r.result), ", ".join(f"{v:+.1f}" for v in relative(r)))
        lines.append(f"| {r.method} | {r.label} | {u} | {e} | {r.cuts} | {r.cpu_s:.1f} |")
    return "\n".join(lines) + "\n"


@styled()
def draw(resets, recommended, file):
    """Error of u_x over resets, and of all components with the recommended settings."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(11, 4.4))
    colours = {"MPM": "C0", "GIMPM": "C1", "B-splines": "C2"}
    for method in study.methods(resets):
        mine = [r for r in resets if r.method == method and r.result]
        name, kind = method.split(", ")
        style = {"ls": "-" if kind == "carried" else "--", "marker": "o", "color": colours[name]}
        axes[0].plot(
            [int(r.label.split()[0]) for r in mine], [relative(r)[0] for r in mine], label=method, **style
        )
    recommended = [r for r in recommended if r.method == "recommended"]
    for k, component in enumerate("xyz"):
        values = [relative(r)[k] for r in recommended]
        axes[1].plot(np.arange(len(values)), values, "o", label=f"$u_{component}$")
    axes[0].set(
        xscale="log", xlabel="number of resets", ylabel="error of $u_x$ (%)", xticks=RESETS, ylim=(-26, 25)
    )
    axes[0].set_xticklabels([str(n) for n in RESETS])
    axes[0].minorticks_off()
    axes[1].set(xlabel="run (3 positions; 15-60 steps; 3-6 points)", ylabel="error (%)", ylim=(-4, 4))
    axes[1].axhspan(-2, 2, color="0.92", zorder=0)
    axes[1].set_title("recommended settings, cells as large as the section")
    for axis in axes:
        axis.axhline(0, color="k", lw=0.6)
        axis.legend(loc="upper left" if axis is axes[0] else "upper right")
    plot.save(figure, file)


def main():
    groups = {
        "resets": reset_discretisations,
        "settings": other_discretisations,
        "recommended": recommended_discretisations,
    }
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer settings")
    parser.add_argument(
        "--only", choices=groups, help="one part; the figure takes the others from their files"
    )
    parser.add_argument("--redraw", action="store_true", help="the figure alone, from the files")
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()

    def show(row):
        print(markdown([row]).splitlines()[-1], flush=True)

    for name in [] if args.redraw else [args.only] if args.only else groups:
        rows = study.run(groups[name](args.quick), {"micropolar": REFERENCE}, record=show)
        study.write_csv(rows, args.output / f"trust_{name}.csv")
        study.write_text(args.output / f"trust_{name}.md", markdown(rows))
    files = {name: args.output / f"trust_{name}.csv" for name in ("resets", "recommended")}
    if all(file.exists() for file in files.values()):
        resets, recommended = (study.read_csv(file) for file in files.values())
        draw(resets, recommended, args.output / "trust.png")
        for method in study.methods(recommended):
            worst = np.nanmax([abs(relative(r)) for r in recommended if r.method == method], axis=0)
            print(json.dumps({f"{method}, largest error of each component (%)": worst.round(3).tolist()}))


if __name__ == "__main__":
    main()
