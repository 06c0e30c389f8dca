"""What the cure of locking is held to: bars, what is found, and whether it holds; the table of
docs/benchmarks.md and a JSON file.

    python benchmarks/locking.py [--only demos cook resets thin coupled space footing dilatant20 dilatant30
                                  micropolar turned costs]
                                 [--json FILE] [--demos FOLDER] [--redraw]

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
from pages import quote
from scenes import demo

import polarmpm as pm

BASES = ("mpm", "gimpm", "bspline")
KINDS = {
    "mpm": "`mpm`",
    "gimpm": "GIMPM",
    "bspline": "B-splines",
    "fem1": "FEM 1",
    "fem2": "FEM 2",
    "": "all",
}
HERE = Path(__file__).parent
RESULTS = HERE / "results" / "locking.json"
ELEMENTS = {2: dmesh.CellType.quadrilateral, 3: dmesh.CellType.hexahedron}


def bar(scene, kind, found, low, high):
    """`kind`: of the functions, see KINDS."""
    found, holds = float(found), bool(low <= found <= high)
    return {"scene": scene, "kind": kind, "found": found, "low": low, "high": high, "holds": holds}


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
        rows.append(bar("Cook, 16 cells, nothing reset: u / 6.92", basis, u / 6.92, 1 - within, 1 + within))
        rows.append(bar("iterations a step", basis, iterations / 10, 0, 3.5))
    return rows


def reset_bars():
    """After 40 balanced resets, on cells of 6 m."""
    rows = []
    for basis, within in (("mpm", 0.01), ("bspline", 0.025)):
        tips = [scenes.cook(basis, 0.4999, 6.0, "auto", reset=r, steps=40)[0] for r in (1, None)]
        rows.append(
            bar(
                "Cook, 8 cells, 40 balanced resets over none",
                basis,
                tips[0] / tips[1],
                1 - within,
                1 + within,
            )
        )
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
                    # constants of one patch can't tell bending from none
                    most = np.inf if (across, basis, lift) == (1, "mpm", 0.0) else high
                    work = beam((4.0, 1.0), material, basis, 1 / across, lift=lift / across)
                    name = f"strip, nu = {nu}, {across} across, {'off the planes' if lift else 'aligned'}"
                    rows.append(bar(name, basis, work / reference, low, most))
    return rows


def coupled_bars():
    """A strip four cells across of large kappa / mu, by points and by elements of degree 1."""
    rows = []
    for ratio in (1.0, 1e3, 1e6):
        material = coupled(ratio)
        reference = beam((4.0, 1.0), material, cells=(64, 16))
        for basis in BASES:
            work = beam((4.0, 1.0), material, basis, 0.25, lift=0.075)
            name = f"micropolar strip, 4 across, kappa/mu = {ratio:g}"
            rows.append(bar(name, basis, work / reference, 0.95, 1.05))
        work = beam((4.0, 1.0), material, cells=(16, 4), degree=1)
        rows.append(bar(name, "fem1", work / reference, 0.95, 1.05))
    return rows


def space_bars():
    """A beam of 4 x 1 x 1 m two cells across, nearly incompressible and of large kappa."""
    rows = []
    near = pm.NeoHookean.from_engineering(E=scenes.YOUNG, nu=0.4999)
    for name, material in (("nu = 0.4999", near), ("kappa/mu = 1000", coupled(1e3))):
        name = f"beam in space, 2 x 2 across, {name}"
        reference = beam((4.0, 1.0, 1.0), material, cells=(16, 4, 4))
        for basis in BASES:
            work = beam((4.0, 1.0, 1.0), material, basis, 0.5, lift=0.15)
            rows.append(bar(name, basis, work / reference, 0.9, 1.1))
        for degree in (1, 2):
            work = beam((4.0, 1.0, 1.0), material, cells=(8, 2, 2), degree=degree)
            rows.append(bar(name, f"fem{degree}", work / reference, 0.9, 1.1))
    return rows


def footing_bars():
    rows = []
    for cells, within in ((4, 0.06), (8, 0.03)):
        for basis in ("mpm", "bspline"):
            load, rise = scenes.footing(basis, cells, "auto")
            limit = 2 + np.pi
            name = f"footing, {cells} cells, 40 equal steps"
            rows.append(bar(f"{name}: over 2 + pi", basis, load / limit, 1 - within, 1 + within))
            rows.append(bar(f"{name}: rise", basis, rise, -0.01, 0.01))
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
        rows.append(
            bar(f"footing, psi = phi = {degrees}, 8 cells: over N_c", name, loads[-1] / limit, 0.95, 1.05)
        )
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
            name = f"micropolar footing, l = {length} b"
            low = max(0.97, before)
            rows.append(bar(f"{name}: over the classical one", basis, load / classical, low, high))
            rows.append(bar(f"{name}: rise", basis, rise, -0.01, 0.01 if length <= 0.02 else np.inf))
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
        given = {"reset": None, "boxes": False, "solver": "direct"}
        problem = pm.QuasiStatic(grid, points, basis=basis, locking=locking, **given)
    else:
        made = dmesh.create_rectangle if dim == 2 else dmesh.create_box
        body = made(MPI.COMM_WORLD, [np.zeros(dim), np.ones(dim)], (cells,) * dim, ELEMENTS[dim])
        elements = pm.Elements(body, material=material, degree=int(basis[-1]))
        problem = pm.QuasiStaticFEM(elements, locking=locking, solver="direct")
    problem.fix(pm.plane(y=0.0), u=0)
    problem.body_load(force=(0.0, 1.0, 0.0)[:dim])
    return problem


def dilatant_cost():
    """CPU time of the second half of a footing's settlement on soil that dilates as it shears, cured over
    not cured; least of two."""
    phi, found = np.radians(20), {"auto": [], None: []}
    elastic = pm.Hencky.from_engineering(E=scenes.YOUNG, nu=0.3)
    soil = pm.MohrCoulomb(elastic, phi=phi, psi=phi, c=1.0, edges="sharp")
    for locking in ("auto", None) * 2:
        grid = pm.Grid.box((0, 0), (7, 3.5), 0.25)
        points = pm.seed(grid, material=soil, points_per_cell=2)
        problem = pm.QuasiStatic(grid, points, basis="mpm", reset=None, locking=locking)
        for x in (0.0, 7.0):
            problem.fix(pm.plane(x=x), ux=0)
        problem.fix(pm.plane(y=0.0), u=0)
        problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > 3.5 - 1e-6), ux=0, uy=-0.02)
        # kernels of all regions of the yield surface are known then
        list(problem.march(5, to=0.25, adaptive=True, progress=False))
        before = time.process_time()
        list(problem.march(5, to=0.5, adaptive=True, progress=False))
        found[locking].append(time.process_time() - before)
    return min(found["auto"]) / min(found[None])


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
                ("nothing to cure, auto over None", far, "auto", 1.02),
            ):
                found = ratio(*(block(dim, basis, material, locking, number) for locking in (one, None)))
                rows.append(bar(f"CPU time of an iteration, {dim}-D: {name}", basis, found, 0.0, most))
    found = dilatant_cost()
    rows.append(bar("CPU time of a footing with psi = phi: cured over not cured", "mpm", found, 0.0, 1.05))
    return rows


def demo_results(folder):
    """JSON of the demos with their defaults: from files of a folder, or by running them."""
    found = {}
    for name in ("cooks_membrane", "strip_footing", "slope", "triaxial"):
        with tempfile.TemporaryDirectory() as own:
            file = Path(folder or own) / f"{name}.json"
            if not file.exists():
                demo(name).main(["--output", own, "--json", str(file)])
            found[name] = json.loads(file.read_text())["result"]
    return found


def demo_bars(folder=None):
    found, rows = demo_results(folder), []
    cook = found["cooks_membrane"]
    for cells, within in (("8", 0.05), ("16", 0.025)):
        for kind, tips in cook["tip"].items():
            tip = tips["0.4999"][cells] / 6.92
            rows.append(bar(f"Cook, {cells} cells: u / 6.92", kind, tip, 1 - within, 1 + within))
    for kind, iterations in cook["iterations"].items():
        rows.append(bar("Cook, 16 cells: iterations a step", kind, iterations["0.4999"]["16"] / 10, 0, 3.5))
    footing = found["strip_footing"]
    for kind, load in footing["bearing"].items():
        rows.append(bar("footing, 8 cells: over 2 + pi", kind, load / (2 + np.pi), 0.97, 1.03))
    for kind, rise in footing["rise"].items():
        rows.append(bar("footing, 8 cells: rise in the second half", kind, rise, -0.01, 0.01))
    for end, factor in zip(("stands", "fails"), found["slope"]["factor"], strict=True):
        rows.append(
            bar(
                f"slope, Griffiths and Lane: factor with which it {end}, over 1.4",
                "bspline",
                factor / 1.4,
                0.97,
                1.03,
            )
        )
    for kind, curve in found["triaxial"]["path"].items():
        rows.append(bar(f"triaxial, {kind}: off the closed form", "gimpm", curve["error"], 0.0, 0.01))
    return rows


def turned_bars():
    """The couple of a face whose microrotations are turned where nothing else moves, cells of twelve lengths,
    over that of fine cells: means over cells are exact, those of splines aren't."""
    layer, cell, rows = 4.0, 0.25, []
    material = pm.MicropolarElastic.bounded_stiffness(lam=600.0, mu=400.0, kappa=400.0, l_b=0.02)

    def couple(problem, width):
        problem.fix(lambda x: np.ones(len(x), bool), u=0)
        problem.fix(pm.plane(y=0.0), theta=0)
        face = problem.fix(pm.plane(y=layer), theta=0.01)
        list(problem.march(1, progress=False))
        return problem.reaction(face).couple[0] / width

    def of_elements(number, degree, locking):
        corners = [np.zeros(2), np.array((cell, layer))]
        body = dmesh.create_rectangle(MPI.COMM_WORLD, corners, (1, number), ELEMENTS[2])
        elements = pm.Elements(body, material=material, degree=degree)
        return couple(pm.QuasiStaticFEM(elements, locking=locking), cell)

    def of_points(basis, locking):
        grid = pm.Grid.box((0, 0), (2 * cell, layer), cell)
        points = pm.seed(grid, material=material, points_per_cell=4)
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking)
        return couple(problem, 2 * cell)

    fine = of_elements(400, 2, None)
    for locking, said, within in (("always", "averaged", 0.01), (None, "not averaged", np.inf)):
        for kind in KINDS:
            if kind:
                own = (
                    partial(of_elements, 16, int(kind[-1])) if kind not in BASES else partial(of_points, kind)
                )
                low, high = (1 - within, 1 + within) if kind != "bspline" else (0.0, np.inf)
                name = f"face that turns microrotations, relative rotation {said}: couple"
                rows.append(bar(name, kind, own(locking) / fine, max(low, 0.0), high))
    return rows


