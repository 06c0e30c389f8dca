"""What the cure of locking is held to: bars, what is found, and whether it holds; a table and a JSON file.

    python benchmarks/locking.py [--only cook resets thin coupled space footing dilatant20 dilatant30
                                  micropolar costs]
                                 [--json FILE]

Scenes without a known limit are compared with fine cured elements of degree 2.
"""

import argparse
import json
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path

from mpi4py import MPI

import locking_table as scenes
import numpy as np
from dolfinx import mesh as dmesh
from scenes import demo

import polarmpm as pm

BASES = ("mpm", "gimpm", "bspline")
RESULTS = Path(__file__).parent / "results" / "locking.json"
ELEMENTS = {2: dmesh.CellType.quadrilateral, 3: dmesh.CellType.hexahedron}


def bar(name, found, low, high):
    return {"bar": name, "found": float(found), "low": low, "high": high, "holds": bool(low <= found <= high)}


def coupled(ratio, cell=0.25, nu=0.3):
    """Micropolar, bending length a tenth of a cell of 1/4 m, kappa = ratio mu."""
    mu = scenes.YOUNG / (2 * (1 + nu))
    lam = 2 * mu * nu / (1 - 2 * nu)
    return pm.MicropolarElastic.bounded_stiffness(lam=lam, mu=mu, kappa=ratio * mu, l_b=0.1 * cell)


def beam(size, material, basis=None, cell=None, cells=None, degree=2, lift=0.0):
    """Work of a small load at the end of a cantilever."""
    dim, size = len(size), np.array(size)
    low = np.array((0.0, *(lift,) * (dim - 1)))
    if basis is None:
        made = dmesh.create_rectangle if dim == 2 else dmesh.create_box
        body = made(MPI.COMM_WORLD, [low, low + size], cells, ELEMENTS[dim])
        problem = pm.QuasiStaticFEM(pm.Elements(body, material=material, degree=degree), locking="always")
    else:
        around = np.array((0.0, *(2 * cell,) * (dim - 1)))
        last = np.ceil((low + size + 2 * cell) / cell) * cell
        grid = pm.Grid.box(tuple(-around), tuple(last), cell)
        points = pm.seed(
            grid, bounds=(low, low + size), material=material, points_per_cell=4 if dim == 2 else 3
        )
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking="always")
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    problem.body_load(force=(0.0, 1e-6 * scenes.YOUNG, 0.0)[:dim])
    list(problem.march(1, progress=False))
    return problem.energies()["external"]


def cook_bars():
    rows = []
    for basis, within in (("mpm", 0.03), ("gimpm", 0.03), ("bspline", 0.015)):
        u, iterations = scenes.cook(basis, 0.4999, 3.0, "auto")
        rows.append(bar(f"Cook, 0.4999, {basis}: u / 6.92", u / 6.92, 1 - within, 1 + within))
        rows.append(bar(f"Cook, 0.4999, {basis}: iterations a step", iterations / 10, 0, 3.5))
    return rows


def reset_bars():
    """After 40 balanced resets, on cells of 6 m."""
    rows = []
    for basis, within in (("mpm", 0.01), ("bspline", 0.025)):
        tips = [scenes.cook(basis, 0.4999, 6.0, "auto", reset=r, steps=40)[0] for r in (1, None)]
        rows.append(bar(f"40 resets, {basis}: over never reset", tips[0] / tips[1], 1 - within, 1 + within))
    return rows


def thin_bars():
    """A strip of 4 x 1 m one, two and four cells across, aligned and off the planes."""
    rows = []
    for nu in (0.3, 0.4999):
        material = pm.NeoHookean.from_engineering(E=scenes.YOUNG, nu=nu)
        reference = beam((4.0, 1.0), material, cells=(96, 24))
        for across in (1, 2, 4):
            for basis in ("mpm", "bspline"):
                low, high = (0.85, 1.2) if across == 1 else (0.9, 1.1) if across == 2 else (0.97, 1.03)
                for lift in (0.0, 0.3):
                    work = beam((4.0, 1.0), material, basis, 1 / across, lift=lift / across)
                    name = f"strip, nu {nu}, {across} across, off by {lift}, {basis}"
                    rows.append(bar(name, work / reference, low, high))
    return rows


