"""Time and memory of the commands against the number of Gaussians, and of adapting against photographs.

    python benchmarks/growth.py                            # all of it: some 15 minutes, 12 GB of memory, 8 GB of disk
    python benchmarks/growth.py --sizes 10000 100000       # some sizes
    python benchmarks/growth.py --only inspect view        # some commands
    python benchmarks/growth.py --plot                     # nothing is run: the picture and the page of the rows

Each command is run as a user runs it, in a process of its own, on cities (``city.py``) that are made once and kept in
benchmarks/cache. From outside come wall and CPU seconds and the resident memory, every 20 ms; from what the command
says on stderr and in its report, the phases that they belong to. A run on a city of 1000 Gaussians is the floor: what
starting up costs. Rows go to results/growth.jsonl; the last one of a kind counts. docs/images/growth.png shows them,
and docs/growth.md has them as tables, with what follows for a city of 100 million. Exponents are least squares in
logarithms, of the seconds above the floor, from 100k Gaussians on.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterable, Sequence
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from common import RESULTS, ROOT, append
from PIL import Image

from clod_adapter.report.style import QUIET, SERIES, label_log, new_figure, save, tidy

FILE, PICTURE, PAGE = "growth.jsonl", ROOT / "docs" / "images" / "growth.png", ROOT / "docs" / "growth.md"
CACHE = ROOT / "benchmarks" / "cache" / "growth"
COMMAND = (sys.executable, "-m", "clod_adapter.cli.main")
FLOOR, SIZES = 1000, (10_000, 100_000, 1_000_000, 5_000_000)
FROM = 100_000  # Gaussians from which on exponents are fitted: below, seconds are all start-up
COMMANDS = ("adapt", "eval", "export", "inspect", "view")
IMAGES, WIDTH, HEIGHT, STEPS, MAX_SV = 10, 640, 400, 8, 3
BUSY = 3.0  # a load of the machine from which on somebody else was at work too
SERIES_COUNT = 100_000  # Gaussians of the series over photographs
MANY, SMALL = (16, 64, 256), (320, 200)  # photographs, of this size
SHAPES, FEW = ((320, 200), (640, 400), (1280, 800), (1600, 1000)), 16  # sizes, of so many photographs
SAID = {
    "load": r": \d+ photographs to train on",
    "base": r"^base: ",
    "train": r"^trained ",
    "write": r"^wrote ",
}
# The order of leaving by itself, on the model as adapting has it: within the report it is a part of "start".
ORDER = """
import sys, time, torch
from clod_adapter.collapse import pruning_order
from clod_adapter.io.ply import load
g = load(sys.argv[1]).gaussians
worth = torch.rand(len(g), generator=torch.Generator().manual_seed(0)) ** 4
pruning_order(g.select(torch.arange(min(len(g), 1000))), worth[:1000])
began, cpu = time.perf_counter(), time.process_time()
pruning_order(g, worth)
print(time.perf_counter() - began, time.process_time() - cpu)
"""


class Run:
    """A process: the moments at which it said things, its memory over time, what it cost."""

    def __init__(self, words: Sequence[object], *, until: str = "") -> None:
        """Waits for its end; or with ``until`` for that text in a line on stdout, which becomes ``line``."""
        self.began = time.perf_counter()
        self.process = subprocess.Popen(
            [str(word) for word in words], text=True, cwd=tempfile.gettempdir(), stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        self.out, self.lines, self.moments, self.memory = (
            "",
            list[str](),
            dict[str, float](),
            list[tuple[float, int, float]](),
        )
        self.ended = False
        self.threads = [Thread(target=each, daemon=True) for each in (self._follow, self._sample)]
        for thread in self.threads:
            thread.start()
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.out += line
            if until and until in line:
                self.line = line
                return
        self.finish()

    def now(self) -> float:
        return time.perf_counter() - self.began

    def _follow(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line.rstrip())
            for name, pattern in SAID.items():
                if name not in self.moments and re.search(pattern, line):
                    self.moments[name] = self.now()

    def _sample(self) -> None:
        statm, stat = (Path(f"/proc/{self.process.pid}/{name}") for name in ("statm", "stat"))
        while not self.ended:
            try:
                pages = int(statm.read_text(encoding="utf-8").split()[1])
                used = stat.read_text(encoding="utf-8").rpartition(")")[2].split()
            except (OSError, IndexError):
                return
            cpu = (int(used[11]) + int(used[12])) / os.sysconf("SC_CLK_TCK")
            self.memory.append((self.now(), pages * os.sysconf("SC_PAGE_SIZE"), cpu))
            time.sleep(0.02)

    def finish(self) -> None:
        _, status, usage = os.wait4(self.process.pid, 0)
        self.seconds, self.ended = self.now(), True
        self.process.returncode = os.waitstatus_to_exitcode(status)
        for thread in self.threads:
            thread.join()
        self.cpu_seconds = usage.ru_utime + usage.ru_stime
        self.peak_bytes = usage.ru_maxrss * 1024
        if self.process.returncode != 0:
            sys.exit("\n".join([f"exit code {self.process.returncode}: {self.process.args}", *self.lines]))

    def cost(self) -> dict[str, Any]:
        return {
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
            "peak_bytes": self.peak_bytes,
        }

    def by_phase(self, ends: Iterable[tuple[str, float]]) -> tuple[dict[str, int], dict[str, float]]:
        """The most memory, and the CPU seconds, in phases that follow one another and end at these moments."""
        peaks, seconds, start, before = dict[str, int](), dict[str, float](), 0.0, 0.0
        for name, end in ends:
            samples = [(size, cpu) for at, size, cpu in self.memory if start <= at < end]
            peaks[name] = max((size for size, _ in samples), default=0)
            now = max((cpu for _, cpu in samples), default=before)
            seconds[name], start, before = round(now - before, 2), end, now
        return peaks, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, metavar="N", help="Gaussians (default: all)")
    parser.add_argument(
        "--only", nargs="+", default=(*COMMANDS, "images", "shapes"), choices=(*COMMANDS, "images", "shapes"),
        help="commands, and the series of adapt over the number and the size of photographs (default: all)",
    )  # fmt: skip
    parser.add_argument("--plot", action="store_true", help="run nothing")
    args = parser.parse_args()
    if not args.plot:
        measure(args.sizes, args.only)
    rows = latest()
    draw(rows)
    fill_in("figures", tables(rows))
    fill_in("paper", on_paper(rows))


def measure(sizes: Sequence[int], only: Sequence[str]) -> None:
    """Runs, and appends the rows."""
    CACHE.mkdir(parents=True, exist_ok=True)
    run_adapt(scene(FLOOR, IMAGES, WIDTH, HEIGHT))  # compiles what is not yet compiled
    for count in sorted({FLOOR, *sizes}):
        folder = scene(count, IMAGES, WIDTH, HEIGHT)
        if "adapt" in only or not dial_of(folder).exists():
            record("count", "adapt", folder, count, IMAGES, WIDTH, HEIGHT, run_adapt(folder) | order_seconds(folder))
        for command in COMMANDS[1:]:
            if command in only:
                record("count", command, folder, count, IMAGES, WIDTH, HEIGHT, RUNS[command](folder))
    for images in MANY if "images" in only else ():
        folder = scene(SERIES_COUNT, images, *SMALL)
        record("images", "adapt", folder, SERIES_COUNT, images, *SMALL, run_adapt(folder))
    for width, height in SHAPES if "shapes" in only else ():
        folder = scene(SERIES_COUNT, FEW, width, height)
        record("shapes", "adapt", folder, SERIES_COUNT, FEW, width, height, run_adapt(folder))


def scene(count: int, images: int, width: int, height: int) -> Path:
    """A city, made where it is not there."""
    folder = CACHE / f"city-{count}-{images}-{width}x{height}"
    if not folder.exists():
        # In a process of its own, so that its memory is given back.
        words = [sys.executable, Path(__file__).parent / "city.py", folder, "--count", count, "--images", images]
        subprocess.run([*map(str, words), "--size", str(width), str(height)], check=True)
    return folder


def dial_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}-dial.ply")


def record(
    series: str, command: str, folder: Path, count: int, images: int, width: int, height: int, found: dict[str, Any]
) -> None:
    append(FILE, {
        "series": series, "command": command, "gaussians": count, "images": images, "width": width, "height": height,
        "file_bytes": (folder / "city.ply").stat().st_size, "busy": round(os.getloadavg()[0], 2), **found,
    })  # fmt: skip


def run_adapt(folder: Path) -> dict[str, Any]:
    """A few steps: seconds and memory by phase."""
    out = dial_of(folder)
    run = Run([
        *COMMAND, folder / "city.ply", "--images", folder, "--iters", STEPS, "--max-sv", MAX_SV, "--out", out
    ])  # fmt: skip
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
    peaks, cpu = run.by_phase(moments)
    return {
        **run.cost(), "steps": STEPS, "phases": {name: round(value, 4) for name, value in phases.items()},
        "phase_peaks": peaks, "phase_cpu": cpu, "psnr": report["base_rows"][0]["psnr"],
    }  # fmt: skip


def order_seconds(folder: Path) -> dict[str, Any]:
    wall, cpu = (round(float(word), 3) for word in Run([sys.executable, "-c", ORDER, folder / "city.ply"]).out.split())
    return {"order_seconds": wall, "order_cpu": cpu}


def run_eval(folder: Path) -> dict[str, Any]:
    return Run([*COMMAND, "eval", dial_of(folder), "--images", folder, "--sv", 1, MAX_SV]).cost()


def run_export(folder: Path) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(dir=CACHE) as out:
        return Run([*COMMAND, "export", dial_of(folder), "-o", Path(out) / "plain.ply", "--sv", 1.5]).cost()


def run_inspect(folder: Path) -> dict[str, Any]:
    return Run([*COMMAND, "inspect", dial_of(folder)]).cost()


def run_view(folder: Path) -> dict[str, Any]:
    """Until the address is printed, and until a page would have all of the model; no browser."""
    run = Run([*COMMAND, "view", dial_of(folder), "--images", folder, "--no-browser"], until="http://")
    address, size = run.now(), 0
    with urllib.request.urlopen(run.line.split()[0] + "files/model") as answer:
        while block := answer.read(1 << 20):
            size += len(block)
    served = run.now()
    run.process.send_signal(signal.SIGINT)
    run.finish()
    return run.cost() | {"seconds": round(served, 3), "address_seconds": round(address, 3), "served_bytes": size}


RUNS = {"eval": run_eval, "export": run_export, "inspect": run_inspect, "view": run_view}


def latest() -> list[dict[str, Any]]:
    """The last row of each kind."""
    found = {}
    for line in (RESULTS / FILE).read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        found[tuple(row[key] for key in ("series", "command", "gaussians", "images", "width", "height"))] = row
    return [found[key] for key in sorted(found)]


def exponent(points: Sequence[tuple[float, float]]) -> float:
    """Of the power of x that y follows, by least squares in logarithms; NaN of fewer than two points."""
    usable = [point for point in points if point[1] > 0]
    return float(np.polyfit(*np.log(usable).T, 1)[0]) if len(usable) > 1 else math.nan


def over_count(rows: Sequence[dict[str, Any]], command: str) -> list[dict[str, Any]]:
    return [row for row in rows if row["series"] == "count" and row["command"] == command]


def seconds_of(rows: Sequence[dict[str, Any]], command: str, phase: str = "") -> list[tuple[float, float]]:
    """(Gaussians, seconds) of a command, or of a phase of adapting."""
    return [(row["gaussians"], phase_of(row, phase)) for row in over_count(rows, command)]


def phase_of(row: dict[str, Any], phase: str) -> float:
    if not phase:
        return row["seconds"]
    if phase == "importance":
        return row["phases"]["start"] - row["order_seconds"]
    return row["order_seconds"] if phase == "order" else row["phases"][phase]


PHASES = ("load", "importance", "order", "step", "evaluate", "write")


def cpu_of(rows: Sequence[dict[str, Any]], command: str, phase: str = "") -> list[tuple[float, float]]:
    """(Gaussians, CPU seconds) of a command, or of a phase of adapting: these hardly know who else is at work."""
    return [
        (row["gaussians"], phase_cpu(row, phase))
        for row in over_count(rows, command)
        if "phase_cpu" in row or not phase
    ]


def phase_cpu(row: dict[str, Any], phase: str) -> float:
    if not phase or phase == "order":
        return row["order_cpu"] if phase else row["cpu_seconds"]
    of = row["phase_cpu"]
    return {
        "load": of["load"], "importance": of["start"] - row["order_cpu"], "step": of["train"] / row["steps"],
        "evaluate": of["base"] + of["measure and write again"] - of["write"], "write": of["write"],
    }[phase]  # fmt: skip


def growth(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The exponent above the floor from FROM on, and that of the last two sizes with the floor in it."""
    floor = dict(points).get(FLOOR, 0.0)
    fitted = exponent([(x, y - floor) for x, y in points if x >= FROM])
    return fitted, exponent(points[-2:])


