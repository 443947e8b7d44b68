"""Popping: the largest change of any pixel per step, for every normaliser and cut, as the steps get shorter.

    python benchmarks/stability_popping.py

Made to pop: Gaussians that lie in one place and leave at one dial value, and one far away that enters the frustum while
the camera turns, among others that leave at dial values of their own. Three sweeps, each in steps of four lengths: the
dial from 1 to max_sv, a camera that turns where it stands, a camera that moves and turns. What fades changes in
proportion to the step's length (slope 1), what pops by as much however short the step (slope 0).

The default, one D for the scene and the soft cut, has a bound. For the opacities that are drawn (``attenuation``)::

    |change of opacity| <= L h    L = 2 x (1.5 - 4 ln x), x = min(1.5 tau max_sv, exp(-5/8)); at most 4.3

``h`` being the change of ``log s``, or of the logarithm of the distance. Rasterizers drop an alpha below 1/255, one
level of a pixel. So, with ``W`` the largest sum of the Gaussians' footprints over one pixel and colours within 0 and 1,
no pixel changes by more than ``W (255 L h + 1)`` levels.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import clod_adapter  # noqa: F401  # before torch: it sets how OpenMP's threads wait

# isort: split
import torch
from common import ROOT
from torch import Tensor

from clod_adapter.adapter import attach
from clod_adapter.cameras import Camera
from clod_adapter.config import CUTS, NORMALIZERS, AdaptConfig, AttenuationConfig
from clod_adapter.distances import normalized_distances
from clod_adapter.evaluation.popping import dial_popping, path, path_popping
from clod_adapter.extinction import sigma_for_extinction
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.render import splat
from clod_adapter.report.style import BLUE, GREEN, INK, ORANGE, QUIET, label_log, new_figure, save, tidy

PICTURE = "stability_popping.png"
STEPS = (20, 40, 80, 160)
SWEEPS = {"dial": "the dial from 1 to 5", "turn": "a camera that turns, s = 2", "path": "a camera that moves, s = 2"}
OTHERS, TOGETHER, SCALE = 120, 4, 2.0
DISTANCE = 4.0  # of the camera from the middle


def main() -> None:
    rows = measure()
    plot(rows, ROOT / "docs" / "images")
    print(markdown(rows))


def measure() -> list[dict[str, Any]]:
    rows = []
    for normalizer in NORMALIZERS:
        for cut in CUTS:
            some, cameras = scene(normalizer, cut)
            for sweep in SWEEPS:
                for steps in STEPS:
                    found = _sweep(some, cameras, sweep, steps)
                    row = {"part": "popping", "normalizer": normalizer, "cut": cut, "sweep": sweep, "steps": steps,
                           "pixel": found.pixel, "persistence": found.pixel_persistence}  # fmt: skip
                    if (normalizer, cut) == ("scene", "soft"):
                        row["bound"] = bound(some, cameras, sweep, steps)
                    rows.append(row)
    return rows


def scene(normalizer: str, cut: str) -> tuple[Gaussians, dict[str, list[Camera]]]:
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
    config = AdaptConfig()
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
    return attach(plain, sigma, settings), cameras


def _looking(eye: Tensor, at: Tensor, width: int = 48, height: int = 36) -> Camera:
    forward = torch.nn.functional.normalize(at - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), forward), dim=0)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    K = torch.tensor([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1.0]])
    return Camera(viewmat, K, width, height)


def _sweep(some: Gaussians, cameras: dict[str, list[Camera]], sweep: str, steps: int) -> Any:
    assert some.attenuation is not None
    if sweep == "dial":
        return dial_popping(some, cameras[sweep][0], some.attenuation.max_sv, steps=steps)
    return path_popping(some, cameras[sweep], SCALE, steps=steps)


def steepest(config: AttenuationConfig) -> float:
    """L: by how much an opacity under the soft cut can change per unit of log s."""
    x = min(1.5 * config.tau * config.max_sv, math.exp(-0.625))
    return max(2 * x * (1.5 - 4 * math.log(x)), 2 / math.e)


@torch.no_grad()
def bound(some: Gaussians, cameras: dict[str, list[Camera]], sweep: str, steps: int) -> float:
    """``W (255 L h + 1)``: the most that a pixel can change in a step of the default; 0 where no distance changes."""
    assert some.attenuation is not None
    if sweep == "turn":
        return 0.0
    if sweep == "dial":
        seen, h = cameras[sweep], math.log(some.attenuation.max_sv) / steps
    else:
        seen = path(cameras[sweep], steps)
        away = torch.stack([(some.means - camera.position).norm(dim=1) for camera in seen]).log()
        h = float((away[1:] - away[:-1]).abs().max())
    covers = [
        torch.stack(
            [splat(one, torch.ones(1), camera)[1] for one in map(some.select, torch.arange(len(some))[:, None])]
        )
        for camera in seen[:: max(steps // 4, 1)]
    ]
    return float(max(cover.sum(0).max() for cover in covers)) * (255 * steepest(some.attenuation) * h + 1)


def markdown(rows: list[dict[str, Any]]) -> str:
    longest, shortest = min(STEPS), max(STEPS)
    bounds = {(row["sweep"], row["steps"]): row["bound"] for row in rows if "bound" in row}
    heads = " | ".join(f"{name}: 1/{longest} | 1/{shortest}" for name in SWEEPS)
    lines = [f"| normaliser | cut | {heads} |", "|---|---" + "|---|---" * len(SWEEPS) + "|"]
    for normalizer, cut in dict.fromkeys((row["normalizer"], row["cut"]) for row in rows):
        pixels = {
            (r["sweep"], r["steps"]): r["pixel"] for r in rows if (r["normalizer"], r["cut"]) == (normalizer, cut)
        }
        ours = (normalizer, cut) == ("scene", "soft")
        found = " | ".join(f"{pixels[name, steps]:.1f}" for name in SWEEPS for steps in (longest, shortest))
        lines.append(f"| {normalizer}{' (default)' if ours else ''} | {cut} | {found} |")
        if ours:
            limit = " | ".join(
                f"{min(bounds[name, steps], 255):.0f}" for name in SWEEPS for steps in (longest, shortest)
            )
            lines.append(f"| its bound | | {limit} |")
    held = all(row["pixel"] <= row["bound"] + 0.05 for row in rows if "bound" in row)
    table, sweeps = "\n".join(lines), "; ".join(SWEEPS.values())
    return f"""## Popping

