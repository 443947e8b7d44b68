"""The alignment of checkpoint and photographs: cameras are moved into the checkpoint's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from clod_adapter.alignment.check import MOST_VIEWS, Alignment, check_alignment
from clod_adapter.alignment.search import Guess, cameras_in, guess_frame, scene_in
from clod_adapter.cameras import Camera, Scene, View
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.scene.colmap import load_points
from clod_adapter.io.scene.load import load_cameras, load_scene

from .console import Console
from .inputs import prepare_kernels

OTHER_COLOURS = (
    "warning: {ply} matches the photographs in {images}, but some differ more from it than from their own mean "
    "colours; check for another exposure, views that it does not cover, or a poor checkpoint"
)
FLAT = "warning: the photographs in {images} have a single colour each, on which the checkpoint is trained"
SMALL = 320  # pixels, width of photographs that only tell the frame


def align(
    checkpoint: Checkpoint, scene: Scene, images: str, console: Console, *, required: bool
) -> tuple[Scene, dict[str, Any]]:
    """Compares renders with the photographs; after a poor match tries other frames, and uses one that fits clearly.

    Args:
        required: for training: raises where the checkpoint fits in no frame, and warns of a poor match; otherwise
            warns of the former alone.

    Returns:
        The scene with its cameras in the checkpoint's frame, and with notes, which are printed. For the report, the
        numbers of ``check_alignment``, in the frame given; ``guess``, another frame that fits, in words; and ``frame``,
        the one that the cameras were moved to, with its ``psnr``.

    Raises:
        ClodError: the checkpoint does not match.
    """
    base, ply, views = checkpoint.gaussians, checkpoint.path, [*scene.test, *scene.train]
    with console.status("comparing the checkpoint with the photographs ..."):
        found = check_alignment(base, views)
    guess = _other_frame(checkpoint, views, found, images, console) if found.doubtful else None
    numbers: dict[str, Any] = found.as_dict() | {"guess": guess and guess.frame.description, "frame": None}
    if guess and guess.clear:
        scene, numbers["frame"] = scene_in(scene, guess.frame), guess.frame.as_dict() | {"psnr": guess.psnr}
        notes = [_moved(checkpoint, images, found, guess)]
    elif found.fits and guess is None:
        notes = [FLAT.format(images=images)] if required and not found.views else []
        notes += [OTHER_COLOURS.format(ply=ply, images=images)] if required and found.margin < 0 else []
    else:
        message = f"{ply}: does not match {images}: {mismatch(found, guess)}"
        if required:
            raise ClodError(f"{message}; use --misaligned-ok to train anyway")
        notes = [f"warning: {message}"]
    for note in notes:
        console.say(note)
    return replace(scene, notes=(*scene.notes, *notes)), numbers


def read_cameras(
    model: Checkpoint, images: str, console: Console, *, training: bool = False
) -> tuple[list[Camera], list[str]]:
    """``load_cameras``, moved into the model's frame, which few small photographs tell; and notes."""
    cameras, notes = load_cameras(images, model.origin, training=training)
    try:
        scene = load_scene(images, origin=model.origin, max_width=SMALL, most=MOST_VIEWS)
    except ClodError:  # cameras alone will do
        return cameras, notes
    prepare_kernels(console, model.gaussians.means.device, training=False)
    views = [*scene.test, *scene.train]
    found = check_alignment(model.gaussians, views)
    if not found.doubtful:
        return cameras, notes
    every = load_cameras(images, model.origin)[0] if training else cameras
    guess = _other_frame(model, views, found, images, console, every)
    if guess is None or not guess.clear:
        return cameras, notes
    return cameras_in(cameras, guess.frame), [*notes, _moved(model, images, found, guess)]


def _moved(checkpoint: Checkpoint, images: str, found: Alignment, guess: Guess) -> str:
    return (
        f"{images}: the cameras are moved into the frame of {checkpoint.path} ({guess.frame.name}): renders have "
        f"{guess.psnr:.1f} dB there, {found.psnr:.1f} dB as given"
    )


def _other_frame(
    checkpoint: Checkpoint,
    views: Sequence[View],
    found: Alignment,
    images: str,
    console: Console,
    cameras: Sequence[Camera] = (),
) -> Guess | None:
    """Another frame that explains the photographs better, if there is one."""
    with console.status("poor match: trying other frames ..."):
        points = load_points(images, checkpoint.origin)
        return guess_frame(checkpoint.gaussians, views, found, points, cameras)


def mismatch(found: Alignment, guess: Guess | None) -> str:
    """The measurements, and a remedy."""
    share = f"{found.in_view:.2g}" if 0 < found.in_view < 0.01 else f"{found.in_view:.0%}"
    facts = f"{share} of its Gaussians are in view"
    if found.views:
        facts = (
            f"renders of {found.views} views have a PSNR of {found.psnr:.1f} dB against the photographs, the mean "
            f"colours of these {found.mean_colour_psnr:.1f} dB; {facts}"
        )
    if found.on_white:
        return (
            f"{facts}; over white the renders have {found.white_psnr:.1f} dB, but clod-adapt renders over black: give "
            "photographs with a transparent background (PNG; composited over black), or a checkpoint trained on black"
        )
    if guess:
        return f"{facts}; in another frame renders have {guess.psnr:.1f} dB: {guess.frame.description}"
    return f"{facts}; give the checkpoint of this scene, in the cameras' frame"
