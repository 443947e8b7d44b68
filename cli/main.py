"""The ``clod-adapt`` command: picks the command, runs it, and turns what went wrong into one line."""

from __future__ import annotations

import io
import json
import os
import sys
from contextlib import nullcontext, redirect_stdout
from typing import Any

from clod_adapter.cli import adapt, apply, demo, evaluate
from clod_adapter.cli.parser import Parser, make_parser
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
        aside = io.StringIO() if args.quiet else sys.stderr
        with redirect_stdout(aside) if args.json else nullcontext():
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
    except OSError as error:
        name = f"{error.filename}: " if error.filename is not None else ""
        print(f"{PROG}: error: {name}{error.strerror or error}; check the path and its permissions", file=sys.stderr)
        return 2
    return 0


def build_parser(name: str) -> Parser:
    """The parser of a command; of the main job for an empty name."""
    command = COMMANDS.get(name, adapt)
    parser = make_parser(command, f"{PROG} {name}".strip())
    if not name:
        others = "\n".join(f"  {PROG} {word:<6} {module.SUMMARY}" for word, module in COMMANDS.items())
        parser.epilog = f"other commands, each with its own --help:\n{others}\n\n{command.EPILOG}"
        parser.add_argument("--version", action="version", version=f"{PROG} {package_version()}")
    return parser


if __name__ == "__main__":
    sys.exit(main())
