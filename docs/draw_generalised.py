"""Draws images/generalised.png: the ideas of generalised continua, one picture each."""

from pathlib import Path

import matplotlib as mpl

mpl.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Polygon

from polarmpm.plot import PAGE, styled

BLUE, RED, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"  # Okabe-Ito
FILL = "#DCE9F4"


def arrow(axes, start, end, colour, width=1.2, style="-|>", **options):
    axes.annotate(
        "",
        end,
        start,
        arrowprops={"arrowstyle": style, "color": colour, "lw": width, "shrinkA": 0, "shrinkB": 0, **options},
    )


def block(axes, corners, **options):
    axes.add_patch(
        Polygon(corners, closed=True, **{"facecolor": FILL, "edgecolor": "black", "lw": 1, **options})
    )


def bent(x, z, curvature):
    """A bar bent to an arc: positions of (x, z)."""
    radius = 1 / curvature - z
    return np.array([radius * np.sin(curvature * x), 1 / curvature - radius * np.cos(curvature * x)])


def microspace(axes):
    """A point, its micro-space, and both deformed."""
    half, curvature = 0.5, 0.7
    edge, end = np.linspace(-half, half, 30), np.full(30, half)
    for shift, k in ((-1.25, 1e-6), (1.05, curvature)):
        sides = ((edge, -end), (end, edge), (edge[::-1], end), (-end, edge[::-1]))
        outline = np.hstack([bent(x, z, k) for x, z in sides])
        block(axes, (outline + np.array([[shift], [0]])).T)
        for a in (-1, 1):
            for b in (-1, 1):
                place = bent(a * half / np.sqrt(3), b * half / np.sqrt(3), k)
                axes.plot(place[0] + shift, place[1], "x", color=RED, markersize=7, markeredgewidth=1.8)
        axes.plot(shift, 0, "o", color="black", markersize=6)
    arrow(axes, (-0.55, 0), (0.25, 0), GREY)
    axes.text(-0.15, 0.1, "F, H", ha="center", color=GREY)
    axes.text(-1.25, -0.12, "point", ha="center", va="top", fontsize=7)
    arrow(axes, (-1.75, -0.68), (-0.75, -0.68), GREY, 1.0, "<->")
    axes.text(-1.25, -0.76, "$l_1$", ha="center", va="top", color=GREY)
    arrow(axes, (-1.93, -0.5), (-1.93, 0.5), GREY, 1.0, "<->")
    axes.text(-1.99, 0, "$l_2$", ha="right", va="center", color=GREY)
    axes.text(
        1.05, -0.66, "places at which\nthe energy is taken", ha="center", va="top", color=RED, fontsize=7
    )
    axes.set(xlim=(-2.35, 1.95), ylim=(-1.15, 1.05), title="A micro-space around a point")


def directors(axes):
    """What fibre, normal and rigid director do in a sheared, bent layer."""
    x = np.linspace(0, 3.4, 80)

    def mid(s):
        return np.array([s, 0.16 * s**2])

    shear = 0.45
    for side in (-0.3, 0.3):
        tangent = np.array([np.ones_like(x), 0.32 * x])
        normal = np.array([-tangent[1], tangent[0]]) / np.hypot(*tangent)
        axes.plot(*(mid(x) + side * normal + side * shear * tangent), color="black", lw=1)
    axes.plot(*mid(x), color=GREY, lw=0.8, ls=(0, (5, 3)))
    for s, name, colour, turn in (
        (0.3, "fibre\n$F d$", BLUE, 1.0),
        (1.4, "normal\n$n$", GREEN, 0.0),
        (2.5, "rigid fibre\n$Q d$", RED, 0.5),
    ):
        t = np.array([1, 0.32 * s]) / np.hypot(1, 0.32 * s)
        n = np.array([-t[1], t[0]])
        d = n + turn * shear * t
        foot, top = mid(s) - 0.5 * d, mid(s) + 0.5 * d
        arrow(axes, foot, top, colour, 2.2)
        axes.plot(*mid(s), "o", color="black", markersize=4)
        axes.text(*(top + np.array([-0.05, 0.05])), name, ha="center", va="bottom", color=colour, fontsize=7)
    axes.set(xlim=(-0.6, 3.9), ylim=(-0.75, 2.6), title="What a director does")


