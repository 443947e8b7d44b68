"""Popping: the largest change of any pixel per step, for every normalizer and threshold, by the length of the steps.

The scene is made to pop: Gaussians in one place with one extinction scale, and one far away that enters the frustum
while the camera turns. A fade changes in proportion to the step's length (slope 1), a pop by the same amount (slope 0).
The default, one D for the scene and the soft threshold, has a bound. For the drawn opacities (``attenuation``), and
for the footprint f of a Gaussian on a pixel, ``exp(-q/2)`` times the compensation of the screen filter::

    |change of opacity| <= L h    L = 2 x (1.5 - 4 ln x), x = min(1.5 tau max_sv, exp(-5/8)); at most 4.3
    |change of f| <= 2/e G h      G = max |growth_d|

``h`` is the change of ``log s``, or of the logarithm of the distance. With ``n`` the largest number of Gaussians on one
pixel and ``W`` the largest sum of their footprints, no pixel changes by more than ``255 (W L + 2/e n G) h + n`` levels:
rasterizers drop an alpha < 1/255. each Gaussian changes by at most that, and a pixel is their sum.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import clod_adapter as clod
from clod_adapter.config import CUTS, NORMALIZERS, AttenuationConfig
from clod_adapter.equation.attenuation import dial
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.extinction import sigma_for_extinction
from clod_adapter.evaluation.popping import dial_popping, path, path_popping
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.render import splat
from clod_adapter.report.style import BLUE, GREEN, INK, ORANGE, label_log, new_figure, save_figure, tidy
from common import table

import torch
from torch import Tensor

STEPS = (20, 40, 80, 160)
SWEEPS = {"dial": "the dial from 1 to 5", "turn": "a camera that turns, s = 2", "path": "a camera that moves, s = 2"}
OTHERS, TOGETHER, SCALE = 120, 4, 2.0
GROWTH, INTERVALS = 0.75, 8  # growth_d that preserves area; of a sweep, for its bound
DEFAULT = ("scene", "soft")
DISTANCE = 4.0  # of the camera from the middle


def measure() -> list[dict[str, Any]]:
    rows = []
    for normalizer, cut, growth in [*product(NORMALIZERS, CUTS, [0.0]), (*DEFAULT, GROWTH)]:
        some, cameras = scene(normalizer, cut)
        some = some.replace(growth_d=torch.full((len(some),), growth))
        for sweep, steps in product(SWEEPS, STEPS):
            found = _sweep(some, cameras, sweep, steps)
            row = {"part": "popping", "normalizer": normalizer, "cut": cut, "growth": growth, "sweep": sweep,
                   "steps": steps, "pixel": found.pixel, "persistence": found.pixel_persistence}  # fmt: skip
            if (normalizer, cut) == DEFAULT:
                row["bound"] = bound(some, cameras, sweep, steps)
            rows.append(row)
    return rows


def scene(normalizer: str, cut: str) -> tuple[Gaussians, dict[str, list[clod.Camera]]]:
    """The Gaussians, and by name of the sweep the cameras it goes through."""
    draw = torch.Generator().manual_seed(0)
    n = OTHERS + TOGETHER + 1
    means = torch.randn(n, 3, generator=draw) * torch.tensor([1.2, 0.9, 1.2])
    means[OTHERS:-1], means[-1] = torch.tensor([0.3, 0.2, -0.5]), torch.tensor([30.0, 0.0, 40.0])
    log_scales = (0.5 * torch.randn(n, 3, generator=draw)) + math.log(0.08)
    log_scales[OTHERS:] = math.log(0.25)
    colours = torch.rand(n, 1, 3, generator=draw)
    colours[OTHERS:-1] = 1.0
    logits = 2 * torch.randn(n, generator=draw) + 1
    logits[OTHERS:] = 3.0
    quats = torch.randn(n, 4, generator=draw)
    plain = Gaussians(means, quats, log_scales, logits, (colours - 0.5) / SH_C0, torch.empty(n, 0, 3))
    config = clod.AdaptConfig()
    settings = replace(config.attenuation(DISTANCE), normalizer=normalizer, cut=cut)
    eye = torch.tensor([0.0, 0.0, -DISTANCE])
    start = _looking(eye, torch.zeros(3))
    cameras = {
        "dial": [start],
        "turn": [start, _looking(eye, torch.tensor([2.5, 0.0, 0.0]))],
        "path": [start, _looking(torch.tensor([1.5, 0.3, -3.5]), torch.tensor([1.0, 0.0, 0.0]))],
    }
    leave = config.max_sv ** torch.rand(n, generator=draw)
    leave[OTHERS:-1] = 2.2
    distances = normalized_distances(means, start, settings)
    sigma = sigma_for_extinction(logits, distances, leave, settings).clamp(max=100.0)
    return clod.with_dial(plain, sigma, settings), cameras


def _looking(eye: Tensor, at: Tensor, width: int = 48, height: int = 36) -> clod.Camera:
    forward = torch.nn.functional.normalize(at - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), forward), dim=0)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    K = torch.tensor([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1.0]])
    return clod.Camera(viewmat, K, width, height)


def _sweep(some: Gaussians, cameras: dict[str, list[clod.Camera]], sweep: str, steps: int) -> Any:
    assert some.attenuation is not None
    if sweep == "dial":
        return dial_popping(some, cameras[sweep][0], some.attenuation.max_sv, steps=steps)
    return path_popping(some, cameras[sweep], SCALE, steps=steps)


def steepest(config: AttenuationConfig) -> float:
    """L: by how much an opacity under the soft threshold can change per unit of log s."""
    x = min(1.5 * config.tau * config.max_sv, math.exp(-0.625))
    return max(2 * x * (1.5 - 4 * math.log(x)), 2 / math.e)


@torch.no_grad()
def bound(some: Gaussians, cameras: dict[str, list[clod.Camera]], sweep: str, steps: int) -> float:
    """``255 (W L + 2/e n G) h + n``, the most that a pixel can change in a step of the default; 0 if no distance does.

    W and n are the largest of a few intervals of the sweep, of the Gaussians that an interval keeps somewhere, with
    their largest scales in it; growth_d is >= 0.
    """
    assert some.attenuation is not None and some.growth_d is not None
    if sweep == "turn":
        return 0.0
    if sweep == "dial":
        h = math.log(some.attenuation.max_sv) / steps
        positions = [(cameras[sweep][0], some.attenuation.max_sv ** (k / INTERVALS)) for k in range(INTERVALS + 1)]
    else:
        seen = path(cameras[sweep], steps)
        away = torch.stack([(some.means - camera.position).norm(dim=1) for camera in seen]).log()
        h = float((away[1:] - away[:-1]).abs().max())
        positions = [(camera, SCALE) for camera in seen[:: max(steps // INTERVALS, 1)]]
    sums, counts = 0.0, 0
    for ends in pairwise(positions):
        turned = [dial(some, *end) for end in ends]
        growth = torch.stack([each.growth for each in turned]).amax(0)
        grown = some.replace(log_scales=some.log_scales + growth.log()[:, None])
        rows = torch.stack([each.keep for each in turned]).any(0).nonzero()
        covers = torch.stack([splat(grown.select(row), torch.ones(1), ends[1][0])[1] for row in rows])
        sums, counts = max(sums, float(covers.sum(0).max())), max(counts, int((covers > 0).sum(0).max()))
    growing = 2 / math.e * counts * float(some.growth_d.abs().max())
    return 255 * h * (sums * steepest(some.attenuation) + growing) + counts


def tables(rows: list[dict[str, Any]]) -> str:
    """Largest change of a pixel in the longest and the shortest steps; the default's bound below its row."""
    ends, lines = [(name, steps) for name in SWEEPS for steps in (min(STEPS), max(STEPS))], []
    for key in dict.fromkeys((row["normalizer"], row["cut"], row["growth"]) for row in rows):
        own = {(r["sweep"], r["steps"]): r for r in rows if (r["normalizer"], r["cut"], r["growth"]) == key}
        normalizer, cut, growth = key
        of = f", growth_d {growth:g}" if growth else " (default)" if key[:2] == DEFAULT else ""
        lines.append([f"{normalizer}{of}", cut, *(f"{own[end]['pixel']:.1f}" for end in ends)])
        if key[:2] == DEFAULT:
            lines.append(["its bound", "", *(f"{min(own[end]['bound'], 255):.0f}" for end in ends)])
    held = all(row["pixel"] <= row["bound"] + 0.05 for row in rows if "bound" in row)
    found = table(["normalizer", "threshold", *(f"{name}: 1/{steps}" for name, steps in ends)], lines)
    return f"{found}\n\nThe bound {'holds' if held else 'IS BROKEN'}."


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    """Log-log, a panel a sweep: a colour a normalizer, dashes for the hard threshold; without growth."""
    rows, colours = [row for row in rows if not row["growth"]], {"scene": BLUE, "quantile": GREEN, "max": ORANGE}
    with new_figure((10.4, 3.9), layout="constrained") as figure:
        panels = figure.subplots(1, len(SWEEPS), sharey=True)
        for axes, (sweep, title) in zip(panels, SWEEPS.items(), strict=True):
            for normalizer, cut in dict.fromkeys((row["normalizer"], row["cut"]) for row in rows):
                own = [r for r in rows if (r["normalizer"], r["cut"], r["sweep"]) == (normalizer, cut, sweep)]
                default = (normalizer, cut) == DEFAULT
                axes.plot(
                    [1 / r["steps"] for r in own], [max(r["pixel"], 0.2) for r in own], color=colours[normalizer],
                    linestyle="-" if cut == "soft" else "--", linewidth=1.4 + default,
                    label=f"{normalizer}, {cut}{' (default)' if default else ''}",
                )  # fmt: skip
            limits = [r for r in rows if r["sweep"] == sweep and r.get("bound", 0) > 0]
            axes.plot([1 / r["steps"] for r in limits], [r["bound"] for r in limits], color=INK, linewidth=1.2,
                      linestyle=":", label="bound of the default")  # fmt: skip
            axes.set_title(title, loc="left", fontsize=9.5)
            axes.set(xscale="log", yscale="log", ylim=(0.15, 500))
            axes.set_xticks([1 / steps for steps in STEPS], [f"1/{steps}" for steps in STEPS])
            axes.set_xticks([], minor=True)
            label_log(axes.yaxis, "{:g}", subs=(1,))
            tidy(axes)
        panels[0].set_ylabel("largest change of a pixel in a step (of 255)")
        panels[1].set_xlabel("length of a step, share of the sweep")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", frameon=False, ncols=4)
        save_figure(figure, path)
