"""``clod-adapt inspect``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.io.file_formats import check_readable

from .command import Command


def inspect_options(parser: ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="a splat, an adapter, or the state of an interrupted run")
    parser.set_defaults(quiet=True)


def check_inspect(args: Namespace) -> None:
    path = Path(args.file)
    if path.suffix.lower() != ".safetensors":  # which may be an adapter or a state, and no splat
        check_readable(path)


INSPECT = Command(
    module="inspect",
    summary="Say what a file is and what is in it.",
    description="""\
Say what a file is, who wrote it as far as it tells, what is in it, and what
adapting it would leave out. Nothing is changed, nothing is written.
""",
    usage="FILE [--json]",
    epilog="""\
Reads what clod-adapt reads: PLY (compressed, too), gsplat's .pt, adapters and
the states of interrupted runs (.safetensors), .sog and .ksplat through
splat-transform where that is installed, and the formats of clod-adapt export.
A file that is none of these is refused with what it is, where that shows.

  looks like   a guess from comments and the order of properties, never a proof
  says         comments in the file, by which to know a baked one
  needle       a Gaussian more than 10 times as long as its second axis
  tau          opacity below which the dial leaves out at s = 1: the file's own,
               or the one that adapting would start from

--json has all of it, the properties and numbers of the file included.

exit codes: 0 it was read; 2 it is broken or something else, one line on stderr

examples:
  clod-adapt inspect garden.ply
  clod-adapt inspect garden_clod.safetensors --json
""",
    add_arguments=inspect_options,
    check=check_inspect,
)
