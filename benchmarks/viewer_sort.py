"""Culling and sorting in the page, per frame: by the worker, and by WebGPU, in a headless Chromium.

Random Gaussians, of which the dial value keeps 69 %; a picture of most of the scene, and one of a part. Prints a row of
JSON for each number of Gaussians: the median milliseconds from the request until the rows to draw are there, and the
numbers of kept and of sorted Gaussians. Here both WebGL and WebGPU are software (SwiftShader), so the times say nothing
about a GPU. On one, open the page and evaluate ``(await clod.order()).ms`` in the browser's console.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

import clod_adapter as clod
from common import ROOT, Row, append, arguments

sys.path.insert(0, str(ROOT / "tests"))
import browser  # noqa: E402
import scenes  # noqa: E402
from shown import REAL_GPU, Shown, serve, sorts_on_gpu  # noqa: E402

FILE = "viewer_sort.jsonl"
COUNTS = (100_000, 500_000)
FIELDS_OF_VIEW = {"most": 90.0, "part": 20.0}  # degrees
DIAL, REPEATS = 2.0, 9


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("counts", nargs="*", type=int, default=COUNTS)
    options = parser.parse_args()
    with browser.launch() as chromium, tempfile.TemporaryDirectory() as folder:
        for count in options.counts:
            path = Path(folder) / f"{count}.ply"
            clod.save(path, scenes.dialled(count, 0, 7))
            row = {"gaussians": count, "virtual_scale": DIAL, "chromium": chromium.version, "software": True}
            for name, script in (("worker", ""), ("webgpu", REAL_GPU)):
                row[name] = measure(chromium, path, script)
            print(json.dumps(row))
            if options.record:
                append(FILE, row)


def measure(chromium: Any, path: Path, script: str) -> dict[str, Row]:
    """Times and counts of each field of view; a ``script`` must make the page sort by WebGPU."""
    with serve(path) as url, chromium.new_context(viewport={"width": 200, "height": 150}) as context:
        context.set_default_timeout(300_000)
        page = context.new_page()
        page.add_init_script(script)
        shown = Shown(page).ready(url)
        if sorts_on_gpu(shown, 60 if script else 0) != bool(script):
            sys.exit("this Chromium has no WebGPU adapter" if script else "the page sorts by WebGPU in software")
        shown.run("clod.setDial(given)", DIAL)
        found = {}
        for name, fov in FIELDS_OF_VIEW.items():
            shown.camera(scenes.camera(200, 150, fov=fov))
            call = "clod.order().then(({ ms, kept, rows }) => ({ ms, kept, sorted: rows.length }))"
            runs = [shown.run(call) for _ in range(REPEATS)]
            found[name] = runs[0] | {"ms": median(run["ms"] for run in runs)}
        assert not shown.errors, shown.errors
        return found


if __name__ == "__main__":
    main()
