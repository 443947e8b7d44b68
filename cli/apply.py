"""``clod-adapt apply``: rebuilds the adapted file from the checkpoint and an adapter."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from clod_adapter._support.version import package_version
from clod_adapter.adapter import dial_tensors
from clod_adapter.errors import ClodError
from clod_adapter.io.adapter_file import load_adapter
from clod_adapter.io.checkpoint import save, trimmed

from .shared.console import Console, put
from .shared.files import size
from .shared.inputs import read_checkpoint


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, adapter = Console(args.quiet), load_adapter(args.adapter)
    for note in adapter.notes:
        console.note(f"{args.adapter}: {note}")
    base = read_checkpoint(args.base, console, args.activated, adapter.origin)
    try:
        adapted = adapter.apply(base.gaussians, base.fingerprint)
    except ClodError as error:
        raise ClodError(f"{args.base}: {error}") from error
    rows = trimmed(base, adapter.kept, adapter.sh_degree)
    save(args.out, adapted, rows, version=adapter.version, calibration=adapter.calibration)
    dial = " and ".join(dial_tensors(adapted))
    put(f"wrote {args.out} ({size(Path(args.out))}): {len(adapted):,} Gaussians with {dial}")
    return {
        "command": "apply", "version": package_version(), "base": args.base, "adapter": args.adapter,
        "base_count": adapter.base_count, "changed": sorted(adapter.updates), "notes": [*adapter.notes, *base.notes],
        "outputs": {"ply": args.out},
    }  # fmt: skip
