"""What of a plan's options is refused without torch."""

from __future__ import annotations

from argparse import Namespace

from clod_adapter.errors import ClodError


def check_plan(args: Namespace) -> None:
    if both := sorted(set(args.keep_in) & set(args.leave_out)):
        raise ClodError(f"--with and --without both name {', '.join(both)}; give each to one of them")
