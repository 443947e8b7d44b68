"""``--antialiasing``: the screen-space filter that a checkpoint is drawn with, as told, stored or found out."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

from clod_adapter.alignment.screen_filter import FilterComparison, compare_filters
from clod_adapter.cameras import View
from clod_adapter.config import FILTERS, ScreenFilter
from clod_adapter.io.checkpoint import Checkpoint

from .console import Console

WORDS = {"off": "without antialiasing", "on": "with antialiasing", "mip": "with Mip-Splatting's antialiasing"}


def with_filter(
    checkpoint: Checkpoint, args: argparse.Namespace, console: Console, views: Sequence[View] = ()
) -> Checkpoint:
    """The checkpoint with the filter that it is to be drawn with, and a note, which is said too, where that is news.

    That of ``--antialiasing``; with ``auto`` what the file says; where it does not say, the one whose renders of
    ``views`` are clearly closest to the photographs, or without views the usual one.
    """
    gaussians = checkpoint.gaussians
    if args.antialiasing != "auto":
        told = FILTERS[args.antialiasing]
        if told == gaussians.screen_filter or not checkpoint.filter_known:
            return replace(checkpoint, gaussians=gaussians.replace(screen_filter=told))
        said = gaussians.screen_filter.description
        note = f"{checkpoint.path}: drawn {WORDS[args.antialiasing]}, as told; the file says {said}"
        return _noted(checkpoint, told, note, console)
    if checkpoint.filter_known or not views:
        return checkpoint
    with console.status("comparing screen-space filters with the photographs ..."):
        found = compare_filters(gaussians, views, gaussians.screen_filter.name or "off")
    if found.chosen == found.expected:
        return checkpoint
    return _noted(checkpoint, found.screen_filter, _news(checkpoint, found), console)


def alike(base: Checkpoint, model: Checkpoint, args: argparse.Namespace) -> Checkpoint:
    """The base that a model was made of, with the filter of the model where its own file does not say."""
    if args.antialiasing != "auto" or base.filter_known or not model.filter_known:
        return base
    return replace(base, gaussians=base.gaussians.replace(screen_filter=model.gaussians.screen_filter))


def _news(checkpoint: Checkpoint, found: FilterComparison) -> str:
    chosen, expected = (f"{found.psnr[name]:.2f} dB {WORDS[name]}" for name in (found.chosen, found.expected))
    return (
        f"{checkpoint.path}: the photographs say that it was trained {WORDS[found.chosen]}: {chosen}, {expected}; "
        f"drawn so (--antialiasing {found.expected} overrides)"
    )


def _noted(checkpoint: Checkpoint, screen_filter: ScreenFilter, note: str, console: Console) -> Checkpoint:
    console.say(note)
    gaussians = checkpoint.gaussians.replace(screen_filter=screen_filter)
    return replace(checkpoint, gaussians=gaussians, notes=(*checkpoint.notes, note))
