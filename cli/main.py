"""The ``clod-adapt`` command: picks the command, runs it, and turns what went wrong into one line."""

from __future__ import annotations

import argparse
import json
import os
import sys
from contextlib import nullcontext, redirect_stdout
from typing import Any, NoReturn

from clod_adapter.cli import adapt, apply, demo, evaluate
from clod_adapter.cli.report import jsonable
from clod_adapter.errors import ClodError
from clod_adapter.io.version import package_version

PROG = "clod-adapt"

# A command is a module with the texts SUMMARY, USAGE, DESCRIPTION and EPILOG, ``add_arguments(parser)`` and
# ``run(args)``, which returns the object that --json prints. Adapting is the main job and needs no word.
COMMANDS: dict[str, Any] = {"eval": evaluate, "apply": apply, "demo": demo}


def main(argv: list[str] | None = None) -> int:
    """Runs a command line; returns its exit code: 0, 2 for bad input, 130 when interrupted with nothing written."""
    words = sys.argv[1:] if argv is None else argv
    name = words[0] if words and words[0] in COMMANDS else ""
    try:
        args = build_parser(name).parse_args(words[1:] if name else words)
        with redirect_stdout(sys.stderr) if args.json else nullcontext():
            report = COMMANDS.get(name, adapt).run(args)
        if args.json:
            print(json.dumps(jsonable(report), allow_nan=False))
        sys.stdout.flush()
    except ClodError as error:
        print(f"{PROG}: error: {' '.join(str(error).splitlines())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{PROG}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of a pipe is gone; without this Python complains once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


class Parser(argparse.ArgumentParser):
    """Reports misuse like any other bad input: in one line, by ``main``."""

    def error(self, message: str) -> NoReturn:
        raise ClodError(f"{message} ({self.prog} --help explains)")


def build_parser(name: str) -> argparse.ArgumentParser:
    """The parser of a command; of the main job for an empty name."""
    command = COMMANDS.get(name, adapt)
    prog = f"{PROG} {name}".strip()
    parser = Parser(
        prog=prog, usage=f"{prog} {command.USAGE}", description=command.DESCRIPTION, epilog=command.EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    command.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout, all else on stderr")
    if not name:
        others = "\n".join(f"  {PROG} {word:<6} {module.SUMMARY}" for word, module in COMMANDS.items())
        parser.epilog = f"other commands, each with its own --help:\n{others}\n\n{command.EPILOG}"
        parser.add_argument("--version", action="version", version=f"{PROG} {package_version()}")
    return parser


if __name__ == "__main__":
    sys.exit(main())
