"""Adam that steps only the rows (Gaussians) that had a gradient."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class RowAdam:
    """Adam (Kingma and Ba 2015) over named ``[N, ...]`` parameters, a subset of rows a step.

    A row that is not handed in keeps its value and its moments, and costs nothing; the bias
    correction counts a row's own steps, so its first step is as long as anyone's.

    Args:
        parameters: updated in place; float32.
    """

    def __init__(
        self, parameters: dict[str, Tensor], *, beta1: float = 0.9, beta2: float = 0.999, epsilon: float = 1e-15
    ):
        self.parameters = parameters
        self.beta1, self.beta2, self.epsilon = beta1, beta2, epsilon
        self._moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for name, p in parameters.items()}
        self._steps = {name: torch.zeros(len(p), dtype=torch.int32, device=p.device) for name, p in parameters.items()}

    @torch.no_grad()
    def step(self, name: str, gradient: Tensor, rows: Tensor, rate: float) -> None:
        """Steps ``parameters[name][rows]`` (``rows [M]`` int64, unique) with ``gradient [M, ...]``."""
        self._steps[name][rows] += 1
        if gradient.device.type == "cpu":
            self._step_fused(name, gradient, rows, rate)
        else:
            self._step_plain(name, gradient, rows, rate)

    def _step_fused(self, name: str, gradient: Tensor, rows: Tensor, rate: float) -> None:
        from clod_adapter._kernels import adam, threads

        first, second = self._moments[name]
        parameter = self.parameters[name]
        width = math.prod(parameter.shape[1:])
        flat = [x.view(len(x), width).numpy() for x in (parameter, first, second)]
        threads.run(
            adam.adam_rows, threads.worker_count(), *flat, gradient.contiguous().view(len(rows), width).numpy(),
            rows.numpy(), self._steps[name].numpy(), rate, self.beta1, self.beta2, self.epsilon,
        )  # fmt: skip

    def _step_plain(self, name: str, gradient: Tensor, rows: Tensor, rate: float) -> None:
        """The plain twin of the fused step."""
        first, second = self._moments[name]
        count = self._steps[name][rows].to(gradient).view(-1, *[1] * (gradient.dim() - 1))
        m = self.beta1 * first[rows] + (1 - self.beta1) * gradient
        v = self.beta2 * second[rows] + (1 - self.beta2) * gradient * gradient
        first[rows], second[rows] = m, v
        length = m / (1 - self.beta1**count) / ((v / (1 - self.beta2**count)).sqrt() + self.epsilon)
        self.parameters[name][rows] -= rate * length
