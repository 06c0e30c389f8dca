"""Draws images/cones.png: Mohr-Coulomb's pyramid and the cones that stand for it."""

import math
from pathlib import Path

import matplotlib as mpl

mpl.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from polarmpm.materials.cones import CONES, cone_slopes, plane_friction
from polarmpm.materials.pyramids import edge_numbers, lode_function
from polarmpm.plot import PAGE, styled

COLOURS = dict(zip(CONES, ("#D55E00", "#0072B2", "#009E73", "#CC79A7"), strict=True))  # Okabe-Ito
PHI, PSI, CORNER = math.radians(30), 0.0, math.radians(25)


def rounded(theta):
    """K of the pyramid with rounded edges."""
    if abs(theta) <= CORNER:
        return lode_function(theta, math.sin(PHI))
    a, b, c = edge_numbers(math.sin(PHI), CORNER, 1 if theta > 0 else -1)
    x = math.sin(3 * theta)
    return a + b * x + c * x * x


def hexagon(k):
    """Angle and radius over sqrt(3) c cos(phi) at p = 0 all around, from K on a sixth."""
    sixth = np.linspace(-math.pi / 6, math.pi / 6, 101)
    radius = 1 / np.array([k(t) for t in sixth])
    parts = [(sixth, radius), (math.pi / 3 - sixth[::-1], radius[::-1])]
    turns = 2 * math.pi / 3 * np.arange(3)
    return np.concatenate([a + t for t in turns for a, _ in parts]), np.tile(
        np.concatenate([radius, radius[::-1]]), 3
    )


def deviatoric_plane(axes):
    """Strengths at p = 0 over those of plane shear."""
    for label, k, style in (
        ("Mohr-Coulomb", lambda t: lode_function(t, math.sin(PHI)), {"color": "black"}),
        ("rounded", rounded, {"color": "black", "linestyle": (0, (4, 2)), "linewidth": 1}),
    ):
        angle, radius = hexagon(k)
        # compression points up
        axes.plot(
            -radius * np.sin(angle - math.pi / 6), radius * np.cos(angle - math.pi / 6), label=label, **style
        )
    circle = np.linspace(0, 2 * math.pi, 361)
    for cone in CONES:
        q = cone_slopes(cone, PHI, PSI)[2] / (math.sqrt(3) * math.cos(PHI))
        axes.plot(q * np.cos(circle), q * np.sin(circle), color=COLOURS[cone], label=cone, linewidth=1)
    axes.set(aspect="equal", xticks=[], yticks=[], title="$p = 0$, φ = 30°, ψ = 0")
    axes.annotate("compression", (0, 1.47), ha="center", va="bottom")
    axes.annotate("extension", (0, -1.47), ha="center", va="top")
    axes.set(xlim=(-1.9, 1.9), ylim=(-1.75, 1.75))
    axes.spines[:].set_visible(False)


def plane_strength(axes):
    """Friction that a cone shows in plane flow, over the angle that it was given."""
    angles = np.linspace(1, 45, 89)
    for cone in CONES:
        shown = [math.degrees(math.asin(plane_friction(cone, angle, PSI))) for angle in np.radians(angles)]
        limited = np.array(shown) < 89.9
        axes.plot(angles[limited], np.array(shown)[limited], color=COLOURS[cone], label=cone)
    axes.plot(angles, angles, color="black", linewidth=0.8)
    axes.set(
        xlabel="φ (degrees)",
        ylabel="friction in plane flow (degrees)",
        title="plane strain, ψ = 0",
        ylim=(0, 90),
    )
    axes.grid(alpha=0.3)


@styled()
def main():
    """The figure."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(PAGE, 3.4), layout="none")
    deviatoric_plane(left)
    plane_strength(right)
    figure.legend(
        *left.get_legend_handles_labels(),
        loc="lower center",
        ncol=6,
        frameon=False,
        columnspacing=1.4,
        handlelength=1.6,
    )
    figure.subplots_adjust(left=0.01, right=0.98, top=0.92, bottom=0.2, wspace=0.12)
    figure.savefig(Path(__file__).parent / "images" / "cones.png", dpi=220)


if __name__ == "__main__":
    main()
