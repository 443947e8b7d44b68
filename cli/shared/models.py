"""The model and the scene of a command that renders or measures, on its device."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch

from clod_adapter.cameras import Scene
from clod_adapter.io.checkpoint import Checkpoint

from .console import Console
from .devices import on_device, pick_device
from .inputs import read_checkpoint, read_scene


def read_model_and_scene(
    args: argparse.Namespace, console: Console, others: Sequence[str] = ()
) -> tuple[Checkpoint, dict[str, Checkpoint], Scene, torch.device]:
    """The model of ``args``, other files by path, the scene, and the device that the Gaussians are on.

    All coordinates are relative to the model's origin.
    """
    device = pick_device(args.device, console)
    model = read_checkpoint(args.model, console, args.activated)
    read = {path: read_checkpoint(path, console, args.activated, model.origin) for path in others}
    scene = read_scene(args.images, console, model.origin)
    return on_device(model, device), {path: on_device(each, device) for path, each in read.items()}, scene, device
