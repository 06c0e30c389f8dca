"""What sums over finite elements cost, by the points' kernels and by dolfinx, in one process.

Microseconds of CPU a quadrature point (the least of several calls, taken in turns) for residual and tangent,
and for the residual alone.

    python benchmarks/element_assembly.py            the ratios
    python benchmarks/element_assembly.py --run      the curved cantilever of phases.py, 15 steps, by phase
    python benchmarks/element_assembly.py --compile  seconds of a first step from an empty cache, in processes
                                                     of their own
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time

import numpy as np

import polarmpm as pm

POLAR = pm.MicropolarElastic(lam=3e3, mu=2e3, kappa=7e2, alpha=110.0, beta=130.0, gamma=170.0)
RUBBER = pm.NeoHookean(lam=3e3, mu=2e3)
CASES = {  # name: cell, cells, degree, material
    "3-D micropolar, 8 nodes": ("hexahedron", (64, 4, 4), 1, POLAR),
    "3-D micropolar, 27 nodes": ("hexahedron", (24, 2, 2), 2, POLAR),
    "3-D neo-Hookean, 8 nodes": ("hexahedron", (64, 4, 4), 1, RUBBER),
    "3-D neo-Hookean, 10 nodes": ("tetrahedron", (24, 2, 2), 2, RUBBER),
    "plane micropolar, 4 nodes": ("quadrilateral", (64, 32), 1, POLAR),
    "plane micropolar, 9 nodes": ("quadrilateral", (48, 24), 2, POLAR),
    "plane neo-Hookean, 6 nodes": ("triangle", (48, 24), 2, RUBBER),
}


def problem_of(case, assembly):
    """A bar that is held at an end and pulled aside at the other."""
    from mpi4py import MPI

    from dolfinx import mesh

    cell, cells, degree, material = CASES[case]
    corners = [np.zeros(len(cells)), np.array(cells, dtype=float) / cells[1]]
    make = mesh.create_rectangle if len(cells) == 2 else mesh.create_box
    body = pm.Elements(
        make(MPI.COMM_WORLD, corners, list(cells), getattr(mesh.CellType, cell)),
        material=material,
        degree=degree,
    )
    problem = pm.QuasiStaticFEM(body, assembly=assembly)
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    problem.load(body.farthest((1,) + (0,) * (len(cells) - 1)), force=(0.0, -1.0, 0.0)[: len(cells)])
    return problem


def seconds(function):
    begin = time.process_time()
    function()
    return time.process_time() - begin


def ratios(repeat, cases):
    print("| | points | tangent native (us) | dolfinx (us) | ratio | residual native | dolfinx | ratio |")
    print("|---|---|---|---|---|---|---|---|")
    for case in cases:
        systems = []
        for assembly in ("native", "dolfinx"):
            problem = problem_of(case, assembly)
            system = problem.system_at(1.0)
            x = np.random.default_rng(0).uniform(-1e-3, 1e-3, system.x.shape)
            system.x = system.before = x
            systems.append((problem, system))
        points = len(systems[0][0].points)
        row = []
        for tangent in (True, False):
            least = [np.inf, np.inf]
            for _ in range(repeat):
                for k, (_, system) in enumerate(systems):
                    taken = seconds(lambda system=system, tangent=tangent: system.assemble(tangent))
                    least[k] = min(least[k], taken)
            native, other = (1e6 * t / points for t in least)
            row += [f"{native:.2f}", f"{other:.2f}", f"{other / native:.1f}"]
        print(f"| {case} | {points} | {' | '.join(row)} |", flush=True)


def runs():
    from mpm_versus_fem import finite_elements

    elements = finite_elements(128, 2, 1).problem.elements
    for assembly in ("native", "dolfinx"):
        scene = finite_elements(128, 2, 1, assembly=assembly).problem
        scene.system_at(0.0)
        taken = seconds(lambda scene=scene: list(scene.march(15, progress=False)))
        phases = {name: round(value, 3) for name, value in scene.timer.seconds.items()}
        print(f"{assembly}: {taken:.2f} s, {len(elements.points)} points, {phases}", flush=True)


def first_step(case, assembly):
    begin = time.perf_counter()
    problem = problem_of(case, assembly)
    next(iter(problem.march(1, progress=False)))
    print(f"{time.perf_counter() - begin:.1f}")


def compile_times(cases):
    print("| first step from an empty cache (s) | native | dolfinx |")
    print("|---|---|---|")
    for case in cases:
        found = []
        for assembly in ("native", "dolfinx"):
            with tempfile.TemporaryDirectory() as cache:
                command = [sys.executable, __file__, "--first-step", case, assembly]
                env = {**os.environ, "POLARMPM_CACHE": cache}
                found.append(subprocess.check_output(command, env=env, text=True).strip())
        print(f"| {case} | {' | '.join(found)} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--run", action="store_true")
    parser.add_argument("--first-step", nargs=2, metavar=("CASE", "ASSEMBLY"))
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    options = parser.parse_args()
    if options.first_step:
        first_step(*options.first_step)
    elif options.run:
        runs()
    elif options.compile:
        compile_times(options.cases)
    else:
        ratios(options.repeat, options.cases)
