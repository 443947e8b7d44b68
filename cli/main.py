"""The ``clod-adapt`` command: selects the command, runs it, and turns errors into one line."""

import argparse
import io
import json
import os
import sys
import traceback
from contextlib import nullcontext, redirect_stdout
from difflib import get_close_matches
from importlib import import_module
from types import ModuleType

from clod_adapter import ClodError, Stopped
from clod_adapter._support.text import as_text, package_version

from . import adapt
from .shared import process
from .shared.command import Parser, parser_of
from .shared.console import Console
from .shared.outputs import Outputs, claimed, jsonable

PROG = "clod-adapt"
INTERRUPTED = 130  # exit code
# what most commands import
LIBRARY = ("torch", "numba", "clod_adapter.io.scene.load", "clod_adapter.training.loop")
# similarity of a misspelt command: two neighbouring letters exchanged in "view" have it
NEAR = 0.75
REPORT = "please report it, with the lines above, as an issue of this program's repository"

FIRST = f"""\
Give a trained 3D Gaussian splat a quality dial:
  {PROG} PLY --images DIR   DIR: the photographs and their COLMAP model
  {PROG} PLY                without photographs
  {PROG} demo               on a built-in scene
  {PROG} --help             all options and commands
"""

# Each is a module, imported on first use, with DESCRIPTION, USAGE, EPILOG, and execute(args), which
# gives the rest of what --json prints, or None. It may have add_arguments(parser), check(args), and
# outputs(args), which is called after it. It imports torch within functions, so that --help and the
# errors of check take no second. Adapting has no name.
COMMANDS = {
    "view": "Look at a file in the browser, and turn its dial.",
    "inspect": "Print what a file is and what it contains.",
    "eval": "Measure quality, count and time at some dial values.",
    "render": "Render a scene's cameras at some dial values to PNG.",
    "export": "Write a file for other tools: another format, or plain.",
    "apply": "Rebuild the adapted PLY from checkpoint and adapter.",
    "robustness": "Adapt checkpoints at several ranges, and plot them.",
    "demo": "Run everything on a built-in scene; nothing to download.",
    "doctor": "Check what renders here, and say how to fix the rest.",
}
WITHOUT_TORCH = ("inspect", "doctor")  # which load it where they need it


def main(argv: list[str] | None = None) -> int:
    """Runs a command line; returns its exit code: 2 for bad input, 130 if interrupted without a
    result, 1 for a bug.
    """
    words = sys.argv[1:] if argv is None else argv
    with process.unbreakable_streams():
        try:
            with process.silence_but_first():
                return _main(words)
        except Exception:
            traceback.print_exc()
            return refuse(
                f"this is a bug in {PROG} {package_version()}, not in the input: {REPORT}", 1, words
            )


def refuse(why: str, code: int, words: list[str]) -> int:
    """Prints why a command failed, with --json also as the one object on stdout; returns the exit
    code.
    """
    line = f"{PROG}: {why}" if code == INTERRUPTED else f"{PROG}: error: {why}"
    print(line, file=sys.stderr)
    if "--json" in words:
        print(json.dumps({"error": as_text(why), "code": code}))
    return code


def _main(words: list[str]) -> int:
    name = words[0] if words and words[0] in COMMANDS else ""
    try:
        with process.interrupt_as_stopped():
            if not words:
                print(FIRST, end="")
                return 0
            if (
                not name
                and not os.path.exists(words[0])
                and (near := get_close_matches(words[0], COMMANDS, 1, NEAR))
            ):
                raise ClodError(
                    f"{words[0]}: no such file or command; did you mean {PROG} {near[0]}?"
                )
            args = build_parser(name).parse_args(words[1:] if name else words)
            return run_here(name, args)
    except ClodError as error:
        return refuse(" ".join(str(error).splitlines()), 2, words)
    except Stopped:
        return refuse("interrupted", INTERRUPTED, words)
    except (MemoryError, RuntimeError, ImportError, OSError) as error:
        if (line := process.shortage(error)) is not None:
            return refuse(line, 2, words)
        if not isinstance(error, OSError):
            raise
        name = f"{error.filename}: " if error.filename is not None else ""
        return refuse(
            f"{name}{error.strerror or error}; check the path and its permissions", 2, words
        )


def command_of(name: str) -> ModuleType:
    return import_module(f".{name}", __package__) if name else adapt


def run_here(name: str, args: argparse.Namespace) -> int:
    """Runs a command and returns its exit code. Of several processes the first runs it; the others
    only train.
    """
    launch = process.launched()
    if launch.size == 1:
        return run(name, args)
    if name:
        raise ClodError("only adapting takes several processes; run this command without torchrun")
    from .adapt.processes import rank0_session, run_worker

    if launch.rank > 0:
        with process.signals_as_interrupt():
            run_worker()
        return 0
    with rank0_session():
        return run(name, args)


def run(name: str, args: argparse.Namespace) -> int:
    """Runs a command, prints its report with --json, and returns the report's exit code, or 0."""
    process.check_surroundings()
    command = command_of(name)
    if args.json:
        process.check_printed()
    if hasattr(command, "check"):
        command.check(args)
    outputs = command.outputs(args) if hasattr(command, "outputs") else Outputs()
    with process.signals_as_interrupt(), claimed(outputs):
        if name not in WITHOUT_TORCH:
            with Console(args.quiet).status("starting ..."):
                for module in LIBRARY:
                    import_module(module)
        aside = io.StringIO() if args.quiet else sys.stderr
        # Again: pycolmap, imported just now, sets a handler.
        with redirect_stdout(aside) if args.json else nullcontext(), process.signals_as_interrupt():
            report = command.execute(args) or {}
    if args.json and report:
        report = {"command": name or "adapt", "version": package_version()} | report
        print(json.dumps(jsonable(report), allow_nan=False))
    if args.json or (report and "outputs" not in report):
        process.check_printed()
    return int(report.get("exit_code", 0))


def build_parser(name: str) -> Parser:
    parser = parser_of(command_of(name), f"{PROG} {name}".strip())
    if not name:
        others = "\n".join(f"  {PROG} {word:<10} {summary}" for word, summary in COMMANDS.items())
        parser.epilog = f"other commands, each with its own --help:\n{others}\n\n{adapt.EPILOG}"
        parser.general.add_argument(
            "--version", action="version", version=f"{PROG} {package_version()}"
        )
    return parser


if __name__ == "__main__":
    sys.exit(main())
