"""A fixed list of scenes with known answers, to see that a change makes nothing worse.

    python benchmarks/nothing_worse.py [--only NAME ...] [--json FILE]
    python benchmarks/nothing_worse.py compare OLD.json NEW.json

Closed forms (thick cylinder, Hill, Kirsch, footing, bending, torsion of a round bar), converged solutions
(AMPLE's beam, Cook's membrane, biaxial compression, the published cantilever by elements of degree 2) and the
published problems B1 to B9 at coarse settings, against what the package found when this list was made. Value,
reference, error, iterations and CPU seconds of each; about three minutes.
"""

import argparse
import sys
from functools import partial

import numpy as np
import records
import scenes
from mpm_versus_fem import REFERENCE
from records import Run, add_to_json, record, report, run
from scenes import demo


def ample():
    """AMPLE's elastic beam: 24 set-ups, which all must finish, with cells of 0.25 m within 0.25 %."""
    rows, fine = [], run(scenes.beam_elements).value
    for cell in (0.5, 0.25):
        for word, reset in (("default resets", None), ("reset every step", 1)):
            for number in range(1, 7):
                made = run(partial(scenes.beam, cell, number, reset), 50)
                rows.append(record(f"{cell:g} m, {word}, {number} points", made, fine))
    return rows


def cook():
    """Cook's membrane, u_y of the corner (m)."""
    rows = []
    for nu, exact in ((0.3, 7.78), (0.4999, 6.92)):
        for cell in (6.0, 3.0, 1.5):
            for number in (2, 4):
                made = run(partial(scenes.cook, cell, number, nu))
                rows.append(record(f"nu = {nu:g}, {cell:g} m, {number} points", made, exact))
    return rows


def closed_forms():
    """Elastic closed forms at small loads."""
    rows = []
    for cell in (0.25, 0.125):
        for number in (2, 3, 4):
            made = run(partial(scenes.plate, cell, number), 1)
            rows.append(record(f"Kirsch, {cell:g} a, {number} points", made, error=made.value))
            made = run(partial(scenes.cylinder, cell, number), 1)
            rows.append(record(f"cylinder, {cell:g} a, {number} points", made, error=made.value))
    for word, stuff in (("classical", scenes.classical()), ("micropolar", scenes.micropolar(l_b=0.2))):
        mu = stuff.mu
        for number in (2, 3, 4):
            exact = scenes.shaft_stiffness(stuff, mu)
            made = run(partial(scenes.shaft, number, stuff), 1)
            rows.append(record(f"torsion, {word}, {number} points", made, exact))
        for angle in (0.0, 0.5):
            for number in (2, 4):
                made = run(partial(scenes.strip, 2.0, angle, number, material=stuff), 1)
                rows.append(record(f"bending, {word}, {angle:g} rad, {number} points", made, 1.0))
    return rows


def plastic():
    """Limit loads, and the sand column under compression."""
    rows = []
    for number in (2, 3, 4):
        for cell in (0.25, 0.125):
            made = run(partial(scenes.hill, cell, number))
            rows.append(record(f"Hill, {cell:g} a, {number} points", made, 1.0))
        for cells in (4, 8):
            made = run(partial(scenes.footing, cells, number))
            rows.append(record(f"footing N_c, {cells} cells, {number} points", made, 2 + np.pi))
    for number in (2, 3, 5):
        made = run(partial(scenes.biaxial, number), 50)
        for k, (word, exact) in enumerate((("peak", PEAK), ("residual", 808.0))):
            one = Run(**{**vars(made), "value": made.value and made.value[k]})
            rows.append(record(f"biaxial, {word} (kPa), {number} points", one, exact))
    return rows


PEAK = 890.9  # kPa, 5 points a direction on cells of 1.25 mm
# what the package found for the published problems at these coarse settings when the list was made
PUBLISHED = {
    "B2 a, tip (m)": (-3.3102161154, -6.7176886945),
    "B3, turns": 0.250961030418,
    "B4 mpm, tip (m)": (-23.5802847239, 14.2605707654, 52.1509428174),
    "B4 gimpm, tip (m)": (-23.1715223294, 14.1138248002, 52.1355427175),
    "B5, force at a quarter (N)": 546031.651204,
    "B6, force at the end (N)": 557985.115280,
    "B8, torque / a^3 (Pa)": 366055635.931,
    "B9, settlement (m)": 0.00500026551079,
}


