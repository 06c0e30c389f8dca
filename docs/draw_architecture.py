"""Draws docs/images/architecture.png: the folders of the package, and the way of one load step through them.

. scripts/env.sh && python docs/draw_architecture.py
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch, Rectangle

OUTPUT = Path(__file__).parent / "images" / "architecture.png"
ROW, COLUMN, NAMES = 0.46, 0.82, 3.25  # in: height of a folder, width of a step, width of the folders' boxes
STEP, ONCE, INK, FAINT = "#0b5394", "#b45f06", "#222222", "#8a8a8a"
LAYERS = {
    "tools": "#eceff1",
    "space": "#e3f2fd",
    "body": "#e8f5e9",
    "equations": "#fff8e1",
    "problem": "#fbe9e7",
    "use": "#f3e5f5",
}


class Room(NamedTuple):
    """A folder of src/polarmpm (`errors` is a module)."""

    name: str
    holds: str
    layer: str


ROOMS = (
    Room("errors", "what can go wrong, in words", "tools"),
    Room("tools", "versions, ranks, checks, timing", "tools"),
    Room("kernels", "UFL to machine code, loops in C", "tools"),
    Room("solvers", "Newton, load steps, linear solvers", "tools"),
    Room("geometry", "grid, nodes, planes, meshes", "space"),
    Room("kinematics", "strains, rotations, motion", "space"),
    Room("basis", "weighting functions", "space"),
    Room("materials", "energies, yield functions", "body"),
    Room("bodies", "material points, finite elements", "body"),
    Room("forms", "weak forms, return mapping", "equations"),
    Room("conditions", "supports, loads", "equations"),
    Room("terms", "ghost penalty, surfaces", "equations"),
    Room("assembly", "sums over points, sparse matrix", "equations"),
    Room("problems", "what a script talks to", "problem"),
    Room("io", "ParaView, tables, restart", "use"),
    Room("plot", "figures", "use"),
    Room("geotechnics", "factors of safety", "use"),
    Room("study", "error against time, demos", "use"),
)


class Stop(NamedTuple):
    """Where a path is in one of its steps."""

    mark: str
    room: str
    what: str


COMPILING = (
    Stop("a", "materials", "energy\nin UFL"),
    Stop("b", "forms", "residual,\ntangent"),
    Stop("c", "kernels", "C code,\ncompiled"),
)
LOAD_STEP = (
    Stop("1", "solvers", "load\nfactor"),
    Stop("2", "problems", "reset\nif due"),
    Stop("3", "basis", "weights\nof points"),
    Stop("4", "assembly", "node sets,\nsparsity"),
    Stop("5", "conditions", "loads,\nsupports"),
    Stop("6", "assembly", "sum over\npoints"),
    Stop("7", "kernels", "stresses,\nmoduli"),
    Stop("8", "terms", "forces,\nmatrices"),
    Stop("9", "solvers", "solve,\ncorrect"),
    Stop("10", "problems", "check,\ncommit"),
    Stop("11", "kinematics", "F, Q, Γ\nupdated"),
    Stop("12", "bodies", "points\nmoved"),
    Stop("13", "solvers", "reset\nnext?"),
    Stop("14", "io", "record"),
)
ITERATION = (5, 8)  # steps of LOAD_STEP that are repeated


def height(room: str) -> float:
    """Middle of a folder's row (in)."""
    return ROW * ([r.name for r in ROOMS].index(room) + 0.5)


