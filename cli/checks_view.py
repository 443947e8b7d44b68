"""What of ``clod-adapt view`` can be seen to be wrong without torch."""

from __future__ import annotations

import math
from argparse import Namespace

from clod_adapter.cli import checks
from clod_adapter.errors import ClodError


def check_view(args: Namespace) -> None:
    if not 0 <= args.port < 1 << 16:
        raise ClodError(f"--port is {args.port}, it must be between 1 and 65535, or 0 for a free one")
    if not 1 <= args.sv < math.inf:
        raise ClodError(f"--sv is {args.sv:g}, it must be at least 1 (1 is full quality)")
    for path in (args.model, *([args.base] if args.base else [])):
        checks.check_checkpoint(path)
    if args.images is not None:
        checks.check_scene(args.images)