def coupled_bars():
    """A strip four cells across of large kappa / mu, by points and by elements of degree 1."""
    rows = []
    for ratio in (1.0, 1e3, 1e6):
        material = coupled(ratio)
        reference = beam((4.0, 1.0), material, cells=(64, 16))
        for basis in BASES:
            work = beam((4.0, 1.0), material, basis, 0.25, lift=0.075)
            rows.append(bar(f"kappa/mu {ratio:g}, {basis}", work / reference, 0.95, 1.05))
        work = beam((4.0, 1.0), material, cells=(16, 4), degree=1)
        rows.append(bar(f"kappa/mu {ratio:g}, elements of degree 1", work / reference, 0.95, 1.05))
    return rows


def space_bars():
    """A beam of 4 x 1 x 1 m two cells across, nearly incompressible and of large kappa."""
    rows = []
    near = pm.NeoHookean.from_engineering(E=scenes.YOUNG, nu=0.4999)
    for name, material in (("0.4999", near), ("kappa/mu 1e3", coupled(1e3))):
        reference = beam((4.0, 1.0, 1.0), material, cells=(16, 4, 4))
        for basis in BASES:
            work = beam((4.0, 1.0, 1.0), material, basis, 0.5, lift=0.15)
            rows.append(bar(f"beam in space, {name}, {basis}", work / reference, 0.9, 1.1))
        for degree in (1, 2):
            work = beam((4.0, 1.0, 1.0), material, cells=(8, 2, 2), degree=degree)
            rows.append(bar(f"beam in space, {name}, degree {degree}", work / reference, 0.9, 1.1))
    return rows


def footing_bars():
    rows = []
    for cells, within in ((4, 0.06), (8, 0.03)):
        for basis in ("mpm", "bspline"):
            load, rise = scenes.footing(basis, cells, "auto")
            limit = 2 + np.pi
            rows.append(
                bar(f"footing, {cells} cells, {basis}: over 2 + pi", load / limit, 1 - within, 1 + within)
            )
            rows.append(bar(f"footing, {cells} cells, {basis}: rise", rise, -0.01, 0.01))
    return rows


def dilatant_bars(degrees, size, settlement):
    """Loads at full settlement over Prandtl's limit on soil whose volume grows as it shears (psi = phi), 8
    cells in half the width. The ground is as wide as the slip lines need."""
    rows, phi = [], np.radians(degrees)
    limit = (np.tan(np.pi / 4 + phi / 2) ** 2 * np.exp(np.pi * np.tan(phi)) - 1) / np.tan(phi)
    for name in (*BASES, "fem1", "fem2"):
        scene = demo("strip_footing")
        (scene.LENGTH, scene.DEPTH), scene.SETTLEMENT = size, settlement
        elastic = pm.Hencky.from_engineering(E=scene.YOUNG, nu=scene.POISSON)
        soil = pm.MohrCoulomb(elastic, phi=phi, psi=phi, c=scene.STRENGTH, edges="sharp")
        scene.soil = lambda soil=soil: soil
        options = argparse.Namespace(cells=8, points_per_cell=2, steps=20, locking="cured", grid="equal")
        with tempfile.TemporaryDirectory() as folder:
            _, loads, _ = scene.solve(name, options, Path(folder))
        rows.append(bar(f"footing, psi = phi = {degrees}, {name}: over N_c", loads[-1] / limit, 0.95, 1.05))
    return rows


