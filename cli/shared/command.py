"""Commands: their text, options and checks, without torch, which takes a second to import."""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from clod_adapter.config import DEVICES, FILTERS
from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import PLY, check_readable, file_has_dial, format_of
from clod_adapter.io.scene.folder import find_cameras
from clod_adapter.report.charts import chart_file
from clod_adapter.report.style import check_matplotlib

from .outputs import Outputs
from .process import check_printed

if TYPE_CHECKING:
    from argparse import _ActionsContainer  # a parser or one of its groups

MANUAL = "index.md"  # the first page; where it is installed: pyproject.toml's data-files


@dataclass(frozen=True)
class Command:
    """The texts of ``--help``, and the functions that parse, check and run a command.

    A module of a command imports torch, and what imports it, within functions, so that ``--help`` and errors of
    arguments take no second.

    Attributes:
        add_arguments: adds the options, in groups, to a parser.
        check: raises ClodError, before torch is imported, for arguments and files that cannot work.
        run: does the work; returns the object that --json prints, or None.
        outputs: the files that the arguments name for writing, and those they name for reading; after ``check``.
        needs_torch: whether ``run`` needs it.
    """

    summary: str
    description: str
    usage: str
    epilog: str
    add_arguments: Callable[[ArgumentParser], None]
    check: Callable[[Namespace], None]
    run: Callable[[Namespace], dict[str, Any] | None]
    outputs: Callable[[Namespace], Outputs] = lambda args: Outputs()
    needs_torch: bool = True

    def parser(self, prog: str) -> Parser:
        """The parser, with the options that all commands have."""
        parser = Parser(
            prog=prog, usage=f"{prog} {self.usage}", description=self.description, epilog=self.epilog,
            formatter_class=RawDescriptionHelpFormatter, add_help=False, allow_abbrev=False,
        )  # fmt: skip
        self.add_arguments(parser)
        parser.general = parser.add_argument_group("general")
        parser.general.add_argument("-h", "--help", action="help", help="show this text")
        if parser.get_default("quiet") is None:
            parser.general.add_argument("--quiet", action="store_true", help="no progress, no notes")
        parser.general.add_argument("--json", action="store_true", help="one JSON object on stdout")
        return parser


def run_of(module: str) -> Callable[[Namespace], dict[str, Any] | None]:
    """``run`` of a module below ``clod_adapter.cli``, imported when it is called."""
    return lambda args: import_module(f"clod_adapter.cli.{module}").run(args)


class Parser(ArgumentParser):
    """Reports misuse as a ClodError, which ``main`` prints in one line.

    Attributes:
        general: the last group of ``--help``: options that all commands have.
    """

    general: Any

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuses empty values too: Path takes one for the current folder, and ``or`` for none."""
        found = super().parse_args(args, namespace)
        for action in self._actions:
            value = getattr(found, action.dest, None)
            if "" in (value if isinstance(value, list) else [value]):
                self.error(f"argument {'/'.join(action.option_strings) or action.metavar}: is empty")
        return found

    def error(self, message: str) -> NoReturn:
        raise ClodError(f"{message} (see {self.prog} --help)")

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """After --help and --version."""
        check_printed()
        super().exit(status, message)

    def format_help(self) -> str:
        page = manual()
        return f"{super().format_help()}\nmanual: {page}\n" if page else super().format_help()


def manual() -> Path | None:
    """The first page of the documentation on this machine: of a checkout, or as installed; None without it."""
    checkout = Path(__file__).resolve().parents[2] / "docs" / MANUAL
    if checkout.is_file():
        return checkout
    try:
        files = metadata.files("clod-adapter") or []
    except metadata.PackageNotFoundError:
        return None
    found = (Path(str(file.locate())).resolve() for file in files if file.parts[-2:] == ("clod-adapter", MANUAL))
    return next((page for page in found if page.is_file()), None)


# Budgets: name (as of budget.dial_for), metavar, type, help.
OPTIONS: tuple[tuple[str, str, type, str], ...] = (
    ("keep", "N", int, "the dial value that keeps N Gaussians {where}"),
    ("fps", "F", float, "the dial value that renders F frames per second, by frame times {times}"),
    ("psnr_drop", "DB", float, "the dial value that loses DB decibels against s = 1, by the calibration"),
)  # fmt: skip
BUDGETS = """\
budgets, each solved for a dial value:
  --keep       exact; s = 1 keeps fewer Gaussians than the file has
  --psnr-drop  from the calibration in the file's header
  --fps        times some frames first; depends on machine, image size and load
