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
# in: height of a folder, width of a step, width of the folders' boxes; of the whole, a journal's page
ROW, COLUMN, NAMES, PAGE = 0.25, 0.228, 2.75, 7.48
LINE, SMALL = 0.15, 7  # in, pt: of the key below
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
    Room("sensitivity", "derivatives by parameters", "use"),
    Room("io", "ParaView, tables, restart", "use"),
    Room("plot", "figures", "use"),
    Room("identification", "parameters from measurements", "use"),
    Room("geotechnics", "factors of safety", "use"),
    Room("study", "error against time, demos", "use"),
)


class Stop(NamedTuple):
    """Where a path is in one of its steps."""

    mark: str
    room: str
    what: str


COMPILING = (
    Stop("a", "materials", "energy in UFL"),
    Stop("b", "forms", "residual, tangent"),
    Stop("c", "kernels", "C code, compiled"),
)
LOAD_STEP = (
    Stop("1", "solvers", "load factor"),
    Stop("2", "problems", "reset if due"),
    Stop("3", "basis", "weights of points"),
    Stop("4", "assembly", "node sets, sparsity"),
    Stop("5", "conditions", "loads, supports"),
    Stop("6", "assembly", "sum over points"),
    Stop("7", "kernels", "stresses, moduli"),
    Stop("8", "terms", "forces, matrices"),
    Stop("9", "solvers", "solve, correct"),
    Stop("10", "problems", "check, commit"),
    Stop("11", "kinematics", "F, Q, Γ updated"),
    Stop("12", "bodies", "points moved"),
    Stop("13", "solvers", "reset next?"),
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
        style = "round,pad=0,rounding_size=0.04"
        shape = (0.0, y - ROW / 2 + 0.02), NAMES - 0.05, ROW - 0.04
        ax.add_patch(FancyBboxPatch(*shape, boxstyle=style, facecolor=colour, edgecolor="#b0b0b0", lw=0.6))
        ax.text(0.07, y - 0.01, room.name, va="center", size=SMALL, weight="bold", color=INK)
        ax.text(0.94, y - 0.01, room.holds, va="center", size=SMALL, color=INK)
    for layer in LAYERS:
        rows = [height(r.name) for r in ROOMS if r.layer == layer]
        low, high = min(rows) - ROW / 2, max(rows) + ROW / 2
        ax.plot([-0.06, -0.06], [low + 0.03, high - 0.03], color=FAINT, lw=1.0, solid_capstyle="butt")
        ax.text(-0.1, (low + high) / 2, layer, ha="right", va="center", size=SMALL, color="#555555")
        ax.plot([0, right], [high, high], color="white", lw=1.2)


def draw_path(ax: Axes, stops: tuple[Stop, ...], first: float, colour: str, style: str = "-") -> list[float]:
    """Stops in the rows of their folders, from left to right; returns their places."""
    x = [first + COLUMN * k for k in range(len(stops))]
    y = [height(stop.room) for stop in stops]
    for k in range(len(stops) - 1):  # along the row to the next stop's column, then up or down to it
        ax.plot([x[k], x[k + 1], x[k + 1]], [y[k], y[k], y[k + 1]], color=colour, lw=1.0, ls=style, zorder=2)
    for stop, at, level in zip(stops, x, y, strict=True):
        ax.plot(at, level, "o", ms=11, color=colour, zorder=3, mec="white", mew=0.6)
        mark = {
            "ha": "center",
            "va": "center",
            "size": SMALL,
            "weight": "bold",
            "color": "white",
            "zorder": 4,
        }
        ax.text(at, level - 0.005, stop.mark, **mark)
    return x


def draw_iteration(ax: Axes, x: list[float]) -> None:
    """A frame around the steps that Newton's method repeats."""
    left, right = x[ITERATION[0]] - 0.11, x[ITERATION[1]] + 0.11
    low, high = height("kernels") - 0.55 * ROW, height("assembly") + 0.55 * ROW
    frame = Rectangle((left, low), right - left, high - low, fill=False, ec=STEP, lw=0.8, ls=(0, (4, 3)))
    ax.add_patch(frame)
    where = {"ha": "center", "va": "top", "size": SMALL, "color": STEP}
    ax.text((left + right) / 2, low - 0.03, "each iteration", **where)


def draw_key(ax: Axes, stops: tuple[Stop, ...], x: float, y: float, colour: str, rows: int = 5) -> None:
    """What happens at the stops, column by column."""
    for k, stop in enumerate(stops):
        at = x + 1.5 * (k // rows), y - LINE * (k % rows)
        ax.text(*at, stop.mark, size=SMALL, weight="bold", color=colour, va="top")
        ax.text(at[0] + 0.18, at[1], stop.what, size=SMALL, color=INK, va="top")


def draw() -> None:
    start = NAMES + 0.14
    first = start + COLUMN * len(COMPILING)
    left, bottom, top = 0.62, 7.2 * LINE, ROW * len(ROOMS)
    right = PAGE - left - 0.05
    fig = plt.figure(figsize=(PAGE, bottom + top + 0.25))
    ax = fig.add_axes((0, 0, 1, 1))
    ax.set_xlim(-left, PAGE - left)
    ax.set_ylim(-bottom, top + 0.25)
    ax.axis("off")
    draw_rooms(ax, right)
    draw_path(ax, COMPILING, start, ONCE, style=(0, (3, 2)))
    draw_iteration(ax, draw_path(ax, LOAD_STEP, first, STEP))
    title = {"va": "top", "size": 8, "weight": "bold"}
    ax.text(0.0, top + 0.2, "Each imports from those below it", color=INK, **title)
    ax.text(0.0, -0.1, "Once for each material", color=ONCE, **title)
    ax.text(1.8, -0.1, "A load step", color=STEP, **title)
    draw_key(ax, COMPILING, 0.0, -0.1 - 1.3 * LINE, ONCE)
    draw_key(ax, LOAD_STEP, 1.8, -0.1 - 1.3 * LINE, STEP)
    OUTPUT.parent.mkdir(exist_ok=True)
    fig.savefig(OUTPUT, dpi=220)


if __name__ == "__main__":
    draw()
