"""The rank of this process among those that torchrun, or a launcher with the same variables, started."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass

from clod_adapter.errors import ClodError

NEEDED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


@dataclass(frozen=True)
class Launch:
    """The place of this process in its group.

    Attributes:
        rank, size: index of this process, from 0, and number of processes.
        local_rank, local_size: the same among the processes on this machine.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1


def launched() -> Launch:
    """Reads the environment variables; a single process without them.

    Raises:
        ClodError: their values are inconsistent.
    """
    if not all(name in os.environ for name in NEEDED):
        return Launch()
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    found = {name: os.environ[name] for name in names if name in os.environ}
    try:
        launch = Launch(*(int(found.get(name, default)) for name, default in zip(names, (0, 1, 0, 1), strict=True)))
    except ValueError:
        launch = Launch(-1)
    if not 0 <= launch.rank < launch.size or not 0 <= launch.local_rank < launch.local_size:
        shown = ", ".join(f"{name}={value}" for name, value in found.items())
        raise ClodError(f"inconsistent environment variables: {shown}; start the processes with torchrun")
    return launch


@contextmanager
def silence_but_first() -> Iterator[None]:
    """Within the block, only the first of several processes prints; an exception that leaves it is not silenced."""
    if os.environ.get("RANK", "0") == "0" or not all(name in os.environ for name in NEEDED):
        yield
        return
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield
