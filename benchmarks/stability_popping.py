"""Popping: the largest change of any pixel per step, for every normalizer and threshold, by the length of the steps.

The scene is made to pop: Gaussians in one place with one extinction scale, and one far away that enters the frustum
while the camera turns. A fade changes in proportion to the step's length (slope 1), a pop by the same amount (slope 0).
"""

import math
from dataclasses import replace
from itertools import product
from typing import Any

import clod_adapter as clod
from clod_adapter.config import CUTS, NORMALIZERS
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.extinction import sigma_for_extinction
from clod_adapter.evaluation.popping import dial_popping, path_popping
from clod_adapter.gaussians import SH_C0, Gaussians
from common import table

import torch
from torch import Tensor

STEPS = (20, 40, 80, 160)
SWEEPS = {"dial": "the dial from 1 to 5", "turn": "a camera that turns, s = 2", "path": "a camera that moves, s = 2"}
OTHERS, TOGETHER, SCALE = 120, 4, 2.0
GROWTH = 0.75  # growth_d that preserves area
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


def tables(rows: list[dict[str, Any]]) -> str:
    """Largest change of a pixel in the longest and the shortest steps."""
    ends, lines = [(name, steps) for name in SWEEPS for steps in (min(STEPS), max(STEPS))], []
    for key in dict.fromkeys((row["normalizer"], row["cut"], row["growth"]) for row in rows):
        own = {(r["sweep"], r["steps"]): r for r in rows if (r["normalizer"], r["cut"], r["growth"]) == key}
        normalizer, cut, growth = key
        of = f", growth_d {growth:g}" if growth else " (default)" if key[:2] == DEFAULT else ""
        lines.append([f"{normalizer}{of}", cut, *(f"{own[end]['pixel']:.1f}" for end in ends)])
    return table(["normalizer", "threshold", *(f"{name}: 1/{steps}" for name, steps in ends)], lines)
