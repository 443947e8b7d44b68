"""The figure and the tables of walk.py, from a stored row."""

from __future__ import annotations

from itertools import pairwise
from statistics import fmean
from typing import Any

from clod_adapter.report.style import BLUE, GREEN, INK, ORANGE, PURPLE, QUIET, label_log, new_figure, save_figure, tidy
from common import ROOT, Row, table
from walk_town import NEAREST, TIMES, Town

FILE = "walk.jsonl"
PICTURE, PAGE = ROOT / "docs" / "images" / "walk.png", ROOT / "docs" / "method.md"
COLOURS = {
    "base": INK, "dial, s = 1": BLUE, "cost, s = 1": QUIET, "dial, held": GREEN, "levels": ORANGE, "merged": PURPLE
}  # fmt: skip
BANDS = (1.0, 3.0, 10.0, 30.0, 100.0)  # times the nearest distance
WITHIN = ((0.1, False), (0.25, False), (0.25, True))  # dB below the base; or below the better of it and s = 1


def summary(row: Row) -> str:
    """Time and PSNR against the base by distance; time saved at equal quality, and the largest change; targets."""
    return f"{by_distance(row)}\n\n{at_equal_quality(row)}\n\n{of_targets(row)}"


def by_distance(row: Row) -> str:
    names, lines = list(row["frames"]), []
    bands = [(NEAREST * low, NEAREST * high) for low, high in pairwise(BANDS)]
    for low, high in [*bands, (NEAREST, NEAREST * TIMES)]:
        inside = [k for k, d in enumerate(row["distances"]) if low * 0.999 <= d <= high * 1.001]
        means = {name: {key: fmean(row["frames"][name][key][k] for k in inside) for key in ("ms", "psnr", "in_view")}
                 for name in names}  # fmt: skip
        base = means.pop("base")
        cells = [f"{base['ms']:.1f} ms, {base['psnr']:.2f} dB"]
        cells += [f"{one['ms'] / base['ms']:.0%}, {one['psnr'] - base['psnr']:+.2f} dB" for one in means.values()]
        lines.append([f"{low:.0f} to {high:.0f} m", *(cell.replace("%", " %") for cell in cells)])
    return table(["distance", *names], lines)


def at_equal_quality(row: Row) -> str:
    methods = [name for name in row["equal"][0] if name != "base"]
    lines = []
    for within, better in WITHIN:
        than = "the better of base and s = 1" if better else "the base"
        shares = [f"{saved(row, name, within, better):.0%}".replace("%", " %") for name in methods]
        lines.append([f"time saved, at most {within:g} dB below {than}", *shares])
    for key, text in (("largest", "largest change between frames"), ("persistence", "its persistence")):
        names = {name: name if name in row["changes"] else f"{name}, s = 1" for name in methods}
        lines.append([text, *(f"{row['changes'][names[name]][key]:.2f}" for name in methods)])
    return table(["", *methods], lines)


def of_targets(row: Row) -> str:
    """Both targets at each dial value, against the base: shares of its time and of its Gaussians in view; PSNR."""
    lines = []
    base = [frame["base"][0] for frame in row["equal"]]
    for k, s in enumerate(row["turned"]):
        cells = []
        for name in ("dial", "cost"):
            found = [frame[name][k] for frame in row["equal"]]
            ms, seen = (sum(x[key] for x in found) / sum(x[key] for x in base) for key in ("ms", "in_view"))
            psnr = fmean(x["psnr"] for x in found) - fmean(x["psnr"] for x in base)
            cells += [f"{ms:.0%}".replace("%", " %"), f"{seen:.0%}".replace("%", " %"), f"{psnr:+.2f} dB"]
        lines.append([f"{s:.3g}", *cells])
    heads = [f"{target}: {what}" for target in ("count", "cost") for what in ("time", "in view", "PSNR")]
    return table(["s", *heads], lines)


def saved(row: Row, method: str, within: float, better: bool) -> float:
    """The share of the base's time that the method's fastest setting saves; the base is drawn where none is as good."""
    base_ms = fastest_ms = 0.0
    for frame in row["equal"]:
        base = frame["base"][0]
        least = max(base["psnr"], frame["dial"][0]["psnr"] if better else 0.0) - within
        base_ms += base["ms"]
        fastest_ms += min([each["ms"] for each in frame[method] if each["psnr"] >= least] + [base["ms"]])
    return 1 - fastest_ms / base_ms


def draw(row: Row, town: Town) -> None:
    """The frames at BANDS; time, Gaussians in view, PSNR and change of the level of detail, against distance."""
    with new_figure((10.4, 8.6), layout="constrained") as figure:
        above, below = figure.subfigures(2, 1, height_ratios=[1.0, 4.2])
        ends = [round(k * (len(row["distances"]) - 1) / (len(BANDS) - 1)) for k in range(len(BANDS))]
        path = town.path(len(row["distances"]))
        for axes, k in zip(above.subplots(1, len(BANDS)), ends, strict=True):
            axes.imshow(town.photograph(path[k]).image.numpy())
            axes.set_title(f"{row['distances'][k]:.0f} m", loc="left", fontsize=9)
            axes.set_axis_off()
        panels = below.subplots(2, 2).flat
        keys = (("ms", "milliseconds of a frame"), ("in_view", "Gaussians in view, thousands"), ("psnr", "PSNR (dB)"))
        for axes, (key, title) in zip(panels, keys, strict=False):
            scale = 1e-3 if key == "in_view" else 1.0
            for name, values in row["frames"].items():
                style = {"linestyle": "--"} if name == "base" else {}
                line = [scale * value for value in values[key]]
                axes.plot(row["distances"], line, color=COLOURS[name], linewidth=1.6, label=name, **style)
            finish(axes, title)
            if key != "psnr":
                axes.set_ylim(bottom=0)
        panels = list(below.axes)
        panels[0].legend(frameon=False, fontsize=8.5)
        draw_changes(panels[3], row)
        PICTURE.parent.mkdir(exist_ok=True)
        save_figure(figure, PICTURE)


def draw_changes(axes: Any, row: Row) -> None:
    """A line for a dial; a point for each switch of levels."""
    for name, found in row["changes"].items():
        points = [(d, each) for d, each in zip(row["distances"][1:], found["each"], strict=True) if each > 0]
        dialled = name.endswith(("s = 1", "held"))
        style = {"linewidth": 1.6} if dialled else {"linestyle": "none", "marker": "o", "markersize": 4}
        label = f"{name}: largest {found['largest']:.2g}"
        axes.plot(*zip(*points, strict=True), color=COLOURS[name], label=label, **style)
    axes.set_yscale("log")
    finish(axes, "change between frames, same camera (RMS of 255)")
    axes.legend(frameon=False, fontsize=8.5)


def finish(axes: Any, title: str) -> None:
    axes.set(xscale="log", xlabel="metres from the door")
    axes.set_title(title, loc="left", fontsize=10, weight="bold")
    tidy(axes)
    label_log(axes.xaxis, "{:g}", (1, 2, 4))