def micropolar_bars():
    """Over the classical footing, 4 cells: it tends to that with l, and grows with l."""
    rows = []
    for basis in ("mpm", "bspline"):
        classical = scenes.footing(basis, 4, "auto")[0]
        before = 0.0
        for length in (0.005, 0.02, 0.1, 0.3):
            load, rise = scenes.footing(basis, 4, "auto", length)
            high = 1.03 if length <= 0.02 else np.inf
            name = f"micropolar footing, {basis}, l = {length} b"
            rows.append(bar(f"{name}: over the classical one", load / classical, max(0.97, before), high))
            rows.append(bar(f"{name}: rise", rise, -0.01, 0.01 if length <= 0.02 else np.inf))
            before = load / classical
    return rows


def ratio(*problems):
    """CPU seconds of an iteration with its tangent and solution, the first problem's over the second's; the
    least of several, that take turns."""
    found = []
    for _ in range(30):
        for system in (problem.system_at(0.1) for problem in problems):
            before = time.process_time()
            system.evaluate(True)
            system.update(True)
            found.append(time.process_time() - before)
            system.x = np.zeros_like(system.x)
            system.before = system.x
    return min(found[::2]) / min(found[1::2])


def block(dim, basis, material, locking, cells):
    """A cube or square that is pulled at its upper face."""
    if basis in BASES:
        grid = pm.Grid.box((0,) * dim, (1,) * dim, 1 / cells)
        points = pm.seed(grid, material=material, points_per_cell=3 if dim == 2 else 2)
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking, boxes=False)
    else:
        made = dmesh.create_rectangle if dim == 2 else dmesh.create_box
        body = made(MPI.COMM_WORLD, [np.zeros(dim), np.ones(dim)], (cells,) * dim, ELEMENTS[dim])
        elements = pm.Elements(body, material=material, degree=int(basis[-1]))
        problem = pm.QuasiStaticFEM(elements, locking=locking)
    problem.fix(pm.plane(y=0.0), u=0)
    problem.body_load(force=(0.0, 1.0, 0.0)[:dim])
    return problem


def cost_bars():
    """CPU time of an iteration, cured over not cured; and of scenes that need no cure, "auto" over None."""
    rows, near, far = [], *(pm.NeoHookean.from_engineering(E=1e3, nu=nu) for nu in (0.4999, 0.3))
    limits = {
        "mpm": (1.4, 2.0),
        "gimpm": (2.5, 2.5),
        "bspline": (1.4, 2.5),
        "fem1": (1.4, 2.0),
        "fem2": (1.4, 2.0),
    }
    for dim, cells in ((2, 48), (3, 8)):
        for basis, high in limits.items():
            number = cells // 2 if basis == "fem2" else cells
            for name, material, one, most in (
                ("cured over not cured", near, "always", high[dim - 2]),
                ("auto over None, nothing to cure", far, "auto", 1.02),
            ):
                found = ratio(*(block(dim, basis, material, locking, number) for locking in (one, None)))
                rows.append(bar(f"cost, {dim}-D, {basis}: {name}", found, 0.0, most))
    return rows


GROUPS = {
    "cook": cook_bars,
    "resets": reset_bars,
    "thin": thin_bars,
    "coupled": coupled_bars,
    "space": space_bars,
    "footing": footing_bars,
    "dilatant20": partial(dilatant_bars, 20, (7.0, 3.5), 0.02),
    "dilatant30": partial(dilatant_bars, 30, (11.0, 5.0), 0.04),
    "micropolar": micropolar_bars,
    "costs": cost_bars,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--json", type=Path, default=RESULTS, help="groups are put in beside others")
    args = parser.parse_args()
    warnings.simplefilter("ignore", pm.TrustWarning)
    for group in args.only:
        rows = GROUPS[group]()
        if MPI.COMM_WORLD.rank == 0:
            for row in rows:
                print(
                    f"{row['bar']:55} {row['found']:.4f} {'holds' if row['holds'] else 'FAILS'}", flush=True
                )
            known = json.loads(args.json.read_text()) if args.json.exists() else {}
            args.json.write_text(json.dumps(known | {group: rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
