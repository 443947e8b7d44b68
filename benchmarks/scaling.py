"""Time and memory of the commands by the number of Gaussians, and of adapting by the photographs.

    python benchmarks/scaling.py            # some 15 minutes, 12 GB of memory, 8 GB of disk; --plot runs nothing
    python benchmarks/scaling.py --only adapt       # one command over the number of Gaussians, 6 minutes

Runs each command in its own process on synthetic cities, which are kept in benchmarks/cache. Measures wall and CPU
seconds and resident memory by phase. A city of 1000 Gaussians gives the start-up cost. Rows go to
results/scaling.jsonl; the last row of a kind counts. Writes docs/images/scaling.png and the tables of docs/scaling.md.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import tempfile
import urllib.request
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import scaling_page
from city import write_city
from common import CACHE, COMMAND, Process, Row, append, arguments, fill_in
from scaling_rows import FEW, FILE, FLOOR, SERIES_COUNT, SIZES, latest, tables

CITIES = CACHE / "scaling"
# The last fifth of STEPS has photographs of full size.
IMAGES, WIDTH, HEIGHT, STEPS, MAX_SV = 10, 640, 400, 20, 3
MANY, SMALL = (16, 64, 256), (320, 200)  # photographs, of this size
SHAPES = ((320, 200), (640, 400), (1280, 800), (1600, 1000))  # sizes, of FEW photographs
SAID = {
    "load": r": \d+ photographs to train on", "base": r"^base: ", "train": r"^trained ", "write": r"^wrote ",
}  # fmt: skip
# Importance and the pruning order by themselves, on the Gaussians of the file: the report has all of "start".
PARTS = """
import sys, time, torch
from pathlib import Path
from clod_adapter import load, load_scene
from clod_adapter.initialization.importance import removal_error
from clod_adapter.initialization.pruning_order import pruning_order
g, views = load(Path(sys.argv[1]) / "city.ply").gaussians, load_scene(sys.argv[1]).train
few = g.select(torch.arange(min(len(g), 1000)))
worth = removal_error(few, views[:1])
pruning_order(few, worth)
def timed(run, *given):
    began, cpu = time.perf_counter(), time.process_time()
    found = run(*given)
    print(time.perf_counter() - began, time.process_time() - cpu)
    return found
