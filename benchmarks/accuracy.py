"""Tables and figure of docs/accuracy.md, from the results of strangers.py and nothing_worse.py.

    python benchmarks/accuracy.py [--results DIR] [--draw FILE]

Two numbers with an arrow between them are what the package found before points integrated over their boxes
(`*_before.json`), and what it finds now.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import records
import strangers

HERE = Path(__file__).parent
NO_ANSWER = "–"


class Results:
    """Rows of both files by group and scene, before and now."""

    def __init__(self, folder: Path):
        self.before, self.now = {}, {}
        for name in ("strangers", "nothing_worse"):
            for found, file in ((self.before, f"{name}_before.json"), (self.now, f"{name}.json")):
                groups = json.loads((folder / file).read_text())
                found |= {(g, r["scene"]): r for g, rows in groups.items() if g != "version" for r in rows}

    def pair(self, group, scene):
        """What was found before, if anything, and now."""
        return self.before.get((group, scene)), self.now[group, scene]

    def group(self, name):
        return [r for (group, _), r in self.now.items() if group == name]


# cells of tables ------------------------------------------------------------------------------------
def percent(row, sign=True):
    """The error (%) with two digits, to a thousandth."""
    if row["failure"]:
        return NO_ANSWER
    error = 100 * (row["error"] if sign else abs(row["error"]))
    if abs(error) < 5e-4:
        return "0"
    number = max(0, min(3, 1 - int(np.floor(np.log10(abs(error))))))
    return f"{error:{'+' if sign else ''}.{number}f}"


def both(pair, show=percent, **options):
    old, new = pair
    return show(new, **options) if old is None else f"{show(old, **options)} → {show(new, **options)}"


def distance(row):
    """Distance to the reference (m), None without an answer."""
    if row["failure"]:
        return None
    return float(np.linalg.norm(np.subtract(row["value"], row["reference"])))


def span(rows):
    """Smallest and largest distance (m), and how many have no answer."""
    found = [distance(r) for r in rows]
    some = [d for d in found if d is not None]
    words = []
    if some:
        ends = [f"{d:.2f}" if d < 2 else f"{d:.1f}" for d in (min(some), max(some))]
        words.append(ends[0] if ends[0] == ends[1] else " to ".join(ends))
    if len(some) < len(found):
        words.append(f"none at {len(found) - len(some)}")
    return "; ".join(words)


# tables ---------------------------------------------------------------------------------------------
def number_of_points(n):
    return "1 point" if n == 1 else f"{n} points"


def arches(results):
    lines = []
    for cell, numbers in ((1, ("default", "3", "4")), (2, ("2", "3", "4", "6"))):
        for number in numbers:
            pairs = [
                results.pair("arch", r["scene"])
                for r in results.group("arch")
                if r["scene"].startswith(f"{cell} m, {number} points, position")
            ]
            name = "2 (default)" if number == "default" else number
            line = [f"{cell} m", name, len(pairs), *(span([p[k] for p in pairs if p[k]]) for k in (0, 1))]
            lines.append([*line, seconds(pairs, 0), seconds(pairs, 1)])
    head = ["cells", "points a direction", "positions", "distance before (m)", "now (m)"]
    records.table([*head, "CPU before (s)", "now (s)"], lines)
    lines = [
        [r["scene"], both(results.pair("arch", r["scene"]), sign=False)]
        for r in results.group("arch")
        if r["scene"].startswith("radius")
    ]
    records.table(["other arches", "error (%)"], lines)
    lines = []
    meshes = [f"mesh, degree {n}{end}" for n in ("default", 2, 7) for end in ("", ", end face")]
    for words in ("default points, end face", *meshes):
        rows = [r for r in results.group("arch") if r["scene"].startswith(f"1 m, {words}, position")]
        if rows:
            old = [results.before.get(("arch", r["scene"])) for r in rows]
            lines.append([words, span([r for r in old if r]), span(rows)])
    records.table(["1 m", "distance before (m)", "now (m)"], lines)


def seconds(pairs, k):
    """Mean of the CPU time of the runs that have an answer."""
    some = [p[k]["cpu_s"] for p in pairs if p[k] and not p[k]["failure"]]
    return f"{np.mean(some):.1f}" if some else ""


def strips(results):
    lines = []
    for thickness in ("2", "1", "0.5", "0.25"):
        for word in strangers.ANGLES:
            scenes = [f"{thickness} thick, {word}, {n} points" for n in (1, 2, 3, 4)]
            lines.append([thickness, word, *(both(results.pair("strips", s)) for s in scenes)])
    records.table(["thickness / cells", "direction", *(number_of_points(n) for n in (1, 2, 3, 4))], lines)


def blocks(results):
    names = dict.fromkeys(r["scene"].rsplit(", ", 1)[0] for r in results.group("blocks"))
    names = [n for n in names if "points" not in n]
    lines = []
    for name in names:
        line = [name]
        for number in (1, 2, 3, 4, 6):
            scene = f"{name}, {number} points"
            line.append(
                both(results.pair("blocks", scene), failed) if ("blocks", scene) in results.now else ""
            )
        count = results.now["blocks", f"{name}, 2 points"]["value"].split()[-1]
        lines.append([name, count, *line[1:]])
    records.table(["bodies", "number", *(number_of_points(n) for n in (1, 2, 3, 4, 6))], lines)


def failed(row):
    return row["value"].split()[0]


def column(results):
    lines = []
    for basis in ("bspline", "bspline-averaged", "gimpm"):
        for number in (2,) if basis == "gimpm" else (2, 3, 4):
            rows = [
                results.now["column", f"{basis}, {number} points, {n} cells"] for n in (8, 16, 32, 64, 128)
            ]
            errors = [f"{r['error']:.1e}".replace("e-0", "e-") for r in rows]
            lines.append([f"`{basis}`", number, *errors, f"{sum(r['cpu_s'] for r in rows):.2f}"])
    head = ["basis", "points", *(f"{n} cells" for n in (8, 16, 32, 64, 128)), "CPU of all (s)"]
    records.table(head, lines)


KNOWN = [  # what, group, scene
    ("AMPLE's beam, cells of half its depth", "AMPLE", "0.5 m, default resets"),
    ("the same, reset every step", "AMPLE", "0.5 m, reset every step"),
    ("AMPLE's beam, cells of a quarter", "AMPLE", "0.25 m, default resets"),
    ("the same, reset every step", "AMPLE", "0.25 m, reset every step"),
    ("Kirsch's hole, strains, cells of a/8", "closed forms", "Kirsch, 0.125 a"),
    ("thick cylinder, cells of a/8", "closed forms", "cylinder, 0.125 a"),
    ("torsion of a round bar, micropolar", "closed forms", "torsion, micropolar"),
    ("Hill's limit pressure, cells of a/8", "plastic", "Hill, 0.125 a"),
    ("Cook, ν = 0.3, cells of 6 m", "Cook", "nu = 0.3, 6 m"),
    ("Cook, ν = 0.3, 1.5 m", "Cook", "nu = 0.3, 1.5 m"),
    ("Cook, ν = 0.4999, 6 m", "Cook", "nu = 0.4999, 6 m"),
    ("Cook, ν = 0.4999, 1.5 m", "Cook", "nu = 0.4999, 1.5 m"),
    ("footing, N_c, 4 cells", "plastic", "footing N_c, 4 cells"),
    ("footing, N_c, 8 cells", "plastic", "footing N_c, 8 cells"),
    ("biaxial test, peak", "plastic", "biaxial, peak (kPa)"),
    ("biaxial test, residual", "plastic", "biaxial, residual (kPa)"),
]


def known(results):
    lines = []
    for what, group, scene in KNOWN:
        line = [what]
        for number in (2, 3, 4, 5):
            key = group, f"{scene}, {number} points"
            line.append(both(results.pair(*key)) if key in results.now else "")
        lines.append(line)
    records.table(["error (%)", *(f"{n} points" for n in (2, 3, 4, 5))], lines)


def doubted(row):
    """Whether the measure of trust warned; nearly incompressible materials have a warning of their own."""
    return any(word in w for w in row["warned"] for word in ("boxes", "smooth", "rough"))


def counts(rows):
    """Number of rows that have an answer, of warnings, within 1 %, 1 to 10 % and more; the median error."""
    mine = [r for r in rows if not r["failure"]]
    errors = 100 * np.abs([r["error"] for r in mine])
    classes = ((-1, 1), (1, 10), (10, np.inf))
    found = [int(((errors > low) & (errors <= high)).sum()) for low, high in classes]
    return [len(mine), sum(map(doubted, mine)), *found, f"{np.median(errors):.2g}"]


def measure(results):
    """Errors over the measure of trust."""
    rows = results.group("measure")
    lines = []
    for low, high in ((0, 0.05), (0.05, 0.2), (0.2, 0.5), (0.5, 1.0)):
        mine = [r for r in rows if r["unresolved"] is not None and low <= r["unresolved"] < high]
        lines.append([f"{low:g} to {high:g}", *counts(mine)])
    lines.append(["without boxes", *counts([r for r in rows if r["unresolved"] is None])])
    none = [r for r in rows if r["failure"]]
    lines.append(["no answer", len(none), sum(map(doubted, none)), "", "", "", ""])
    head = ["U", "runs", "warned", "within 1 %", "1 to 10 %", "more than 10 %", "median error (%)"]
    records.table(head, lines)
    strangers.verdict(rows)


def invariance(results):
    lines = []
    for r in results.group("invariance"):
        old, new = results.pair("invariance", r["scene"])
        lines.append(
            [r["scene"], f"{old['error']:.1e}", f"{new['error']:.1e}", old["unsolved"], new["unsolved"]]
        )
    records.table(["scenes", "before", "now", "without answer before", "now"], lines)


# figure ---------------------------------------------------------------------------------------------
BEFORE, NOW, THIRD = "#D55E00", "#0072B2", "#009E73"  # Okabe and Ito's


def draw(results, file):
    """Errors of arches and strips before and now, and errors over the measure of trust."""
    import matplotlib

    from polarmpm.plot import figures as plot

    sizes = {"font.size": 8, "axes.titlesize": 8, "legend.fontsize": 7, "xtick.labelsize": 7}
    with matplotlib.rc_context({**sizes, "ytick.labelsize": 7, "axes.linewidth": 0.6}):
        figure, axes = plot.subplots(1, 3, figsize=(7.2, 3.5))
        draw_arches(axes[0], results)
        draw_strips(axes[1], results)
        draw_measure(axes[2], results)
        for letter, axis in zip("abc", axes, strict=True):
            axis.set_title(f"({letter})", loc="left")
            axis.grid(True, lw=0.3, color="0.85", zorder=0)
            below = {"loc": "upper center", "bbox_to_anchor": (0.45, -0.2), "ncol": 2, "frameon": False}
            axis.legend(**below, handletextpad=0.1, columnspacing=0.8)
        plot.save(figure, file)


def none_line(axis, at):
    """Where runs without an answer are drawn."""
    axis.axhline(at, color="0.4", lw=0.6, ls=":")
    axis.annotate("no equilibrium", (0.98, at), xycoords=("axes fraction", "data"), xytext=(0, 3),
                  textcoords="offset points", ha="right", va="bottom", color="0.3", fontsize=7)  # fmt: skip


def draw_arches(axis, results):
    top, shift = 200.0, {1: -0.14, 2: 0.14}
    for cell, marker in ((1, "o"), (2, "s")):
        for found, colour, word in ((results.before, BEFORE, "before"), (results.now, NOW, "now")):
            at, values = [], []
            for (group, scene), r in found.items():
                if group == "arch" and scene.startswith(f"{cell} m, ") and " points, position" in scene:
                    number = scene.split()[2]
                    at.append((2 if number == "default" else int(number)) + shift[cell])
                    values.append(distance(r) or top)
            face = colour if cell == 1 else "none"
            label = f"{word}, {cell} m"
            axis.plot(at, values, marker, ms=3.5, mfc=face, mec=colour, mew=0.8, label=label, zorder=3)
    none_line(axis, top)
    axis.set(yscale="log", ylim=(0.02, 800), xlim=(1.5, 6.5), xticks=(2, 3, 4, 6))
    axis.set(xlabel="points a cell and direction", ylabel="distance to the solution (m)")


def draw_strips(axis, results):
    top, floor = 300.0, 1e-3
    thicknesses = ("0.25", "0.5", "1", "2")
    for (word, _), marker, shift in zip(strangers.ANGLES.items(), "o^s", (0.9, 1.0, 1.11), strict=True):
        for found, colour, when in ((results.before, BEFORE, "before"), (results.now, NOW, "now")):
            rows = [found["strips", f"{t} thick, {word}, 2 points"] for t in thicknesses]
            values = [top if r["failure"] else max(floor, 100 * abs(r["error"])) for r in rows]
            at = shift * np.array(thicknesses, float)
            axis.plot(at, values, marker, ms=3.5, mfc=colour if marker == "o" else "none", mec=colour,
                      mew=0.8, label=f"{when}, {word.replace(' degrees', '°')}", zorder=3)  # fmt: skip
    none_line(axis, top)
    axis.set(xscale="log", yscale="log", ylim=(floor / 1.7, 800), xlim=(0.18, 2.8))
    axis.set_xticks([0.25, 0.5, 1, 2], ["1/4", "1/2", "1", "2"])
    axis.minorticks_off()
    axis.set(xlabel="thickness of a strip (cells)", ylabel="error of the deflection (%)")


PLASTIC = ("footing", "biaxial", "Hill")


def draw_measure(axis, results):
    floor = 1e-3
    kinds = [
        ("along the grid", "s", "0.55", lambda s: s.startswith("strip") and "aligned" in s),
        ("plastic", "^", BEFORE, lambda s: s.startswith(PLASTIC)),
        ("ν = 0.4999", "D", THIRD, lambda s: "0.4999" in s),
        ("all others", "o", NOW, lambda s: True),
    ]
    taken = set()
    for label, marker, colour, test in kinds:
        mine = [r for r in results.group("measure") if test(r["scene"]) and r["scene"] not in taken]
        taken |= {r["scene"] for r in mine}
        mine = [r for r in mine if not r["failure"] and r["unresolved"] is not None]
        values = [max(floor, 100 * abs(r["error"])) for r in mine]
        axis.plot([max(1e-4, r["unresolved"]) for r in mine], values, marker, ms=3.2, mfc="none", mec=colour,
                  mew=0.8, label=label, zorder=3)  # fmt: skip
    for at, style in ((0.97, "-"), (0.2, "--")):
        axis.axvline(at, color="0.3", lw=0.7, ls=style)
    axis.set(xscale="log", yscale="log", xlim=(1e-4, 1.3), ylim=(floor / 1.7, 200))
    axis.set(xlabel="share inside the boxes, $U$ (-)", ylabel="error (%)")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=HERE / "results", metavar="DIR")
    parser.add_argument("--draw", type=Path, metavar="FILE", help="draw the figure, too")
    args = parser.parse_args()
    results = Results(args.results)
    for show in (arches, strips, known, blocks, column, invariance, measure):
        print(f"### {show.__name__}\n")
        show(results)
    if args.draw:
        draw(results, args.draw)


if __name__ == "__main__":
    main()
