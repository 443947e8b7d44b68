"""The picture of docs/scaling.md, and its estimate for a city of 100 million Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import scaling_rows as fit
from clod_adapter.report.style import QUIET, SERIES, label_log, new_figure, save_figure, tidy
from common import ROOT, Row, table

import numpy as np
from PIL import Image

PICTURE, PAGE = ROOT / "docs" / "images" / "scaling.png", ROOT / "docs" / "scaling.md"
# What is assumed of the city on paper, and of machines; the rest is fit.
CITY, PHOTOGRAPHS, SIZE = 100_000_000, 20_000, 1600 * 1000 / 1e6  # Gaussians; how many, of so many megapixels
BORDER = 0.2  # Gaussians around a block that go along frozen, of its own
BLOCK_STEPS, LOOKED_AT, HELD_OUT = 1500, 64, 64  # of a block; photographs for its start, and to measure it on
FOR_IMAGES = 0.25  # of the memory, as decoded photographs
CORES_OF_A_JOB, CORE_HOUR = 2, 0.05  # as measured; dollars
GPU_TIMES, GPU_HOUR = 30, 3.0  # times as fast as the two cores, all told; dollars
MEMORIES = (8, 16, 32, 64)  # GB for a job


def on_paper(rows: Sequence[Row]) -> str:
    """The city in blocks for jobs of a given memory: number of blocks, hours, price. Markdown."""
    each, rest = fit.bytes_a_gaussian(rows, "adapt")
    lines = []
    for memory in MEMORIES:
        room = int(((1 - FOR_IMAGES) * memory * 1e9 - rest) / each)
        blocks = math.ceil(CITY * (1 + BORDER) / room)
        training, other = block_seconds(rows, room)
        hours = (training + other) / 3600
        cores, gpu = blocks * hours * CORES_OF_A_JOB, blocks * hours / GPU_TIMES
        money = [f"{cores / 64:.1f}", f"{cores * CORE_HOUR:.1f}", f"{gpu:.1f}", f"{gpu * GPU_HOUR:.1f}"]
        spent = [f"{hours:.2f}, {training / 3600:.2f}", f"{cores:.0f}", *money]
        lines.append([memory, f"{room / 1e6:.1f} million", blocks, *spent])
    heads = ["a job's memory, GB", "Gaussians in a block", "blocks", "hours a block, of them training", "core-hours"]
    return table([*heads, "hours on 64 cores", "dollars", "on one assumed GPU: hours", "dollars"], lines)


def block_seconds(rows: Sequence[Row], count: int) -> tuple[float, float]:
    """Training, and everything else, for a block of so many Gaussians on the machine of the rows.

    In proportion from the largest city that was measured, the pruning order by n log n; a megapixel more of a
    photograph adds to each view what it does in the series over sizes.
    """
    row = fit.over_count(rows, "adapt")[-1]
    n, share = row["gaussians"], count / row["gaussians"]
    shapes = sorted((each for each in rows if each["series"] == "shapes"), key=fit.megapixels)[-2:]

    def a_megapixel(phase: str, views: int) -> float:
        """Seconds that it adds to a phase, for each of the views that were rendered."""
        if len(shapes) < 2:
            return 0.0
        more = shapes[1]["phases"][phase] - shapes[0]["phases"][phase]
        return max(more / (fit.megapixels(shapes[1]) - fit.megapixels(shapes[0])) / views, 0.0)

    trained, held_out = split(row["images"])
    larger = SIZE - fit.megapixels(row)
    step = fit.wall(row, "step") * share + larger * a_megapixel("step", 1)
    importance = fit.wall(row, "importance") / trained * share + larger * a_megapixel("start", split(fit.FEW)[0])
    evaluate = fit.wall(row, "evaluate") / held_out * share + larger * a_megapixel("evaluate", split(fit.FEW)[1])
    order = fit.wall(row, "order") * share * math.log(count) / math.log(n)
    fixed = (fit.wall(row, "load") + 2 * fit.wall(row, "write")) * share
    return BLOCK_STEPS * step, LOOKED_AT * importance + HELD_OUT * evaluate + order + fixed


def split(images: int) -> tuple[int, int]:
    """Photographs to train on, and held out: every eighth."""
    held_out = -(-images // 8)
    return images - held_out, held_out


def draw(rows: Sequence[Row]) -> None:
    """Four panels: seconds and memory of the commands, phases of adapting, adapting over photographs."""
    with new_figure((9.6, 7.2), layout="constrained") as figure:
        (a, b), (c, d) = figure.subplots(2, 2)
        for command, colour in zip(fit.COMMANDS, SERIES, strict=True):
            points = fit.times_of(rows, command)
            line(a, points, colour, f"{command}  {fit.growth(points)[0]:.2f}")
            memory = [(row["gaussians"], row["peak_bytes"] / 1e9) for row in fit.over_count(rows, command)]
            line(b, memory, colour, f"{command}  {fit.bytes_a_gaussian(rows, command)[0]:,.0f} B")
        for phase, colour in zip(fit.PHASES, (*SERIES, "#b8860b"), strict=True):
            points = fit.times_of(rows, "adapt", phase)
            line(c, points, colour, f"{phase}  {fit.growth(points)[0]:.2f}")
        guide(c, rows)
        for series, x, colour in (("images", itemgetter("images"), SERIES[0]), ("shapes", fit.megapixels, SERIES[1])):
            chosen = sorted((row for row in rows if row["series"] == series), key=x)
            name = "photographs" if series == "images" else "size of each"
            for key, style in (("start", "-"), ("step", "--"), ("evaluate", ":")):
                points = [(row["images"] * fit.megapixels(row), row["phases"][key]) for row in chosen]
                line(d, points, colour, f"{key}, {name}  {fit.exponent(points):.2f}", style)
        finish(a, "Seconds of a command, and exponent", "Gaussians", "seconds")
        finish(b, "Peak memory, and bytes a Gaussian", "Gaussians", "GB")
        finish(c, "Phases of adapting, and exponent", "Gaussians", "seconds; of one step")
        d.set_ylim(bottom=d.get_ylim()[0] / 8)  # room for six names
        finish(d, f"Adapting {fit.SERIES_COUNT:,} Gaussians", "megapixels of all photographs", "seconds; of one step")
        PICTURE.parent.mkdir(exist_ok=True)
        save_figure(figure, PICTURE)
    Image.open(PICTURE).convert("RGB").quantize(128).save(PICTURE, optimize=True)  # a third of the bytes


def line(axes: Any, points: Sequence[tuple[float, float]], colour: str, label: str, style: str = "-") -> None:
    shown = [(x, y) for x, y in points if y > 0 and x != fit.FLOOR]
    if shown:
        axes.plot(*zip(*shown, strict=True), style, color=colour, marker="o", markersize=4, linewidth=1.6, label=label)


def guide(axes: Any, rows: Sequence[Row]) -> None:
    """What n log n would be, through the last point of the pruning order."""
    points = fit.times_of(rows, "adapt", "order")
    if points:
        n, seconds = points[-1]
        x = np.array([size for size, _ in points if size != fit.FLOOR], float)
        axes.plot(x, seconds * x * np.log(x) / (n * math.log(n)), color=QUIET, linewidth=0.8, label="n log n")


def finish(axes: Any, title: str, x: str, y: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    axes.set_title(title, loc="left", fontsize=10, weight="bold")
    tidy(axes)
    label_log(axes.xaxis, "{:,.10g}", subs=(1,))
    label_log(axes.yaxis, "{:,.10g}", subs=(1,))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, fontsize=7.5)
