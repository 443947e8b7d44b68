"""Numerical stability: the equation against 50 digits, stiffness, extreme scenes, popping. For
docs/performance.md.

    python benchmarks/stability.py    # everything, then the tables and the pictures
    python benchmarks/stability.py --only scenes    # one part; the rows of the others stay
    python benchmarks/stability.py --page    # the tables and the pictures, from the stored rows

Rows go to ``results/stability.jsonl``, where they replace those of the parts that were run. The
tables of docs/performance.md are printed, its pictures are written.
"""

import json
import time
from itertools import chain

import stability_equation
import stability_popping
import stability_scenes
import stability_stiffness
from clod_adapter.cli.shared.outputs import jsonable
from common import RESULTS, ROOT, Row, about, arguments, stored

FILE, IMAGES = "stability.jsonl", ROOT / "docs" / "images"
PARTS = {
    "equation": stability_equation,
    "stiffness": stability_stiffness,
    "scenes": stability_scenes,
    "popping": stability_popping,
}


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts to run"
    )
    parser.add_argument(
        "--page", action="store_true", help="run nothing, print the tables of the stored rows"
    )
    args = parser.parse_args()
    rows: dict[str, list[Row]] = {part: [] for part in PARTS}
    for row in stored(FILE):
        rows[row["part"]].append(row)
    for part in () if args.page else args.only:
        started = time.perf_counter()
        measured = PARTS[part].measure()
        head = {**about(), "part_seconds": round(time.perf_counter() - started, 1)}
        rows[part] = [jsonable({**head, "part": part, **row}) for row in measured]
        lines = map(json.dumps, chain.from_iterable(rows.values()))
        (RESULTS / FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")
    for part in args.only:
        if rows[part]:
            first = rows[part][0]
            head = f"## {part}: commit {first['commit']}, {first['part_seconds']} s"
            print(f"{head}\n\n{PARTS[part].tables(rows[part])}\n", flush=True)
            if part == "stiffness":
                stability_stiffness.picture(rows[part], IMAGES / "stability_stiffness.png")


if __name__ == "__main__":
    main()
