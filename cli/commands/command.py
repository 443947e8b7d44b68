"""A command: its ``--help`` text, options, early checks, and the module that runs it."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import dataclass

from ..shared.outputs import Outputs


@dataclass(frozen=True)
class Command:
    """The texts of ``--help``, and the functions that parse, check and run a command.

    Attributes:
        module: name below ``clod_adapter.cli``; its ``run(args)`` returns the object that --json prints. It may import
            torch.
        add_arguments: adds the options, in groups, to a parser.
        check: raises ClodError, before torch is imported, for arguments and files that cannot work.
        outputs: the files that the arguments name for writing, and those they name for reading; after ``check``.
    """

    module: str
    summary: str
    description: str
    usage: str
    epilog: str
    add_arguments: Callable[[ArgumentParser], None]
    check: Callable[[Namespace], None]
    outputs: Callable[[Namespace], Outputs] = lambda args: Outputs()
