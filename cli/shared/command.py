"""A command: its ``--help`` text, options and early checks, and the function that runs it."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, NoReturn

from clod_adapter.errors import ClodError

from .outputs import Outputs
from .streams import check_printed

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
