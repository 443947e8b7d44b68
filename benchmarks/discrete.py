"""Two levels of detail with a hard switch against one file with its dial: a picture and the measured jump.

    clod-adapt demo                                      # makes demo/gallery.ply and demo/capture
    python benchmarks/discrete.py                        # docs/images/discrete_vs_continuous.webp

The two levels are the file at both ends of its dial, so that only the switch differs. Adds a row to
``results/discrete.jsonl``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import clod_adapter as clod
from clod_adapter.cli.shared.console import Console
from clod_adapter.evaluation import popping
from clod_adapter.evaluation.popping import Popping
from clod_adapter.metrics import psnr
from clod_adapter.report.style import BLUE, ORANGE, QUIET, new_figure, save_figure, tidy
from common import ROOT, append, arguments

import numpy as np
import torch
from torch import Tensor

PICTURE = ROOT / "docs" / "images" / "discrete_vs_continuous.webp"
STRIPS, FRAMES = 4, 120
NAMES = ("two levels, a hard switch", "one file, its dial")


@dataclass(frozen=True)
class Sweep:
    """F frames from most to least detail: dial values, ``[F, H, W, 3]`` in [0, 1], Gaussians, dB."""

    dials: list[float]
    images: Tensor
    kept: list[int]
    psnr: list[float]

    def popping(self) -> Popping:
        """The change of the image from frame to frame."""
        return popping.sweep(lambda _, j: self.images[j], self.dials)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("demo", nargs="?", default="demo", help="the folder of clod-adapt demo (default: demo)")
    folder = Path(parser.parse_args().demo)
    gaussians, view = clod.load(folder / "gallery.ply").gaussians, clod.load_scene(folder / "capture").test[0]
    dial = sweep(gaussians, view, FRAMES)
    levels = hard_switch(dial)
    draw(PICTURE, view, levels, dial)
    append("discrete.jsonl", {
        "benchmark": "discrete", "model": "gallery.ply", "gaussians": len(gaussians), "frames": FRAMES,
        "view": view.camera.name, "max_sv": dial.dials[-1], "switch": summary(levels), "dial": summary(dial),
    })  # fmt: skip


@torch.no_grad()
def sweep(gaussians: clod.Gaussians, view: clod.View, frames: int) -> Sweep:
    """The dial from 1 to the largest value trained, in equal ratios."""
    widest = gaussians.attenuation.max_sv if gaussians.attenuation else 1.0
    dials = [widest ** (k / (frames - 1)) for k in range(frames)]
    images, kept = [], []
    with Console().meter("sweep") as meter:
        for k, s in enumerate(dials):
            rendering = clod.render(gaussians, view.camera, s)
            images.append(rendering.image.clamp(0, 1))
            kept.append(int(rendering.kept.sum()))
            meter.update((k + 1) / frames)
    return Sweep(dials, torch.stack(images), kept, [psnr(image, view.image) for image in images])


def hard_switch(dial: Sweep) -> Sweep:
    """The same sweep with the two levels of its ends only, switched half way."""
    half = len(dial.dials) // 2
    at = [0] * half + [len(dial.dials) - 1] * (len(dial.dials) - half)
    return Sweep(dial.dials, dial.images[at], [dial.kept[k] for k in at], [dial.psnr[k] for k in at])


def summary(frames: Sweep) -> dict[str, Any]:
    """The largest change between frames against the mean of all: 1 is even, the number of steps a single jump."""
    found = frames.popping()
    return {
        "largest_change": found.largest, "mean_change": found.mean, "largest_over_mean": found.ratio,
        "kept": [frames.kept[0], frames.kept[-1]], "psnr": [frames.psnr[0], frames.psnr[-1]],
    }  # fmt: skip


def strips(frames: Sweep) -> tuple[np.ndarray, list[int]]:
    """One picture in vertical strips, from least detail on the left to most, and the frame of each."""
    last = len(frames.dials) - 1
    picked = [round(last * (1 - k / (STRIPS - 1))) for k in range(STRIPS)]
    width = frames.images.shape[2]
    edges = [round(width * k / STRIPS) for k in range(STRIPS + 1)]
    parts = [frames.images[f][:, a:b] for f, a, b in zip(picked, edges[:-1], edges[1:], strict=True)]
    return torch.cat(parts, dim=1).numpy(), picked


def draw(path: Path, view: clod.View, levels: Sweep, dial: Sweep) -> None:
    aspect = view.camera.height / view.camera.width
    with new_figure((12.4, 6.1 * aspect + 3.6), layout="constrained") as figure:
        above, below = figure.subfigures(2, 1, height_ratios=[6.1 * aspect + 0.75, 2.85])
        for axes, name, frames in zip(above.subplots(1, 2), NAMES, (levels, dial), strict=True):
            draw_strips(axes, name, frames)
        left, right = below.subplots(1, 2)
        for name, frames, colour in zip(NAMES, (levels, dial), (ORANGE, BLUE), strict=True):
            changes = frames.popping().changes
            left.plot(frames.dials, frames.psnr, color=colour, linewidth=1.8, label=name)
            label = f"{name}: largest {max(changes):.2g}"
            right.plot(frames.dials[1:], changes, color=colour, linewidth=1.8, label=label)
        right.set_ylim(bottom=0)
        for axes, label in ((left, "PSNR on this view (dB)"), (right, "change in one frame (of 255)")):
            axes.set(xscale="log", xlabel="from most detail to least: the dial s (log scale)", ylabel=label)
            tidy(axes)
            ticks = [s for s in (1, 1.5, 2, 3, 4, 5, 7, 10, 15, 20) if s <= dial.dials[-1]]
            axes.set_xticks(ticks, [f"{s:g}" for s in ticks])
            axes.set_xticks([], minor=True)
            axes.legend(frameon=False, fontsize=8.5)
        save_figure(figure, path)


def draw_strips(axes: Any, name: str, frames: Sweep) -> None:
    picture, picked = strips(frames)
    height, width = picture.shape[:2]
    axes.imshow(picture, interpolation="antialiased")
    axes.set_title(name, loc="left", fontsize=11, weight="bold")
    axes.set_xticks([width * (k + 0.5) / STRIPS for k in range(STRIPS)], [
        f"{frames.kept[f]:,} Gaussians\n{frames.psnr[f]:.2f} dB" for f in picked
    ])  # fmt: skip
    axes.set_yticks([])
    axes.tick_params(length=0, labelcolor=QUIET)
    axes.spines[:].set_visible(False)
    for k in range(1, STRIPS):
        jump = frames.kept[picked[k]] != frames.kept[picked[k - 1]] and len(set(frames.kept)) == 2
        style = {"color": "#e0262e", "linewidth": 1.6} if jump else {"color": "white", "linewidth": 0.8, "alpha": 0.7}
        axes.axvline(width * k / STRIPS - 0.5, linestyle="--", **style)
    axes.set_ylim(height - 0.5, -0.5)


if __name__ == "__main__":
    main()
