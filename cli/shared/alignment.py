"""The alignment of checkpoint and photographs, checked before training."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import torch

from clod_adapter.alignment.check import DOUBTFUL, Alignment, check_alignment
from clod_adapter.alignment.frames import focus_of
from clod_adapter.alignment.search import Guess, guess_frame
from clod_adapter.cameras import Scene, View
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.scene.colmap import load_points
from clod_adapter.origin import Origin

from .console import Console

OTHER_COLOURS = (
    "warning: {ply} matches the photographs in {images}, but some differ more from it than from their own mean "
    "colours; check for another exposure, views that it does not cover, or a poor checkpoint"
)
FLAT = "warning: the photographs in {images} have a single colour each, on which the checkpoint is trained"


def require_alignment(
    checkpoint: Checkpoint, scene: Scene, args: argparse.Namespace, console: Console
) -> tuple[dict[str, Any], list[str]]:
    """Compares renders with the photographs; for a poor match also in other frames, which takes some seconds.

    Returns:
        The numbers of ``check_alignment`` and the ``guess``, for the report; and notes.

    Raises:
        ClodError: the checkpoint does not match, or matches clearly better in another frame; not with --misaligned-ok.
    """
    base, ply, views = checkpoint.gaussians, checkpoint.path, [*scene.test, *scene.train]
    with console.status("comparing the checkpoint with the photographs ..."):
        found = check_alignment(base, views)
    guess = None
    if not found.on_white and (not found.fits or found.margin < DOUBTFUL):
        with console.status("poor match: trying other frames ..."):
            guess = guess_frame(base, views, found, load_points(args.images, checkpoint.origin))
    numbers = found.as_dict() | {"guess": guess and guess.description}
    if found.fits and guess is None:
        notes = [FLAT.format(images=args.images)] if not found.views else []
        notes += [OTHER_COLOURS.format(ply=ply, images=args.images)] if found.margin < 0 else []
        for note in notes:
            console.say(note)
        return numbers, notes
    message = f"{ply}: does not match {args.images}: {mismatch(checkpoint, views, found, guess)}"
    if not args.misaligned_ok:
        raise ClodError(f"{message}; use --misaligned-ok to train anyway")
    console.say(f"warning: {message}")
    return numbers, [f"warning: {message}"]


def mismatch(checkpoint: Checkpoint, views: Sequence[View], found: Alignment, guess: Guess | None) -> str:
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
        return f"{facts}; in another frame renders have {guess.psnr:.1f} dB: {guess.description}"
    return f"{facts}; {positions(checkpoint, views)}; give the checkpoint of this scene, in the cameras' frame"


def positions(checkpoint: Checkpoint, views: Sequence[View]) -> str:
    """The positions of Gaussians and cameras, in the coordinates of their files."""
    base, origin = checkpoint.gaussians, checkpoint.origin
    if not len(base):
        return "it is empty"
    middle = base.means.median(dim=0).values
    radius = float((base.means - middle).norm(dim=1).median())
    centres = torch.stack([view.camera.position for view in views])
    focus = focus_of(torch.stack([view.camera.viewmat for view in views])).to(centres)
    away = float((centres - focus).norm(dim=1).median())
    return (
        f"half of the Gaussians lie within {radius:.3g} of {_point(middle, origin)}, the cameras look at about "
        f"{_point(focus, origin)} from a distance of {away:.3g}"
    )


def _point(position: torch.Tensor, origin: Origin) -> str:
    return "(" + ", ".join(f"{value + by:.3g}" for value, by in zip(position.tolist(), origin, strict=True)) + ")"
