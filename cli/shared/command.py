"""Commands: their text, options and checks, without torch, which takes a second to import."""

from __future__ import annotations

import math
import sysconfig

# a parser or its group
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter, _ActionsContainer
from collections.abc import Sequence
from pathlib import Path
from site import getuserbase
from typing import Any, NoReturn

from clod_adapter import AdaptConfig, AttenuationConfig, ClodError
from clod_adapter.config import DEVICES, FILTERS, PLACED_MAX_SV, field_descriptions
from clod_adapter.io.file_formats import check_readable, file_has_dial
from clod_adapter.io.scene.folder import find_cameras
from clod_adapter.report.charts import QUANTITIES, chart_file, check_matplotlib

from .console import Console
from .process import check_printed, launched


def parser_of(command: Any, prog: str) -> Parser:
    """The parser, with the options that all commands have."""
    parser = Parser(
        prog=prog,
        usage=f"{prog} {command.USAGE}",
        description=command.DESCRIPTION,
        epilog=command.EPILOG,
        formatter_class=RawDescriptionHelpFormatter,
        add_help=False,
        allow_abbrev=False,
    )
    if hasattr(command, "add_arguments"):
        command.add_arguments(parser)
    parser.general = parser.add_argument_group("general")
    parser.general.add_argument("-h", "--help", action="help", help="show this text")
    if parser.get_default("quiet") is None:
        parser.general.add_argument("--quiet", action="store_true", help="no progress, no notes")
    parser.general.add_argument("--json", action="store_true", help="one JSON object on stdout")
    return parser


class Parser(ArgumentParser):
    """Reports misuse as a ClodError, which ``main`` prints in one line."""

    general: Any  # the last group of --help: options that all commands have

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuses empty values too: Path takes one for the current folder, and ``or`` for none."""
        found = super().parse_args(args, namespace)
        for action in self._actions:
            value = getattr(found, action.dest, None)
            if "" in (value if isinstance(value, list) else [value]):
                self.error(
                    f"argument {'/'.join(action.option_strings) or action.metavar}: is empty"
                )
        return found

    def error(self, message: str) -> NoReturn:
        raise ClodError(f"{message} (see {self.prog} --help)")

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """Exits after --help and --version."""
        check_printed()
        super().exit(status, message)

    def format_help(self) -> str:
        page = manual()
        return f"{super().format_help()}\nmanual: {page}\n" if page else super().format_help()


def manual() -> Path | None:
    """The first page of the documentation on this machine: of a checkout, or as installed."""
    folders = [Path(__file__).resolve().parents[2] / "docs"]
    folders += [
        Path(root, "share", "doc", "clod-adapter")
        for root in (sysconfig.get_path("data"), getuserbase())
    ]
    return next((page for folder in folders if (page := folder / "index.md").is_file()), None)


# Name (as of budget.dial_for), metavar, type, help.
BUDGET_OPTIONS: tuple[tuple[str, str, type, str], ...] = (
    ("keep", "N", int, "the dial value that keeps N Gaussians {where}"),
    ("fps", "F", float, "the dial value that renders F frames per second, by frame times {times}"),
    (
        "psnr_drop",
        "DB",
        float,
        "the dial value that loses DB decibels against s = 1, by the quality table",
    ),
)
BUDGETS = """\
budgets, each solved for a dial value:
  --keep       exact; s = 1 keeps fewer Gaussians than the file has
  --psnr-drop  from the quality table in the file's header
  --fps        times some frames first; depends on machine, image size and load