If s = 1 meets the budget, or the largest trained dial value loses less than DB,
that is the result. A count or frame rate that is out of reach is an error.
"""


def add_activated(options: _ActionsContainer) -> None:
    options.add_argument(
        "--activated", choices=["none", "opacity", "scales", "both"],
        help="values that the file stores after activation (sigmoid of opacities, exp of scales)",
    )  # fmt: skip


def add_antialiasing(options: _ActionsContainer, photographs: bool = True) -> None:
    otherwise = "by the photographs" if photographs else "off"
    options.add_argument(
        "--antialiasing", choices=["auto", *FILTERS], default="auto",
        help="screen-space filter of the training: off, on (gsplat's rasterize_mode antialiased, Inria's "
        f"--antialiasing), mip (Mip-Splatting), or auto: as the file says, else {otherwise} (default: auto)",
    )  # fmt: skip


def add_device(options: _ActionsContainer, what: str) -> None:
    usual = "auto: the NVIDIA GPU if gsplat works on it, else the CPU (default: auto)"
    options.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto", help=f"where to {what}; {usual}")


def add_images(options: _ActionsContainer) -> None:
    scene = "scene folder: photographs, and a COLMAP model or transforms.json"
    options.add_argument("--images", metavar="DIR", required=True, help=scene)


def add_misaligned_ok(options: _ActionsContainer) -> None:
    options.add_argument(
        "--misaligned-ok", action="store_true", help="train even if the checkpoint does not match the photographs"
    )


def add_dial_options(options: _ActionsContainer, sv_help: str, where: str, *, several: bool) -> None:
    """Adds --sv and the budgets, of which one may be given; ``several`` allows more than one value of it."""
    times = "measured first" if several else "in the file, or with --images measured first"
    group: Any = options.add_mutually_exclusive_group()
    count = "+" if several else 1
    group.add_argument("--sv", metavar="S", type=float, nargs=count, help=sv_help)
    for name, metavar, kind, text in OPTIONS:
        option = f"--{name.replace('_', '-')}"
        shown = text.format(where=where, times=times)
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


def page_files(path: Path, charts: list[str]) -> list[Path]:
    """The files of a page and its charts; refuses a page that cannot be written."""
    check_matplotlib()
    if path.suffix.lower() != ".html":
        raise ClodError(f"{path}: --report names the page to write, so it must end in .html")
    return [path, *(chart_file(path, name) for name in charts)]


def check_dials(args: Namespace, model: str, *, measured: Collection[str] = ("fps",)) -> None:
    """Refuses dial values out of range, and budgets that need something the file does not have.

    Args:
        measured: budgets that the command solves by measuring, without a calibration.
    """
    for virtual_scale in args.sv or ():
        if not 0 <= virtual_scale < math.inf:
            raise ClodError(f"--sv has {virtual_scale:g}, it must be at least 0 (1 is full quality, 0 everything)")
    budget = given_budget(args)
    if budget is None:
        return
    name, option, values = budget
    for value in values:
        if not 0 < value < math.inf:
            raise ClodError(f"{option} has {value:g}, it must be positive and finite")
    if not model_has_dial(model):
        raise ClodError(f"{model}: has no sigma_d, which {option} needs; adapt it first: clod-adapt {model} ...")
    needed = name != "keep" and name not in measured
    if needed and not may_store(model, "calibrated"):
        raise ClodError(
            f"{model}: has no calibration in its header, which {option} needs; adapt it again without interrupting, "
            "or give --sv or --keep"
        )


def may_store(model: str, name: str) -> bool:
    """Whether a PLY's header has a comment of this name (``ply_settings``); True of formats that must be read."""
    from clod_adapter.io.ply import all_comments, read_head  # here: --help needs no plyfile
    from clod_adapter.io.ply_settings import PREFIX

    path = Path(model)
    if format_of(path) is not PLY:
        return True
    return any(comment.startswith(f"{PREFIX}{name} ") for comment in all_comments(read_head(path).ply))


def check_stored_cameras(model: str, stored: bool) -> None:
    """Refuses --device-preset without a scene, of a file that stores no cameras."""
    if not stored:
        raise ClodError(f"{model}: stores no cameras, which --device-preset needs; give --images")


def model_has_dial(model: str) -> bool:
    """Whether the file's header has a sigma_d."""
    return file_has_dial(Path(model))


def check_checkpoint(path: str) -> None:
    """Refuses a file that is no checkpoint, by its first bytes."""
    check_readable(Path(path))


def check_scene(folder: str) -> None:
    """Refuses anything but a folder with a COLMAP model or a transforms.json."""
    if not Path(folder).is_dir():
        raise ClodError(f"{folder}: is not a folder; give the one that holds images/ and sparse/0")
    find_cameras(Path(folder))
