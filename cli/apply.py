"""``clod-adapt apply``: an adapter and its base make the extended file again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from clod_adapter.cli.console import Console
from clod_adapter.cli.files import check_output, check_ply_name, read_checkpoint, size
from clod_adapter.errors import ClodError
from clod_adapter.io.adapter_file import load_adapter
from clod_adapter.io.ply import save
from clod_adapter.io.version import package_version

SUMMARY = "Make the adapted PLY from checkpoint and adapter."
DESCRIPTION = "Make the adapted PLY again from the checkpoint and the small adapter file."
USAGE = "BASE.ply ADAPTER.safetensors -o OUT.ply [--json]"
EPILOG = """\
OUT.ply is bit for bit what clod-adapt wrote. BASE.ply must be the very file
that was adapted: its SHA-256 is compared with the one in the adapter.

example:
  clod-adapt apply garden.ply garden_clod.safetensors -o again.ply
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("base", metavar="BASE.ply", help="the checkpoint that was adapted")
    parser.add_argument("adapter", metavar="ADAPTER.safetensors", help="what clod-adapt wrote beside its PLY")
    parser.add_argument("-o", "--out", metavar="OUT.ply", required=True, help="what to write; replaced if it exists")
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")


def run(args: argparse.Namespace) -> dict[str, Any]:
    out = Path(args.out)
    check_ply_name(out, "--out")
    check_output(out, [args.base, args.adapter])
    adapter = load_adapter(args.adapter)
    base = read_checkpoint(args.base, Console(args.quiet))
    try:
        adapted = adapter.apply(base.gaussians, base.fingerprint)
    except ClodError as error:
        raise ClodError(f"{args.base}: {error}") from error
    save(out, adapted, base, version=adapter.version)
    print(f"wrote {args.out} ({size(out)}): {len(adapted):,} Gaussians with their dial")
    return {
        "command": "apply", "version": package_version(), "base": args.base, "adapter": args.adapter,
        "base_count": len(adapted), "changed": sorted(adapter.updates), "outputs": {"ply": args.out},
    }  # fmt: skip
