"""Time of a training step by section and kernel, on real checkpoints.

Wall times are means over the steps after the first few, at the start of a training: steps with photographs of half the
size (``coarse`` 1), then, in a training of its own, as many with whole ones (``coarse`` 0). None is at s = 1 or 0
(``full_share`` 0), where photographs are never halved. The other settings are the defaults; a default training mixes
these kinds of steps.
``splat_share`` is the rasterizer's share of a step. A row names the commit of the imported package: to measure another
one, put it first on PYTHONPATH.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import clod_adapter as clod
from clod_adapter._kernels import threads
from clod_adapter.initialization.importance import for_training, initialize
from clod_adapter.rasterizers import cpu
from clod_adapter.training import objective, optimizer
from clod_adapter.training.trainer import Trainer
from clod_adapter.training.view_sampler import ViewSampler
from common import append, arguments, checkpoint, photographs

import torch

FILE = "step.jsonl"
THREADS = 2
SECTIONS = {"count_gradient_at": "count", "photometric_loss": "loss"}
HALVED, WHOLE = 1.0, 0.0  # coarse: the share of the training with photographs of half the size


class Clock:
    """Adds up the time spent in functions, by name; a function called from another one counts in both."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def wrap(self, owner: Any, attribute: str, name: str | None = None) -> None:
        """Times ``owner.attribute``, under its first argument's name where ``name`` is None."""
        inner: Callable[..., Any] = getattr(owner, attribute)

        def timed(*args: Any, **kwargs: Any) -> Any:
            began = time.perf_counter()
            try:
                return inner(*args, **kwargs)
            finally:
                self.seconds[name or f"kernel {args[0].__name__}"] += time.perf_counter() - began

        static = isinstance(owner, type) and isinstance(owner.__dict__[attribute], staticmethod)
        setattr(owner, attribute, staticmethod(timed) if static else timed)


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("scenes", nargs="*", default=["plush_half", "bonsai146"])
    args = parser.parse_args()
    torch.set_num_threads(THREADS)
    clock = Clock()
    clock.wrap(threads, "run")
    for name, section in SECTIONS.items():
        clock.wrap(objective, name, section)
    clock.wrap(torch.autograd, "grad", "backward")
    clock.wrap(ViewSampler, "draw", "sample")
    clock.wrap(cpu, "kept", "kept")
    clock.wrap(cpu, "draw", "splat forward")
    clock.wrap(cpu._Drawn, "backward", "splat backward")
    clock.wrap(optimizer.RowAdam, "step", "optimiser")
    for scene in args.scenes:
        for measured in profile(scene, 120, clock):
            row = {"benchmark": "step", "scene": scene, "threads": THREADS, **measured}
            print(json.dumps(row, indent=1), flush=True)
            if args.record:
                append(FILE, row)


def profile(scene: str, steps: int, clock: Clock, warm: int = 5) -> Iterator[dict[str, Any]]:
    """Milliseconds a step, in all and by section; of half-size and of whole photographs."""
    base, views = checkpoint(scene).gaussians, photographs(scene).train
    config = clod.AdaptConfig(full_share=0.0)
    begun = for_training(initialize(base, views, config), views, config)
    for coarse in (HALVED, WHOLE):
        run = Trainer(begun, views, replace(config, coarse=coarse))
        for _ in range(warm):
            run.step(0.0)
        clock.seconds.clear()
        began = time.perf_counter()
        for _ in range(steps):
            run.step(0.0)
        total = (time.perf_counter() - began) / steps
        sections = {name: round(seconds / steps * 1e3, 2) for name, seconds in clock.seconds.items()}
        splat = (clock.seconds["splat forward"] + clock.seconds["splat backward"]) / steps
        yield {
            "halved": coarse == HALVED, "full_share": config.full_share, "steps": steps,
            "step_ms": round(total * 1e3, 2), "splat_share": round(splat / total, 3), "ms": sections,
        }  # fmt: skip


if __name__ == "__main__":
    main()
