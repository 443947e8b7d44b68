"""The parser of a command, for ``main`` and for a command that runs another one."""

from __future__ import annotations

import argparse
from typing import NoReturn

from clod_adapter.errors import ClodError

from .command import Command


class Parser(argparse.ArgumentParser):
    """Reports misuse like any other bad input: in one line, by ``main``."""

    def error(self, message: str) -> NoReturn:
        raise ClodError(f"{message} ({self.prog} --help explains)")


def make_parser(command: Command, prog: str) -> Parser:
    """The parser of a command, with the options that all commands have."""
    parser = Parser(
        prog=prog, usage=f"{prog} {command.usage}", description=command.description, epilog=command.epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    command.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout, all else on stderr")
    return parser