def bytes_a_gaussian(rows: Sequence[dict[str, Any]], command: str) -> tuple[float, float]:
    """What each Gaussian adds to the peak, and the peak without any: a line through the largest two sizes."""
    points = [(row["gaussians"], row["peak_bytes"]) for row in over_count(rows, command)][-2:]
    if len(points) < 2:
        return math.nan, math.nan
    (n, low), (m, high) = points
    each = (high - low) / (m - n)
    return each, low - each * n


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown for docs/growth.md."""
    sizes = sorted({row["gaussians"] for row in rows if row["series"] == "count"})
    head = "| | " + " | ".join(f"{size:,}" for size in sizes) + " | exponent | last two | exponent of CPU |"
    busy = max(row["busy"] for row in rows)
    lines = [f"**Preliminary**: the machine's load was up to {busy:.0f} while these rows were taken, so wall times are "
             "several times too long; the CPU's and memory stand.", ""] if busy > BUSY else []  # fmt: skip
    lines += [head, "|---" * (len(sizes) + 4) + "|"]
    cases = [(command, "") for command in COMMANDS] + [("adapt", phase) for phase in PHASES]
    for command, phase in cases:
        points = seconds_of(rows, command, phase)
        fitted, last = growth(points)
        cells = [f"{dict(points)[size]:.3g}" if size in dict(points) else "" for size in sizes]
        powers = " | ".join(f"{power:.2f}" for power in (fitted, last, growth(cpu_of(rows, command, phase))[0]))
        lines.append(f"| {phase or command} | {' | '.join(cells)} | {powers} |")
    lines += ["", "| | peak, GB | | bytes a Gaussian | besides, MB |", "|---|---|---|---|---|"]
    for command in COMMANDS:
        each, rest = bytes_a_gaussian(rows, command)
        peaks = [f"{row['gaussians']:,}: {row['peak_bytes'] / 1e9:.2f}" for row in over_count(rows, command)[-2:]]
        lines.append(f"| {command} | {' | '.join(peaks or ['', ''])} | {each:,.0f} | {rest / 1e6:,.0f} |")
    for row in over_count(rows, "adapt")[-1:]:
        peaks = row["phase_peaks"]
        lines += ["", f"| adapt, {row['gaussians']:,}: up to | {' | '.join(peaks)} |", "|---" * (len(peaks) + 1) + "|"]
        per = " | ".join(f"{peak / row['gaussians']:,.0f}" for peak in peaks.values())
        lines.append(f"| resident bytes a Gaussian | {per} |")
    for series, name, x in (("images", "photographs", photographs), ("shapes", "megapixels", megapixels)):
        chosen = sorted((row for row in rows if row["series"] == series), key=x)
        lines += ["", f"| adapt over {name} | seconds | start | step | evaluate | load | peak, GB |", "|---" * 7 + "|"]
        for row in chosen:
            times = " | ".join(f"{row['phases'][key]:.3g}" for key in ("start", "step", "evaluate", "load"))
            lines.append(f"| {x(row):.3g} | {row['seconds']:.3g} | {times} | {row['peak_bytes'] / 1e9:.2f} |")
        powers = [exponent([(x(row), row["phases"][key]) for row in chosen]) for key in ("start", "step", "evaluate")]
        lines.append(f"| exponent | | {' | '.join(f'{power:.2f}' for power in powers)} | | |")
    return "\n".join(lines)


def fill_in(name: str, text: str) -> None:
    """Puts the text between the page's comments of this name, and prints it."""
    begin, end = f"<!-- {name}: written by benchmarks/growth.py -->", f"<!-- end of {name} -->"
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(begin)
    PAGE.write_text(f"{before}{begin}\n\n{text}\n\n{end}{rest.partition(end)[2]}", encoding="utf-8")
    print(text)


