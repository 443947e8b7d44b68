"""Training settings: the options that are fields of ``AdaptConfig``, and the config that they make."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from clod_adapter.config import AdaptConfig, field_descriptions
from clod_adapter.errors import ClodError

from .process import launched

if TYPE_CHECKING:
    from argparse import _ActionsContainer

OPTIONS: dict[str, Any] = {
    "max_sv": ("S", float), "iters": ("N", int), "batch": ("N", int), "time_budget": ("SEC", float),
    "seed": ("N", int), "growth": ("on|off", str),
}  # fmt: skip
# Defaults that depend on another option or on the scene.
DEFAULTS = {
    "iters": "",  # its help has it
    "batch": "1 per process",
    "growth": "on, with --form paper off",
}


def add_settings(options: _ActionsContainer, without: Sequence[str] = ()) -> None:
    """Adds the options except the fields in ``without``, which a command has in another form."""
    helps, defaults = field_descriptions(AdaptConfig), AdaptConfig()
    for name, (metavar, kind) in OPTIONS.items():
        if name in without:
            continue
        default = None if name in DEFAULTS else getattr(defaults, name)
        shown = f" (default: {DEFAULTS[name]})" if DEFAULTS.get(name) else ""
        shown = (
            shown if default is None else f" (default: {default if isinstance(default, str) else format(default, 'g')})"
        )
        options.add_argument(
            f"--{name.replace('_', '-')}", metavar=metavar, type=kind, default=default, help=helps[name] + shown
        )
    options.add_argument(
        "--form", choices=["ours", "paper"], default="ours",
        help="training as measured here (ours) or as published (paper) (default: ours)",
    )  # fmt: skip


def make_config(args: argparse.Namespace) -> AdaptConfig:
    """The settings.

    Raises:
        ClodError: a value is out of range; the message names the option.
    """
    make = AdaptConfig.paper if args.form == "paper" else AdaptConfig
    limit = 1 / make().tau
    if args.max_sv >= limit:
        raise ClodError(f"--max-sv is {args.max_sv:g}, it must be below {limit:g}, where every Gaussian is culled")
    given = {name: getattr(args, name) for name in OPTIONS}
    size = launched().size
    given["batch"] = size if given["batch"] is None else given["batch"]
    if given["iters"] is None:
        del given["iters"]  # the default is by the scene
    given["growth"] = given["growth"] or make().growth
    for name, value in given.items():  # one at a time, so that the error can name the option
        try:
            make(**{name: value})
        except ClodError as error:
            raise ClodError(f"--{name.replace('_', '-')}{_without_name(str(error), name)}") from error
    if given["batch"] < size:
        raise ClodError(f"--batch is {given['batch']}, it must be at least {size}: a view for each process")
    return make(**given)


def make_configs(args: argparse.Namespace) -> list[AdaptConfig]:
    """One config per value of ``--max-sv``, ascending."""
    return [make_config(argparse.Namespace(**vars(args) | {"max_sv": value})) for value in sorted(set(args.max_sv))]


def _without_name(message: str, name: str) -> str:
    return message.removeprefix(name) if message.startswith(f"{name} ") else f": {message}"
