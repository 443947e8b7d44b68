"""Stiffness: optimizers, parameters and learning rates on values of sigma_d that span eight
decades.

The slope of the equation goes as 1/sigma_d, and is 0 beyond the reach. Gaussians at distances over
eight decades have a known sigma_d that meets the target-count curve; training starts up to four
decades off and minimises the mean square difference of the drawn opacities from the right ones, and
the count term, with the package's schedule and mean of the last steps. Every optimizer gets the
same gradients, and RowAdam's epsilon, which is that of 3DGS.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import clod_adapter as clod
from clod_adapter._kernels.threads import torch_on_one_thread
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.initialization.importance import WIDEST, extinction_from_rank
from clod_adapter.report.charts import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    QUIET,
    label_log,
    new_figure,
    save_figure,
)
from clod_adapter.training.dial import SIGMA_RANGE, Dial
from clod_adapter.training.optimizer import RowAdam
from clod_adapter.training.schedule import OURS
from clod_adapter.training.target_count import count_gradient, target_share
from common import Table

import numpy as np
import torch
from torch import Tensor

CONFIG = clod.AdaptConfig(growth="off")
DIALS = tuple(CONFIG.max_sv ** (k / 11) for k in range(12))
RATES = tuple(10 ** (k / 2) for k in range(-8, 1))  # 1e-4 to 1 in half decades
WRONG = 4.0  # decades, each way
STEPS = 600
LENGTHS = (30, 100, 300, 1000)
CONVERGED = 0.25  # of the start's error
Stepper = Callable[[list[Tensor], list[float]], None]


def _torch_optimizer(kind, **settings):
    def make(runs):
        optimizer = kind([{"params": [x]} for x in runs], lr=1.0, **settings)

        def step(gradients, rates):
            for group, gradient, rate in zip(optimizer.param_groups, gradients, rates, strict=True):
                group["params"][0].grad, group["lr"] = gradient, rate
            optimizer.step()

        return step

    return make


def _row_adam(runs):
    def named(values):
        return {str(run): value for run, value in enumerate(values)}

    rows = torch.ones(len(runs[0]), dtype=torch.bool)
    optimizer = RowAdam(named(runs))
    return lambda gradients, rates: optimizer.step(named(gradients), rows, named(rates))


# AdamW is left out: its decay pulls sigma_d towards 0 (log sigma_d: 1), which nothing about a dial
# asks for.
OPTIMIZERS: dict[str, tuple[Callable[[list[Tensor]], Stepper], str]] = {
    "RowAdam": (_row_adam, BLUE),
    "Adam": (_torch_optimizer(torch.optim.Adam, eps=1e-15), GREEN),
    "AMSGrad": (_torch_optimizer(torch.optim.Adam, eps=1e-15, amsgrad=True), "#3aa6a0"),
    "NAdam": (_torch_optimizer(torch.optim.NAdam, eps=1e-15), "#8fb339"),
    "RMSprop": (_torch_optimizer(torch.optim.RMSprop, eps=1e-15), PURPLE),
    "Adagrad": (_torch_optimizer(torch.optim.Adagrad, eps=1e-15), ORANGE),
    "SGD, momentum 0.9": (_torch_optimizer(torch.optim.SGD, momentum=0.9), QUIET),
}


@dataclass(frozen=True)
class Problem:
    """What the equation is to be fitted to: all ``[N]``, but ``wanted [dial values, N]``, the right
    ones as drawn.
    """

    logits: Tensor
    distances: Tensor
    right: Tensor
    start: Tensor
    wanted: Tensor

    def parameter(self, log):
        """What training starts with: sigma_d, or its logarithm."""
        sigma = self.start.clamp(*SIGMA_RANGE)
        return sigma.log() if log else sigma

    def error(self, sigma):
        """Root mean square over Gaussians and dial values of the opacity they are drawn with, less
        the right one.
        """
        opacities = drawn(self.logits, sigma, self.distances)
        return float((opacities - self.wanted).square().mean().sqrt())


def drawn(logits, sigma, distances):
    settings = CONFIG.attenuation(1.0)
    return torch.stack([attenuate(logits, sigma, distances, s, settings).drawn for s in DIALS])


def problem(n=192):
    """Distances d' from 1e-3 to 1e5, log-uniform; the start is wrong by up to WRONG decades each
    way.
    """
    draw = torch.Generator().manual_seed(0)
    distances = 10 ** torch.empty(n).uniform_(-3, 5, generator=draw)
    logits = torch.empty(n).uniform_(0.3, 0.99, generator=draw).logit()
    rank = torch.randperm(n, generator=draw)
    right = distances * extinction_from_rank(rank, CONFIG).clamp(max=WIDEST * CONFIG.max_sv)
    off = torch.empty(n).uniform_(-WRONG, WRONG, generator=torch.Generator().manual_seed(1))
    return Problem(logits, distances, right, right * 10**off, drawn(logits, right, distances))


@torch_on_one_thread()
def fit(task, optimizer, log, rates, steps):
    """sigma_d after training, at dial value 1 and another one a step; and seconds. One run a rate,
    all at once.
    """
    limits = tuple(map(math.log, SIGMA_RANGE)) if log else SIGMA_RANGE
    start = task.parameter(log)
    runs = [start.clone() for _ in rates]
    step = OPTIMIZERS[optimizer][0](runs)
    means = torch.zeros(len(rates), len(start))
    random = np.random.default_rng(0)
    began = time.perf_counter()
    averaged = 0
    for k in range(steps):
        fall = OURS.lr_final ** (k / steps)
        dials = (0, int(random.integers(1, len(DIALS))))
        slopes = gradients(task, torch.stack(runs), log, dials)
        step(list(slopes), [rate * fall for rate in rates])
        for x in runs:
            x.clamp_(*limits)
        if k >= (1 - OURS.average) * steps:
            averaged += 1
            means.lerp_(torch.stack(runs), 1 / averaged)
    return list(means.exp() if log else means), time.perf_counter() - began


def gradients(task, x, log, dials):
    """``[runs, N]``: gradient by ``x`` of the loss at these dial values and of the count term."""
    settings = CONFIG.attenuation(1.0)
    n = len(task.start)
    total = torch.zeros(())
    pull = torch.zeros_like(x)
    leaf = x.requires_grad_()
    sigma = (leaf.exp() if log else leaf).flatten()
    logits, distances = task.logits.repeat(len(x)), task.distances.repeat(len(x))
    for k in dials:
        s = DIALS[k]
        opacities = attenuate(logits, sigma, distances, s, settings).drawn
        losses = (opacities.view(-1, n) - task.wanted[k]).square().mean(1)
        weight = (1 - Dial.weight_slope * s / CONFIG.max_sv) ** 2
        total = total + weight * losses.sum()
        target = target_share(s, n, CONFIG)
        runs = zip(sigma.detach().view(-1, n), (weight * losses.detach()).tolist(), strict=True)
        for run, (values, loss) in enumerate(runs):
            pull[run] += count_gradient(task.distances, values, s, loss, CONFIG, target)
    (gradient,) = torch.autograd.grad(total, leaf)
    return gradient + (pull if log else pull / x.detach())


def measure():
    task, rows = problem(), []
    for optimizer, log in product(OPTIMIZERS, (True, False)):
        parameter = "log" if log else "linear"
        about = {"what": "equation", "optimizer": optimizer, "parameter": parameter}
        # compiled, and imported by torch, before the clock starts
        fit(task, optimizer, log, (1e-4,), 2)
        errors = [task.error(sigma) for sigma in fit(task, optimizer, log, RATES, STEPS)[0]]
        for rate, error in zip(RATES, errors, strict=True):
            rows.append(about | {"rate": rate, "steps": STEPS, "error": error})
        best = RATES[int(np.nanargmin(errors))]
        for steps in LENGTHS:
            (sigma,), seconds = fit(task, optimizer, log, (best,), steps)
            cost = {"error": task.error(sigma), "seconds": seconds}
            rows.append(about | {"rate": best, "steps": steps} | cost)
    rows.append({"what": "start", "error": task.error(task.start)})
    return rows


def curves(rows, timed):
    """Rows by optimizer and parameter: over the learning rates; or, timed, over the steps at the
    best one.
    """
    lines = {}
    for row in rows:
        if row["what"] == "equation" and ("seconds" in row) == timed:
            lines.setdefault((row["optimizer"], row["parameter"]), []).append(row)
    return lines


def page_table(rows):
    """Error and learning rates that converge of the logarithm; optimizers that are alike share a
    line.
    """
    (start,) = (row["error"] for row in rows if row["what"] == "start")
    alike = {}
    for (optimizer, parameter), line in curves(rows, False).items():
        if parameter == "log":
            good = [f"{row['rate']:.2g}" for row in line if row["error"] <= CONVERGED * start]
            span = " to ".join(dict.fromkeys((good[0], good[-1]))) if good else "none"
            error = f"{min(row['error'] for row in line):.3f}"
            alike.setdefault((error, span), []).append(optimizer)
    heads = ["optimizer, on `log sigma_d`", "best error", "learning rates that converge"]
    lines = []
    for cells, names in alike.items():
        lines.append([", ".join(names).replace("RowAdam", "RowAdam (default)"), *cells])
    return Table(heads, lines, rows)


def picture(rows, path):
    """Error by learning rate on the left, by seconds at the best one on the right; dots for linear
    sigma_d.
    """
    with new_figure((10.4, 4.6), layout="constrained") as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, timed, along in zip(panels, (False, True), ("rate", "seconds"), strict=True):
            for (optimizer, parameter), line in curves(rows, timed).items():
                ours = (optimizer, parameter) == ("RowAdam", "log")
                label = f"{optimizer} (default)" if ours else optimizer
                axes.plot(
                    [row[along] for row in line],
                    [row["error"] for row in line],
                    color=OPTIMIZERS[optimizer][1],
                    linestyle="-" if parameter == "log" else ":",
                    linewidth=2.6 if ours else 1.3,
                    label=label if parameter == "log" else None,
                )
            axes.set(xscale="log", yscale="log")
            label_log(axes.xaxis, "{:g}", subs=(1,))
        label_log(panels[0].yaxis, "{:g}")
        panels[0].axvline(CONFIG.lr_sigma, color=BLUE, linewidth=0.8)
        panels[0].set(
            ylabel="RMS error of the opacity that is drawn", xlabel=f"learning rate, {STEPS} steps"
        )
        panels[1].set_xlabel("seconds of training at the best learning rate")
        panels[0].plot([], [], color=QUIET, linestyle=":", label="linear sigma_d")
        entries = panels[0].get_legend_handles_labels()
        figure.legend(*entries, loc="outside lower center", frameon=False, ncols=4)
        save_figure(figure, path)
