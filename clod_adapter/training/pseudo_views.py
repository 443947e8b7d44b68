"""Views where there are no photographs: cameras placed from the Gaussians alone, their pictures the checkpoint's own.

A checkpoint is right only where its photographs looked, and shows in two ways where that was:

- Gaussians end up a pixel or two large as their nearest cameras saw them. So the smallest ones tell how far
  away those stood (``typical_reach``), and a picture that is full of Gaussians many pixels wide is of a place that
  none of them looked at.
- The higher SH bands begin at 0 and are moved only by photographs, so their part of the colour is strong in the
  directions a Gaussian was seen from and fades in others.

Candidates look at random Gaussians, small opaque ones first, from random sides; each is judged by two small pictures
(``_score``), and as many again are tried beside the best. Of those that are good, the ones far from each other are
taken. Nothing here knows which way is up, whether the scene is an object or a room, or its unit: a side or a place
that nobody photographed fails the judgement.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from clod_adapter.cameras import Camera, Scene, View, near_plane
from clod_adapter.config import AdaptConfig, require
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.render import render, splat

VIEWS = 96
FEW, OWN = 8, 16  # photographs to train on, and what is added where there are fewer
WIDTH, HEIGHT = 496, 368
FIELD = 55.0  # horizontal, degrees: between a phone's 65 and the 35 of a portrait lens
TRIES = 3  # candidates for each view, first anywhere, then as many beside the best of those
BEST = 0.2  # share of the first ones that see what was photographed; later ones must be as good
STEP = 0.2  # how far beside, in units of the distance, and of the direction's length
LOOK = (80, 60)  # size of the picture that a candidate is judged by
TEST_EVERY = 8  # as with photographs
SMALL, SMALL_PIXELS = 0.1, 2.0  # a tenth of the Gaussians is this small or smaller, as their nearest cameras saw them
FAR = 4.0  # cameras stand at most this many times as far away as the scene is large
VISIBLE = 0.05  # less opaque ones say nothing about where cameras stood


@dataclass(frozen=True)
class Candidate:
    """A camera, and how much what it sees looks photographed (larger is better, no unit)."""

    camera: Camera
    score: float


def place_cameras(
    gaussians: Gaussians,
    *,
    views: int = VIEWS,
    seed: int = 0,
    field: float = FIELD,
    progress: Callable[[int, int], None] | None = None,
) -> list[Camera]:
    """Cameras that see the scene from about where it was photographed.

    Args:
        gaussians: a checkpoint without a dial; one it has is ignored.
        views: how many cameras, at least 1.
        seed: of the candidates; the same seed gives the same cameras.
        field: of view, horizontal, degrees; best that of the cameras it was photographed with.
        progress: called with the number of candidates judged, and of all of them.

    Returns:
        ``views`` cameras (fewer only where fewer see anything) of 496x368 pixels, in an order in which every
        beginning is spread out.

    Raises:
        ClodError: no Gaussian is visible and finite, or no camera sees anything.
    """
    require(views >= 1, "views", views, "at least 1")
    seen, generator = _judgeable(gaussians), torch.Generator().manual_seed(seed)
    reach, tries, zoom = typical_reach(seen, field), TRIES * views, _zoom(field)
    judged: list[Candidate] = []

    def judge(cameras: Iterable[Camera]) -> None:
        for camera in cameras:
            judged.append(Candidate(camera, _score(seen, camera)))
            if progress:
                progress(len(judged), 2 * tries)

    judge(_anywhere(seen, tries, reach, zoom, generator))
    good = _best(judged, math.inf, max(round(BEST * tries), 1))
    if not good:
        raise ClodError("no camera can be placed: from everywhere that was tried the checkpoint shows nothing")
    judge(_beside(good, tries, reach, zoom, generator))
    good = _best(judged, good[-1].score, views)
    return [_resized(c.camera, WIDTH, HEIGHT, k) for k, c in enumerate(_spread(good, views, reach))]


@torch.no_grad()
def render_pseudo_views(
    gaussians: Gaussians, cameras: list[Camera], *, progress: Callable[[int, int], None] | None = None
) -> Scene:
    """The scene of ``cameras`` with the checkpoint's own pictures as photographs; every 8th is held out.

    Args:
        gaussians: the teacher, rendered at s = 1: a checkpoint without a dial in full.
        progress: called with the number of pictures made, and of all of them.
    """
    teacher = gaussians.without_empty_bands()
    views = []
    for camera in cameras:
        views.append(View(camera, render(teacher, camera).pixels.cpu()))
        if progress:
            progress(len(views), len(cameras))
    held_out = range(0, len(views), TEST_EVERY) if len(views) > 1 else range(0)
    train = tuple(view for k, view in enumerate(views) if k not in held_out)
    test = tuple(views[k] for k in held_out)
    note = (
        f"no photographs: {len(train)} placed cameras to train on, {len(test)} held out, {_describe(cameras)}, and the "
        "checkpoint is its own teacher; the numbers are against the checkpoint, not photographs"
    )
    return Scene(train, test, (note,))


def add_pseudo_views(gaussians: Gaussians, scene: Scene, config: AdaptConfig) -> tuple[Scene, AdaptConfig]:
    """What to adapt with where there are fewer than FEW photographs to train on; otherwise what was given.

    So few do not show all that the checkpoint knows, and what they do not show would be lost. They get OWN pictures of
    the checkpoint's own beside them, from placed cameras with the field of view of the first, and everything but
    sigma_d steps half as far. Of more photographs the checkpoint's pictures take more than they add, as they have its
    errors and other distances (docs/method.md). Where no camera can be
    placed, the photographs have to do, and a note says so.
    """
    if not 0 < len(scene.train) < FEW:
        return scene, config
    try:
        placed = render_pseudo_views(
            gaussians, place_cameras(gaussians, views=OWN, seed=config.seed, field=_field(scene.train[0].camera))
        )
        own = (*placed.train, *placed.test)
        added = f"{len(own)} of the checkpoint's own pictures from placed cameras are added"
    except ClodError as error:
        own, added = (), f"none of the checkpoint's own pictures can be added ({error})"
    note = f"only {len(scene.train)} photographs to train on: {added}, and everything but sigma_d steps half as far"
    return dataclasses.replace(scene, train=(*scene.train, *own), notes=(*scene.notes, note)), config.lighter(0.5)


def typical_reach(gaussians: Gaussians, field: float = FIELD) -> float:
    """World units between the cameras and what they look at.

    From there the smallest tenth of the visible Gaussians is at most SMALL_PIXELS pixels large; but never more than
    FAR times the median distance of the Gaussians from their centre, for a splat of few large ones. ``field`` is the
    cameras' horizontal field of view, degrees.
    """
    footprint = _quantile(_size(gaussians), SMALL) * WIDTH * _zoom(field) / SMALL_PIXELS
    from_centre = (gaussians.means - gaussians.means.median(0).values).norm(dim=1)
    return min(footprint, FAR * _quantile(from_centre, 0.5)) or footprint


def _judgeable(gaussians: Gaussians) -> Gaussians:
    """What is visible and finite, without a dial. An infinite opacity logit is a fully opaque Gaussian."""
    plain = gaussians.replace(sigma_d=None, attenuation=None)
    rows = plain.opacities > VISIBLE
    for values in plain.tensors().values():
        if values.shape[1:].numel() and values is not plain.opacity_logits:
            rows &= values.reshape(len(values), -1).isfinite().all(1)
    if not rows.any():
        raise ClodError("no camera can be placed: the checkpoint has no Gaussian that is visible and finite")
    return plain.select(rows).without_empty_bands()


def _anywhere(gaussians: Gaussians, count: int, reach: float, zoom: float, generator: torch.Generator) -> list[Camera]:
    """Looking at Gaussians drawn by opacity over size, from uniform directions, at half to twice the reach."""
    interest = gaussians.opacities / _size(gaussians).clamp(min=1e-12)
    # Drawn by hand, as torch.multinomial has a limit of 2^24 weights.
    ends = interest.double().cumsum(0).cpu()  # cameras are placed on the CPU
    drawn = torch.searchsorted(ends, torch.rand(count, generator=generator, dtype=torch.float64) * ends[-1])
    targets = gaussians.means[drawn.clamp(max=len(gaussians) - 1).to(gaussians.means.device)].cpu()
    sides = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    away = reach * 2 ** (2 * torch.rand(count, 1, generator=generator) - 1)
    return [_looking(eye, target, zoom) for eye, target in zip(targets + away * sides, targets, strict=True)]


def _beside(
    candidates: list[Candidate], count: int, reach: float, zoom: float, generator: torch.Generator
) -> list[Camera]:
    """A step away from the candidates, each in turn, and looking a little elsewhere."""
    steps = STEP * torch.randn(count, 2, 3, generator=generator)
    cameras = []
    for k in range(count):
        camera = candidates[k % len(candidates)].camera
        forward = camera.viewmat[2, :3] + steps[k, 0]
        eye = camera.position + reach * steps[k, 1]
        cameras.append(_looking(eye, eye + reach * forward, zoom))
    return cameras


def _best(judged: list[Candidate], least: float, count: int) -> list[Candidate]:
    """By score: those that have ``least``, or the first ``count`` if that is more, but none that shows nothing."""
    ranked = sorted((c for c in judged if c.score > -math.inf), key=lambda c: -c.score)
    return ranked[: max(count, sum(c.score >= least for c in ranked))]


def _score(gaussians: Gaussians, camera: Camera) -> float:
    """How much the picture looks photographed; -inf where it shows nothing.

    ``log h - 0.5 p - 2 e`` with h the mean size of the higher bands' part of the colour, p the mean log
    size in pixels (both means weighted by what covers the picture), e the share of pixels that are not covered.
    """
    higher = torch.zeros_like(gaussians.sh0)  # so that the colour is 0.5 + the higher bands' part
    bands, alpha = splat(gaussians.replace(sh0=higher), gaussians.opacities, camera)
    covered = float(alpha.sum())
    if covered < 0.1 * alpha.numel():
        return -math.inf
    row = camera.viewmat[2].to(gaussians.means)
    depths = gaussians.means @ row[:3] + row[3]
    pixels = _size(gaussians) * WIDTH / camera.width * camera.K[0, 0] / depths.clamp(min=1e-6)
    shade = (pixels.clamp(1e-3, 1e4).log() + 7)[:, None, None].expand(-1, 1, 3)  # positive, as colours are
    sizes, _ = splat(
        gaussians.replace(sh0=(shade - 0.5) / SH_C0, shN=gaussians.shN[:, :0]), gaussians.opacities, camera
    )
    size = float(sizes[..., 0].sum()) / covered - 7
    empty = float((alpha < 0.9).float().mean())
    strength = float((bands - 0.5 * alpha[..., None]).abs().mean(2).sum()) / covered if gaussians.sh_degree else 1.0
    return math.log(strength + 1e-4) - 0.5 * size - 2 * empty


def _spread(candidates: list[Candidate], count: int, reach: float) -> list[Candidate]:
    """``count`` of them, first the best, then each time the one farthest from those taken, in place and direction."""
    places = torch.stack([torch.cat([c.camera.position / reach, c.camera.viewmat[2, :3]]) for c in candidates])
    taken = [0]
    gap = (places - places[0]).norm(dim=1)
    while len(taken) < min(count, len(candidates)):
        taken.append(int(gap.argmax()))
        gap = gap.minimum((places - places[taken[-1]]).norm(dim=1))
    return [candidates[k] for k in taken]


def _looking(eye: Tensor, target: Tensor, zoom: float) -> Camera:
    """A camera for a look; which way is up is unknown, and COLMAP's y axis points down more often than not."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    down = torch.tensor([0.0, 1.0, 0.0]) if abs(float(forward[1])) < 0.99 else torch.tensor([0.0, 0.0, 1.0])
    right = torch.nn.functional.normalize(torch.linalg.cross(down, forward), dim=0)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    width, height = LOOK
    K = torch.tensor([[zoom * width, 0, width / 2], [0, zoom * width, height / 2], [0, 0, 1.0]])
    return Camera(viewmat, K, width, height, near=near_plane(float((target - eye).norm())))


def _resized(camera: Camera, width: int, height: int, number: int) -> Camera:
    focal = float(camera.K[0, 0]) / camera.width * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(camera.viewmat, K, width, height, f"placed_{number:03}", camera.near)


def _describe(cameras: list[Camera]) -> str:
    if not cameras:
        return "no pictures"
    return f"{cameras[0].width}x{cameras[0].height}, {_field(cameras[0]):.0f} degrees wide"


def _zoom(field: float) -> float:
    """The focal length in widths of the picture, of a horizontal field of view in degrees."""
    return 0.5 / math.tan(math.radians(field) / 2)


def _field(camera: Camera) -> float:
    return math.degrees(2 * math.atan(0.5 * camera.width / float(camera.K[0, 0])))


def _size(gaussians: Gaussians) -> Tensor:
    """``[N]`` the largest standard deviation, world units."""
    return gaussians.scales.amax(1)


def _quantile(values: Tensor, share: float) -> float:
    return float(values.kthvalue(max(round(share * len(values)), 1)).values)
