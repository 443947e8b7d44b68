"""Brings a scene's cameras into the checkpoint's frame, and finds the checkpoint's screen-space
filter.

Both are told by the photographs, and each change by a note.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

from clod_adapter.alignment.check import Alignment, check_alignment, compare_filters
from clod_adapter.alignment.search import Guess, guess_frame, scene_in
from clod_adapter.cameras import Camera, Scene, View
from clod_adapter.config import FILTERS
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.scene.colmap import load_points

Note = Callable[[str], object]
"""Is called with each line that the user should read."""

WORDS = {
    "off": "without antialiasing",
    "on": "with antialiasing",
    "mip": "with Mip-Splatting's antialiasing",
}


def align(
    checkpoint: Checkpoint,
    scene: Scene,
    note: Note,
    *,
    required: bool,
) -> tuple[Scene, dict[str, Any]]:
    """The scene with its cameras in the checkpoint's frame, if that fits clearly; and measurements
    for the report.

    Raises:
        ClodError: the checkpoint fits in no frame, and that is ``required``; if not, there is a
            note.
    """
    alignment, guess = compare_frames(checkpoint, scene, note)
    ply = checkpoint.path
    images = scene.folder or "the photographs"
    frame = None
    if guess and guess.clear:
        scene = scene_in(scene, guess.frame)
        frame = guess.frame.as_dict() | {"psnr": guess.psnr}
    elif guess or not alignment.fits:
        message = f"{ply}: does not match {images}: {mismatch(alignment, guess)}"
        if required:
            raise ClodError(f"{message}; --misaligned-ok (misaligned_ok in Python) trains anyway")
        note(f"warning: {message}")
    elif required and not alignment.views:
        note(f"warning: the photographs in {images}, to train on, have a single colour each")
    elif required and alignment.margin < 0:
        note(
            f"warning: {ply} matches the photographs in {images}, but some differ more from it than"
            " from their own mean colours; check for another exposure, views that it does not"
            " cover, or a poor checkpoint"
        )
    return scene, asdict(alignment) | {"guess": guess and guess.frame.description, "frame": frame}


def compare_frames(
    checkpoint: Checkpoint,
    scene: Scene,
    note: Note,
    cameras: Sequence[Camera] = (),
) -> tuple[Alignment, Guess | None]:
    """Compares renders with the photographs, and after a poor match finds a frame that explains
    them better.

    ``cameras`` are all of the scene's, if its photographs are not.
    """
    views = [*scene.test, *scene.train]
    alignment = check_alignment(checkpoint.gaussians, views)
    if not alignment.doubtful:
        return alignment, None
    points = load_points(scene.folder, checkpoint.origin) if scene.folder else None
    guess = guess_frame(checkpoint.gaussians, views, alignment, points, cameras)
    if guess and guess.clear:
        note(
            f"{scene.folder or 'the photographs'}: the cameras are moved into the frame of"
            f" {checkpoint.path} ({guess.frame.name}): renders have {guess.psnr:.1f} dB there,"
            f" {alignment.psnr:.1f} dB as given"
        )
    return alignment, guess


def mismatch(alignment: Alignment, guess: Guess | None) -> str:
    """The measurements, and a remedy."""
    facts = f"{alignment.in_view:.2%} of its Gaussians are in view"
    if alignment.views:
        facts = (
            f"renders have a PSNR of {alignment.psnr:.1f} dB against {alignment.views} photographs,"
            f" their mean colours {alignment.mean_colour_psnr:.1f} dB; {facts}"
        )
    if alignment.on_white:
        return (
            f"{facts}; over white the renders have {alignment.white_psnr:.1f} dB, but clod-adapt"
            " renders over black: give photographs with a transparent background (PNG; composited"
            " over black), or a checkpoint trained on black"
        )
    if guess:
        return (
            f"{facts}; in another frame renders have {guess.psnr:.1f} dB: {guess.frame.description}"
        )
    return f"{facts}; give the checkpoint of this scene, in the cameras' frame"


def detect_filter(checkpoint: Checkpoint, views: Sequence[View], note: Note) -> Checkpoint:
    """The checkpoint with its file's screen-space filter; if that has none, with the one that fits
    ``views`` best.
    """
    if checkpoint.filter_known or not views:
        return checkpoint
    gaussians = checkpoint.gaussians
    expected = gaussians.screen_filter.name or "off"
    name, psnr = compare_filters(gaussians, views, expected)
    if name != expected:
        note(
            f"{checkpoint.path}: by the photographs it was trained {WORDS[name]}:"
            f" {psnr[name]:.2f} dB {WORDS[name]}, {psnr[expected]:.2f} dB {WORDS[expected]};"
            f" rendered so (--antialiasing {expected} overrides it, filter_known=True in Python)"
        )
    return replace(checkpoint, gaussians=gaussians.replace(screen_filter=FILTERS[name]))
