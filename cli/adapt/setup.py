"""The first value of the pipeline: the arguments, checked, and the services that later steps use."""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass

from clod_adapter.config import AdaptConfig
from clod_adapter.io.adapter_file import check_config

from ..commands.settings import make_config
from ..shared.console import Console
from ..shared.measure import Stopwatch
from ..shared.outputs import AdaptFiles
from ..shared.process import GracefulStop, launched
from .resume import Resumed, find_state


@dataclass(frozen=True)
class Setup:
    """One run, before anything but its state file is read.

    Attributes:
        config: of the options. ``Inputs.config`` may have lower learning rates.
        resumed: the state that ``--resume`` found.
    """

    args: argparse.Namespace
    config: AdaptConfig
    outputs: AdaptFiles
    console: Console
    watch: Stopwatch
    stop: GracefulStop
    resumed: Resumed | None

    @classmethod
    def of(cls, args: argparse.Namespace) -> Setup:
        """Raises the ClodError of options, or of a state file, that cannot be used."""
        console, stop = Console(args.quiet), GracefulStop(aborts=launched().size == 1)
        config, outputs = make_config(args), AdaptFiles.of(args.ply, args.out)
        check_config(asdict(config))
        resume = args.resume and (not args.memory or outputs.state.exists())  # blocks have files of their own
        resumed = find_state(outputs.state, resume, config, console)
        return cls(args, config, outputs, console, Stopwatch(), stop, resumed)
