"""Bodies with edges inside: supports on a part of a face, and layers whose limit cuts boxes; all defaults.

    python benchmarks/edges.py [supports layers] [--json F]

- supports: eight bodies held on half a metre beside which they go on, 4 to 16 cells long, in three places in
  the grid; by how much their largest mean displacement differs from that of elements of degree 2;
- layers: a cantilever of two layers whose limit lies amid boxes, by `assign` and by `join`.

Some minutes.
"""

import argparse
from functools import partial

import numpy as np
import scenes
from records import add_to_json, record, report, run
from scenes import COMM

import polarmpm as pm

SOFT = scenes.classical()
PLACES = ((0.13, 0.07), (0.0, 0.0), (0.04, 0.02))  # of a body's lower left corner (m)
WIDTH = 0.5  # of supports (m)
BODIES = {  # size, elements, supports (along its foot: 0, its left side: 1; where they begin), weight
    "beam on two, span 2.5": ((4.0, 0.5), (64, 8), ((0, 0.25), (0, 3.25)), (0, -50)),
    "beam on two, span 1": ((2.0, 0.5), (64, 16), ((0, 0.0), (0, 1.5)), (0, -50)),
    "block 2 x 1 on one": ((2.0, 1.0), (64, 32), ((0, 0.75),), (0, -50)),
    "block 2 x 1 on one, pushed": ((2.0, 1.0), (64, 32), ((0, 0.75),), (50, 0)),
    "cantilever held below its end": ((3.0, 0.5), (96, 16), ((0, 0.0),), (0, -20)),
    "cantilever held by half its end": ((3.0, 1.0), (96, 32), ((1, 0.25),), (0, -20)),
    "column 1 x 3 on half its foot": ((1.0, 3.0), (32, 96), ((0, 0.25),), (0, -20)),
    "strip held below its end, pulled": ((4.0, 0.5), (128, 16), ((0, 0.0),), (50, 0)),
}


def held(size, elements, supports, weight, cell=None, low=(0.0, 0.0)):
    """A body held on parts of its sides, on cells or, without their size, of elements."""
    if cell is None:
        body = scenes.rectangle_elements(size, elements, SOFT)
        problem = pm.QuasiStaticFEM(body)
    else:
        grid = pm.Grid.box((-1, -1), np.ceil(size) + 2, cell, COMM)
        points = pm.seed(grid, bounds=(low, np.add(low, size)), material=SOFT)
        problem = pm.QuasiStatic(grid, points)
    for side, begin in supports:
        along = np.eye(2)[side]
        a, b = begin * along, (begin + WIDTH) * along
        if cell is None:

            def there(x, side=side, begin=begin):
                on = np.abs(x[:, 1 - side]) < 1e-9
                return on & (x[:, side] > begin - 1e-9) & (x[:, side] < begin + WIDTH + 1e-9)

            problem.fix(body.surface(there), u=0)
        else:
            ends = (b, a) if side else (a, b)
            number = max(8, round(4 * WIDTH / cell))
            problem.fix(pm.Surface.line(*np.add(low, ends), number), u=0)
    problem.body_load(force=weight)
    return problem, problem.points.mean_displacement


def supports():
    rows = []
    for name, body in BODIES.items():
        fine = run(partial(held, *body)).value
        most = np.argmax(np.abs(fine))
        for cells in (4, 8, 12, 16):
            for low in PLACES:
                made = run(partial(held, *body, WIDTH / cells, low))
                made.value = made.value[most]
                rows.append(record(f"{name}, {cells} cells, corner at {low}", made, fine[most]))
    for cells in (4, 8, 12, 16):
        errors = [100 * r["error"] for r in rows if f", {cells} cells" in r["scene"]]
        print(f"{cells} cells: {max(errors):.1f} to {min(errors):.1f} %", flush=True)
    return rows


def layered(ratio, cell=None, joined=False, length=4.0, thickness=0.5, low=0.061):
    """A cantilever under its weight, its upper half so many times as stiff; mean deflection."""
    stiff, middle = scenes.classical(E=ratio * scenes.YOUNG), low + thickness / 2
    high = (length, low + thickness)
    if cell is None:
        mesh = scenes.rectangle_elements((length, thickness), (32, 4), SOFT).mesh
        mesh.geometry.x[:, 1] += low
        body = pm.Elements(mesh, material=SOFT, degree=2, comm=COMM)
        points, make = body.points, partial(pm.QuasiStaticFEM, body)
    else:
        grid = pm.Grid.box((0, -2), (6, 2), cell, COMM)
        points = pm.seed(grid, bounds=((0, low), (length, middle) if joined else high), material=SOFT)
        make = partial(pm.QuasiStatic, grid, points)
    if joined:
        points.join(pm.seed(grid, bounds=((0, middle), high), material=stiff))
    else:
        points.assign(points.where(lambda x: x[:, 1] > middle), stiff)
    problem = make()
    problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=(0, -300.0))
    return problem, lambda: float(problem.points.mean_displacement()[1])


def layers():
    rows = []
    for ratio in (10.0, 100.0):
        fine = run(partial(layered, ratio), 4).value
        for cell in (0.5, 0.25, 0.125):
            for word, joined in (("assigned", False), ("joined", True)):
                made = run(partial(layered, ratio, cell, joined), 4)
                rows.append(record(f"{ratio:g} : 1, {cell:g} m, {word}", made, fine))
    return rows


GROUPS = {"supports": supports, "layers": layers}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("groups", nargs="*", choices=[*GROUPS, []], help="default: all")
    parser.add_argument("--json", metavar="FILE", help="put the results in, beside those of other groups")
    args = parser.parse_args()
    for name in args.groups or GROUPS:
        rows = GROUPS[name]()
        report(name, rows)
        add_to_json(args.json, name, rows)


if __name__ == "__main__":
    main()
