"""`python -m polarmpm`: versions, the cache of compiled code, a check of the installation, the demos."""

from __future__ import annotations

import argparse
import os
import runpy
import shutil
import site
import sys
import sysconfig
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

# of a clone or an unpacked source distribution; else what a wheel has installed, or `pip install --user`
DEMOS = (
    Path(__file__).resolve().parents[2] / "demos",
    *(
        Path(base or "") / "share" / "polarmpm" / "demos"
        for base in (sysconfig.get_path("data"), site.USER_BASE)
    ),
)
USED = (
    "dolfinx",
    "ufl",
    "basix",
    "petsc4py",
    "mpi4py",
    "numpy",
    "scipy",
    "h5py",
    "meshio",
    "matplotlib",
    "gmsh",
)


def versions() -> int:
    """What is installed, a line each."""
    import polarmpm as pm

    print(f"polarmpm {pm.__version__}, {Path(pm.__file__).parent}")
    print(f"Python {sys.version.split()[0]}, {sys.executable}")
    for name in USED:
        try:
            print(f"{name} {getattr(import_module(name), '__version__', '(no version)')}")
        except (ImportError, OSError) as error:
            print(f"{name}: not found ({error})")
    return 0


def show_cache(clear: bool) -> int:
    """Where compiled code is kept, and how much of it; `clear` removes it."""
    from .tools import cache

    folder = cache.directory()
    files = [path for path in folder.rglob("*") if path.is_file()] if folder.is_dir() else []
    print(f"{folder}: {len(files)} files, {sum(path.stat().st_size for path in files) / 1e6:.1f} MB")
    if clear and folder.is_dir():
        for path in folder.iterdir():
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        print("removed")
    return 0


def check() -> int:
    """A bar in tension against the closed form: 0 if all works."""
    import numpy as np

    import polarmpm as pm

    begin = time.perf_counter()
    grid = pm.Grid.box((0, 0), (4, 1), cell=0.5)
    rubber = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)
    points = pm.seed(grid, bounds=((0, 0), (3, 1)), material=rubber)
    problem = pm.QuasiStatic(grid, points)
    problem.symmetry(pm.plane(x=0.0))
    problem.symmetry(pm.plane(y=0.0))
    problem.traction(pm.Surface.line((3, 0), (3, 1), 16), force=(1e3, 0))
    list(problem.march(1, progress=False))
    tip = points.farthest((1, 0))
    place = points.mean(points.X[:, 0], tip)
    end = points.mean_displacement(tip)[0] / place
    error = abs(end / (1e3 / 1e6 * (1 - 0.3**2)) - 1)
    passed = bool(np.isfinite(error) and error < 2e-3)  # strains of a thousandth
    print(f"stretch of a bar: {error:.1e} off; {time.perf_counter() - begin:.1f} s")
    print(
        "polarmpm works." if passed else "polarmpm gives a wrong answer: please report it with the versions."
    )
    return 0 if passed else 1


def demos(name: str | None, arguments: Sequence[str]) -> int:
    """List the demos, or run one with its own arguments."""
    folders = [folder for folder in DEMOS if any(folder.glob("*.py"))]
    if not folders:
        print(f"no demos in {', '.join(map(str, DEMOS))}: is polarmpm installed whole?", file=sys.stderr)
        return 1
    found = {path.stem: path for path in sorted(folders[0].glob("*.py"))}
    if name is None:
        for stem, path in found.items():
            print(f"{stem:24} {path.read_text().split(chr(10), 1)[0].strip(chr(34))}")
        return 0
    if name not in found:
        print(f"demo {name!r}: there are {', '.join(found)}", file=sys.stderr)
        return 2
    sys.argv = [str(found[name]), *arguments]
    sys.path.insert(0, str(folders[0]))
    runpy.run_path(str(found[name]), run_name="__main__")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m polarmpm", description=__doc__)
    parser.add_argument("--version", action="store_true", help="the same as version")
    commands = parser.add_subparsers(dest="command")
    commands.add_parser("version", help="what is installed (also without a command)")
    cached = commands.add_parser("cache", help="where compiled code is kept")
    cached.add_argument("--clear", action="store_true", help="remove it; it's compiled anew when it's needed")
    commands.add_parser("check", help="a computation of two seconds against a closed form")
    commands.add_parser("clear", help="the same as cache --clear")
    demo = commands.add_parser("demo", aliases=["demos"], help="list the demos, or run one", add_help=False)
    demo.add_argument("name", nargs="?")
    demo.add_argument("arguments", nargs=argparse.REMAINDER, help="of the demo")
    args = parser.parse_args(argv)
    if args.command == "cache":
        return show_cache(args.clear)
    if args.command == "clear":
        return show_cache(clear=True)
    if args.command == "check":
        return check()
    if args.command in ("demo", "demos"):
        return demos(args.name, args.arguments)
    return versions()


if __name__ == "__main__":
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:  # whoever reads has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 0
    sys.exit(status)
