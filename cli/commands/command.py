"""A command: what ``--help`` says of it, its options, its checks, and the module that runs it."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """What ``--help`` says of a command, and its options.

    Attributes:
        module: of ``clod_adapter.cli``; its ``run(args)`` returns the object that --json prints. It may import torch.
        add_arguments: adds the options to a parser.
        check: refuses, before torch is imported, arguments and files that cannot work.
    """

    module: str
    summary: str
    description: str
    usage: str
    epilog: str
    add_arguments: Callable[[ArgumentParser], None]
    check: Callable[[Namespace], None]
