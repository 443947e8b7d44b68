"""The ways to give a dial value: ``--sv``, or a budget that it is solved from."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

# Option, metavar, type, help. All but the first are budgets, under the names that budget.dial_for has for them.
OPTIONS: tuple[tuple[str, str, type, str], ...] = (
    ("keep", "N", int, "the dial value that keeps N Gaussians {where}"),
    ("fps", "F", float, "the dial value that draws F frames a second, by the frame times {times}"),
    ("psnr_drop", "DB", float, "the dial value that gives up DB decibels against s = 1, {decibels}"),
)  # fmt: skip
BUDGETS = """\
budgets, each solved to the dial value that just keeps within it:
  --keep       exact, from the dial values at which Gaussians leave; s = 1 keeps
               fewer than the file has
  --psnr-drop  read off the calibration in the file's header, measured by
               clod-adapt on its held-out photographs; where it had none,
               against the checkpoint's own pictures, as a note then says
  --fps        some frames are timed first, here and now: times depend on the
               machine, the size of the pictures, and what else is running
A count or frame rate that s = 1 meets gives s = 1 and a note, and a drop larger
than there is the largest trained dial value; a count or frame rate that this
does not reach is an error that says what is reachable.
"""


def add_dial_options(parser: ArgumentParser, sv_help: str, where: str, *, several: bool, required: bool) -> None:
    """Adds --sv and the budgets, of which one may be given; ``several`` allows more than one value of it."""
    times = "measured here first" if several else "stored in the file, or with --images measured first"
    decibels = "by the stored calibration" if several else "by the stored calibration, or with --images as measured"
    group: Any = parser.add_mutually_exclusive_group(required=required)
    count = "+" if several else 1
    group.add_argument("--sv", metavar="S", type=float, nargs=count, help=sv_help)
    for name, metavar, kind, text in OPTIONS:
        option = f"--{name.replace('_', '-')}"
        shown = text.format(where=where, times=times, decibels=decibels)
        group.add_argument(option, metavar=metavar, type=kind, nargs=count, help=shown)


def opens_at(virtual_scale: float, max_sv: float | None) -> tuple[float, list[str]]:
    """Where the dial of a page stands at first, and a note where that is not what was asked for.

    Args:
        max_sv: where it ends; None for a file without a dial.
    """
    if max_sv is None:
        return 1.0, [f"no sigma_d, so no dial to be at s = {virtual_scale:g}"] if virtual_scale > 1 else []
    if virtual_scale > max_sv:
        return max_sv, [f"the page's dial ends at s = {max_sv:g}, as far as was trained for, and opens there"]
    return virtual_scale, []


def given_budget(args: Namespace) -> tuple[str, str, list[float]] | None:
    """The budget's name, its option and its values, if one is given."""
    for name, *_ in OPTIONS:
        if getattr(args, name) is not None:
            return name, f"--{name.replace('_', '-')}", getattr(args, name)
    return None
