"""The compiled kernels, loaded or on the first run compiled before anything is measured or timed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from numba.core.caching import NullCache
from numba.core.event import Event, Listener, install_listener

from clod_adapter.cameras import Camera, Scene, View
from clod_adapter.config import CLASSIC, AdaptConfig, ScreenFilter
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Stopped
from clod_adapter.training.loop import adapt

from .console import Console, Meter

CPU = torch.device("cpu")
OTHER = ""
# Share of each kernel in the time to compile all of them; used only for the progress shown.
SHARES = {"project_dialled": 0.23, "project_gradient": 0.16, "adam_rows": 0.12, OTHER: 0.03}


def prepare_kernels(
    console: Console, device: torch.device = CPU, *, training: bool = True, screen_filter: ScreenFilter = CLASSIC
) -> None:
    """Evaluates, and with ``training`` adapts, a scene of one Gaussian, so that all kernels are compiled.

    Training with a filter that compensates opacities needs another kernel.
    """
    one = Gaussians(
        torch.zeros(1, 3), torch.ones(1, 4), torch.zeros(1, 3), torch.zeros(1), torch.zeros(1, 1, 3),
        torch.zeros(1, 3, 3), screen_filter=screen_filter,
    ).to(device)  # fmt: skip
    viewmat, K = torch.eye(4), torch.eye(3)
    viewmat[2, 3] = 2.0
    view = View(Camera(viewmat, K, 4, 4), torch.zeros(4, 4, 3, dtype=torch.uint8))
    with announced_compiling(console, SHARES), one_thread():
        evaluate(one, [view], [1.0])
        if training:
            adapted = adapt(one, Scene((view,), ()), AdaptConfig(iters=1, full_share=1.0), progress=False)
            if adapted.interrupted:
                raise Stopped("stopped while the kernels were compiled")


@contextmanager
def one_thread() -> Iterator[None]:
    """Limits torch to one thread; after a Ctrl-C in one, each of several threads would compile on its own."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def announced_compiling(console: Console, shares: Mapping[str, float]) -> Iterator[None]:
    """Prints a line when something is compiled within the block, and the progress.

    Args:
        shares: of the compile time, by kernel and for ``OTHER`` ones.
    """
    listener = _Compiling(console, shares)
    try:
        with install_listener("numba:compile", listener):
            yield
    finally:
        listener.close()


class _Compiling(Listener):  # type: ignore[misc]
    """Follows compilations; functions that a kernel calls are compiled within its own."""

    def __init__(self, console: Console, shares: Mapping[str, float]) -> None:
        self.console, self.shares = console, shares
        self.meter: Meter | None = None
        self.depth, self.done = 0, 0.0

    def on_start(self, event: Event) -> None:
        self.depth += 1
        if not self.meter:
            cached = not isinstance(event.data["dispatcher"]._cache, NullCache)
            nowhere = "on every run, as no cache folder is writable: set NUMBA_CACHE_DIR"
            self.console.say(f"compiling kernels ({'first run only, well under a minute' if cached else nowhere}) ...")
            self.meter = Meter(self.console, "compiling", slow=True)

    def on_end(self, event: Event) -> None:
        self.depth -= 1
        if self.depth == 0 and self.meter:
            self.done += self.shares.get(event.data["dispatcher"].py_func.__name__, self.shares[OTHER])
            self.meter.update(self.done)

    def close(self) -> None:
        if self.meter:
            self.meter.close()
