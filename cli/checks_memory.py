"""What of ``--memory`` and ``--chunk`` can be seen to be wrong without torch."""

from __future__ import annotations

from argparse import Namespace

from clod_adapter.cli.launch import launched
from clod_adapter.errors import ClodError
from clod_adapter.memory import parse_size


def check_memory(args: Namespace) -> None:
    if args.memory is not None:
        parse_size(args.memory)
        if launched().size > 1:
            raise ClodError(
                "--memory is for one process: leave out torchrun, and give jobs of their own each a --chunk"
            )
    if args.chunk is None:
        return
    if args.memory is None:
        raise ClodError("--chunk is of a run in chunks, which --memory makes; give it too")
    if args.chunk != "start" and not (args.chunk.isascii() and args.chunk.isdigit() and int(args.chunk) >= 1):
        raise ClodError(f"--chunk is {args.chunk!r}; give start, or the number of a chunk, from 1")
