"""Pseudo views: placed cameras, with the checkpoint's own renderings as photographs."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from clod_adapter.cameras import Camera, Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import render
from clod_adapter.training.camera_placement import place_cameras

FEW, OWN = 8, 16  # with fewer than FEW training photographs, OWN pseudo views are added
TEST_EVERY = 8  # as with photographs


@torch.no_grad()
def render_pseudo_views(gaussians: Gaussians, cameras: list[Camera], *, progress: Listener | None = None) -> Scene:
    """A scene of ``cameras`` with the checkpoint's own renderings as photographs; every 8th is held out.

    Args:
        gaussians: the teacher, rendered at s = 1.
        progress: called in ``Phase.PSEUDO_VIEWS`` after each view.
    """
    teacher = gaussians.without_empty_bands()
    views = []
    for camera in cameras:
        views.append(View(camera, render(teacher, camera).pixels.cpu()))
        tell(progress, Phase.PSEUDO_VIEWS, len(views), len(cameras))
    held_out = range(0, len(views), TEST_EVERY) if len(views) > 1 else range(0)
    train = tuple(view for k, view in enumerate(views) if k not in held_out)
    test = tuple(views[k] for k in held_out)
    note = (
        f"no photographs: {len(train)} pseudo views to train on, {len(test)} held out, {_describe(cameras)}; the "
        "checkpoint is the teacher, and all numbers compare with its renderings, not with photographs"
    )
    return Scene(train, test, (note,))


def add_pseudo_views(gaussians: Gaussians, scene: Scene, config: AdaptConfig) -> tuple[Scene, AdaptConfig]:
    """Adds OWN pseudo views, and halves all learning rates but the dial's, with fewer than FEW photographs.

    So few photographs do not show the whole scene, and training would damage the rest. Pseudo views have the field of
    view of the first photograph. With more photographs they harm more than they help, as they contain the errors of
    the checkpoint and have other distances (docs/method.md). If no camera can be placed, a note says so.
    """
    if not 0 < len(scene.train) < FEW:
        return scene, config
    try:
        placed = render_pseudo_views(
            gaussians, place_cameras(gaussians, views=OWN, seed=config.seed, field=_field(scene.train[0].camera))
        )
        own = (*placed.train, *placed.test)
        added = f"{len(own)} pseudo views, the checkpoint's own renderings from placed cameras, are added"
    except ClodError as error:
        own, added = (), f"no pseudo views can be added ({error})"
    note = f"only {len(scene.train)} photographs to train on: {added}, and all learning rates but the dial's are halved"
    return replace(scene, train=(*scene.train, *own), notes=(*scene.notes, note)), config.lighter(0.5)


def _describe(cameras: list[Camera]) -> str:
    if not cameras:
        return "no images"
    return f"{cameras[0].width}x{cameras[0].height}, {_field(cameras[0]):.0f} degrees wide"


def _field(camera: Camera) -> float:
    return math.degrees(2 * math.atan(0.5 * camera.width / float(camera.K[0, 0])))
