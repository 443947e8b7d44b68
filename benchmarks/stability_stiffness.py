"""Stiffness: optimisers, parameters and step sizes on values of sigma_d that span eight decades.

The slope of the equation goes as 1/sigma. All measurements use the package's equation, target-count curve, schedule and
mean of the last steps:

- ``equation``: Gaussians at distances over eight decades with known sigma_d that meets the target count. The loss is
  the mean square difference of the drawn opacities from the right ones. Starts are off by up to four decades each way.
  Every optimizer gets the same gradient, of the loss and of the count term.
- ``stuck`` and ``training``: the same through the training step itself (``stability_stuck.py``).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

from clod_adapter._kernels.threads import torch_on_one_thread
from clod_adapter.equation.attenuation import Attenuated, attenuate
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.report.style import BLUE, GREEN, ORANGE, PURPLE, QUIET
from clod_adapter.training.objective import SIGMA_RANGE
from clod_adapter.training.optimizer import RowAdam
from clod_adapter.training.target_count import count_gradient
from common import table
from stability_stuck import CONFIG, DIALS, STUCK_STEPS, TRAINING_STEPS, scene, stuck_rows, training_rows

import numpy as np
import torch
from torch import Tensor

RATES = tuple(10 ** (k / 2) for k in range(-8, 1))  # 1e-4 to 1 in half decades
WRONG = 4.0  # decades, each way
STEPS, LENGTHS = 600, (30, 100, 300, 1000)
CONVERGED = 0.25  # of the start's error
Stepper = Callable[[list[Tensor], list[float]], None]


def _torch_optimizer(kind: type[torch.optim.Optimizer], **settings: Any) -> Callable[[list[Tensor]], Stepper]:
    def make(runs: list[Tensor]) -> Stepper:
        optimizer = kind([{"params": [x]} for x in runs], lr=1.0, **settings)

        def step(gradients: list[Tensor], rates: list[float]) -> None:
            for group, gradient, rate in zip(optimizer.param_groups, gradients, rates, strict=True):
                group["params"][0].grad, group["lr"] = gradient, rate
            optimizer.step()

        return step

    return make


def _row_adam(runs: list[Tensor]) -> Stepper:
    names, rows = list(map(str, range(len(runs)))), torch.ones(len(runs[0]), dtype=torch.bool)
    optimizer = RowAdam(dict(zip(names, runs, strict=True)))
    return lambda gradients, rates: optimizer.step(
        dict(zip(names, gradients, strict=True)), rows, dict(zip(names, rates, strict=True))
    )


# AdamW is left out: its decay pulls sigma_d towards 0 (log sigma_d: 1), which nothing about a dial asks for.
OPTIMIZERS: dict[str, tuple[Callable[[list[Tensor]], Stepper], str]] = {
    "RowAdam": (_row_adam, BLUE),
    "Adam": (_torch_optimizer(torch.optim.Adam), GREEN),
    "AMSGrad": (_torch_optimizer(torch.optim.Adam, amsgrad=True), "#3aa6a0"),
    "NAdam": (_torch_optimizer(torch.optim.NAdam), "#8fb339"),
    "RMSprop": (_torch_optimizer(torch.optim.RMSprop), PURPLE),
    "Adagrad": (_torch_optimizer(torch.optim.Adagrad), ORANGE),
    "SGD, momentum 0.9": (_torch_optimizer(torch.optim.SGD, momentum=0.9), QUIET),
}


def measure() -> list[dict[str, Any]]:
    task, rows = problem(), []
    for optimizer, parameter in product(OPTIMIZERS, ("log", "linear")):
        own = {"part": "stiffness", "what": "equation", "optimizer": optimizer, "parameter": parameter}
        fit(task, optimizer, parameter, (1e-4,), 2)  # compiled, and imported by torch, before the clock starts
        errors = [task.error(sigma) for sigma in fit(task, optimizer, parameter, RATES, STEPS)[0]]
        rows += [own | {"rate": rate, "steps": STEPS, "error": e} for rate, e in zip(RATES, errors, strict=True)]
        best = RATES[int(np.nanargmin(errors))]
        for steps in LENGTHS:
            (sigma,), seconds = fit(task, optimizer, parameter, (best,), steps)
            rows.append(own | {"rate": best, "steps": steps, "error": task.error(sigma), "seconds": seconds})
    rows.append({"part": "stiffness", "what": "start", "error": task.error(task.start)})
    near = problem(1.0)
    for parameter in ("log", "linear"):  # for the default alone: how wide where the start is only a decade wrong
        errors = [near.error(sigma) for sigma in fit(near, "RowAdam", parameter, RATES, STEPS)[0]]
        good = [rate for rate, e in zip(RATES, errors, strict=True) if e <= CONVERGED * near.error(near.start)]
        rows.append({"part": "stiffness", "what": "near", "parameter": parameter, "steps": STEPS, "rates": good})
    return rows + stuck_rows() + training_rows()


@dataclass(frozen=True)
class Problem:
    """What the equation is to be fitted to: all ``[N]``, but ``wanted [dial values, N]``, the right ones as drawn."""

    logits: Tensor
    distances: Tensor
    right: Tensor
    start: Tensor
    wanted: Tensor

    def drawn(self, sigma: Tensor) -> Tensor:
        return _drawn(self.logits, sigma, self.distances)

    def error(self, sigma: Tensor) -> float:
        """Root mean square over Gaussians and dial values of the opacity they are drawn with, less the right one."""
        return float((self.drawn(sigma) - self.wanted).square().mean().sqrt())


def _drawn(logits: Tensor, sigma: Tensor, distances: Tensor) -> Tensor:
    settings = CONFIG.attenuation(1.0)
    return torch.stack([attenuate(logits, sigma, distances, s, settings).drawn for s in DIALS])


def problem(wrong: float = WRONG) -> Problem:
    """The scene's equation; the start is wrong by up to ``wrong`` decades each way, log-uniform."""
    some, camera = scene()
    distances, right = normalized_distances(some.means, camera, some.attenuation), some.sigma_d
    off = torch.empty(len(right)).uniform_(-wrong, wrong, generator=torch.Generator().manual_seed(1))
    return Problem(
        some.opacity_logits, distances, right, right * 10**off, _drawn(some.opacity_logits, right, distances)
    )


