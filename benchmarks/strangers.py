"""What somebody gets who takes every default: few points, bodies anywhere in the grid, thin and turned ones.

    python benchmarks/strangers.py [arch strips blocks column invariance measure tents] [--quick] [--json F]
    python benchmarks/strangers.py compare OLD.json NEW.json

- arch: the curved cantilever (P 4.4) and others at random positions in the grid, against the converged
  micropolar solution or finite elements of degree 2;
- strips: bending of strips 2 to 1/4 cells thick, along and across the grid, against beams;
- blocks: turned blocks and discs under a tiny load, of which each has a solution;
- column: the stress of a column that settles under its own weight (Coombs and Augarde 2020);
- invariance: the same scene moved by cells, turned by a right angle, mirrored, its points in another order,
  in other units: how far do displacements and stresses differ?
- measure: does the measure of trust warn of wrong answers, and only of them?
- tents: what is said of the trust in answers with mpm and gimpm, and how far off they are.

Runs under older versions of the package too, so that both columns of a comparison come from one script.
"""

import argparse
import sys
from functools import partial

import numpy as np
import records
import scenes
from mpm_versus_fem import REFERENCE
from records import Run, add_to_json, record, report, run
from scenes import YOUNG, Arch, Block, Disc
from scipy.spatial import cKDTree

import polarmpm as pm

SEED = 20240601  # of positions


# arch ---------------------------------------------------------------------------------------------
def positions(number):
    """y of the centre of curvature and lowest z (m), anywhere in the cells."""
    return -100 + np.random.default_rng(SEED).uniform(0, 2, (number, 2)) * (1, 0.5)


# radius, side, angle, force: of the size and shape of deflection of the published one
OTHERS = {
    "radius 50, side 1": (50.0, 1.0, np.pi / 4, 2400.0),
    "radius 60, side 2, 60 degrees": (60.0, 2.0, np.pi / 3, 15000.0),
    "radius 40, side 0.7, 0.7 rad": (40.0, 0.7, 0.7, 1100.0),
}