If s = 1 meets the budget, or the largest trained dial value loses less than DB,
that is the result. A count below the trained range is met with a note; a frame
rate that is out of reach is an error.
"""


def add_input(parser: ArgumentParser, name: str, metavar: str, text: str) -> _ActionsContainer:
    """Adds the group of what is read, with the file that every command has; returns it."""
    given = parser.add_argument_group("input")
    given.add_argument(name, metavar=metavar, help=text)
    return given


def add_out(
    parser: ArgumentParser, metavar: str, text: str, default: str | None = None, **more: Any
) -> _ActionsContainer:
    """Adds the group of what is written, with ``--out``; returns it."""
    output = parser.add_argument_group("output")
    output.add_argument("-o", "--out", metavar=metavar, default=default, help=text, **more)
    return output


def add_activated(options: _ActionsContainer) -> None:
    text = "values that the file stores after activation (sigmoid of opacities, exp of scales)"
    options.add_argument("--activated", choices=["none", "opacity", "scales", "both"], help=text)


def add_reading(options: _ActionsContainer, images: str = "", photographs: bool = True) -> None:
    """Adds ``--images``, required unless there is another help for it, and the options for reading
    a checkpoint.
    """
    scene = images or "scene folder: photographs, and a COLMAP model or transforms.json"
    options.add_argument("--images", metavar="DIR", required=not images, help=scene)
    add_activated(options)
    text = (
        "screen-space filter of the training: off, on (gsplat's rasterize_mode antialiased,"
        " Inria's --antialiasing), mip (Mip-Splatting), or auto: as the file says, else"
        f" {'by the photographs' if photographs else 'off'}"
    )
    options.add_argument(
        "--antialiasing", choices=["auto", *FILTERS], default="auto", help=f"{text} (default: auto)"
    )


def add_device(options: _ActionsContainer, what: str) -> None:
    usual = "auto: the NVIDIA GPU if gsplat works on it, else the CPU (default: auto)"
    options.add_argument(
        "--device",
        choices=["auto", "cpu", "cuda"],
        default="auto",
        help=f"where to {what}; {usual}",
    )


def add_dial_options(
    options: _ActionsContainer, sv_help: str, where: str, *, several: bool
) -> _ActionsContainer:
    """Adds --sv and the budgets, of which one may be given, with ``several`` values; returns their
    group.
    """
    times = "measured first" if several else "in the file, or with --images measured first"
    group: Any = options.add_mutually_exclusive_group()
    count = "+" if several else 1
    group.add_argument("--sv", metavar="S", type=float, nargs=count, help=sv_help)
    for name, metavar, kind, text in BUDGET_OPTIONS:
        shown = text.format(where=where, times=times)
        group.add_argument(as_option(name), metavar=metavar, type=kind, nargs=count, help=shown)
    if not several:
        add_device_preset(group)
    return group


def add_device_preset(options: _ActionsContainer) -> None:
    text = (
        "--keep with the number that viewers allow a device:"
        f" {', '.join(f'{n:,}' for n in DEVICES.values())}"
    )
    options.add_argument("--device-preset", choices=[*DEVICES], help=text)


def as_option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def initial_dial(virtual_scale: float, dial: AttenuationConfig | None, console: Console) -> float:
    """The initial dial value of a page."""
    if dial is None:
        if virtual_scale > 1:
            console.note(f"no sigma_d, so s = {virtual_scale:g} has no effect")
        return 1.0
    if virtual_scale > dial.max_sv:
        console.note(
            f"the page's dial ends at s = {dial.max_sv:g}, the largest value trained for, and opens"
            " there"
        )
    return min(virtual_scale, dial.max_sv)


def given_budget(args: Namespace) -> tuple[str, str, list[float]] | None:
    """Name, option and values of the budget, or None without one."""
    if device := getattr(args, "device_preset", None):
        return "keep", f"--device-preset {device}, --keep", [DEVICES[device]]
    for name, *_ in BUDGET_OPTIONS:
        if getattr(args, name, None) is not None:
            return name, as_option(name), getattr(args, name)
    return None


def page_files(path: Path, *more: str) -> list[Path]:
    """The files of a page and its charts; refuses a page that cannot be written."""
    check_matplotlib()
    if path.suffix.lower() != ".html":
        raise ClodError(f"{path}: --report names the page to write, so it must end in .html")
    return [path, *(chart_file(path, name) for name in (*QUANTITIES, *more))]


def check_dials(args: Namespace, model: str) -> None:
    """Refuses dial values out of range, and budgets of a file without a dial."""
    for virtual_scale in args.sv or ():
        if not 0 <= virtual_scale < math.inf:
            raise ClodError(
                f"--sv has {virtual_scale:g}, it must be at least 0 (1 is full quality, 0"
                " everything)"
            )
    name, option, values = given_budget(args) or ("", "", [])
    for value in values:
        if not 0 < value < math.inf:
            raise ClodError(f"{option} has {value:g}, it must be positive and finite")
    if name and not file_has_dial(Path(model)):
        option = option.partition(",")[0]
        raise ClodError(
            f"{model}: has no sigma_d, which {option} needs; adapt it first: clod-adapt {model} ..."
        )


def check_inputs(scene: str | None, *paths: str) -> None:
    """Refuses a file that is none to read, and a scene that is no folder with a COLMAP model or a
    transforms.json.
    """
    for path in paths:
        check_readable(Path(path))
    if scene is not None and not Path(scene).is_dir():
        raise ClodError(f"{scene}: is not a folder; give the one that holds images/ and sparse/0")
    if scene is not None:
        find_cameras(Path(scene))


# Training settings, by field of AdaptConfig: metavar, type, and what help says of a default that
# depends on another option or on the scene.
SETTINGS: dict[str, tuple[str, Any, str | None]] = {
    "max_sv": ("S", float, f" (default: 5; without photographs {PLACED_MAX_SV:g}, of our form)"),
    "iters": ("N", int, ""),
    "batch": ("N", int, " (default: 1 per process)"),
    "time_budget": ("SEC", float, None),
    "seed": ("N", int, None),
    "growth": ("on|off", str, " (default: on, with --form paper off)"),
}


def add_settings(options: _ActionsContainer, without: Sequence[str] = ()) -> None:
    """Adds the options except the fields in ``without``, which a command has in another form."""
    helps, defaults = field_descriptions(AdaptConfig), AdaptConfig()
    for name, (metavar, kind, shown) in SETTINGS.items():
        if name in without:
            continue
        default = getattr(defaults, name) if shown is None else None
        text = helps[name] + (shown or ("" if default is None else f" (default: {default:g})"))
        options.add_argument(
            as_option(name), metavar=metavar, type=kind, default=default, help=text
        )
    text = "training as measured here (ours) or as published (paper) (default: ours)"
    options.add_argument("--form", choices=["ours", "paper"], default="ours", help=text)
    text = "train even if the checkpoint does not match the photographs"
    options.add_argument("--misaligned-ok", action="store_true", help=text)
    add_device(options, "train and measure")


def make_config(args: Namespace) -> AdaptConfig:
    """The settings; the error of a value out of range names the option."""
    forms = {"paper": AdaptConfig.paper, "ours": AdaptConfig if args.images else AdaptConfig.placed}
    make, size = forms[args.form], launched().size
    try:
        given = {name: value for name in SETTINGS if (value := getattr(args, name)) is not None}
        config = make(**{"batch": size} | given)
    except ClodError as error:
        name, _, rest = str(error).partition(" ")
        raise ClodError(f"{as_option(name)} {rest}") from error
    if config.batch < size:
        raise ClodError(
            f"--batch is {config.batch}, it must be at least {size}: a view for each process"
        )
    return config


def make_configs(args: Namespace) -> list[AdaptConfig]:
    """One config per value of ``--max-sv``, ascending."""
    return [
        make_config(Namespace(**vars(args) | {"max_sv": value}))
        for value in sorted(set(args.max_sv))
    ]
