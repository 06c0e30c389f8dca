"""The bars of dynamics and contact, one by one: what is asked, what is found, and the command that says so.

Cases that aren't asked for stay as they were in the file: `--only waves cost`. Writes JSON, and the table of
docs/dynamics.md.
"""

import argparse
import json
import time
from pathlib import Path

from dynamics_cases import CASES, quietly
from pages import quote

HERE = Path(__file__).parent


def table(kept):
    lines = ["| | bar | found | holds | `--only` |", "|---|---|---|---|---|"]
    for case in CASES:
        for row in kept.get(case, {}).get("rows", ()):
            holds = {True: "yes", False: "**no**", None: ""}[row["holds"]]
            lines.append(f"| {row['what']} | {row['bar']} | {row['found']} | {holds} | {case} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), metavar="CASE")
    parser.add_argument("--redraw", action="store_true", help="the table from the JSON file")
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    file = args.output / "dynamics.json"
    args.output.mkdir(parents=True, exist_ok=True)
    kept = json.loads(file.read_text()) if file.exists() else {}
    for case in () if args.redraw else args.only:
        begin = time.process_time()
        rows = [row._asdict() for row in quietly(case)]
        kept[case] = {"rows": rows, "cpu_s": time.process_time() - begin}
        file.write_text(json.dumps(kept, indent=1, default=bool) + "\n")
        for row in rows:
            print(f"{case}: {row['what']}: {row['found']} ({row['bar']}) {row['holds']}", flush=True)
    if args.output == HERE / "results":
        quote(HERE.parent / "docs" / "dynamics.md", "bars", f"\n{table(kept)}\n")


if __name__ == "__main__":
    main()
