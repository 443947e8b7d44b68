"""The parser of a command, for ``main`` and for a command that runs another one."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from clod_adapter.errors import ClodError

from ..shared.manual import manual
from ..shared.streams import check_printed
from .command import Command


class Parser(argparse.ArgumentParser):
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


def make_parser(command: Command, prog: str) -> Parser:
    """The parser of a command, with the options that all commands have."""
    parser = Parser(
        prog=prog, usage=f"{prog} {command.usage}", description=command.description, epilog=command.epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter, add_help=False, allow_abbrev=False,
    )  # fmt: skip
    command.add_arguments(parser)
    parser.general = parser.add_argument_group("general")
    parser.general.add_argument("-h", "--help", action="help", help="show this text")
    if parser.get_default("quiet") is None:
        parser.general.add_argument("--quiet", action="store_true", help="no progress, no notes")
    parser.general.add_argument("--json", action="store_true", help="one JSON object on stdout")
    return parser