# What is assumed of the city on paper, and of machines; the rest is measured.
CITY, PHOTOGRAPHS, SIZE = 100_000_000, 20_000, 1600 * 1000 / 1e6  # Gaussians; how many, of so many megapixels
BORDER = 0.2  # Gaussians around a block that go along frozen, of its own
BLOCK_STEPS, LOOKED_AT, HELD_OUT = 1500, 64, 64  # of a block; photographs for its start, and to measure it on
FOR_IMAGES = 0.25  # of the memory, as decoded photographs
CORES_OF_A_JOB, CORE_HOUR = 2, 0.05  # as measured; dollars
GPU_TIMES, GPU_HOUR = 30, 3.0  # times as fast as the two cores, all told; dollars
MEMORIES = (8, 16, 32, 64)  # GB for a job


def on_paper(rows: Sequence[dict[str, Any]]) -> str:
    """The city in blocks, for jobs of some memory: how many, how long, at what price. Markdown."""
    each, rest = bytes_a_gaussian(rows, "adapt")
    lines = ["| a job's memory, GB | Gaussians in a block | blocks | hours a block, of them training | core-hours | "
             "hours on 64 cores | dollars | on one assumed GPU: hours | dollars |", "|---" * 9 + "|"]  # fmt: skip
    for memory in MEMORIES:
        room = int(((1 - FOR_IMAGES) * memory * 1e9 - rest) / each)
        blocks = math.ceil(CITY * (1 + BORDER) / room)
        training, other = block_seconds(rows, room)
        hours = (training + other) / 3600
        core_hours, gpu_hours = blocks * hours * CORES_OF_A_JOB, blocks * hours / GPU_TIMES
        lines.append(
            f"| {memory} | {room / 1e6:.1f} million | {blocks} | {hours:.2f}, {training / 3600:.2f} | {core_hours:.0f} "
            f"| {core_hours / 64:.1f} | {core_hours * CORE_HOUR:.1f} | {gpu_hours:.1f} | {gpu_hours * GPU_HOUR:.1f} |"
        )
    return "\n".join(lines)