def published():
    """B1 to B9, coarse; but for B1 and B4 the error is the change since this list was made."""
    rows = []
    for basis, number in (("mpm", 2), ("bspline", 3)):
        made = run(partial(manufactured, basis, number), 1)
        rows.append(record(f"B1, {basis}, error of displacement", made, error=made.value))
    made = run(fitted)
    rows.append(record("B4, splines, points of a mesh, tip (m)", made, REFERENCE))
    for name, (build, steps, options) in COARSE.items():
        made = run(build, steps, **options)
        rows.append(record(name, made, PUBLISHED[name]))
    return rows


def manufactured(basis, number):
    """B1 on 8^3 cells, relative to the amplitude."""
    module = demo("manufactured_solution")
    args = argparse.Namespace(points_per_cell=number, basis=basis)
    problem, exact = module.build(8, args)
    return problem, lambda: 30 * exact.errors(problem)["displacement"]


def fitted():
    """B4 by splines, with points at the Gauss positions of a mesh that fits."""
    from trust import fitted as build

    case = build("bspline", number=4, resets=0, balanced=True)
    return case.problem, case.result


def bent(case="a"):
    """B2: 10 x 1 m on cells of 0.5 m, GIMPM."""
    problem, tip = demo("cantilever_2d").build(
        case, argparse.Namespace(cell=0.5, points_per_cell=4, basis="gimpm")
    )
    return problem, lambda: problem.points.mean_displacement(tip)


def turned():
    """B3: turns of the end on cells of 0.5 m at a fifth of the moment."""
    module = demo("torsion")
    problem, tip = module.build(argparse.Namespace(cell=0.5, points_per_cell=2, basis="gimpm", moment=6.4e6))
    return problem, lambda: float(problem.points.mean(problem.points.rotation_vector[:, 0], tip) / 2 / np.pi)


def curved(basis):
    """B4 as published, cells of 1 m."""
    args = argparse.Namespace(cell=1.0, points_per_cell=4, basis=basis, centre=-100.0, bottom=0.0)
    problem, tip = demo("curved_cantilever").build(args)
    return problem, lambda: problem.points.mean_displacement(tip)


def sheared(model="micropolar", columns=1):
    """B5 and B6: the grid of 9 rows, GIMPM; force at the base."""
    args = argparse.Namespace(
        model=model, mode="mpm", zone=None, weakness=0.1, basis="gimpm", points_per_cell=4, ghost="thesis",
        regrid=None,
    )  # fmt: skip
    problem, base = demo("shear_layer").build(9, columns, 5e-3, args)
    return problem, lambda: float(-problem.reaction(base)[0][0])


def wire():
    """B8: the thinnest wire, four cells across, to a tenth of the twist."""
    args = argparse.Namespace(length=3.7e-6, cells=4, points_per_cell=2, basis="mpm", ghost=0.0)
    problem, top = demo("wire_torsion").build(12e-6, args)
    return problem, lambda: float(problem.reaction(top)[1][2] / 6e-6**3)


def collapse():
    """B9: 12 x 12 cells, under 30 % of the weight."""
    args = argparse.Namespace(points_per_cell=3, basis="gimpm", ghost=0.3)
    problem, corner = demo("column_collapse").build(12, args)
    return problem, lambda: float(np.linalg.norm(problem.points.mean_displacement(corner)))


COARSE = {
    "B2 a, tip (m)": (bent, 50, {}),
    "B3, turns": (turned, 10, {}),
    "B4 mpm, tip (m)": (lambda: curved("mpm"), 15, {}),
    "B4 gimpm, tip (m)": (lambda: curved("gimpm"), 15, {}),
    "B5, force at a quarter (N)": (lambda: sheared("classical", 5), 200, {"to": 0.25}),
    "B6, force at the end (N)": (sheared, 40, {}),
    "B8, torque / a^3 (Pa)": (wire, 10, {"to": 0.1}),
    "B9, settlement (m)": (collapse, 6, {"to": 0.3}),
}

GROUPS = {
    "AMPLE": ample,
    "Cook": cook,
    "closed forms": closed_forms,
    "plastic": plastic,
    "published": published,
}


def main(argv=None):
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["compare"]:
        return records.compare(*argv[1:3])
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=GROUPS, help="default: all")
    parser.add_argument("--json", metavar="FILE", help="put the results in, beside those of other groups")
    args = parser.parse_args(argv)
    for name in args.only or GROUPS:
        rows = GROUPS[name]()
        report(name, rows)
        add_to_json(args.json, name, rows)


if __name__ == "__main__":
    main()
