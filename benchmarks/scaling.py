"""Time and memory of the commands by the number of Gaussians.

    python benchmarks/scaling.py    # some 30 minutes, 14 GB of memory, 8 GB of disk

Runs each command in its own process on synthetic towns, which are kept in benchmarks/cache.
Measures wall and CPU seconds and peak memory. The smallest town gives the start-up cost.
Rows go to results/scaling.jsonl; the last row of a kind counts.
"""

import json
import math
import multiprocessing
import os
import signal
import sys
import tempfile
import urllib.request
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path

from city import write_city
from common import CACHE, Process, Row, Table, append, arguments, clod_adapt, last, report_of

import numpy as np

FILE = "scaling.jsonl"
CITIES = CACHE / "scaling"
FLOOR = 10_000
SIZES = (FLOOR, 100_000, 1_000_000, 5_000_000)
LARGE = SIZES[-2:]  # between which exponents and bytes per Gaussian are taken
IMAGES = 10
WIDTH = 640
HEIGHT = 400
STEPS = 20  # of which the last fifth has photographs of full size
MAX_SV = 3
PARTS_SHOWN = {
    "load": "load",
    "importance": "importance",
    "order": "pruning order",
    "step": "a step",
}
# Loading, importance and the pruning order by themselves; the report has all of "start".
PARTS = """
import json, sys, time, torch
from pathlib import Path
from clod_adapter import load, load_scene
from clod_adapter.initialization.importance import removal_error
from clod_adapter.initialization.pruning_order import pruning_order
spent = {}
def timed(name, run, *given):
    began, cpu = time.perf_counter(), time.process_time()
    found = run(*given)
    spent[name + "_seconds"] = time.perf_counter() - began
    spent[name + "_cpu"] = time.process_time() - cpu
    return found
g = timed("load", load, Path(sys.argv[1]) / "city.ply").gaussians
cameras = [view.camera for view in load_scene(sys.argv[1]).train]
few = g.select(torch.arange(min(len(g), 1000)))
pruning_order(few, removal_error(few, cameras[:1]))  # compiled
error = timed("importance", removal_error, g, cameras)
timed("order", pruning_order, g, error.sqrt() * g.opacities)
print(json.dumps({name: round(value, 3) for name, value in spent.items()}))
"""


def main():
    arguments(__doc__).parse_args()
    CITIES.mkdir(parents=True, exist_ok=True)
    for run in RUNS.values():
        run(town(FLOOR))  # compiles the kernels
    for count, (command, run) in product(SIZES, RUNS.items()):
        cost = run(town(count))
        about = {"command": command, "gaussians": count, "busy": round(os.getloadavg()[0], 2)}
        append(FILE, {"series": "count", **about, **cost})


def town(count):
    """A town, made where it is not there, in a process of its own, so that its memory is given
    back.
    """
    folder = CITIES / f"town-{count}"
    if not folder.exists():
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            pool.submit(write_city, folder, count, IMAGES, WIDTH, HEIGHT).result()
    return folder


def dial_of(folder):
    return folder.with_name(f"{folder.name}-dial.ply")


def run_adapt(folder):
    """A few steps."""
    out = dial_of(folder)
    settings = ("--iters", STEPS, "--max-sv", MAX_SV, "--accept-loss")
    run = clod_adapt(folder / "city.ply", "--images", folder, *settings, "--out", out)
    seconds = report_of(out)["seconds"]
    return {**run.cost(), "step_seconds": seconds["train"] / STEPS, "phases": seconds}


def run_export(folder):
    with tempfile.TemporaryDirectory(dir=CITIES) as out:
        plain = Path(out) / "plain.ply"
        return clod_adapt("export", dial_of(folder), "-o", plain, "--sv", 1.5).cost()


def run_eval(folder):
    return clod_adapt("eval", dial_of(folder), "--images", folder, "--sv", 1, MAX_SV).cost()


def run_view(folder):
    """Until a page would have all of the model; no browser."""
    words = (dial_of(folder), "--images", folder, "--no-browser")
    run = clod_adapt("view", *words, until="http://")
    with urllib.request.urlopen(run.line.split()[0] + "files/model") as answer:
        while answer.read(1 << 20):
            pass
    served = run.now()
    run.process.send_signal(signal.SIGINT)
    run.finish()
    return run.cost() | {"seconds": round(served, 3)}


RUNS: dict[str, Callable[[Path], Row]] = {
    "adapt": lambda folder: (
        run_adapt(folder) | json.loads(Process([sys.executable, "-c", PARTS, folder]).out)
    ),
    "eval": run_eval,
    "export": run_export,
    "inspect": lambda folder: clod_adapt("inspect", dial_of(folder)).cost(),
    "view": run_view,
}


def exponent(points):
    """Power of x that y follows, by least squares in logarithms; NaN of fewer than two points."""
    usable = [point for point in points if point[1] > 0]
    return float(np.polyfit(*np.log(usable).T, 1)[0]) if len(usable) > 1 else math.nan


def measured():
    """The rows by command and size."""
    rows = last(FILE, "command", "gaussians", series="count")
    return {key: row for key, row in rows.items() if key[1] in SIZES}


def page_table():
    """Seconds by size, with the exponents above start-up, between LARGE."""
    found = measured()
    clocks = {command: (command, "seconds", "cpu_seconds") for command in RUNS}
    for part, name in PARTS_SHOWN.items():
        clocks[name] = ("adapt", f"{part}_seconds", f"{part}_cpu")
    lines = []
    for name, (command, wall, cpu) in clocks.items():
        rows = [found[command, size] for size in SIZES]
        line = [name, *(f"{row.get(wall, math.nan):.3g}" for row in rows)]
        for clock in (wall, cpu):
            times = {row["gaussians"]: row.get(clock, math.nan) for row in rows}
            power = exponent([(n, times[n] - times[FLOOR]) for n in LARGE])
            line.append("" if math.isnan(power) else f"{power:.2f}")
        lines.append(line)
    heads = ["seconds", *(f"{size:,}" for size in SIZES), "exponent", "of CPU seconds"]
    return Table(heads, lines, found.values())


def memory_table():
    """Peak memory at the largest size, and bytes a Gaussian from the one before."""
    found, lines = measured(), []
    less, most = LARGE
    for command in RUNS:
        low, high = (found[command, count]["peak_bytes"] for count in (less, most))
        lines.append([command, f"{high / 1e9:.1f}", f"{(high - low) / (most - less):,.0f}"])
    return Table(["", f"GB at {most:,}", "bytes per Gaussian"], lines, found.values())


if __name__ == "__main__":
    main()