def block_seconds(rows: Sequence[dict[str, Any]], count: int) -> tuple[float, float]:
    """Training, and everything else, for a block of so many Gaussians on the machine of the rows.

    In proportion from the largest city that was measured, the order of leaving by n log n; a megapixel more of a
    photograph adds to each view what it does in the series over sizes.
    """
    row = over_count(rows, "adapt")[-1]
    n, share = row["gaussians"], count / row["gaussians"]
    shapes = sorted((each for each in rows if each["series"] == "shapes"), key=megapixels)[-2:]

    def a_megapixel(phase: str, views: int) -> float:
        """Seconds that it adds to a phase, for each of the views that were rendered."""
        if len(shapes) < 2:
            return 0.0
        more = shapes[1]["phases"][phase] - shapes[0]["phases"][phase]
        return max(more / (megapixels(shapes[1]) - megapixels(shapes[0])) / views, 0.0)

    trained, held_out = split(row["images"])
    larger = SIZE - megapixels(row)
    step = phase_of(row, "step") * share + larger * a_megapixel("step", 1)
    importance = phase_of(row, "importance") / trained * share + larger * a_megapixel("start", split(FEW)[0])
    evaluate = phase_of(row, "evaluate") / held_out * share + larger * a_megapixel("evaluate", split(FEW)[1])
    order = phase_of(row, "order") * share * math.log(count) / math.log(n)
    fixed = (phase_of(row, "load") + 2 * phase_of(row, "write")) * share
    return BLOCK_STEPS * step, LOOKED_AT * importance + HELD_OUT * evaluate + order + fixed