@torch_on_one_thread()
def fit(
    task: Problem, optimizer: str, parameter: str, rates: tuple[float, ...], steps: int
) -> tuple[list[Tensor], float]:
    """sigma_d after training as ``trainer.Trainer`` does it, at dial value 1 and another one a step; and seconds.

    One run a step size, all of them at once; they know nothing of each other.
    """
    log, n = parameter == "log", len(task.start)
    limits = tuple(map(math.log, SIGMA_RANGE)) if log else SIGMA_RANGE
    x = task.start.clamp(*SIGMA_RANGE)
    runs = [(x.log() if log else x).clone() for _ in rates]
    step, means, random = OPTIMIZERS[optimizer][0](runs), torch.zeros(len(rates), n), np.random.default_rng(0)
    began, averaged = time.perf_counter(), 0
    for k in range(steps):
        fall = CONFIG.lr_final ** (k / steps)
        gradients = _gradients(task, torch.stack(runs), log, int(random.integers(1, len(DIALS))))
        step(list(gradients), [rate * fall for rate in rates])
        for x in runs:
            x.clamp_(*limits)
        if k >= (1 - CONFIG.average) * steps:
            averaged += 1
            means.lerp_(torch.stack(runs), 1 / averaged)
    return list(means.exp() if log else means), time.perf_counter() - began


def _gradients(task: Problem, x: Tensor, log: bool, other: int) -> Tensor:
    """``[runs, N]``: gradient by ``x`` of the loss at dial value 1 and another one, and of the count term."""
    settings, n, total, pull = CONFIG.attenuation(1.0), len(task.start), torch.zeros(()), torch.zeros_like(x)
    leaf = x.requires_grad_()
    sigma = (leaf.exp() if log else leaf).flatten()
    logits, distances = task.logits.repeat(len(x)), task.distances.repeat(len(x))
    for k in (0, other):
        s = DIALS[k]
        dialled = attenuate(logits, sigma, distances, s, settings)
        losses = (dialled.drawn.view(-1, n) - task.wanted[k]).square().mean(1)
        weight = (1 - CONFIG.weight_slope * s / CONFIG.max_sv) ** 2
        total = total + weight * losses.sum()
        for run, loss in enumerate((weight * losses.detach()).tolist()):
            own = Attenuated(*(value[run * n : (run + 1) * n] for value in dialled))
            pull[run] += count_gradient(own, task.logits, s, settings.tau, loss, CONFIG)
    (gradient,) = torch.autograd.grad(total, leaf)
    return gradient + (pull if log else pull / x.detach())


def curves(rows: list[dict[str, Any]], timed: bool) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Rows by optimizer and parameter: over the learning rates; or, timed, over the steps at the best one."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        if row["what"] == "equation" and ("seconds" in row) == timed:
            found.setdefault((row["optimizer"], row["parameter"]), []).append(row)
    return found


def tables(rows: list[dict[str, Any]]) -> str:
    """Error and step sizes that converge; Gaussians that cannot come back; the objective before and after."""
    (start,) = (row["error"] for row in rows if row["what"] == "start")
    enough, timed, lines = CONVERGED * start, curves(rows, True), []
    for key, own in curves(rows, False).items():
        best = min(own, key=lambda row: row["error"])
        good = [row["rate"] for row in own if row["error"] <= enough]
        first = next((f"{row['seconds']:.2f}" for row in timed[key] if row["error"] <= enough), "")
        lines.append([*key, f"{best['error']:.3f}", f"{best['rate']:.2g}", _span(good), first])
    stuck = [[row["method"], f"{row['start']} of {row['of']}", row["end"]] for row in rows if row["what"] == "stuck"]
    near = [f"{row['parameter']} sigma_d {_span(row['rates'])}" for row in rows if row["what"] == "near"]
    ends = [
        f"{row['from']} start: {row['before']:.3f} to {row['after']:.3f}" for row in rows if row["what"] == "training"
    ]
    heads = ["optimizer", "sigma_d", "best error", "at", "learning rates that converge", "seconds to it"]
    return "\n\n".join([
        table(heads, lines), f"RMS error at the start: {start:.2f}",
        f"learning rates that converge from initial values at most one decade wrong: {'; '.join(near)}",
        table(["cannot come back", "at the start", f"after {STUCK_STEPS} steps"], stuck),
        f"objective, {TRAINING_STEPS} steps: {'; '.join(ends)}",
    ])  # fmt: skip


def _span(rates: list[float]) -> str:
    return "none" if not rates else f"{rates[0]:.2g}" if len(rates) == 1 else f"{rates[0]:.2g} to {rates[-1]:.2g}"