def double_stress(axes):
    """Stress and double stress on the face of a block."""
    block(axes, [(-1.5, -0.6), (0, -0.6), (0, 0.6), (-1.5, 0.6)])
    for y in (-0.4, 0, 0.4):
        arrow(axes, (0.02, y), (0.75, y), BLUE)
    axes.text(0.4, 0.58, "traction\nworks on $u$", ha="center", va="bottom", color=BLUE, fontsize=7)
    for y in (-0.4, 0.0, 0.4):
        arrow(axes, (1.62, y), (2.15, y), RED)
        arrow(axes, (1.58, y), (1.05, y), RED)
        axes.plot([1.6, 1.6], [y - 0.09, y + 0.09], color=RED, lw=1)
    axes.text(
        1.6,
        0.58,
        "double traction\nworks on $\\partial u/\\partial n$",
        ha="center",
        va="bottom",
        color=RED,
        fontsize=7,
    )
    axes.text(1.6, -0.62, "pairs of forces\na length apart", ha="center", va="top", color=GREY, fontsize=7)
    axes.set(xlim=(-1.8, 2.5), ylim=(-1.2, 1.3), title="What a double stress is")


def symmetry(axes):
    """A half body with and without the slope condition."""
    y = np.linspace(0, 1.4, 60)
    for smooth, offset in ((True, 0), (False, 2.6)):

        def u(s, smooth=smooth):
            return 0.75 - 0.28 * s**2 if smooth else 0.75 - 0.38 * s

        axes.plot(offset + y, u(y), color=BLUE, lw=2)
        axes.plot(offset - y * 0.75, u(0.75 * y), color=BLUE, lw=1.2, ls=(0, (4, 2)))
        axes.plot([offset, offset], [-0.05, 1.1], color="black", lw=1, ls=(0, (8, 2, 2, 2)))
        axes.plot(offset, u(0), "o", color=GREEN if smooth else RED, markersize=6)
        axes.text(
            offset,
            1.16,
            "$\\partial u_t/\\partial n = 0$" if smooth else "nothing asked",
            ha="center",
            va="bottom",
            color=GREEN if smooth else RED,
            fontsize=7,
        )
        axes.text(
            offset + 0.1,
            -0.1,
            "as in the whole body" if smooth else "a kink, which a whole\nbody can't have",
            ha="center",
            va="top",
            fontsize=7,
            color=GREY,
        )
    axes.text(0.95, 0.68, "$u_t$", color=BLUE, fontsize=7)
    axes.text(-0.55, 0.86, "image", color=BLUE, fontsize=7, ha="center")
    axes.set(xlim=(-1.3, 4.2), ylim=(-0.55, 1.5), title="A plane of symmetry needs the slope")


def size(axes):
    """Stiffness of beams over their thickness."""
    h = np.geomspace(10, 200, 200)
    axes.loglog(h, (24 / h) ** 2, color=BLUE, label="second gradient, $(l/h)^2$: the fit to epoxy beams")
    axes.loglog(h, 0.7 * (24 / h) ** 2, color=GREEN, ls="--", label="micropolar, $(1-\\nu)(l/h)^2$")
    axes.set(
        xlabel="thickness $h$ (µm)",
        ylabel="stiffness / classical − 1",
        xlim=(10, 200),
        ylim=(6e-3, 8),
        title="Thin is stiff: $l$ = 24 µm, ν = 0.3",
    )
    axes.set_xticks([10, 20, 50, 100, 200], ["10", "20", "50", "100", "200"])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=7, loc="lower left")
    axes.spines[["top", "right"]].set_visible(False)


def concentrations(axes):
    """Hoop stress at a round hole under pressure from outside, classical and with a length."""
    r = np.array([2, 2.5, 3, 5])
    for values, label, colour, style in (
        ((128.62, 105.47, 92.89, 74.60), "classical", "black", "-"),
        ((123.57, 103.24, 91.40, 73.79), "$l$ = 1 m", GREEN, "--"),
        ((94.91, 85.96, 80.09, 69.20), "$l$ = 4 m", BLUE, "-."),
    ):
        axes.plot(r, values, style, marker="o", color=colour, label=label)
    axes.set(xlabel="radius (m)", ylabel="hoop stress (MPa)", title="Peaks are spread: hole of radius 2 m")
    axes.legend(frameon=False, fontsize=7)
    axes.spines[["top", "right"]].set_visible(False)


@styled()
def main():
    figure, axes = plt.subplots(3, 2, figsize=(PAGE, 7.2))
    sketches = (microspace, directors, double_stress, symmetry)
    for draw, place in zip((*sketches, size, concentrations), axes.flat, strict=True):
        draw(place)
        if draw in sketches:
            place.set_aspect("equal", adjustable="datalim")
            place.set_axis_off()
    for letter, place in zip("abcdef", axes.flat, strict=True):
        place.set_title(f"({letter})", loc="left", fontweight="bold")
    figure.savefig(Path(__file__).parent / "images" / "generalised.png", dpi=220)


if __name__ == "__main__":
    main()
