"""Redraws the figures of the pages: runs the demos, and benchmarks on the numbers that they have kept.

python docs/draw_all.py               # all figures; some of the demos take minutes, in all an hour or two
python docs/draw_all.py hertz waves   # some of them
python docs/draw_all.py --list
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES, KEPT = ROOT / "docs" / "images", ROOT / "benchmarks" / "results"

# by the figure's name: the script with its arguments, and what it calls the figure. {folder} is written to;
# {kept} has the numbers that benchmarks have kept
FIGURES: dict[str, tuple[str, str]] = {
    "architecture": ("docs/draw_architecture.py", ""),
    "cones": ("docs/draw_cones.py", ""),
    "generalised": ("docs/draw_generalised.py", ""),
    "curved_cantilever": ("demos/curved_cantilever.py --cell 1 --output {folder}", "arch"),
    "cantilever_2d": ("demos/cantilever_2d.py --output {folder}", "cantilever"),
    "torsion": ("demos/torsion.py --output {folder}", "shaft"),
    "manufactured_solution": (
        "demos/manufactured_solution.py --cell 0.03125 --output {folder}",
        "convergence",
    ),
    "shear_layer": ("demos/shear_layer.py --output {folder}", "shear_layer"),
    "shear_layer_classical": ("demos/shear_layer.py --model classical --output {folder}", "shear_layer"),
    "shear_layer_fixed_zone": (
        "demos/shear_layer.py --basis bspline --zone 0.0114 --weakness 0.02 --output {folder}",
        "shear_layer",
    ),
    "shear_layer_lengths": (
        "demos/shear_layer.py --basis bspline --zone 0.0114 --weakness 0.02 --grids 39x4 "
        "--length 2.5e-3 5e-3 10e-3 --output {folder}",
        "shear_layer",
    ),
    "wire_torsion": ("demos/wire_torsion.py --output {folder}", "wires"),
    "oriented_sheet": (
        "demos/oriented_sheet.py --sides 6000 3000 1200 600 --output {folder}",
        "oriented_sheet",
    ),
    **{
        name: (f"demos/{name}.py --output {{folder}}", name)
        for name in (
            *("biaxial", "column_collapse", "cooks_membrane", "excavation", "follower_cantilever", "hertz"),
            *("incline", "penetration", "size_effects", "slope", "strip_footing", "triaxial", "waves"),
        )
    },
    "trust": ("benchmarks/trust.py --redraw --output {kept}", "trust"),
    "iterative": ("benchmarks/iterative.py --redraw --output {kept}", "iterative"),
    "peer_kratos": ("benchmarks/peer_kratos.py --redraw", ""),
    **{
        f"mpm_versus_fem{end}": (
            "benchmarks/mpm_versus_fem.py --redraw --output {kept}",
            f"mpm_versus_fem{own}",
        )
        for end, own in (("", "_cpu_s"), ("_h", "_h"), ("_orders", "_orders"), ("_phases", "_phases"))
    },
    "stress_locking": ("benchmarks/stress.py --only locking --output {folder}", "stress_locking"),
}


def draw(name: str) -> bool:
    """Run what draws a figure, and put it in its place; whether that went well."""
    command, drawn = FIGURES[name]
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "results"
        if "{kept}" in command:
            shutil.copytree(KEPT, folder)
        script, *arguments = command.format(folder=folder, kept=folder).split()
        done = subprocess.run([sys.executable, str(ROOT / script), *arguments], cwd=ROOT, check=False)
        if done.returncode:
            print(f"{name}: {script} failed", file=sys.stderr)
            return False
        if drawn:
            shutil.copy(folder / f"{drawn}.png", IMAGES / f"{name}.png")
        (IMAGES / f"{name}.pdf").unlink(missing_ok=True)
    print(f"{name}: drawn", flush=True)
    return True


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="of figures; all of them by default")
    parser.add_argument("--list", action="store_true", help="the figures, and what draws them")
    args = parser.parse_args()
    if args.list:
        for name, (command, _) in FIGURES.items():
            print(f"{name:24} {command}")
        return 0
    unknown = sorted(set(args.names) - set(FIGURES))
    if unknown:
        print(f"{', '.join(unknown)}: there are {', '.join(FIGURES)}", file=sys.stderr)
        return 2
    drawn = [draw(name) for name in args.names or FIGURES]
    return 0 if all(drawn) else 1


if __name__ == "__main__":
    sys.exit(main())
