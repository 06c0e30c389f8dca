"""Volumetric locking: a strip that bends and a layer under a footing in plane strain, over Poisson's ratio.

What is compared is the work of the body force on the displacements it causes, against that of finite elements
of degree 2 on a fine mesh. Loads are small.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from stress_cases import BASES, COMM, Record, Watch, block_points

import polarmpm as pm
from polarmpm.plot import styled

YOUNG = 1e6  # Pa
RATIOS = (0.0, 0.3, 0.45, 0.49, 0.499, 0.4999)
METHODS = (*BASES, "FEM 1", "FEM 2")
SCENES = {"strip": (4.0, 1.0), "footing": (2.0, 1.0)}  # m
CELLS = {"strip": 4, "footing": 8}  # in a metre
FINE = {"strip": 40, "footing": 40}


def material(nu, micropolar):
    if not micropolar:
        return pm.NeoHookean.from_engineering(E=YOUNG, nu=nu)
    return pm.MicropolarElastic.from_engineering(E=YOUNG, nu=nu, n=0.5, l_b=0.05, l_t=0.05, psi=1.0)


def force(scene):
    """The body force (N/m^3) as a function of the load factor and positions."""

    def strip(t, x):
        return np.stack([0 * x[:, 0], np.full(len(x), -t * 1e-6 * YOUNG)], axis=1)

    def footing(t, x):
        share = np.exp(-((x[:, 0] - 1.0) ** 2 + (x[:, 1] - 1.0) ** 2) / 0.25**2)
        return np.stack([0 * x[:, 0], -t * 1e-4 * YOUNG * share], axis=1)

    return strip if scene == "strip" else footing


def build(scene, method, stuff, cells, per_cell=4):
    """The problem; `cells` in a metre."""
    size = np.array(SCENES[scene])
    if method.startswith("FEM"):
        from dolfinx import mesh

        count = [round(s * cells) for s in size]
        made = mesh.create_rectangle(COMM, [[0, 0], size], count, mesh.CellType.quadrilateral)
        problem = pm.QuasiStaticFEM(pm.Elements(made, material=stuff, degree=int(method[-1])), locking=None)
    else:
        upper = size if scene == "footing" else size + 2.0
        grid = pm.Grid.box((0, 0) if scene == "footing" else (0, -1), upper, 1 / cells, COMM)
        corner = (0, 0.3 if scene == "strip" else 0)  # the strip's faces stand clear of the grid's planes
        points = block_points(corner, size * cells, (per_cell,) * 2, stuff, 1 / cells)
        problem = pm.QuasiStatic(grid, points, basis=method, reset=None, balanced_reset=False, locking=None)
    held = {"u": 0} | ({"theta": 0} if stuff.micropolar else {})
    if scene == "strip":
        problem.fix(pm.plane(x=0.0), **held)
    else:
        problem.fix(pm.plane(y=0.0), **held)
        for side in (0.0, size[0]):
            problem.fix(pm.plane(x=side), ux=0)
    problem.body_load(force=force(scene))
    return problem


def work(problem, scene):
    """The body force's work on the displacements (J/m)."""
    p = problem.points
    return float(np.sum(p.volume0[:, None] * force(scene)(1.0, p.X) * p.displacement))


@cache
def reference(scene, nu, micropolar, cells=None):
    problem = build(scene, "FEM 2", material(nu, micropolar), cells or FINE[scene])
    for _ in problem.march(1, progress=False):
        pass
    return work(problem, scene)


def locking(scene, method, nu, micropolar, cells=None, per_cell=4, tangents=True):
    """A record; its error is the share of the work that is missing. It has passed if it converges."""
    cells = cells or CELLS[scene]
    problem = build(scene, method, material(nu, micropolar), cells, per_cell)
    watch = Watch(problem, 1, tangents=tangents and "FEM" not in method)
    ratio = work(problem, scene) / reference(scene, nu, micropolar)
    kind = "micropolar" if micropolar else "classical"
    points = "" if "FEM" in method or per_cell == 4 else f", {per_cell}² points a cell"
    case = f"{scene}, {kind}, {method}, nu = {nu:g}, {cells} cells a metre{points}"
    measure = f"{ratio:.4f} of the reference's work"
    return watch.record("locking", case, error=1 - ratio, measure=measure)


def reference_error(scene, nu, micropolar):
    """How far the reference is from one on a mesh half as fine."""
    whole, half = (reference(scene, nu, micropolar, FINE[scene] // k) for k in (1, 2))
    kind = "micropolar" if micropolar else "classical"
    case = f"{scene}, {kind}, reference against half the elements, nu = {nu:g}"
    error = abs(half / whole - 1)
    return Record("locking", case, error < 0.01, error=error, measure="difference of the work")


@styled()
def draw(records, file: Path):
    """Work over Poisson's ratio, in a figure."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(10, 3.8), sharey=True)
    found = {r.case: 1 - r.error for r in records if r.group == "locking" and r.error is not None}
    names = {
        "mpm": "MPM",
        "gimpm": "GIMPM",
        "bspline": "B-splines",
        "FEM 1": "FEM, degree 1",
        "FEM 2": "FEM, degree 2",
    }
    styles = dict(zip(METHODS, ("o-", "s--", "^-", "x:", "d-"), strict=True))
    at = np.arange(len(RATIOS))
    for axis, scene in zip(axes, SCENES, strict=True):
        for k, method in enumerate(METHODS):
            for micropolar, kind in ((False, "classical"), (True, "micropolar")):
                values = [
                    found.get(f"{scene}, {kind}, {method}, nu = {nu:g}, {CELLS[scene]} cells a metre")
                    for nu in RATIOS
                ]
                if None in values:
                    continue
                label = names[method] if not micropolar else None
                axis.plot(
                    at,
                    values,
                    styles[method],
                    color=f"C{k}",
                    ms=4,
                    alpha=0.45 if micropolar else 1.0,
                    label=label,
                )
        axis.axhline(1.0, color="k", lw=0.6)
        axis.set(xticks=at, xticklabels=[f"{nu:g}" for nu in RATIOS], xlabel="Poisson's ratio", ylim=(0, 1.1))
        axis.set_title(f"{scene}, cells of 1/{CELLS[scene]} m")
    axes[0].set_ylabel("work over that of the reference")
    axes[0].legend(fontsize=8, loc="lower left", title="pale: micropolar")
    plot.save(figure, file)