The largest change of any pixel in one step, levels of 255, in steps of 1/{longest} and 1/{shortest} of a sweep:
{sweeps}. The scene is made to pop
(`benchmarks/stability_popping.py`): {TOGETHER} opaque white Gaussians in one place leave at the same dial value, and
one far away enters as the camera turns.

{table}

![Largest change of a pixel against the step's length](images/{PICTURE})

With the default, once steps are shorter than a fade, half the step changes the picture half as much, and a turn changes
nothing. What is left at the shortest steps is one level for each of the {TOGETHER} Gaussians, the alpha of 1/255 at
which every rasterizer drops them. The hard cut leaves a jump that no step is short enough for; with the quantile and
the maximum a turn changes every opacity at once when a Gaussian enters. The default's bound, `W (255 L h + 1)`,
{"holds" if held else "IS BROKEN"}."""


def plot(rows: list[dict[str, Any]], folder: Path) -> None:
    """Log-log, a panel a sweep: a colour a normaliser, dashes for the hard cut."""
    colours = {"scene": BLUE, "quantile": GREEN, "max": ORANGE}
    with new_figure((10.4, 3.9), layout="constrained") as figure:
        panels = figure.subplots(1, len(SWEEPS), sharey=True)
        for axes, (sweep, title) in zip(panels, SWEEPS.items(), strict=True):
            for normalizer, cut in dict.fromkeys((row["normalizer"], row["cut"]) for row in rows):
                own = [r for r in rows if (r["normalizer"], r["cut"], r["sweep"]) == (normalizer, cut, sweep)]
                if sweep == "dial" and normalizer != "scene":  # D is one number as long as the camera stands still
                    continue
                default = (normalizer, cut) == ("scene", "soft")
                axes.plot(
                    [1 / r["steps"] for r in own], [max(r["pixel"], 0.2) for r in own], marker="o", markersize=3.5,
                    color=colours[normalizer], linestyle="-" if cut == "soft" else "--", linewidth=1.4 + default,
                    label=f"{normalizer}, {cut}{' (default)' if default else ''}", zorder=3 if default else 2,
                )  # fmt: skip
            limits = [r for r in rows if r["sweep"] == sweep and r.get("bound", 0) > 0]
            if limits:
                axes.plot([1 / r["steps"] for r in limits], [r["bound"] for r in limits], color=INK, linewidth=1.2,
                          linestyle=":", label="bound of the default")  # fmt: skip
            axes.axhline(TOGETHER, color=QUIET, linewidth=0.8)
            axes.set_title(title, loc="left", fontsize=9.5)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xticks([1 / steps for steps in STEPS], [f"1/{steps}" for steps in STEPS])
            axes.set_xticks([], minor=True)
            axes.set_ylim(0.15, 500)
            label_log(axes.yaxis, "{:g}", subs=(1,))
            tidy(axes)
        panels[0].set_ylabel("largest change of a pixel in a step (of 255)")
        note = {"fontsize": 8, "color": QUIET, "va": "top"}
        panels[0].text(1 / max(STEPS), TOGETHER * 0.9, f"one level for each of the {TOGETHER}", **note)
        panels[1].text(1 / max(STEPS), 0.24, "scene, both cuts: no change", fontsize=8, color=BLUE)
        panels[1].set_xlabel("length of a step, share of the sweep")
        handles = {h.get_label(): h for axes in panels for h in axes.get_lines() if not h.get_label().startswith("_")}
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False, fontsize=8.5
        )
        save(figure, folder / PICTURE)


if __name__ == "__main__":
    main()
