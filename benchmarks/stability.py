"""Numerical stability: the equation against 50 digits, stiff starts, extreme scenes, popping. All of docs/stability.md.

    python benchmarks/stability.py                   # everything, then docs/stability.md and its pictures
    python benchmarks/stability.py --only scenes     # one part; the rows of the others stay
    python benchmarks/stability.py --page            # the page and the pictures again, from the rows there are

Rows go to ``results/stability.jsonl``, where they replace those of the parts that were run.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import stability_equation
import stability_popping
import stability_scenes
import stability_stiffness
from common import RESULTS, ROOT, commit

from clod_adapter.cli.shared.report import jsonable, machine

FILE, PAGE, IMAGES = RESULTS / "stability.jsonl", ROOT / "docs" / "stability.md", ROOT / "docs" / "images"
PARTS = {
    "equation": stability_equation,
    "stiffness": stability_stiffness,
    "scenes": stability_scenes,
    "popping": stability_popping,
}
Rows = list[dict[str, Any]]
HEAD = """\
# Numerical stability

What was tried, what it gave, and what it is worth. Everything here is written by `python benchmarks/stability.py`
({seconds} on two cores; the rows are in `benchmarks/results/stability.jsonl`, commit {commit}). The extreme scenes need
a real capture (`CLOD_SHARED_DATA`); the rest needs nothing.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts to run")
    parser.add_argument("--page", action="store_true", help="run nothing, write the page from the rows there are")
    args = parser.parse_args()
    rows = stored()
    for part in () if args.page else args.only:
        started = time.perf_counter()
        found = PARTS[part].measure()
        about = {"commit": commit(), "machine": machine(), "part_seconds": round(time.perf_counter() - started, 1)}
        rows[part] = [jsonable({**about, **row}) for row in found]
        lines = [json.dumps(row) for part in PARTS for row in rows[part]]
        FILE.write_text("\n".join(lines) + "\n", encoding="utf-8")
        print(f"{part}: {about['part_seconds']} s", flush=True)
    write_page(rows)


def stored() -> dict[str, Rows]:
    """The rows there are, by part."""
    lines = FILE.read_text(encoding="utf-8").splitlines() if FILE.exists() else []
    rows = [json.loads(line) for line in lines]
    return {part: [row for row in rows if row["part"] == part] for part in PARTS}


def write_page(rows: dict[str, Rows]) -> None:
    present = {part: found for part, found in rows.items() if found}
    seconds = sum(found[0]["part_seconds"] for found in present.values())
    commits = sorted({found[0]["commit"] for found in present.values()})
    sections = [HEAD.format(seconds=f"{seconds / 60:.1f} minutes", commit=", ".join(commits))]
    for part, found in present.items():
        sections.append(PARTS[part].markdown(found))
        if hasattr(PARTS[part], "plot"):
            PARTS[part].plot(found, IMAGES)
    PAGE.write_text("\n".join(section.strip() + "\n" for section in sections), encoding="utf-8")


if __name__ == "__main__":
    main()
