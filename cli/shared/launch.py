"""Where this process stands among those that a launcher started, torchrun or another that sets the same variables."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass

from clod_adapter.errors import ClodError

NEEDED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


@dataclass(frozen=True)
class Launch:
    """Attributes:
    rank, size: which process this is, from 0, and how many there are; local_rank, local_size: of those on this machine.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1


def launched() -> Launch:
    """By the environment; one process by itself where it does not say otherwise.

    Raises:
        ClodError: the variables do not make sense.
    """
    if not all(name in os.environ for name in NEEDED):
        return Launch()
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    said = {name: os.environ[name] for name in names if name in os.environ}
    try:
        launch = Launch(*(int(said.get(name, default)) for name, default in zip(names, (0, 1, 0, 1), strict=True)))
    except ValueError:
        launch = Launch(-1)
    if not 0 <= launch.rank < launch.size or not 0 <= launch.local_rank < launch.local_size:
        shown = ", ".join(f"{name}={value}" for name, value in said.items())
        raise ClodError(f"the environment says {shown}, which cannot be; start the processes with torchrun")
    return launch


@contextmanager
def silence_but_first() -> Iterator[None]:
    """Within, of several processes the first alone prints; what the others would is the same, or it says it for them.

    An exception that leaves the block is none of that.
    """
    if os.environ.get("RANK", "0") == "0" or not all(name in os.environ for name in NEEDED):
        yield
        return
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield
