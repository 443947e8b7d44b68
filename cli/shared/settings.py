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

# By field: metavar, type, and what help says of a default that depends on another option or on the scene.
OPTIONS: dict[str, tuple[str, Any, str | None]] = {
    "max_sv": ("S", float, None), "iters": ("N", int, ""), "batch": ("N", int, " (default: 1 per process)"),
    "time_budget": ("SEC", float, None), "seed": ("N", int, None),
    "growth": ("on|off", str, " (default: on, with --form paper off)"),
}  # fmt: skip


def add_settings(options: _ActionsContainer, without: Sequence[str] = ()) -> None:
    """Adds the options except the fields in ``without``, which a command has in another form."""
    helps, defaults = field_descriptions(AdaptConfig), AdaptConfig()
    for name in [name for name in OPTIONS if name not in without]:
        metavar, kind, shown = OPTIONS[name]
        default = getattr(defaults, name) if shown is None else None
        text = helps[name] + (shown or ("" if default is None else f" (default: {default:g})"))
        options.add_argument(as_option(name), metavar=metavar, type=kind, default=default, help=text)
    text = "training as measured here (ours) or as published (paper) (default: ours)"
    options.add_argument("--form", choices=["ours", "paper"], default="ours", help=text)
    text = "train even if the checkpoint does not match the photographs"
    options.add_argument("--misaligned-ok", action="store_true", help=text)
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