error = timed(removal_error, g, views)
timed(pruning_order, g, error.sqrt() * g.opacities)
"""


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--plot", action="store_true", help="run nothing")
    parser.add_argument("--only", choices=RUNS, help="one command, over the number of Gaussians")
    args = parser.parse_args()
    if not args.plot:
        measure_counts([args.only] if args.only else RUNS)
        if not args.only:
            measure_photographs()
    rows = latest()
    scaling_page.draw(rows)
    fill_in(scaling_page.PAGE, "figures", tables(rows))
    fill_in(scaling_page.PAGE, "paper", scaling_page.on_paper(rows))


def measure_counts(commands: Iterable[str]) -> None:
    """Runs over the number of Gaussians, and appends the rows."""
    CITIES.mkdir(parents=True, exist_ok=True)
    run_adapt(scene(FLOOR, IMAGES, WIDTH, HEIGHT))  # compiles the kernels
    for count in (FLOOR, *SIZES):
        shape = count, IMAGES, WIDTH, HEIGHT
        for command in commands:
            record("count", command, *shape, RUNS[command](scene(*shape)))


def measure_photographs() -> None:
    """Runs over the number and the size of photographs, and appends the rows."""
    for images in MANY:
        shape = SERIES_COUNT, images, *SMALL
        record("images", "adapt", *shape, run_adapt(scene(*shape)))
    for size in SHAPES:
        shape = SERIES_COUNT, FEW, *size
        record("shapes", "adapt", *shape, run_adapt(scene(*shape)))


def scene(count: int, images: int, width: int, height: int) -> Path:
    """A city, made where it is not there."""
    folder = CITIES / f"city-{count}-{images}-{width}x{height}"
    if not folder.exists():
        # In a process of its own, so that its memory is given back.
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            pool.submit(write_city, folder, count, images, width, height).result()
    return folder


def dial_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}-dial.ply")


def record(series: str, command: str, count: int, images: int, width: int, height: int, found: Row) -> None:
    file = scene(count, images, width, height) / "city.ply"
    append(FILE, {
        "series": series, "command": command, "gaussians": count, "images": images, "width": width, "height": height,
        "file_bytes": file.stat().st_size, "busy": round(os.getloadavg()[0], 2), **found,
    })  # fmt: skip


def run_adapt(folder: Path) -> Row:
    """A few steps: seconds and memory by phase."""
    out = dial_of(folder)
    words = [folder / "city.ply", "--images", folder, "--iters", STEPS, "--max-sv", MAX_SV, "--out", out]
    run = Process([*COMMAND, *words], SAID)
    report, at = json.loads(out.with_suffix(".json").read_text(encoding="utf-8")), run.moments
    seconds = report["seconds"]
    moments = [
        ("load", at["load"]), ("base", at["base"]), ("start", at["train"] - seconds["train"]), ("train", at["train"]),
        ("write", at["write"]), ("measure and write again", run.seconds),
    ]  # fmt: skip
    phases = {
        "load": seconds["load"], "start": seconds["start"], "step": seconds["train"] / STEPS,
        "write": at["write"] - at["train"], "evaluate": seconds["evaluate"],
    }  # fmt: skip
    peaks, cpu = by_phase(run, moments)
    return {
        **run.cost(), "steps": STEPS, "phases": {name: round(value, 4) for name, value in phases.items()},
        "phase_peaks": peaks, "phase_cpu": cpu, "psnr": report["base_rows"][0]["psnr"],
    }  # fmt: skip


def by_phase(run: Process, ends: Iterable[tuple[str, float]]) -> tuple[dict[str, int], dict[str, float]]:
    """Peak memory and CPU seconds of consecutive phases that end at these times."""
    peaks, seconds, start, before = dict[str, int](), dict[str, float](), 0.0, 0.0
    for name, end in ends:
        samples = [(size, cpu) for at, size, cpu in run.memory if start <= at < end]
        peaks[name] = max((size for size, _ in samples), default=0)
        now = max((cpu for _, cpu in samples), default=before)
        seconds[name], start, before = round(now - before, 2), end, now
    return peaks, seconds


def parts_of_start(folder: Path) -> Row:
    """Wall and CPU seconds of importance and of the pruning order."""
    words = Process([sys.executable, "-c", PARTS, folder]).out.split()
    names = [f"{part}_{clock}" for part in ("importance", "order") for clock in ("seconds", "cpu")]
    return {name: round(float(word), 3) for name, word in zip(names, words, strict=True)}


def run_export(folder: Path) -> Row:
    with tempfile.TemporaryDirectory(dir=CITIES) as out:
        return Process([*COMMAND, "export", dial_of(folder), "-o", Path(out) / "plain.ply", "--sv", 1.5]).cost()


def run_view(folder: Path) -> Row:
    """Until the address is printed, and until a page would have all of the model; no browser."""
    run = Process([*COMMAND, "view", dial_of(folder), "--images", folder, "--no-browser"], until="http://")
    address, size = run.now(), 0
    with urllib.request.urlopen(run.line.split()[0] + "files/model") as answer:
        while block := answer.read(1 << 20):
            size += len(block)
    served = run.now()
    run.process.send_signal(signal.SIGINT)
    run.finish()
    return run.cost() | {"seconds": round(served, 3), "address_seconds": round(address, 3), "served_bytes": size}


RUNS = {
    "adapt": lambda folder: run_adapt(folder) | parts_of_start(folder),
    "eval": lambda folder: Process([*COMMAND, "eval", dial_of(folder), "--images", folder, "--sv", 1, MAX_SV]).cost(),
    "export": run_export,
    "inspect": lambda folder: Process([*COMMAND, "inspect", dial_of(folder)]).cost(),
    "view": run_view,
}


if __name__ == "__main__":
    main()
