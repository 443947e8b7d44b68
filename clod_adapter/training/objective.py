"""What one view asks of the parameters: the training objective and its gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.attenuation import SIGMA_MAX, attenuate, normalized_distances
from clod_adapter.cameras import View
from clod_adapter.config import CLASSIC, AdaptConfig, AttenuationConfig, ScreenFilter
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import photometric_loss
from clod_adapter.render import splat
from clod_adapter.training.target_count import TargetShare, count_gradient, paper_count, target_share

# Sigma stays where the equation still tells values apart; below, a Gaussian would be gone for good.
SIGMA_RANGE = (1e-4, SIGMA_MAX)


@dataclass(frozen=True)
class TrainableSubset:
    """What is trained of a scene, where that is not all of it.

    Attributes:
        trained: how many of the first rows are; the others are only drawn.
        extent: of the whole scene's cameras, world units: the unit of position steps. By default that of the views.
        quota: gives, for a view, a dial value and the loss there, what the count term asks of the trained rows; by
            default the law.
        rest_in_full: the others are drawn as if they had no dial, and not at the dial too.
        total: what the law is a share of, where there are more than those trained (``counting.target_share``).
    """

    trained: int
    extent: float | None = None
    quota: Callable[[View, float, float], TargetShare] | None = None
    rest_in_full: bool = False
    total: int | None = None


@dataclass
class GradientSum:
    """What views ask of the parameters; of several, their sum.

    Attributes:
        gradients: of what is trained, by parameter, of its first ``trained`` rows.
        kept: ``[trained]`` bool, the rows that a picture had.
        loss: photometric loss at the first dial value of each view, summed.
    """

    gradients: dict[str, Tensor]
    kept: Tensor
    loss: float

    def __add__(self, other: GradientSum) -> GradientSum:
        gradients = {name: mine + other.gradients[name] for name, mine in self.gradients.items()}
        return GradientSum(gradients, self.kept | other.kept, self.loss + other.loss)


@dataclass(frozen=True)
class Objective:
    """The objective that ``train.adapt`` states, over parameters as it keeps them.

    Attributes:
        tuned: the attributes that are trained, beside ``opacity_logits`` and the decay, which always are.
        part: which rows are, and what is asked of them.
        screen_filter: that the pictures are drawn with.
    """

    config: AdaptConfig
    attenuation: AttenuationConfig
    tuned: tuple[str, ...]
    part: TrainableSubset
    screen_filter: ScreenFilter = CLASSIC

    @property
    def trained(self) -> int:
        """How many of the first rows are trained."""
        return self.part.trained

    @property
    def decay(self) -> str:
        """The name of the parameter that is trained for sigma_d."""
        return "sigma" if self.config.parameter == "linear" else "log_sigma"

    @property
    def stepped(self) -> tuple[str, ...]:
        """The names of all parameters that are trained."""
        return (*self.tuned, "opacity_logits", self.decay)

    @property
    def has_law(self) -> bool:
        """Whether the count law presses; a range of one dial value asks for none."""
        return self.config.count_term == "law" and self.config.max_sv > 1

    @property
    def decay_range(self) -> tuple[float, float]:
        low, high = SIGMA_RANGE
        return SIGMA_RANGE if self.config.parameter == "linear" else (math.log(low), math.log(high))

    def sigma(self, decay: Tensor) -> Tensor:
        """``[N]`` sigma_d of its parameter."""
        return decay if self.config.parameter == "linear" else decay.exp()

    def parameter(self, sigma_d: Tensor) -> Tensor:
        """The inverse of ``sigma``, within the range that is trained."""
        sigma = sigma_d.detach().float().clamp(*SIGMA_RANGE)
        return sigma if self.config.parameter == "linear" else sigma.log()

    def pull(self, parameters: dict[str, Tensor], draws: Sequence[tuple[View, list[float]]]) -> GradientSum:
        """The sum over ``draws``, each a view and the dial values it is rendered at."""
        return reduce(GradientSum.__add__, (self._pull_of(parameters, view, dials) for view, dials in draws))

    def _pull_of(self, parameters: dict[str, Tensor], view: View, dials: list[float]) -> GradientSum:
        config, tau, first = self.config, self.attenuation.tau, slice(self.trained)
        dialled_rows = first if self.part.rest_in_full else slice(None)
        leaves = {name: parameters[name].detach().requires_grad_(name in self.stepped) for name in parameters}
        logits, decay = leaves["opacity_logits"], leaves[self.decay]
        sigma = self.sigma(decay[dialled_rows])
        distances = normalized_distances(parameters["means"], view.camera, self.attenuation)[dialled_rows]
        drawn_of: Any = {name: leaves[name] for name in ATTRIBUTES}
        shown = Gaussians(**drawn_of, screen_filter=self.screen_filter)
        photograph = view.image.to(decay.device)
        total, count = decay.new_zeros(()), torch.zeros_like(decay[first])
        kept = torch.zeros_like(count, dtype=torch.bool)
        losses = []
        for s in dials:
            dialled = attenuate(logits[dialled_rows], sigma, distances, s, self.attenuation)
            drawn = dialled.drawn
            if self.part.rest_in_full:
                drawn = torch.cat([drawn, parameters["opacity_logits"][self.trained :].sigmoid()])
            # Dropped rows have opacity 0: the rasterizer leaves them out, and they get no gradient.
            image, _ = splat(shown, drawn, view.camera)
            loss = photometric_loss(image, photograph, config.ssim_weight)
            losses.append(float(loss.detach()))
            weight = self._weight(s, alone=len(dials) == 1)
            if config.count_term == "paper" and config.reg_weight > 0:
                loss = loss + paper_count(dialled, s, tau, config, self.part.total)
            total = total + weight * loss
            if self.has_law:
                own = type(dialled)(*(tensor[first] for tensor in dialled))
                quota = self._quota(view, s, losses[-1])
                asked = (s, tau, weight * losses[-1], config, quota)
                count += count_gradient(own, parameters["opacity_logits"][first], *asked)
            kept |= dialled.keep[first]
        found = torch.autograd.grad(total, [leaves[name] for name in self.stepped])
        gradients = {name: gradient[first] for name, gradient in zip(self.stepped, found, strict=True)}
        count = count if config.parameter == "log" else count / decay.detach()[first]
        return GradientSum(gradients | {self.decay: gradients[self.decay] + count}, kept, losses[0])

    def _quota(self, view: View, s: float, loss: float) -> TargetShare:
        part = self.part
        return part.quota(view, s, loss) if part.quota else target_share(s, self.trained, self.config, part.total)

    def _weight(self, s: float, *, alone: bool) -> float:
        """w_s, times ``full_weight`` at the s = 1 that goes with another dial value."""
        weight = (1 - self.config.weight_slope * s / self.config.max_sv) ** 2
        return weight if alone or s > 1 else weight * self.config.full_weight
