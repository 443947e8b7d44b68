"""``clod-adapt apply``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.errors import ClodError

from ..shared.files import check_ply_name
from ..shared.outputs import check_outputs
from .checks import check_checkpoint
from .command import Command
from .options import add_activated


def apply_options(parser: ArgumentParser) -> None:
    parser.add_argument("base", metavar="BASE.ply", help="the checkpoint that was adapted")
    parser.add_argument("adapter", metavar="ADAPTER.safetensors", help="what clod-adapt wrote beside its PLY")
    parser.add_argument("-o", "--out", metavar="OUT.ply", required=True, help="what to write; replaced if it exists")
    add_activated(parser)
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")


def check_apply(args: Namespace) -> None:
    out = Path(args.out)
    check_ply_name(out, "--out")
    if not Path(args.adapter).is_file():
        raise ClodError(f"{args.adapter}: No such file; give the .safetensors that clod-adapt wrote")
    check_outputs([out], [args.base, args.adapter])
    check_checkpoint(args.base)


APPLY = Command(
    module="apply",
    summary="Make the adapted PLY from checkpoint and adapter.",
    description="Make the adapted PLY again from the checkpoint and the small adapter file.",
    usage="BASE.ply ADAPTER.safetensors -o OUT.ply [--json]",
    epilog="""\
OUT.ply is bit for bit what clod-adapt wrote. BASE.ply must be the very file
that was adapted: its SHA-256 is compared with the one in the adapter.

example:
  clod-adapt apply garden.ply garden_clod.safetensors -o again.ply
""",
    add_arguments=apply_options,
    check=check_apply,
)