def split(images: int) -> tuple[int, int]:
    """Photographs to train on, and held out: every eighth."""
    held_out = -(-images // 8)
    return images - held_out, held_out


def photographs(row: dict[str, Any]) -> float:
    return row["images"]


def megapixels(row: dict[str, Any]) -> float:
    return row["width"] * row["height"] / 1e6


def draw(rows: Sequence[dict[str, Any]]) -> None:
    """Four panels: seconds and memory of the commands, phases of adapting, adapting over photographs."""
    with new_figure((9.6, 7.2), layout="constrained") as figure:
        (a, b), (c, d) = figure.subplots(2, 2)
        for command, colour in zip(COMMANDS, SERIES, strict=True):
            points = seconds_of(rows, command)
            line(a, points, colour, f"{command}  {growth(points)[0]:.2f}")
            memory = [(row["gaussians"], row["peak_bytes"] / 1e9) for row in over_count(rows, command)]
            line(b, memory, colour, f"{command}  {bytes_a_gaussian(rows, command)[0]:,.0f} B")
        for phase, colour in zip(PHASES, (*SERIES, "#b8860b"), strict=True):
            points = seconds_of(rows, "adapt", phase)
            line(c, points, colour, f"{phase}  {growth(points)[0]:.2f}")
        guide(c, rows)
        for series, x, colour in (("images", photographs, SERIES[0]), ("shapes", megapixels, SERIES[1])):
            chosen = sorted((row for row in rows if row["series"] == series), key=x)
            name = "photographs" if series == "images" else "size of each"
            for key, style in (("start", "-"), ("step", "--"), ("evaluate", ":")):
                points = [(row["images"] * megapixels(row), row["phases"][key]) for row in chosen]
                line(d, points, colour, f"{key}, {name}  {exponent(points):.2f}", style)
        finish(a, "Seconds of a command, and exponent", "Gaussians", "seconds")
        finish(b, "Peak memory, and bytes a Gaussian", "Gaussians", "GB")
        finish(c, "Phases of adapting, and exponent", "Gaussians", "seconds; of one step")
        d.set_ylim(bottom=d.get_ylim()[0] / 8)  # room for six names
        finish(d, f"Adapting {SERIES_COUNT:,} Gaussians", "megapixels of all photographs", "seconds; of one step")
        PICTURE.parent.mkdir(exist_ok=True)
        save(figure, PICTURE)
    Image.open(PICTURE).convert("RGB").quantize(128).save(PICTURE, optimize=True)  # a third of the bytes


def line(axes: Any, points: Sequence[tuple[float, float]], colour: str, label: str, style: str = "-") -> None:
    shown = [(x, y) for x, y in points if y > 0 and x != FLOOR]
    if shown:
        axes.plot(*zip(*shown, strict=True), style, color=colour, marker="o", markersize=4, linewidth=1.6, label=label)


def guide(axes: Any, rows: Sequence[dict[str, Any]]) -> None:
    """What n log n would be, through the last point of the order of leaving."""
    points = seconds_of(rows, "adapt", "order")
    if points:
        n, seconds = points[-1]
        x = np.array([size for size, _ in points if size != FLOOR], float)
        axes.plot(x, seconds * x * np.log(x) / (n * math.log(n)), color=QUIET, linewidth=0.8, label="n log n")


def finish(axes: Any, title: str, x: str, y: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    axes.set_title(title, loc="left", fontsize=10, weight="bold")
    tidy(axes)
    label_log(axes.xaxis, "{:,.10g}", subs=(1,))
    label_log(axes.yaxis, "{:,.10g}", subs=(1,))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, fontsize=7.5)


if __name__ == "__main__":
    main()
