"""``clod-adapt apply``: rebuilds the adapted file from the checkpoint and an adapter."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter import ClodError
from clod_adapter.io.file_formats import check_readable

from .shared.command import add_activated, add_input, add_out
from .shared.console import Console
from .shared.outputs import Outputs, Report, check_ply_name, size


def add_arguments(parser: ArgumentParser) -> None:
    given = add_input(parser, "base", "BASE.ply", "the checkpoint that was adapted")
    given.add_argument(
        "adapter", metavar="ADAPTER.safetensors", help="the adapter that clod-adapt wrote"
    )
    add_activated(given)
    add_out(parser, "OUT.ply", "output file; replaced if it exists", required=True)


def check(args: Namespace) -> None:
    check_ply_name(Path(args.out), "--out")
    if not Path(args.adapter).is_file():
        raise ClodError(
            f"{args.adapter}: No such file; give the .safetensors that clod-adapt wrote"
        )
    check_readable(Path(args.base))


def outputs(args: Namespace) -> Outputs:
    return Outputs([Path(args.out)], inputs=[args.base, args.adapter])


def execute(args: Namespace) -> Report:
    from clod_adapter import load_adapter, save
    from clod_adapter.adapter import dial_tensors

    from .shared.inputs import read_checkpoint

    console, adapter = Console(args.quiet), load_adapter(args.adapter)
    console.note(*adapter.notes, of=args.adapter)
    base = read_checkpoint(args.base, console, args.activated, adapter.origin)
    try:
        adapted = adapter.apply(base.gaussians, base.fingerprint)
    except ClodError as error:
        raise ClodError(f"{args.base}: {error}") from error
    save(args.out, adapted, base, version=adapter.version, quality_table=adapter.quality_table)
    dial = " and ".join(dial_tensors(adapted))
    print(f"wrote {args.out} ({size(Path(args.out))}): {len(adapted):,} Gaussians with {dial}")
    return {
        "base": args.base,
        "adapter": args.adapter,
        "base_count": adapter.base_count,
        "changed": sorted(adapter.updates),
        "notes": console.notes,
        "outputs": {"ply": args.out},
    }


DESCRIPTION = "Rebuild the adapted PLY from checkpoint and adapter."
USAGE = "BASE.ply ADAPTER.safetensors -o OUT.ply [--json]"
EPILOG = """\
OUT.ply equals the file that clod-adapt wrote, bit for bit. BASE.ply must be the
checkpoint that was adapted: the adapter stores its SHA-256.

example:
  clod-adapt apply garden.ply garden_clod.safetensors -o again.ply
"""
