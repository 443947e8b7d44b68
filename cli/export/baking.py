"""The cameras that ``clod-adapt export`` bakes for, and the search for a file within a PSNR budget."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from clod_adapter.calibration import Viewpoint
from clod_adapter.cameras import Camera, View
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.progress import Stopped
from clod_adapter.training.camera_placement import place_cameras

from ..shared.alignment import align, read_cameras
from ..shared.console import Console
from ..shared.inputs import named, prepare_kernels, read_scene
from ..shared.measure import measure

PLACED = 16  # cameras placed where none are known
DIAL_RATIO = 1.01  # of two dial values, at which the search for a PSNR ends


@dataclass(frozen=True)
class Target:
    """The cameras that a dial value is baked for.

    Attributes:
        camera: the one of ``--camera``, for which the result is exact; else None.
        cameras: that one, or all that the file is baked for; empty for a model without a dial.
        about: a description in printable ASCII.
    """

    camera: Camera | None
    cameras: Sequence[Camera | Viewpoint]
    about: str


def find_target(args: argparse.Namespace, model: Checkpoint, console: Console) -> tuple[Target, list[str]]:
    """The cameras of --camera, --images or the model's file, else placed ones; and notes on them."""
    if args.camera is not None:
        cameras, notes = read_cameras(model, args.images, console)
        found = named(cameras, args.camera, "--camera")
        if len(found) > 1:
            both = f"{found[0].name} and {found[1].name}"
            raise ClodError(f"--camera: {args.camera!r} matches {both}; give the full name")
        return Target(found[0], found, "one camera"), notes
    if args.images is not None:
        cameras, notes = read_cameras(model, args.images, console, training=True)
        return Target(None, cameras, f"{len(cameras)} training cameras"), notes
    if model.viewpoints:
        return Target(None, model.viewpoints, f"{len(model.viewpoints)} training cameras"), []
    return _placed(model, console)


def _placed(model: Checkpoint, console: Console) -> tuple[Target, list[str]]:
    try:
        with console.meter("placing cameras") as meter:
            cameras = place_cameras(model.gaussians, views=PLACED, progress=meter)
    except ClodError as error:
        raise ClodError(f"{model.path}: no cameras stored to bake for, and {error}; give --images") from error
    note = f"{model.path} stores no cameras: baked for {len(cameras)} placed ones; --images gives a better result"
    return Target(None, cameras, f"{len(cameras)} placed cameras"), [note]


@dataclass(frozen=True)
class Photographs:
    """The photographs that files are measured on, for a PSNR budget.

    Attributes:
        views: held-out views.
        reference: PSNR of the model at s = 1, dB.
    """

    views: Sequence[View]
    reference: float

    def drop_of(self, gaussians: Gaussians, console: Console, label: str) -> float:
        """PSNR of the model at s = 1 minus that of Gaussians without a dial, dB."""
        return self.reference - _psnr(gaussians, self.views, console, label)


def measure_drop(
    args: argparse.Namespace, model: Checkpoint, candidate: Callable[[float], Gaussians], console: Console
) -> tuple[float, Photographs]:
    """The largest dial value, to 1 %, whose file has at most ``--psnr-drop`` dB less than the model at s = 1.

    Args:
        candidate: the Gaussians in the file of a dial value, as read back.

    Raises:
        ClodError: no photographs are held out, or already the file of s = 1 loses more.
    """
    scene, drop = read_scene(args.images, console, model.origin), args.psnr_drop[0]
    if not scene.test:
        raise ClodError(f"{args.images}: there are no held-out photographs to measure on; give at least two")
    assert model.gaussians.attenuation is not None
    prepare_kernels(console, model.gaussians.means.device, training=False)
    scene, _ = align(model, scene, args.images, console, required=False)
    photographs = Photographs(scene.test, _psnr(model.gaussians, scene.test, console, "dial, s=1"))

    def lost(s: float) -> float:
        return photographs.drop_of(candidate(s), console, f"file, s={s:.4g}")

    if (least := lost(1.0)) > drop:
        raise ClodError(
            f"--psnr-drop {drop:g} is out of reach: the file baked at s = 1 is {least:.2f} dB below the model at s = 1"
        )
    return largest_within(lost, drop, model.gaussians.attenuation.max_sv), photographs


def _psnr(gaussians: Gaussians, views: Sequence[View], console: Console, label: str) -> float:
    rows, interrupted = measure(gaussians, views, [1.0], console, label)
    if interrupted:
        raise Stopped("stopped during measurement")
    return rows[0].psnr


def largest_within(lost: Callable[[float], float], drop: float, largest: float) -> float:
    """The largest dial value in [1, largest], to 1 %, that loses at most ``drop`` dB, if 1 does."""
    if largest == 1 or lost(largest) <= drop:
        return largest
    low, high = 1.0, largest
    while high / low > DIAL_RATIO:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if lost(middle) <= drop else (low, middle)
    return low
