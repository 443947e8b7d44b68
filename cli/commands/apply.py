"""``clod-adapt apply``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.errors import ClodError

from ..shared.files import check_ply_name
from ..shared.outputs import Outputs
from .checks import check_checkpoint
from .command import Command
from .options import add_activated


def apply_options(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    given.add_argument("base", metavar="BASE.ply", help="the checkpoint that was adapted")
    given.add_argument("adapter", metavar="ADAPTER.safetensors", help="the adapter that clod-adapt wrote")
    add_activated(given)
    output = parser.add_argument_group("output")
    output.add_argument("-o", "--out", metavar="OUT.ply", required=True, help="output file; replaced if it exists")


def check_apply(args: Namespace) -> None:
    check_ply_name(Path(args.out), "--out")
    if not Path(args.adapter).is_file():
        raise ClodError(f"{args.adapter}: No such file; give the .safetensors that clod-adapt wrote")
    check_checkpoint(args.base)


APPLY = Command(
    module="apply",
    summary="Rebuild the adapted PLY from checkpoint and adapter.",
    description="Rebuild the adapted PLY from the checkpoint and the small adapter file.",
    usage="BASE.ply ADAPTER.safetensors -o OUT.ply [--json]",
    epilog="""\
OUT.ply equals the file that clod-adapt wrote, bit for bit. BASE.ply must be the
checkpoint that was adapted: the adapter stores its SHA-256.

example:
  clod-adapt apply garden.ply garden_clod.safetensors -o again.ply
""",
    add_arguments=apply_options,
    check=check_apply,
    outputs=lambda args: Outputs([Path(args.out)], inputs=[args.base, args.adapter]),
)