def arch(quick=False):
    """All defaults but the number of points, on cells as large as the section and twice as large."""
    rows = []

    def add(scene, reference, *arguments, **options):
        rows.append(record(scene, run(partial(scenes.arch, *arguments, **options)), reference))
        print(rows[-1]["scene"], rows[-1]["value"], rows[-1]["failure"], flush=True)

    places = positions(1 if quick else 20)
    count = {1.0: 20, 2.0: 6}  # positions
    for cell in (1.0, 2.0):
        for number in (2,) if quick else (None, 3, 4) if cell == 1 else (2, 3, 4, 6):
            for k, (centre, z) in enumerate(places[: count[cell]]):
                name = f"{cell:g} m, {number or 'default'} points, position {k + 1}"
                add(name, REFERENCE, Arch(centre, z), cell, number)
    for k, (centre, z) in enumerate(places[:2]):
        add(f"1 m, default points, end face, position {k + 1}", REFERENCE, Arch(centre, z), 1.0, surface=True)
        for degree in ("default",) if quick else ("default", 7):
            for surface in (False, True):
                name = f"1 m, mesh, degree {degree}, {'end face, ' * surface}position {k + 1}"
                add(name, REFERENCE, Arch(centre, z), 1.0, degree=degree, surface=surface)
    for name, (radius, side, angle, force) in {} if quick else OTHERS.items():
        centre, z = places[0] + (100 - radius // 1, 0)
        body = Arch(centre, z, radius, side, angle)
        fine = run(partial(scenes.arch_elements, body, 32, 2, force))
        for number in (2, 3):
            add(f"{name}, {number} points", fine.value, body, 1.0, number, force=force)
    return rows


# strips -------------------------------------------------------------------------------------------
ANGLES = {"aligned": 0.0, "0.5 rad": 0.5, "45 degrees": np.pi / 4}


def strips(quick=False, thicknesses=(2.0, 1.0, 0.5, 0.25), numbers=(1, 2, 3, 4)):
    """Deflection of strips on unit cells over that of a beam."""
    rows = []
    for thickness in thicknesses[1:2] if quick else thicknesses:
        for name, angle in ANGLES.items():
            for number in numbers[1:2] if quick else numbers:
                made = run(partial(scenes.strip, thickness, angle, number))
                rows.append(record(f"{thickness:g} thick, {name}, {number} points", made, 1.0))
    for thickness in () if quick else (1.0, 0.5):
        for name, angle in ANGLES.items():
            for number in (2, 3):
                stuff = scenes.micropolar(l_b=0.3 * thickness)
                made = run(partial(scenes.strip, thickness, angle, number, material=stuff))
                rows.append(record(f"{thickness:g} thick, {name}, {number} points, micropolar", made, 1.0))
    return rows


# blocks -------------------------------------------------------------------------------------------
MATERIALS = {
    "neo-Hookean": lambda E=YOUNG, lu=1.0: scenes.classical(0.3, E),
    "Hencky": lambda E=YOUNG, lu=1.0: pm.Hencky.from_engineering(E=E, nu=0.3),
    "micropolar, n = 0": lambda E=YOUNG, lu=1.0: scenes.micropolar(0.3, 0.0, 0.1 * lu, E),
    "micropolar, n = 0.5": lambda E=YOUNG, lu=1.0: scenes.micropolar(0.3, 0.5, 0.1 * lu, E),
}


def block(seed, material, number, shape="block", load=1e-4, dim=2):
    """A few cells of a body, turned by up to 0.8 rad, anywhere in the grid, held on its left; its weight."""
    r = np.random.default_rng(seed)
    size, angle, offset = (
        (r.uniform(3, 5), r.uniform(1.2, 2.5)),
        r.uniform(-0.8, 0.8),
        r.uniform(-0.5, 0.5, 2),
    )
    depth = r.uniform(0.8, 2.0)
    if shape == "disc":
        body = Disc(offset + 2.0, size[1], **({"low": 0.1, "high": 0.1 + depth} if dim == 3 else {}))
    else:
        low = offset if dim == 2 else (*offset, r.uniform(0, 1))
        body = Block(low, size if dim == 2 else (*size, depth), angle)
    lower, upper = ((-4.0, -5.0, -1.0)[:dim], (8.0, 8.0, 5.0)[:dim])
    grid = pm.Grid.box(lower, upper, 1.0, scenes.COMM)
    points = pm.seed(grid, body, material=material, points_per_cell=number)
    problem = pm.QuasiStatic(grid, points)
    held = np.ceil(points.X[:, 0].min()) + 0.55
    problem.fix(lambda x: x[:, 0] <= held, u=0, **({"theta": 0} if material.micropolar else {}))
    problem.body_load(force=(0, -load * YOUNG, 0)[:dim])
    return problem, lambda: float(np.abs(points.displacement).max())


def blocks(quick=False):
    """How many of so many blocks find no equilibrium."""
    rows = []

    def add(scene, count, *arguments, **options):
        made = [run(partial(block, k, *arguments, **options), 2) for k in range(count)]
        failed = sum(bool(m.failure) for m in made)
        total = Run(value=f"{failed} of {count}", iterations=sum(m.iterations for m in made))
        total.cpu_s, total.cuts = sum(m.cpu_s for m in made), sum(m.cuts for m in made)
        shares = [m.unresolved for m in made if m.unresolved is not None]
        total.unresolved = max(shares) if shares else None
        rows.append(record(scene, total, error=failed / count))
        print(scene, total.value, flush=True)

    for name, stuff in list(MATERIALS.items())[: 1 if quick else 3]:
        for number in (2,) if quick else (1, 2, 3, 4, 6):
            count = 4 if quick else 80 if name == "neo-Hookean" else 40
            add(f"blocks, {name}, {number} points", count, stuff(), number)
    for number in () if quick else (1, 2, 3):
        add(f"discs, neo-Hookean, {number} points", 40, MATERIALS["neo-Hookean"](), number, "disc")
        add(
            f"blocks, neo-Hookean, {number} points, 100 x the load",
            40,
            MATERIALS["neo-Hookean"](),
            number,
            load=1e-2,
        )
    for number in () if quick else (1, 2, 3):
        add(f"blocks in space, neo-Hookean, {number} points", 16, MATERIALS["neo-Hookean"](), number, dim=3)
        add(
            f"discs in space, neo-Hookean, {number} points",
            8,
            MATERIALS["neo-Hookean"](),
            number,
            "disc",
            dim=3,
        )
    add(
        "blocks in space, micropolar, n = 0, 2 points",
        2 if quick else 16,
        MATERIALS["micropolar, n = 0"](),
        2,
        dim=3,
    )
    return rows


# column -------------------------------------------------------------------------------------------
def column(quick=False):
    """Mean error of the vertical stress over the weight of the column."""
    rows = []
    bases = [b for b in ("bspline", "gimpm", "bspline-averaged") if scenes.has_basis(b)]
    for basis in bases:
        for number in (2,) if quick else (2, 3, 4):
            for cells in (8,) if quick else (8, 16, 32, 64, 128):
                made = run(partial(scenes.column, cells, number, basis))
                rows.append(record(f"{basis}, {number} points, {cells} cells", made, error=made.value))
    return rows


# invariance ---------------------------------------------------------------------------------------
def moves(dim):
    """x' = A x + b, and the units of length and stress, by name; or another order of the points."""
    turn, mirror, shift = np.eye(dim), np.eye(dim), np.array([7.0, -4.0, 2.0])[:dim]
    turn[:2, :2], mirror[0, 0] = [[0, -1], [1, 0]], -1
    none = np.zeros(dim)
    return {
        "shift by cells": {"move": (np.eye(dim), shift)},
        "right angle": {"move": (turn, none)},
        "mirror": {"move": (mirror, none)},
        "order of points": {"shuffle": True},
        "units": {"units": (1e-3, 1e-6)},
    }


def anywhere(seed, dim, move=None, shuffle=False, units=(1.0, 1.0), extra=()):
    """A random scene, moved; reads initial positions, displacements and stresses, moved back."""
    r = np.random.default_rng(1000 * dim + seed)
    A, b = move or (np.eye(dim), np.zeros(dim))
    lu, su = units
    name = list(MATERIALS)[r.integers(len(MATERIALS))]
    number = int(r.integers(2, 6)) if dim == 2 else int(r.integers(2, 4))
    size = np.array((r.uniform(2.5, 4.5), r.uniform(0.6, 2.2), r.uniform(0.8, 1.8)))[:dim]
    low, angle = r.uniform(-0.5, 0.5, dim), r.choice([0.0, r.uniform(-0.8, 0.8)])
    if r.random() < 0.3:
        body = Disc(
            low[:2] + 1.5,
            r.uniform(1.2, 2.0),
            **({"low": low[2], "high": low[2] + size[2]} if dim == 3 else {}),
        )
    else:
        body = Block(low, size, angle)
    force, reset = r.normal(size=dim), [None, 1][r.integers(2)]
    stuff = MATERIALS[name](YOUNG * su, lu)
    corners = np.array([(-4.0, -5.0, -3.0)[:dim], (8.0, 8.0, 5.0)[:dim]]) @ A.T + b

    def back(x):
        return (x / lu - b) @ A

    grid = pm.Grid.box(lu * corners.min(0), lu * corners.max(0), lu, scenes.COMM)
    points = pm.seed(grid, lambda x: body(back(x)), material=stuff, points_per_cell=number)
    if shuffle:
        order = np.random.default_rng(seed).permutation(len(points))
        points.replace({k: v[order] for k, v in points.arrays().items()})
    problem = pm.QuasiStatic(grid, points, **({} if reset is None else {"reset": reset}))
    held = np.ceil(back(points.X)[:, 0].min()) + 0.617
    problem.fix(lambda x: back(x)[:, 0] <= held, u=0, **({"theta": 0} if stuff.micropolar else {}))
    problem.body_load(force=tuple(1e-3 * YOUNG * su / lu * A @ force / np.linalg.norm(force)))

    def read():
        A3 = np.eye(3)
        A3[:dim, :dim] = A
        stress = A3.T @ (problem.fields("stress").stress / su) @ A3
        return back(points.X), points.displacement / lu @ A, stress

    return problem, read


def invariance(quick=False):
    """The worst relative change of displacements and stresses over random scenes."""
    rows = []
    for dim, count in ((2, 3 if quick else 40), (3, 0 if quick else 8)):
        plain = [run(partial(anywhere, k, dim), 2) for k in range(count)]
        for name, options in moves(dim).items() if count else ():
            worst, lost, made = np.zeros(2), 0, Run()
            for k in range(count):
                other = run(partial(anywhere, k, dim, **options), 2)
                made.iterations, made.cpu_s = made.iterations + other.iterations, made.cpu_s + other.cpu_s
                if plain[k].failure or other.failure:
                    lost += bool(plain[k].failure) != bool(other.failure)
                    continue
                (X, *first), (Y, *second) = plain[k].value, other.value
                at = cKDTree(Y).query(X)[1]
                change = [
                    np.abs(a - c[at]).max() / np.abs(a).max() for a, c in zip(first, second, strict=True)
                ]
                worst = np.maximum(worst, change)
            made.value = [float(worst[0]), float(worst[1])]
            where = "plane" if dim == 2 else "space"
            failed = sum(bool(p.failure) for p in plain)
            scene = f"{where}, {count} scenes, {name}"
            rows.append(record(scene, made, error=float(worst.max())))
            rows[-1] |= {"unsolved": failed, "solved_differently": lost}
            print(scene, made.value, "unsolved", failed, "differently", lost, flush=True)
    return rows


# measure ------------------------------------------------------------------------------------------
def wrong_and_right():
    """Names, builders, references and numbers of steps of runs of which about half should be wrong."""
    cases = []

    def add(name, build, reference, steps=None):
        cases.append((name, build, reference, steps))

    for thickness in (2.0, 1.0, 0.5, 0.25, 0.125):
        for word, angle in ANGLES.items():
            for number in (1, 2, 4)[: 3 if thickness > 0.2 else 2]:
                add(
                    f"strip {thickness:g}, {word}, {number} points",
                    partial(scenes.strip, thickness, angle, number),
                    1.0,
                )
    for thickness in (1.0, 0.5, 0.25):
        for number in (1, 2, 4):
            stuff = scenes.micropolar(l_b=0.3 * thickness)
            add(
                f"micropolar strip {thickness:g}, 0.5 rad, {number} points",
                partial(scenes.strip, thickness, 0.5, number, material=stuff),
                1.0,
            )
    for k, (centre, z) in enumerate(positions(2)):
        for cell, number in ((1.0, 1), (1.0, 2), (2.0, 1), (2.0, 2), (2.0, 3), (4.0, 1), (4.0, 2), (4.0, 3)):
            add(
                f"arch, {cell:g} m, {number} points, position {k + 1}",
                partial(scenes.arch, Arch(centre, z), cell, number),
                REFERENCE,
            )
    without_boxes(add)
    fine = run(scenes.beam_elements).value
    for cell in (0.5, 1.0, 2.0):
        for number in (1, 2, 3):
            add(f"AMPLE, {cell:g} m, {number} points", partial(scenes.beam, cell, number), fine, 50)
    for nu, exact in ((0.3, 7.78), (0.4999, 6.92)):
        for cell, number in ((3.0, 1), (3.0, 2), (3.0, 3), (12.0, 1), (12.0, 2)):
            name = f"Cook, nu = {nu:g}, {cell:g} m, {number} points"
            add(name, partial(scenes.cook, cell, number, nu), exact)
    for number in (1, 2, 3):
        add(f"cylinder, {number} points", partial(scenes.cylinder, 0.25, number), None)
        for cell in (0.25, 0.5):
            add(f"Hill, {cell:g} a, {number} points", partial(scenes.hill, cell, number), 1.0)
        for cells in (2, 4):
            name = f"footing, {cells} cells, {number} points"
            add(name, partial(scenes.footing, cells, number), 2 + np.pi)
        for cell in (2.5e-3, 5e-3):
            name = f"biaxial residual, {1e3 * cell:g} mm, {number} points"
            add(name, partial(biaxial_residual, number, cell), 808.0, 50)
        stuff = scenes.micropolar(l_b=0.2)
        exact = scenes.shaft_stiffness(stuff, stuff.mu)
        add(f"shaft, {number} points", partial(scenes.shaft, number, stuff), exact)
    return cases


def without_boxes(add):
    """Points that stand for themselves alone, and at Gauss positions."""
    for thickness in (2.0, 1.0, 0.5):
        for word, angle in ANGLES.items():
            for number in (2, 3, 4):
                name = f"strip {thickness:g}, {word}, {number} points without boxes"
                add(name, partial(scenes.strip, thickness, angle, number, boxes=False), 1.0)
            for number in (2, 4) if angle else (2,):
                name = f"strip {thickness:g}, {word}, {number} Gauss points"
                add(name, partial(scenes.strip, thickness, angle, number, layout="gauss"), 1.0)
    for k, (centre, z) in enumerate(positions(2)):
        for degree in (2, 5):
            build = partial(scenes.arch, Arch(centre, z), 1.0, degree=degree)
            add(f"arch, 1 m, mesh, degree {degree}, position {k + 1}", build, REFERENCE)


def biaxial_residual(number, cell):
    problem, read = scenes.biaxial(number, cell)
    return problem, lambda: read()[1]


def measure(quick=False):
    """Errors, the measure of trust, and whether there was a warning."""
    rows = []
    for name, build, reference, steps in wrong_and_right()[: 2 if quick else None]:
        made = run(build, steps)
        error = made.value if reference is None else None  # the value is the error itself
        rows.append(record(name, made, reference, error))
        print(name, records.percent(rows[-1]), rows[-1]["unresolved"], bool(made.warned), flush=True)
    verdict(rows)
    return rows


def verdict(rows):
    """Print how errors and warnings go together."""
    kinds = {
        "no answer": lambda r: bool(r["failure"]),
        "off by more than 10 %": lambda r: not r["failure"] and abs(r["error"]) > 0.1,
        "1 to 10 %": lambda r: not r["failure"] and 0.01 < abs(r["error"]) <= 0.1,
        "within 1 %": lambda r: not r["failure"] and abs(r["error"]) <= 0.01,
    }
    lines = []
    for name, test in kinds.items():
        mine = [r for r in rows if test(r)]
        shares = [r["unresolved"] for r in mine if r["unresolved"] is not None]
        span = f"{min(shares):.2g} to {max(shares):.2g}" if shares else ""
        lines.append([name, len(mine), sum(bool(r["warned"]) for r in mine), span])
    records.table(["answer", "runs", "warned", "unresolved"], lines)
    for r in rows:
        if not r["failure"] and ((abs(r["error"]) > 0.1) > bool(r["warned"])):
            print(f"- not warned of: {r['scene']}, {records.percent(r)} %, unresolved {digits_of(r)}")
        if not r["failure"] and abs(r["error"]) <= 0.01 and r["warned"]:
            print(f"- warned for nothing: {r['scene']}, {records.percent(r)} %, unresolved {digits_of(r)}")


def digits_of(row):
    return records.digits(row["unresolved"], 3) or "not known"


def tents(quick=False):
    """Errors of bodies by tents, elastic and plastic, and what the measure says."""
    cases, fine = [], run(scenes.beam_elements).value
    for thickness in (1.0,) if quick else (4.0, 2.0, 1.0, 0.5):
        for word, angle in ANGLES.items():
            cases.append((f"strip {thickness:g}, {word}", partial(scenes.strip, thickness, angle, 3), 1.0, 1))
    for cell in () if quick else (0.25, 0.5):
        cases.append((f"AMPLE, {cell:g} m", partial(scenes.beam, cell, 3), fine, 20))
    for cell in () if quick else (3.0, 12.0):
        cases.append((f"Cook, nu = 0.3, {cell:g} m", partial(scenes.cook, cell, 3, 0.3), 7.78, 4))
    for cell in () if quick else (0.5, 0.25, 0.125):
        cases.append((f"Hill, {cell:g} a", partial(scenes.hill, cell, 2), 1.0, None))
    for cells in () if quick else (2, 4, 8):
        cases.append((f"footing, {cells} cells", partial(scenes.footing, cells, 2), 2 + np.pi, None))
    return [
        record(f"{basis}, {name}: {found.value[1]}", Run(**{**vars(found), "value": found.value[0]}), exact)
        for basis in ("mpm", "gimpm")
        for name, build, exact, steps in cases
        for found in [run(partial(by_tents, build, basis), steps)]
    ]


def by_tents(build, basis):
    """A scene whose problem is made with a basis; reads its answer, and what is said of its trust."""
    make = scenes.pm.QuasiStatic
    scenes.pm.QuasiStatic = partial(make, basis=basis)
    try:
        problem, read = build()
    finally:
        scenes.pm.QuasiStatic = make
    return problem, lambda: (read(), problem.trust())


GROUPS = {
    "arch": arch,
    "strips": strips,
    "blocks": blocks,
    "column": column,
    "invariance": invariance,
    "measure": measure,
    "tents": tents,
}


def main(argv=None):
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["compare"]:
        return records.compare(*argv[1:3])
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("groups", nargs="*", choices=[*GROUPS, []], help="default: all")
    parser.add_argument("--quick", action="store_true", help="a few runs of each")
    parser.add_argument("--json", metavar="FILE", help="put the results in, beside those of other groups")
    args = parser.parse_args(argv)
    for name in args.groups or GROUPS:
        rows = GROUPS[name](args.quick)
        report(name, rows)
        add_to_json(args.json, name, rows)


if __name__ == "__main__":
    main()
