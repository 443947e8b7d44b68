"""Popping: the largest change of any pixel per step, in both forms of the dial, by the length of
the steps.

The scene is made to pop: Gaussians in one place that end together, a black one that fades in front
of a white one that ends its pixels, and one far away that enters the frustum while the camera
turns. A fade changes in proportion to the step's length (slope 1), a pop by the same amount (slope
0).
"""

import math
from itertools import product
from typing import Any

import clod_adapter as clod
from clod_adapter.config import FORMS
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.paper import TAU
from clod_adapter.evaluation.popping import dial_popping, path_popping
from clod_adapter.gaussians import SH_C0, Gaussians
from common import table

import torch
from torch import Tensor

STEPS = (20, 40, 80, 160)
SWEEPS = {
    "dial": "the dial from 1 to 5",
    "pair": "the same, of the black and the white one alone",
    "turn": "a camera that turns, s = 2",
    "path": "a camera that moves, s = 2",
}
OTHERS, TOGETHER, SCALE = 120, 4, 2.0
GROWTH = 0.75  # growth_d that preserves area
DISTANCE = 4.0  # of the camera from the middle


def measure() -> list[dict[str, Any]]:
    rows = []
    for form, growth in (*product(FORMS, [0.0]), ("ours", GROWTH)):
        some, cameras = scene(form)
        some = some.replace(growth_d=torch.full((len(some),), growth))
        for sweep, steps in product(SWEEPS, STEPS):
            found = _sweep(some, cameras, sweep, steps)
            row = {
                "part": "popping",
                "form": form,
                "growth": growth,
                "sweep": sweep,
                "steps": steps,
                "pixel": found.pixel,
                "persistence": found.pixel_persistence,
            }
            rows.append(row)
    return rows


def scene(form: str) -> tuple[Gaussians, dict[str, list[clod.Camera]]]:
    """The Gaussians, and by name of the sweep the cameras it goes through."""
    draw, n = torch.Generator().manual_seed(0), OTHERS + TOGETHER + 3
    together, (front, back, far) = slice(OTHERS, OTHERS + TOGETHER), range(n - 3, n)
    eye, line = torch.tensor([0.0, 0.0, -DISTANCE]), torch.tensor([-0.25, 0.15, 1.0])
    means = torch.randn(n, 3, generator=draw) * torch.tensor([1.2, 0.9, 1.2])
    means[together], means[far] = torch.tensor([0.3, 0.2, -0.5]), torch.tensor([30.0, 0.0, 40.0])
    means[front], means[back] = eye + line, eye + 1.2 * line
    log_scales = 0.5 * torch.randn(n, 3, generator=draw) + math.log(0.08)
    log_scales[together] = log_scales[far] = math.log(0.25)
    log_scales[front] = log_scales[back] = math.log(0.02)
    colours = torch.rand(n, 1, 3, generator=draw)
    colours[together], colours[front], colours[back] = 1.0, 0.0, 1.0
    opacities = (2 * torch.randn(n, generator=draw) + 1).sigmoid()
    opacities[together] = opacities[far] = 0.95
    opacities[front], opacities[back] = 0.93, 0.9997
    config = clod.AdaptConfig(form=form)
    settings = config.attenuation(DISTANCE)
    start = _looking(eye, torch.zeros(3))
    cameras = {
        "dial": [start],
        "turn": [start, _looking(eye, torch.tensor([2.5, 0.0, 0.0]))],
        "path": [start, _looking(torch.tensor([1.5, 0.3, -3.5]), torch.tensor([1.0, 0.0, 0.0]))],
    }
    # the dial values at which Gaussians are culled
    ends = config.max_sv ** torch.rand(n, generator=draw)
    ends[together], ends[front], ends[back] = 2.2, 4.7, 5.0
    sigma = ends * normalized_distances(means, start, settings)
    if form == "paper":
        sigma = sigma / (2 * (opacities / (TAU * ends)).log().clamp(min=1e-3)).sqrt()
    sigma[back] = SIGMA_MAX
    shapes = torch.randn(n, 4, generator=draw), log_scales
    plain = Gaussians(
        means, *shapes, opacities.logit(), (colours - 0.5) / SH_C0, torch.empty(n, 0, 3)
    )
    return clod.with_dial(plain, sigma, settings), cameras


def _looking(eye: Tensor, at: Tensor, width: int = 48, height: int = 36) -> clod.Camera:
    forward = torch.nn.functional.normalize(at - eye, dim=0)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), forward), dim=0
    )
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    K = torch.tensor([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1.0]])
    return clod.Camera(viewmat, K, width, height)


def _sweep(some: Gaussians, cameras: dict[str, list[clod.Camera]], sweep: str, steps: int) -> Any:
    if sweep in ("turn", "path"):
        return path_popping(some, cameras[sweep], SCALE, steps=steps)
    assert some.attenuation is not None
    if sweep == "pair":  # the others stay, for the paper's unit of distances
        rest = torch.arange(len(some)) < len(some) - 3
        some = some.replace(opacity_logits=some.opacity_logits.where(~rest, -20))
    return dial_popping(some, cameras["dial"][0], some.attenuation.max_sv, steps=steps)


def tables(rows: list[dict[str, Any]]) -> str:
    """Largest change of a pixel in the longest and the shortest steps."""
    ends, lines = [(name, steps) for name in SWEEPS for steps in (min(STEPS), max(STEPS))], []
    for form, growth in dict.fromkeys((row["form"], row["growth"]) for row in rows):
        own = {
            (r["sweep"], r["steps"]): r for r in rows if (r["form"], r["growth"]) == (form, growth)
        }
        name = f"{form}, growth_d {growth:g}" if growth else form
        lines.append([name, *(f"{own[end]['pixel']:.1f}" for end in ends)])
    return table(["form", *(f"{name}: 1/{steps}" for name, steps in ends)], lines)
