"""Adapting: virtual distance scaling, after the fact, on a checkpoint someone else trained."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.attenuation import attenuate, normalized_distances, normalizing_distance, soft_count
from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.importance import removal_error, sigma_from_importance, typical_distance
from clod_adapter.losses import photometric_loss
from clod_adapter.optimizer import RowAdam
from clod_adapter.render import splat

# Adam keeps log sigma within what the equation can tell apart (SIGMA_MAX is the identity).
LOG_SIGMA_RANGE = (math.log(1e-4), math.log(1e9))


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
    started = time.perf_counter()
    gaussians = start(base, scene.train, config, progress)
    return _Run(gaussians, scene.train, config, progress).run(time.perf_counter() - started)


def start(
    base: Gaussians, views: tuple[View, ...], config: AdaptConfig, progress: Callable[[Progress], None] | None = None
) -> Gaussians:
    """The training-free start: sigma_d from the importance of each Gaussian (``importance.py``)."""
    if base.sigma_d is not None and base.attenuation is not None:
        kept = config.attenuation(base.attenuation.scene_distance)
        return base.replace(attenuation=kept, sigma_d=base.sigma_d)
    attenuation = config.attenuation(scene_distance(base, views, config.quantile))
    began = time.perf_counter()

    def report(done: int) -> None:
        if progress:
            progress(
                Progress(
                    "start", done, len(views), time.perf_counter() - began, done / len(views), math.nan, lambda: base
                )
            )

    importance = removal_error(base, views, seed=config.seed, progress=report)
    distances = typical_distance(base, views, attenuation)
    sigma = sigma_from_importance(
        base, importance, distances, attenuation, share=config.start_share, exponent=config.exponent
    )
    return base.replace(sigma_d=sigma, attenuation=attenuation)


def scene_distance(base: Gaussians, views: tuple[View, ...], quantile: float) -> float:
    """D of the scene normaliser: mean over views of the ``quantile`` distance in the frustum, world units."""
    probe = AttenuationConfig(normalizer="quantile", quantile=quantile)
    total = 0.0
    for view in views:
        distances = (base.means - view.camera.position).norm(dim=1)
        total += float(normalizing_distance(distances, base.means, view.camera, probe))
    return total / len(views)


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
        self.parameters = {name: getattr(start, name).clone() for name in ATTRIBUTES}
        self.parameters["log_sigma"] = start.sigma_d.clamp(min=1e-30).log().clamp(*LOG_SIGMA_RANGE)
        self.optimizer = RowAdam(self.parameters)
        self.rates = {
            "means": config.lr_means * camera_extent(views), "quats": config.lr_quats, "log_scales": config.lr_scales,
            "opacity_logits": config.lr_opacities, "sh0": config.lr_sh0, "shN": config.lr_shN,
            "log_sigma": config.lr_sigma,
        }  # fmt: skip
        self.random = np.random.default_rng(config.seed)
        self.order: list[int] = []
        self.by_row = set(ATTRIBUTES) - {"opacity_logits"}
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
        return Gaussians(**values, sigma_d=self.parameters["log_sigma"].exp(), attenuation=self.attenuation)

    def _draw(self) -> tuple[View, float]:
        """A view (each once per round, in random order) and a dial value."""
        if not self.order:
            self.order = self.random.permutation(len(self.views)).tolist()
        view = self.views[self.order.pop()]
        uniform, full = self.random.random(), self.random.random() < self.config.full_share
        return view, 1.0 if full else self.config.max_sv**uniform

    def step(self, share_done: float) -> None:
        """One view, one dial value, one update."""
        view, s = self._draw()
        config, p = self.config, self.parameters
        logits, log_sigma = p["opacity_logits"].detach().requires_grad_(), p["log_sigma"].detach().requires_grad_()
        distances = normalized_distances(p["means"], view.camera, self.attenuation)
        dialled = attenuate(logits, log_sigma.exp(), distances, s, self.attenuation)
        rows = dialled.keep.nonzero()[:, 0]
        # Only the kept rows take part: gradients, moments and steps of the others do not exist this step.
        leaves = {name: p[name].index_select(0, rows).requires_grad_() for name in ATTRIBUTES if name in self.by_row}
        kept = Gaussians(**leaves, opacity_logits=logits.detach()[rows])
        image, _ = splat(kept, dialled.opacities.index_select(0, rows), view.camera)
        loss = photometric_loss(image, view.image, config.ssim_weight)
        self.loss = float(loss.detach()) if math.isnan(self.loss) else 0.98 * self.loss + 0.02 * float(loss.detach())
        excess = (soft_count(dialled.log_opacities, s, config.tau, config.temperature) - s**-config.exponent).clamp(
            min=0
        )
        weight = (1 - config.weight_slope * s / config.max_sv) ** 2
        total = weight * (loss + config.reg_weight * (s - 1) ** 2 * excess**2)
        of_logits, of_sigma, *of_leaves = torch.autograd.grad(total, [logits, log_sigma, *leaves.values()])
        self._update(rows, dict(zip(leaves, of_leaves, strict=True)), of_logits, of_sigma, config.lr_final**share_done)

    def _update(
        self, rows: Tensor, leaves: dict[str, Tensor], of_logits: Tensor, of_sigma: Tensor, decay: float
    ) -> None:
        """Steps the kept rows of most attributes; logits and sigma of all rows, which the count term reaches."""
        for name, gradient in leaves.items():
            if gradient.numel() and self.rates[name] > 0:
                self.optimizer.step(name, gradient, rows, self.rates[name] * decay)
        everything = torch.arange(len(of_logits))
        self.optimizer.step("opacity_logits", of_logits, everything, self.rates["opacity_logits"] * decay)
        self.optimizer.step("log_sigma", of_sigma, everything, self.rates["log_sigma"] * decay)
        self.parameters["log_sigma"].clamp_(*LOG_SIGMA_RANGE)