def draw_rooms(ax: Axes, right: float) -> None:
    """Boxes stacked from the ground up, their rows, and the names of the layers."""
    for room in ROOMS:
        y, colour = height(room.name), LAYERS[room.layer]
        ax.add_patch(Rectangle((NAMES, y - ROW / 2), right - NAMES, ROW, color=colour, alpha=0.45, lw=0))
        style = "round,pad=0,rounding_size=0.05"
        shape = (0.0, y - ROW / 2 + 0.035), NAMES - 0.06, ROW - 0.07
        ax.add_patch(FancyBboxPatch(*shape, boxstyle=style, facecolor=colour, edgecolor="#b0b0b0", lw=0.7))
        ax.text(0.1, y, room.name, va="center", size=9.5, weight="bold", color=INK)
        ax.text(1.15, y, room.holds, va="center", size=8.2, color=INK)
    for layer in LAYERS:
        rows = [height(r.name) for r in ROOMS if r.layer == layer]
        low, high = min(rows) - ROW / 2, max(rows) + ROW / 2
        ax.plot([-0.08, -0.08], [low + 0.05, high - 0.05], color=FAINT, lw=1.2, solid_capstyle="butt")
        ax.text(-0.14, (low + high) / 2, layer, ha="right", va="center", size=9, color="#555555")
        ax.plot([0, right], [high, high], color="white", lw=1.5)


def draw_path(ax: Axes, stops: tuple[Stop, ...], first: float, colour: str, style: str = "-") -> list[float]:
    """Stops in the rows of their folders, from left to right; returns their places."""
    x = [first + COLUMN * k for k in range(len(stops))]
    y = [height(stop.room) for stop in stops]
    for k in range(len(stops) - 1):  # along the row to the next stop's column, then up or down to it
        ax.plot([x[k], x[k + 1], x[k + 1]], [y[k], y[k], y[k + 1]], color=colour, lw=1.3, ls=style, zorder=2)
    for stop, at, level in zip(stops, x, y, strict=True):
        ax.plot(at, level, "o", ms=14, color=colour, zorder=3, mec="white", mew=0.8)
        mark = {"ha": "center", "va": "center", "size": 8, "weight": "bold", "color": "white", "zorder": 4}
        ax.text(at, level - 0.005, stop.mark, **mark)
        lines = stop.what.split("\n")
        for line, shift, side in zip(lines, (0.03, -0.04), ("bottom", "top"), strict=False):
            ax.text(at + 0.12, level + shift, line, va=side, size=8.5, color=colour, zorder=4)
    return x


def draw_iteration(ax: Axes, x: list[float]) -> None:
    """A frame around the steps that Newton's method repeats."""
    left, right = x[ITERATION[0]] - 0.13, x[ITERATION[1]] + COLUMN - 0.13
    low, high = height("kernels") - 0.62 * ROW, height("assembly") + 0.62 * ROW
    frame = Rectangle((left, low), right - left, high - low, fill=False, ec=STEP, lw=0.9, ls=(0, (4, 3)))
    ax.add_patch(frame)
    ax.text((left + right) / 2, low - 0.05, "each iteration", ha="center", va="top", size=9, color=STEP)


def draw() -> None:
    start = NAMES + 0.2
    first = start + COLUMN * len(COMPILING) + 0.1
    right, top = first + COLUMN * len(LOAD_STEP), ROW * len(ROOMS)
    fig = plt.figure(figsize=(right + 1.05, top + 0.55))
    ax = fig.add_axes((0, 0, 1, 1))
    ax.set_xlim(-0.95, right + 0.1)
    ax.set_ylim(-0.1, top + 0.45)
    ax.axis("off")
    draw_rooms(ax, right)
    draw_path(ax, COMPILING, start, ONCE, style=(0, (3, 2)))
    x = draw_path(ax, LOAD_STEP, first, STEP)
    draw_iteration(ax, x)
    title = {"va": "bottom", "size": 10.5, "weight": "bold"}
    ax.text(0.0, top + 0.12, "Each imports from those below it", color=INK, **title)
    ax.text(start - 0.15, top + 0.12, "Once for each material", color=ONCE, **title)
    ax.text(first - 0.15, top + 0.12, "A load step", color=STEP, **title)
    OUTPUT.parent.mkdir(exist_ok=True)
    fig.savefig(OUTPUT, dpi=110)


if __name__ == "__main__":
    draw()
