"""The training objective of one view, and its gradients."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, AdaptConfig, AttenuationConfig, ScreenFilter
from clod_adapter.equation.attenuation import SIGMA_MAX, Attenuated, dial
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import photometric_loss
from clod_adapter.rasterizers import for_device
from clod_adapter.training.target_count import TargetShare, count_gradient_at, paper_count, target_share
from clod_adapter.training.view_sampler import Sample

# Sigma stays where the equation still resolves it; below, a Gaussian would be culled for good.
SIGMA_RANGE = (1e-4, SIGMA_MAX)


@dataclass(frozen=True)
class TrainableSubset:
    """The trained Gaussians, where these are not the whole scene.

    Attributes:
        trained: number of trained rows, the first ones; the others are the context: drawn, but not trained.
        full_context: draw the context without a dial, instead of at the dial value of the trained rows.
        total: number of Gaussians that the target-count curve is a share of, where that is more than ``trained``
            (``target_count.target_share``).
        target: returns the count term's target at a dial value, in place of the target-count curve's.
        cameras: the whole scene's, which typical distances are from. By default those of the views.
    """

    trained: int
    full_context: bool = False
    total: int | None = None
    target: Callable[[float], TargetShare] | None = None
    cameras: Sequence[Camera] | None = None


@dataclass
class GradientSum:
    """Gradients of the objective, summed over views.

    Attributes:
        gradients: by name of the trained parameter, of its first ``trained`` rows.
        kept: ``[trained]`` bool, the rows that at least one rendering kept.
        loss: 0-d float64, photometric loss of each view, summed.
        views: their number.
    """

    gradients: dict[str, Tensor]
    kept: Tensor
    loss: Tensor
    views: int = 1

    def __add__(self, other: GradientSum) -> GradientSum:
        gradients = {name: mine + other.gradients[name] for name, mine in self.gradients.items()}
        return GradientSum(gradients, self.kept | other.kept, self.loss + other.loss, self.views + other.views)


@dataclass(frozen=True)
class Objective:
    """The objective that ``training.loop.adapt`` documents, as a function of the optimizer's parameters.

    Attributes:
        tuned: the trained attributes, besides ``opacity_logits`` and the decay, which are always trained.
        part: the trained rows.
        typical: ``[trained]`` normalised distances that Gaussians are counted at; no view's own, whose counts differ
            from the mean's: gradients that correct such differences cancel out, and only add noise.
        screen_filter: the filter that images are rendered with.
    """

    config: AdaptConfig
    attenuation: AttenuationConfig
    tuned: tuple[str, ...]
    part: TrainableSubset
    typical: Tensor
    screen_filter: ScreenFilter = CLASSIC

    @property
    def trained(self) -> int:
        """Number of trained rows, the first ones."""
        return self.part.trained

    @property
    def decay(self) -> str:
        """The name of the parameter that sigma_d is trained through."""
        return "sigma" if self.config.parameter == "linear" else "log_sigma"

    @property
    def stepped(self) -> tuple[str, ...]:
        """The names of all trained parameters."""
        growth = ("growth_d",) if self.config.growth == "on" else ()
        return (*self.tuned, "opacity_logits", self.decay, *growth)

    @property
    def decay_range(self) -> tuple[float, float]:
        """Lowest and highest value of the decay parameter."""
        low, high = SIGMA_RANGE
        return SIGMA_RANGE if self.config.parameter == "linear" else (math.log(low), math.log(high))

    def sigma(self, decay: Tensor) -> Tensor:
        """``[N]`` sigma_d from its parameter."""
        return decay if self.config.parameter == "linear" else decay.exp()

    def parameter(self, sigma_d: Tensor) -> Tensor:
        """The inverse of ``sigma``, clamped to the trained range."""
        sigma = sigma_d.detach().float().clamp(*SIGMA_RANGE)
        return sigma if self.config.parameter == "linear" else sigma.log()

    def gradient_sum(
        self, parameters: dict[str, Tensor], samples: Sequence[Sample], until: float = math.inf
    ) -> GradientSum:
        """The gradients summed over the samples: the first, and those begun before ``until`` (``perf_counter``)."""
        found = self._of_view(parameters, samples[0])
        for sample in samples[1:]:
            if time.perf_counter() >= until:
                break
            found += self._of_view(parameters, sample)
        return found

    def _of_view(self, parameters: dict[str, Tensor], sample: Sample) -> GradientSum:
        """Renders one view at its dial value, and differentiates the weighted loss."""
        (view, s, counted, halved), config, first = sample, self.config, slice(self.trained)
        leaves = {name: parameters[name].detach().requires_grad_(name in self.stepped) for name in parameters}
        shown = self._shown(leaves, halved)
        kept = for_device(shown.means.device).kept(shown, view.camera, s)[first]
        image, term = self._draw(shown, view.camera, s), self._paper_count(shown, view.camera, s)
        loss = photometric_loss(image, view.image, config.ssim_weight)
        plain, weight = loss.detach().double(), loss_weight(s, config)
        total = weight * (loss if term is None else loss + term)
        found = torch.autograd.grad(total, [leaves[name] for name in self.stepped])
        gradients = {name: gradient[first] for name, gradient in zip(self.stepped, found, strict=True)}
        counts = [(s, weight * plain)] if s >= 1 else []  # below, all are to be kept
        if counted is not None:
            # Its weight is 1: with half of w_s, counts at the far end were 1.25 times the target, at a gain of 0.05 to
            # 0.1 dB at equal counts.
            counts.append((counted, plain))
        if config.has_target_count:
            for at, weighted in counts:
                gradients[self.decay] = gradients[self.decay] + self._count_gradient(parameters, at, weighted)
        return GradientSum(gradients, kept, plain)

    def image(self, parameters: dict[str, Tensor], camera: Camera, s: float, halved: bool) -> Tensor:
        """The image ``[H, W, 3]`` of the parameters; ``halved`` if the camera is for images of half the size."""
        return self._draw(self._shown(parameters, halved), camera, s)

    def undialled(self, parameters: dict[str, Tensor], camera: Camera, halved: bool) -> Tensor:
        """``image`` without a dial: of untrained parameters it is the base's."""
        attributes: Any = {name: parameters[name] for name in ATTRIBUTES}
        return self._draw(Gaussians(**attributes, screen_filter=self._filter(halved)), camera, 1.0)

    def _filter(self, halved: bool) -> ScreenFilter:
        return self.screen_filter.halved() if halved else self.screen_filter

    def _draw(self, shown: Gaussians, camera: Camera, s: float) -> Tensor:
        return for_device(shown.means.device).draw(shown, camera, s, trained=self.trained)[0]

    def _shown(self, leaves: dict[str, Tensor], halved: bool) -> Gaussians:
        """The Gaussians of the parameters, the context without a dial where that is asked for."""
        sigma, growth_d = self.sigma(leaves[self.decay]), leaves.get("growth_d")
        if self.part.full_context:
            sigma = _ending_in(math.inf, sigma, self.trained)
            growth_d = None if growth_d is None else _ending_in(0.0, growth_d, self.trained)
        attributes: Any = {name: leaves[name] for name in ATTRIBUTES}
        return Gaussians(
            **attributes, sigma_d=sigma, attenuation=self.attenuation, growth_d=growth_d,
            screen_filter=self._filter(halved),
        )  # fmt: skip

    def _paper_count(self, shown: Gaussians, camera: Camera, s: float) -> Tensor | None:
        """The paper's count term, where it is asked for."""
        if self.config.count_term != "paper" or self.config.reg_weight <= 0 or s < 1:
            return None
        rows = slice(self.trained) if self.part.full_context else slice(None)
        dialled = dial(shown, camera, s)
        counted = Attenuated(*(field[rows] for field in dialled))
        return paper_count(counted, s, self.attenuation.tau, self.config, self.part.total)

    @torch.no_grad()
    def _count_gradient(self, parameters: dict[str, Tensor], s: float, loss: Tensor) -> Tensor:
        """``[trained]`` the count term's gradient of the decay parameter at one dial value."""
        decay, logits = (parameters[name][: self.trained].detach() for name in (self.decay, "opacity_logits"))
        if self.part.target is not None:
            target = self.part.target(s)
        else:
            target = target_share(s, self.trained, self.config, self.part.total)
        sigma = self.sigma(decay)
        counted = count_gradient_at(self.typical, logits, sigma, s, self.attenuation, loss, self.config, target)
        return counted if self.config.parameter == "log" else counted / decay


def loss_weight(virtual_scale: float, config: AdaptConfig) -> float:
    """``w_s = max(0, 1 - k s / max_sv)^2``, the weight of the loss at the dial value s."""
    return max(1 - config.weight_slope * virtual_scale / config.max_sv, 0.0) ** 2


def _ending_in(value: float, tensor: Tensor, trained: int) -> Tensor:
    """``[N]`` with this value in the rows from ``trained`` on."""
    return torch.cat([tensor[:trained], torch.full_like(tensor[trained:], value)])
