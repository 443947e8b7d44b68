"""Numerical stability: the equation against 50 digits, stiffness, extreme scenes, popping. For
docs/performance.md.

    python benchmarks/stability.py    # everything
    python benchmarks/stability.py --only scenes    # one part; the rows of the others stay

Rows go to ``results/stability.jsonl``, where they replace those of the parts that were run. The
picture of docs/performance.md is drawn.
"""

import json
import time
from itertools import chain

import stability_equation
import stability_popping
import stability_scenes
import stability_stiffness
from clod_adapter.cli.shared.outputs import jsonable
from common import RESULTS, ROOT, about, arguments, stored

FILE, IMAGES = "stability.jsonl", ROOT / "docs" / "images"
PARTS = {
    "equation": stability_equation,
    "stiffness": stability_stiffness,
    "scenes": stability_scenes,
    "popping": stability_popping,
}


def main():
    parser = arguments(__doc__)
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts to run"
    )
    args = parser.parse_args()
    rows = {part: [] for part in PARTS}
    for row in stored(FILE):
        rows[row["part"]].append(row)
    for part in args.only:
        started = time.perf_counter()
        measured = PARTS[part].measure()
        head = {**about(), "part_seconds": round(time.perf_counter() - started, 1)}
        rows[part] = [jsonable({**head, "part": part, **row}) for row in measured]
        lines = map(json.dumps, chain.from_iterable(rows.values()))
        (RESULTS / FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")
        print(f"{part}: {head['part_seconds']} s", flush=True)
    stability_stiffness.picture(rows["stiffness"], IMAGES / "stability_stiffness.png")


def page_table(part):
    rows = [row for row in stored(FILE) if row["part"] == part]
    return PARTS[part].page_table(rows)


if __name__ == "__main__":
    main()
