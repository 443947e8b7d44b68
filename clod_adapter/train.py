"""Adapting: virtual distance scaling, after the fact, on a checkpoint someone else trained."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from clod_adapter._kernels.threads import torch_on_one_thread
from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.attenuation import SIGMA_MAX, attenuate, normalized_distances, soft_count
from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.importance import start
from clod_adapter.losses import photometric_loss
from clod_adapter.optimizer import RowAdam
from clod_adapter.render import splat

# Log sigma stays where the equation still tells values apart; below, a Gaussian would be gone for good.
LOG_SIGMA_RANGE = (math.log(1e-4), math.log(SIGMA_MAX))


@dataclass(frozen=True)
class Progress:
    """Where an adaptation stands; handed to the progress callback.

    Attributes:
        phase: "start" (importance pass) or "train".
        done, total: steps of the phase.
        seconds: since the phase began.
        share: of the phase that is done, by steps or by time budget, whichever is further.
        loss: running mean of the photometric loss, NaN before the first step.
        gaussians: gives the state now (in the start phase, the base); it shares memory with what is
            being trained, so use it within the callback.
    """

    phase: str
    done: int
    total: int
    seconds: float
    share: float
    loss: float
    gaussians: Callable[[], Gaussians]


@dataclass(frozen=True)
class Adapted:
    """The outcome of ``adapt``.

    Attributes:
        gaussians: with ``sigma_d`` and ``attenuation``.
        steps: training steps done.
        seconds: wall time of the training loop; start_seconds: of the importance pass before it.
        interrupted: a KeyboardInterrupt ended it early.
    """

    gaussians: Gaussians
    steps: int
    seconds: float
    start_seconds: float
    interrupted: bool


def adapt(
    base: Gaussians, scene: Scene, config: AdaptConfig | None = None, progress: Callable[[Progress], None] | None = None
) -> Adapted:
    """Learns sigma_d for ``base`` on the training views of ``scene``, and updates the rest lightly.

    Each step draws a view and a dial value s and minimises ``w_s (L_render + reg_weight L_reg)``
    (CLoD-GS section 3.3): L_render is ``losses.photometric_loss``,
    ``L_reg = (s - 1)^2 relu(eta - s^-exponent)^2`` with eta the share of all Gaussians kept,
    ``w_s = (1 - 0.5 s / max_sv)^2``. A base that already has a sigma_d is continued from.

    A KeyboardInterrupt ends training and returns what there is.

    Raises:
        ClodError: no training views, or no Gaussians.
    """
    config = config or AdaptConfig()
    if not scene.train:
        raise ClodError("the scene has no training views: give at least one photograph that is not held out")
    if len(base) == 0:
        raise ClodError("the checkpoint has no Gaussians, so there is nothing to adapt")
    began = time.perf_counter()

    def report(done: int, total: int) -> None:
        if progress:
            seconds = time.perf_counter() - began
            progress(Progress("start", done, total, seconds, done / total, math.nan, lambda: base))

    # Where the higher bands are not tuned, empty ones stay empty.
    lean = base if config.lr_shN > 0 else base.without_empty_bands()
    gaussians = start(lean, scene.train, config, report)
    run = _Run(gaussians, scene.train, config, progress)
    run.empty_bands = None if lean is base else base.shN.clone()
    return run.run(time.perf_counter() - began)


def camera_extent(views: tuple[View, ...]) -> float:
    """1.1 times the largest distance of a camera from their mean (3DGS's unit for position steps)."""
    centres = torch.stack([view.camera.position for view in views])
    return 1.1 * float((centres - centres.mean(0)).norm(dim=1).max()) or 1.0


class _Run:
    """One training run: parameters, optimiser, random state."""

    def __init__(
        self,
        start: Gaussians,
        views: tuple[View, ...],
        config: AdaptConfig,
        progress: Callable[[Progress], None] | None,
    ):
        self.config, self.views, self.progress = config, views, progress
        assert start.sigma_d is not None and start.attenuation is not None
        self.attenuation = start.attenuation
        own = {"dtype": torch.float32, "copy": True, "memory_format": torch.contiguous_format}
        self.parameters = {name: getattr(start, name).detach().to(**own) for name in ATTRIBUTES}
        self.parameters["log_sigma"] = start.sigma_d.detach().float().clamp(min=1e-30).log().clamp(*LOG_SIGMA_RANGE)
        self.optimizer = RowAdam(self.parameters)
        self.empty_bands: Tensor | None = None  # the base's whole shN, where what was left out of it comes back
        self.all_rows = torch.ones(len(start), dtype=torch.bool)
        self.rates = {
            "means": config.lr_means * camera_extent(views), "quats": config.lr_quats, "log_scales": config.lr_scales,
            "opacity_logits": config.lr_opacities, "sh0": config.lr_sh0, "shN": config.lr_shN,
            "log_sigma": config.lr_sigma,
        }  # fmt: skip
        self.random = np.random.default_rng(config.seed)
        self.order: list[int] = []
        # What is stepped by row; a frozen attribute asks the rasterizer for no gradient.
        self.tuned = [
            n for n in ATTRIBUTES if n != "opacity_logits" and self.rates[n] > 0 and getattr(start, n).numel()
        ]
        self.loss = math.nan

    def run(self, start_seconds: float) -> Adapted:
        began, done, interrupted = time.perf_counter(), 0, False
        try:
            while (share := self._share_done(done, time.perf_counter() - began)) < 1:
                self.step(share)
                done += 1
                if self.progress:
                    seconds = time.perf_counter() - began
                    share = self._share_done(done, seconds)
                    self.progress(Progress("train", done, self.config.iters, seconds, share, self.loss, self.gaussians))
        except KeyboardInterrupt:
            interrupted = True
        return Adapted(self.gaussians(), done, time.perf_counter() - began, start_seconds, interrupted)

    def _share_done(self, done: int, seconds: float) -> float:
        by_steps = done / self.config.iters if self.config.iters else 1.0
        return max(by_steps, seconds / self.config.time_budget) if self.config.time_budget else by_steps

    def gaussians(self) -> Gaussians:
        values = {name: self.parameters[name] for name in ATTRIBUTES}
        if self.empty_bands is not None:
            values["shN"] = self.empty_bands
        return Gaussians(**values, sigma_d=self.parameters["log_sigma"].exp(), attenuation=self.attenuation)

    def _draw(self) -> tuple[View, float]:
        """A view (each once per round, in random order) and a dial value."""
        if not self.order:
            self.order = self.random.permutation(len(self.views)).tolist()
        view = self.views[self.order.pop()]
        uniform, full = self.random.random(), self.random.random() < self.config.full_share
        return view, 1.0 if full else self.config.max_sv**uniform

    @torch_on_one_thread()
    def step(self, share_done: float) -> None:
        """One view, one dial value, one update."""
        view, s = self._draw()
        config, p = self.config, self.parameters
        logits, log_sigma = p["opacity_logits"].detach().requires_grad_(), p["log_sigma"].detach().requires_grad_()
        distances = normalized_distances(p["means"], view.camera, self.attenuation)
        dialled = attenuate(logits, log_sigma.exp(), distances, s, self.attenuation)
        # Dropped rows have opacity 0: the rasterizer leaves them out before anything else, and they get no gradient.
        leaves = {name: p[name].detach().requires_grad_(name in self.tuned) for name in ATTRIBUTES}
        opacities = torch.where(dialled.keep, dialled.opacities, 0)
        image, _ = splat(Gaussians(**leaves), opacities, view.camera)
        loss = photometric_loss(image, view.image, config.ssim_weight)
        self.loss = float(loss.detach()) if math.isnan(self.loss) else 0.98 * self.loss + 0.02 * float(loss.detach())
        count = soft_count(dialled.log_opacities, s, self.attenuation.tau, config.temperature)
        excess = (count - s**-config.exponent).clamp(min=0)
        weight = (1 - config.weight_slope * s / config.max_sv) ** 2
        total = weight * (loss + config.reg_weight * (s - 1) ** 2 * excess**2)
        leaves = {name: leaves[name] for name in self.tuned}
        of_logits, of_sigma, *of_leaves = torch.autograd.grad(total, [logits, log_sigma, *leaves.values()])
        rates = {name: rate * config.lr_final**share_done for name, rate in self.rates.items()}
        self.optimizer.step(dict(zip(leaves, of_leaves, strict=True)), dialled.keep, rates)
        # The count term reaches the dropped ones too.
        self.optimizer.step({"opacity_logits": of_logits, "log_sigma": of_sigma}, self.all_rows, rates)
        self.parameters["log_sigma"].clamp_(*LOG_SIGMA_RANGE)
