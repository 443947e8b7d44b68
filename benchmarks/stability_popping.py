"""Popping: the largest change of any pixel per step, in both forms of the dial, by the length of
the steps.

The scene is made to pop: Gaussians in one place that end together, a black one that fades in front
of a white one that ends its pixels, and one far away that enters the frustum while the camera
turns. A fade changes in proportion to the step's length (slope 1), a pop by the same amount (slope
0).
"""

import math
from dataclasses import replace
from itertools import product

import clod_adapter as clod
from city import look_at
from clod_adapter.cameras import intrinsics
from clod_adapter.config import FORMS
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.paper import TAU
from clod_adapter.evaluation.popping import dial_popping, path_popping
from clod_adapter.gaussians import SH_C0, Gaussians
from common import Table

import torch

STEPS = (20, 40, 80, 160)
SWEEPS = {
    "dial": "the dial from 1 to 5",
    "pair": "the same, of the black and the white one alone",
    "turn": "a camera that turns, s = 2",
    "path": "a camera that moves, s = 2",
}
OTHERS = 120  # Gaussians that are not made to pop
TOGETHER = 4  # that end together
SCALE = 2.0
WIDTH = 48
HEIGHT = 36
GROWTH = 0.75  # growth_d that preserves area
SHOWN = {  # in the table
    ("ours", 0.0): "ours",
    ("ours", GROWTH): f"with growth_d {GROWTH:g}",
    ("paper", 0.0): "the paper's",
}
DISTANCE = 4.0  # of the camera from the middle


def measure():
    rows = []
    for form, growth in (*product(FORMS, [0.0]), ("ours", GROWTH)):
        gaussians, cameras = scene(form)
        gaussians = gaussians.replace(growth_d=torch.full((len(gaussians),), growth))
        for sweep, steps in product(SWEEPS, STEPS):
            popping = swept(gaussians, cameras, sweep, steps)
            row = {"form": form, "growth": growth, "sweep": sweep, "steps": steps}
            row |= {"pixel": popping.pixel, "persistence": popping.pixel_persistence}
            rows.append(row)
    return rows


def scene(form, others=OTHERS):
    """The Gaussians, and by name of the sweep the cameras it goes through."""
    draw = torch.Generator().manual_seed(0)
    n = others + TOGETHER + 3
    together = slice(others, others + TOGETHER)
    front, back, far = range(n - 3, n)
    eye = torch.tensor([0.0, 0.0, -DISTANCE])
    line = torch.tensor([-0.25, 0.15, 1.0])
    means = torch.randn(n, 3, generator=draw) * torch.tensor([1.2, 0.9, 1.2])
    means[together] = torch.tensor([0.3, 0.2, -0.5])
    means[far] = torch.tensor([30.0, 0.0, 40.0])
    means[front] = eye + line
    means[back] = eye + 1.2 * line
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


def _looking(eye, at):
    camera = look_at(eye.double().numpy(), at.double().numpy(), WIDTH, HEIGHT, "")
    K = intrinsics(1.1 * WIDTH, 1.1 * WIDTH, WIDTH / 2, HEIGHT / 2)
    return replace(camera, K=K)


def swept(gaussians, cameras, sweep, steps):
    """The popping of a sweep, in so many steps."""
    if sweep in ("turn", "path"):
        return path_popping(gaussians, cameras[sweep], SCALE, steps=steps)
    if sweep == "pair":  # the others stay, for the paper's unit of distances
        logits = gaussians.opacity_logits.clone()
        logits[:-3] = -20
        gaussians = gaussians.replace(opacity_logits=logits)
    return dial_popping(gaussians, cameras["dial"][0], gaussians.attenuation.max_sv, steps=steps)


def page_table(rows):
    """Largest change of a pixel in the longest and the shortest steps."""
    lines = {label: [label] for label in SHOWN.values()}
    ends = (min(STEPS), max(STEPS))
    for row in rows:
        if row["steps"] in ends:
            lines[SHOWN[row["form"], row["growth"]]].append(f"{row['pixel']:.1f}")
    heads = ["form"]
    for sweep in SWEEPS:
        heads += [f"{sweep}: 1/{ends[0]}", f"1/{ends[1]}"]
    return Table(heads, lines.values(), rows)