GROUPS = {
    "demos": demo_bars,
    "cook": cook_bars,
    "resets": reset_bars,
    "thin": thin_bars,
    "coupled": coupled_bars,
    "space": space_bars,
    "footing": footing_bars,
    "dilatant20": partial(dilatant_bars, 20, (7.0, 3.5), 0.02),
    "dilatant30": partial(dilatant_bars, 30, (11.0, 5.0), 0.04),
    "micropolar": micropolar_bars,
    "turned": turned_bars,
    "costs": cost_bars,
}


def allowed(row):
    """A row's bar, in words."""
    low, high = row["low"], row["high"]
    if high == np.inf:
        return "" if low <= 0.0 else f"> {low:.3g}"
    if low <= 0.0:
        return f"< {high:.3g}"
    if abs(low + high - 2) < 1e-9:
        return f"{100 * (high - 1):.3g} %"
    return f"{low:.3g} to {high:.3g}"


def table(known):
    """Rows by scene, columns by kind of functions; what doesn't hold is bold."""
    kinds = [kind for kind in KINDS if kind]
    lines = [
        "| scene | bar | " + " | ".join(KINDS[k] for k in kinds) + " | `--only` |",
        "|---" * (len(kinds) + 3) + "|",
    ]
    for group in GROUPS:
        by_scene = {}
        for row in known.get(group, ()):
            by_scene.setdefault(row["scene"], {})[row["kind"]] = row
        for scene, own in by_scene.items():
            bars = dict.fromkeys(allowed(row) for row in own.values())
            bars = "; ".join(b for b in bars if b)
            cells = []
            for kind in kinds:
                found = f"{own[kind]['found']:.3g}" if kind in own else ""
                if kind in own and 0.5 < own[kind]["found"] < 2:
                    found = f"{own[kind]['found']:.3f}"
                cells.append(found if kind not in own or own[kind]["holds"] else f"**{found}**")
            lines.append(f"| {scene} | {bars} | " + " | ".join(cells) + f" | {group} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--json", type=Path, default=RESULTS, help="groups are put in beside others")
    parser.add_argument("--demos", type=Path, metavar="FOLDER", help="with JSON files of the demos' defaults")
    parser.add_argument("--redraw", action="store_true", help="the table from the JSON file")
    args = parser.parse_args()
    warnings.simplefilter("ignore", pm.TrustWarning)
    known = json.loads(args.json.read_text()) if args.json.exists() else {}
    for group in () if args.redraw else args.only:
        rows = GROUPS[group](args.demos) if group == "demos" else GROUPS[group]()
        known[group] = rows
        if MPI.COMM_WORLD.rank == 0:
            for row in rows:
                name, holds = f"{row['scene']}, {row['kind']}", "holds" if row["holds"] else "FAILS"
                print(f"{name:75} {row['found']:.4f} {holds}", flush=True)
            args.json.write_text(json.dumps(known, indent=1) + "\n")
    if MPI.COMM_WORLD.rank == 0 and args.json == RESULTS:
        quote(HERE.parent / "docs" / "benchmarks.md", "locking", f"\n\n{table(known)}\n\n")


if __name__ == "__main__":
    main()
