"""Gradients of a step, and Adam that steps only some rows (Gaussians) at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clod_adapter.config import AdaptConfig
from clod_adapter.integrations.splats import NAMES


@dataclass
class GradientSum:
    """Gradients of the objective, summed over views."""

    gradients: dict[str, Tensor]  # by parameter, of its trained rows, the first ones
    kept: Tensor  # [trained] bool, the rows that at least one rendering kept
    loss: Tensor  # 0-d float64, photometric
    views: int = 1

    def __add__(self, other: GradientSum) -> GradientSum:
        return GradientSum(
            {name: mine + other.gradients[name] for name, mine in self.gradients.items()},
            self.kept | other.kept,
            self.loss + other.loss,
            self.views + other.views,
        )


class RowAdam:
    """Adam (Kingma and Ba 2015) over named ``[N, ...]`` parameters, the same subset of their rows
    in a step.

    A row that is not stepped keeps its value and its moments; the bias correction counts a row's
    own ``steps``. ``moments`` has the ``first`` and the ``second`` ones by parameter.

    Args:
        parameters: at least one; updated in place; float32, contiguous, as the leading rows of a
            larger tensor are.
        units: ``[N]`` factors of the rates of each row, by parameter; by default 1.
    """

    def __init__(
        self,
        parameters: dict[str, Tensor],
        *,
        beta1: float = 0.9,
        beta2: float = 0.999,
        epsilon: float = 1e-15,
        units: dict[str, Tensor] | None = None,
    ):
        self.parameters = parameters
        self._units = {name: p.new_ones(1) for name, p in parameters.items()} | (units or {})
        self.beta1 = beta1
        self.beta2 = beta2
        self.epsilon = epsilon
        self.moments = dict[str, dict[str, Tensor]]()
        for kind in ("first", "second"):
            self.moments[kind] = {name: torch.zeros_like(p) for name, p in parameters.items()}
        some = next(iter(parameters.values()))
        self.steps = torch.zeros(len(some), dtype=torch.int32, device=some.device)
        # After so many steps of its own a row's bias corrections are 1 in float32.
        last = math.ceil(-25 * math.log(2) / math.log(max(beta1, beta2)))
        count = np.arange(1, last + 2)
        with np.errstate(under="ignore"):
            corrections = 1 / (1 - beta1**count), 1 / np.sqrt(1 - beta2**count)
        table = np.pad(corrections, ((0, 0), (1, 0))).astype(np.float32)
        self._corrections = torch.from_numpy(table).to(some.device)

    @torch.no_grad()
    def step(self, gradients: dict[str, Tensor], rows: Tensor, rates: dict[str, float]) -> None:
        """Steps all parameters, each at its rate, where ``rows`` (bool ``[N]``) is set.

        A gradient has the shape of its parameter; what it holds elsewhere does not matter.
        """
        if rows.device.type == "cpu":
            self._step_fused(gradients, rows, rates)
        else:
            self._step_plain(gradients, rows, rates)

    def _step_fused(
        self,
        gradients: dict[str, Tensor],
        rows: Tensor,
        rates: dict[str, float],
    ) -> None:
        from clod_adapter._kernels import threads
        from clod_adapter._kernels.adam import adam_rows

        jobs = list[tuple[Any, ...]]()
        for name, parameter in self.parameters.items():
            moments = [kind[name] for kind in self.moments.values()]
            tensors = (parameter, *moments, gradients[name].contiguous())
            job: list[Any] = [_as_matrix(tensor).numpy() for tensor in tensors]
            counted = 0 if jobs else 1  # rows count their steps once
            job += [rows.numpy(), self.steps.numpy(), counted, self._corrections.numpy()]
            jobs.append((*job, self._units[name].numpy(), rates[name]))

        def adam(worker: int, workers: int) -> None:
            for job in jobs:
                adam_rows(worker, workers, *job, self.beta1, self.beta2, self.epsilon)

        threads.run(adam, threads.worker_count())

    def _step_plain(
        self,
        gradients: dict[str, Tensor],
        rows: Tensor,
        rates: dict[str, float],
    ) -> None:
        """The plain twin of the fused step: all rows, without asking which (a GPU would have to
        answer first).
        """
        self.steps.add_(rows)
        counts = self.steps.clamp(max=self._corrections.shape[1] - 1)
        length, correction = self._corrections[:, counts].unsqueeze(2)
        for name, parameter in self.parameters.items():
            flat_parameter = _as_matrix(parameter)
            first, second = (_as_matrix(moments[name]) for moments in self.moments.values())
            gradient = gradients[name].reshape(flat_parameter.shape)
            lengths = length * self._units[name][:, None]
            m = self.beta1 * first + (1 - self.beta1) * gradient
            v = self.beta2 * second + (1 - self.beta2) * gradient * gradient
            root = v.sqrt() * correction + self.epsilon
            moved = flat_parameter - rates[name] * lengths * m / root
            for old, new in ((first, m), (second, v), (flat_parameter, moved)):
                old.copy_(torch.where(rows[:, None], new, old))


def _as_matrix(tensor: Tensor) -> Tensor:
    """``[N, columns]``, a view of a tensor ``[N, ...]``, with no column where it has no values."""
    return tensor.view(len(tensor), math.prod(tensor.shape[1:]))


def learning_rates(config: AdaptConfig, decay: str) -> dict[str, float]:
    """Learning rate of each parameter, for a batch; that of means is in units of ``own_sizes``."""
    rates = {ours: getattr(config, f"lr_{name}") for name, ours in NAMES.items()}
    rates |= {decay: config.lr_sigma, "growth_d": config.lr_growth}
    return {name: rate * math.sqrt(config.batch) for name, rate in rates.items()}


@torch.no_grad()
def own_sizes(log_scales: Tensor) -> Tensor:
    """``[N]`` the unit of each Gaussian's position steps, world units: the geometric mean of its
    scales.

    A length of the scene, as in 3DGS, is a hundred times the size of most Gaussians in a scene of
    millions.
    """
    return log_scales.detach().float().mean(1).exp()


@torch.no_grad()
def add_to_mean(mean: dict[str, Tensor], values: dict[str, Tensor], count: int) -> None:
    """Takes the ``count``-th ``values`` into their running ``mean``; infinite ones, opacities, are
    their own mean.
    """
    for name, value in values.items():
        if count == 1:
            mean[name] = value.clone()
        else:
            torch.where(value.isinf(), value, mean[name].lerp_(value, 1 / count), out=mean[name])
