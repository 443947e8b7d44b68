"""``clod-adapt inspect``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.io.file_formats import check_readable

from .command import Command


def inspect_options(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    given.add_argument("file", metavar="FILE", help="a splat, an adapter, or the state of an interrupted run")
    parser.set_defaults(quiet=True)


def check_inspect(args: Namespace) -> None:
    path = Path(args.file)
    if path.suffix.lower() != ".safetensors":  # an adapter or a state is no splat
        check_readable(path)


INSPECT = Command(
    module="inspect",
    summary="Print what a file is and what it contains.",
    description="""\
Print what a file is, which program wrote it, what it contains, and what
adapting it would exclude. Reads only.
""",
    usage="FILE [--json]",
    epilog="""\
FILE can be a PLY (also compressed), gsplat's .pt, an adapter or the state of an
interrupted run (.safetensors), any format of clod-adapt export, and, with
splat-transform installed, .sog or .ksplat.

  looks like   a guess from comments and the order of properties
  says         comments in the file, for example of a baked one
  needle       a Gaussian more than 10 times as long as its second axis
  tau          culling threshold of the opacity at s = 1: the file's own, or the
               one that adapting would use

--json also has all properties and numbers.

exit codes: 0 read; 2 damaged or of another kind, one line on stderr

examples:
  clod-adapt inspect garden.ply
  clod-adapt inspect garden_clod.safetensors --json
""",
    add_arguments=inspect_options,
    check=check_inspect,
)
