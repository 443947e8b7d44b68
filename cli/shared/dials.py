"""The options for dial values: ``--sv``, or a budget from which the dial value is solved."""

from __future__ import annotations

from argparse import Namespace
from typing import TYPE_CHECKING, Any

from clod_adapter.config import DEVICES

if TYPE_CHECKING:
    from argparse import _ActionsContainer

# Budgets: name (as of budget.dial_for), metavar, type, help.
OPTIONS: tuple[tuple[str, str, type, str], ...] = (
    ("keep", "N", int, "the dial value that keeps N Gaussians {where}"),
    ("fps", "F", float, "the dial value that renders F frames per second, by frame times {times}"),
    ("psnr_drop", "DB", float, "the dial value that loses DB decibels against s = 1, {decibels}"),
)  # fmt: skip
BUDGETS = """\
budgets, each solved for a dial value:
  --keep       exact; s = 1 keeps fewer Gaussians than the file has
  --psnr-drop  from the calibration in the file's header
  --fps        times some frames first; depends on machine, image size and load
If s = 1 meets the budget, or the largest trained dial value loses less than DB,
that is the result. A count or frame rate that is out of reach is an error.
"""


def add_dial_options(options: _ActionsContainer, sv_help: str, where: str, *, several: bool) -> None:
    """Adds --sv and the budgets, of which one may be given; ``several`` allows more than one value of it."""
    times = "measured first" if several else "in the file, or with --images measured first"
    decibels = "by the calibration" if several else "by the calibration, or with --images measured"
    group: Any = options.add_mutually_exclusive_group()
    count = "+" if several else 1
    group.add_argument("--sv", metavar="S", type=float, nargs=count, help=sv_help)
    for name, metavar, kind, text in OPTIONS:
        option = f"--{name.replace('_', '-')}"
        shown = text.format(where=where, times=times, decibels=decibels)
        group.add_argument(option, metavar=metavar, type=kind, nargs=count, help=shown)
    if not several:
        add_device_preset(group)


def add_device_preset(options: _ActionsContainer) -> None:
    counts = ", ".join(f"{count:,}" for count in DEVICES.values())
    options.add_argument(
        "--device-preset", choices=[*DEVICES], help=f"--keep with the number that viewers allow a device: {counts}"
    )


def initial_dial(virtual_scale: float, max_sv: float | None) -> tuple[float, list[str]]:
    """The initial dial value of a page, and a note where it differs from the one asked for.

    Args:
        max_sv: largest value of the page's dial; None for a file without a dial.
    """
    if max_sv is None:
        return 1.0, [f"no sigma_d, so s = {virtual_scale:g} has no effect"] if virtual_scale > 1 else []
    if virtual_scale > max_sv:
        return max_sv, [f"the page's dial ends at s = {max_sv:g}, the largest value trained for, and opens there"]
    return virtual_scale, []


def given_budget(args: Namespace) -> tuple[str, str, list[float]] | None:
    """Name, option and values of the budget, or None without one."""
    if device := getattr(args, "device_preset", None):
        return "keep", f"--device-preset {device}, --keep", [DEVICES[device]]
    for name, *_ in OPTIONS:
        if getattr(args, name, None) is not None:
            return name, f"--{name.replace('_', '-')}", getattr(args, name)
    return None
