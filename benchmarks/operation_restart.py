"""Restart files that have been damaged, edited or belong to another problem, each loaded in a process of its
own: it has to be refused with a word on why, or to give the saved state."""

import random
import tempfile
from pathlib import Path

import numpy as np
from operation_cases import Case, forked
from operation_files import MATERIAL, YIELDING, mesh, state, strip

import polarmpm as pm

KINDS = {
    "points": lambda: strip(reset=None),
    "yielding": lambda: strip(material=YIELDING, reset=1),
    "elements": mesh,
}
STIFF = pm.MicropolarElastic.from_engineering(E=2e6, nu=0.3, n=0.3, l_b=0.1, l_t=0.1, psi=1.0)


def damages(content, rng, many):
    """Names and damaged contents of a file."""
    for k in range(many):
        damaged = bytearray(content)
        for _ in range(rng.choice([1, 1, 4, 16])):
            damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        yield f"flipped bits {k}", damaged
    for share in (0.999, 0.95, 0.7, 0.5, 0.2, 0.05, 0.0):
        yield f"cut to {share:g}", content[: int(len(content) * share)]
    yield "one byte less", content[:-1]
    yield "one byte more", content + b"\0"
    for k in range(max(1, many // 4)):
        damaged, start = bytearray(content), rng.randrange(len(content) - 4096)
        damaged[start : start + 4096] = bytes(4096)
        if damaged != content:
            yield f"zeroed block {k}", damaged
        damaged, start = bytearray(content), rng.randrange(len(content) - 64)
        damaged[start : start + 64] = rng.randbytes(64)
        yield f"random bytes {k}", damaged


def edits(rng):
    """Names and functions that edit an open file."""

    def put(name, value):
        def edit(file):
            file[name][...] = value

        return edit

    def drop(name):
        def edit(file):
            del file[name]

        return edit

    for name in ("points/x", "points/F", "points/q"):
        yield f"{name} is not a number", put(name, np.nan)
    for name in ("points/F", "points/x", "points/id"):
        yield f"{name} is missing", drop(name)
    yield "no load factor", lambda file: file.attrs.__delitem__("progress/factor")
    yield "another load factor", lambda file: file.attrs.__setitem__("progress/factor", rng.random())
    yield "materials that there aren't", put("points/material", 7)
    yield "all points of one id", put("points/id", 0)
    yield "other numbers of rows", put("counts/points/x", 3)


def unlike():
    """Names of problems that the state of `KINDS["points"]` doesn't fit, what makes them, and words one of
    which the message has to have."""
    yield "another modulus", lambda: strip(material=STIFF, reset=None), ("materials",)
    yield "plastic for elastic", lambda: strip(material=YIELDING, reset=None), ("materials", "plastic")
    yield "another seeding", lambda: strip(per_cell=3, reset=None), ("points", "seeding")
    yield "other cells", lambda: strip(cell=0.25, per_cell=1, reset=None), ("cell", "grid")
    yield "another basis", lambda: strip(basis="gimpm", reset=None), ("basis",)
    yield "elements for points", mesh, ("finite elements",)
    yield "a load that isn't given", unloaded, ("body load",)
    yield "points that are moved", moved, ("points", "seeding")


def unloaded():
    """The strip without its load."""
    problem = strip(reset=None)
    problem.release(problem.given.entries[-1].condition)
    problem.given.entries.pop()
    return problem


def moved():
    """The strip a little higher."""
    grid = pm.Grid.box((0, -2), (6, 3), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (4, 1)), material=MATERIAL, points_per_cell=2)
    points.X = points.X + np.array([0.0, 1e-3])
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=None)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0.0, -2e3))
    return problem


def loading(make, file, expected, words=()):
    """Verdict on a file that is loaded into a fresh problem."""

    def run():
        problem = make()
        before = state(problem)
        try:
            pm.load_restart(problem, file)
        except pm.PolarMPMError as e:
            text = str(e)
            if not np.array_equal(state(problem), before):
                return "silent", f"refused, but the problem isn't what it was: {text}"
            named = file.name in text and (not words or any(word in text for word in words))
            return ("clear" if named else "unclear"), text
        found = state(problem)
        same = expected is not None and found.shape == expected.shape and np.array_equal(found, expected)
        return ("right", "the saved state") if same else ("silent", "taken, but it isn't the saved state")

    return forked(run)


def cases(quick, seed):
    """Damages drawn at random, edits and problems that don't fit."""
    import h5py

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "state.h5")
        for kind, make in list(KINDS.items())[: 1 if quick else None]:
            problem = make()
            for _ in problem.march(4, to=0.5, progress=False):
                pass
            pm.save_restart(problem, file)
            content, expected = file.read_bytes(), state(problem)
            yield Case("restart", f"{kind}, whole", *loading(make, file, expected))
            rng = random.Random(f"{seed} {kind}")
            for name, damaged in damages(content, rng, 10 if quick else 40):
                file.write_bytes(damaged)
                yield Case("restart", f"{kind}, {name}", *loading(make, file, expected))
            for name, edit in edits(rng):
                file.write_bytes(content)
                with h5py.File(file, "r+") as opened:
                    edit(opened)
                yield Case("restart", f"{kind}, {name}", *loading(make, file, None))
            if kind == "points":
                file.write_bytes(content)
                for name, other, words in unlike():
                    yield Case("restart", name, *loading(other, file, None, words))
