"""``--antialiasing``: the screen-space filter of a checkpoint, as given, stored or measured."""

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
    """The checkpoint with the filter to render it with, and a note, also printed, where the file has another or none.

    The filter is that of ``--antialiasing``. With ``auto`` it is the file's; if the file has none, the one whose
    renders of ``views`` are clearly closest to the photographs, or without views the default.
    """
    gaussians = checkpoint.gaussians
    if args.antialiasing != "auto":
        given = FILTERS[args.antialiasing]
        if given == gaussians.screen_filter or not checkpoint.filter_known:
            return replace(checkpoint, gaussians=gaussians.replace(screen_filter=given))
        stored = gaussians.screen_filter.description
        note = f"{checkpoint.path}: rendered {WORDS[args.antialiasing]} (--antialiasing); the file has {stored}"
        return _noted(checkpoint, given, note, console)
    if checkpoint.filter_known or not views:
        return checkpoint
    with console.status("comparing screen-space filters with the photographs ..."):
        found = compare_filters(gaussians, views, gaussians.screen_filter.name or "off")
    if found.chosen == found.expected:
        return checkpoint
    return _noted(checkpoint, found.screen_filter, _measured_note(checkpoint, found), console)


def with_filter_of(base: Checkpoint, model: Checkpoint, args: argparse.Namespace) -> Checkpoint:
    """The base of a model, with the model's filter if its own file has none."""
    if args.antialiasing != "auto" or base.filter_known or not model.filter_known:
        return base
    return replace(base, gaussians=base.gaussians.replace(screen_filter=model.gaussians.screen_filter))


def _measured_note(checkpoint: Checkpoint, found: FilterComparison) -> str:
    chosen, expected = (f"{found.psnr[name]:.2f} dB {WORDS[name]}" for name in (found.chosen, found.expected))
    return (
        f"{checkpoint.path}: by the photographs it was trained {WORDS[found.chosen]}: {chosen}, {expected}; "
        f"rendered so (--antialiasing {found.expected} overrides it)"
    )


def _noted(checkpoint: Checkpoint, screen_filter: ScreenFilter, note: str, console: Console) -> Checkpoint:
    console.say(note)
    gaussians = checkpoint.gaussians.replace(screen_filter=screen_filter)
    return replace(checkpoint, gaussians=gaussians, notes=(*checkpoint.notes, note))
