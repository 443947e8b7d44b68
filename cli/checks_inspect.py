"""What ``clod-adapt inspect`` refuses without torch."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from clod_adapter.io.readers import check_readable


def check_inspect(args: Namespace) -> None:
    path = Path(args.file)
    if path.suffix.lower() != ".safetensors":  # which may be an adapter or a state, and no splat
        check_readable(path)
