"""Training settings: the options that are fields of ``AdaptConfig``, and the config that they make."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from clod_adapter.config import AdaptConfig, field_descriptions
from clod_adapter.errors import ClodError

from .command import add_device, as_option
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
    "batch": " (default: 1 per process)",
    "growth": " (default: on, with --form paper off)",
}


def add_settings(options: _ActionsContainer, without: Sequence[str] = ()) -> None:
    """Adds the options except the fields in ``without``, which a command has in another form."""
    helps, defaults = field_descriptions(AdaptConfig), AdaptConfig()
    for name, (metavar, kind) in OPTIONS.items():
        default = None if name in DEFAULTS else getattr(defaults, name)
        shown = DEFAULTS.get(name, "" if default is None else f" (default: {default:g})")
        if name not in without:
            options.add_argument(as_option(name), metavar=metavar, type=kind, default=default, help=helps[name] + shown)
    options.add_argument(
        "--form", choices=["ours", "paper"], default="ours",
        help="training as measured here (ours) or as published (paper) (default: ours)",
    )  # fmt: skip
    options.add_argument(
        "--misaligned-ok", action="store_true", help="train even if the checkpoint does not match the photographs"
    )
    add_device(options, "train and measure")


def make_config(args: argparse.Namespace) -> AdaptConfig:
    """The settings; the error of a value out of range names the option."""
    make, size = AdaptConfig.paper if args.form == "paper" else AdaptConfig, launched().size
    limit = 1 / make().tau
    if args.max_sv >= limit:
        raise ClodError(f"--max-sv is {args.max_sv:g}, it must be below {limit:g}, where every Gaussian is culled")
    given = {name: getattr(args, name) for name in OPTIONS}
    given["batch"] = size if given["batch"] is None else given["batch"]
    if given["iters"] is None:
        del given["iters"]  # the default is by the scene
    given["growth"] = given["growth"] or make().growth
    try:
        config = make(**given)
    except ClodError as error:
        name, _, rest = str(error).partition(" ")
        raise ClodError(f"{as_option(name)} {rest}") from error
    if config.batch < size:
        raise ClodError(f"--batch is {config.batch}, it must be at least {size}: a view for each process")
    return config


def make_configs(args: argparse.Namespace) -> list[AdaptConfig]:
    """One config per value of ``--max-sv``, ascending."""
    return [make_config(argparse.Namespace(**vars(args) | {"max_sv": value})) for value in sorted(set(args.max_sv))]
