"""One training run: parameters, optimizer and view sampler, and the step that changes them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from clod_adapter._kernels.threads import torch_on_one_thread
from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.cameras import View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.distances import typical_distance
from clod_adapter.equation.growth import GROWTH_RANGE
from clod_adapter.equation.units import in_world_units
from clod_adapter.errors import ClodError
from clod_adapter.finite import LossNotFinite, require_finite, spoilt_rows
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS
from clod_adapter.training.distributed import ProcessGroup
from clod_adapter.training.gate import Gate
from clod_adapter.training.objective import GradientSum, Objective, TrainableSubset
from clod_adapter.training.optimizer import RowAdam, add_to_mean
from clod_adapter.training.state import TrainingState
from clod_adapter.training.view_sampler import ViewSampler

# Adam's decay rates per view. A batch takes their powers and multiplies learning rates by its square root, so that
# each view has the same effect (Zhao et al., "On Scaling Up 3D Gaussian Splatting Training", ICLR 2025).
BETA1, BETA2 = 0.9, 0.999


class Trainer:
    """Holds everything that training steps change. The start has a growth_d if the config has growth.

    Attributes:
        parameters: tensors by name; the first ``objective.trained`` rows of those in ``stepped`` are trained.
        mean: of the trained parameters over the last ``average`` of the steps; averaged: how many steps it has.
        loss: running mean of the photometric loss, NaN before the first step.
        done: steps; seconds: spent in them; start_seconds: spent before the first.
        held: ``[trained]`` bool, rows that some step did not move because their gradient was not finite.
        gate: watches s = 1; None without watched views.
    """

    def __init__(
        self, start: Gaussians, views: tuple[View, ...], config: AdaptConfig, subset: TrainableSubset | None = None,
        group: ProcessGroup | None = None, watched: tuple[View, ...] = (),
    ) -> None:  # fmt: skip
        subset = subset or TrainableSubset(len(start))
        assert start.sigma_d is not None and start.attenuation is not None
        self.config, self.group, self.sampler = config, group, ViewSampler(views, config, start.attenuation.tau)
        rates = learning_rates(config)
        # A frozen attribute requests no gradient from the rasterizer.
        tuned = [n for n in ATTRIBUTES if n != "opacity_logits" and rates[n] > 0 and getattr(start, n).numel()]
        cameras = subset.cameras or [view.camera for view in spread(views, MOST_VIEWS)]
        typical = typical_distance(start.means, cameras, start.attenuation)[: subset.trained]
        self.objective = Objective(config, start.attenuation, tuple(tuned), subset, typical, start.screen_filter)
        self.decay, self.stepped = self.objective.decay, self.objective.stepped
        self.decay_range = self.objective.decay_range
        self.rates = rates | {self.decay: config.lr_sigma * math.sqrt(config.batch)}
        self.rates["growth_d"] = config.lr_growth * math.sqrt(config.batch)
        own = {"dtype": torch.float32, "memory_format": torch.contiguous_format}
        self.parameters = {
            name: getattr(start, name).detach().to(**own, copy=name in self.stepped) for name in ATTRIBUTES
        }
        self.parameters[self.decay] = self.objective.parameter(start.sigma_d)
        if config.growth == "on":
            assert start.growth_d is not None
            self.parameters["growth_d"] = start.growth_d.detach().float().clamp(*GROWTH_RANGE)
        self.unit = own_sizes(start.log_scales[: subset.trained])
        # The paper's count term has a gradient for opacities too, also of culled Gaussians.
        everywhere = {self.decay} | ({"opacity_logits"} if config.count_term == "paper" else set())
        self.optimizers = [self._optimizer(set(self.stepped) - everywhere), self._optimizer(everywhere)]
        self.empty_sh: Tensor | None = None  # the whole shN of a base whose empty degrees were removed
        self.done, self.seconds, self.start_seconds, self.loss = 0, 0.0, 0.0, math.nan
        self.mean: dict[str, Tensor] = {}
        self.averaged = 0
        self.held = torch.zeros(subset.trained, dtype=torch.bool, device=start.means.device)
        self._updating = False
        self.gate = Gate(self, watched, bool(set(map(id, watched)) & set(map(id, views)))) if watched else None

    @torch_on_one_thread()
    def step(self, share_done: float, until: float = math.inf) -> None:
        """Samples views and dial values, sums the gradients of their losses, and updates the parameters once.

        Args:
            until: as for ``Objective.gradient_sum``: the step has fewer views if the time is over.

        Raises:
            LossNotFinite, or any error of the rasterizer: nothing has changed.
        """
        if self.gate:
            self.gate.check(share_done)
        before = self.sampler.state()
        numbers = range(self.done * self.config.batch, (self.done + 1) * self.config.batch)
        samples = [self.sampler.draw(number, share_done) for number in numbers]
        try:  # if it fails, the next step samples the same views again
            own = self.group.share(samples) if self.group else samples
            found = self.objective.gradient_sum(self.parameters, own, until)
            found = self.group.sum(found) if self.group else found
            self._updating = True
            self._update(found, share_done)
            loss = float(found.loss) / found.views  # the host waits for a GPU, as else only gsplat does
            if not math.isfinite(loss):
                self._updating = False
                names = ", ".join(view.camera.name or "a view without a name" for view, *_ in samples)
                raise LossNotFinite(f"the loss of step {self.done + 1} is not finite ({names})")
        except Exception:
            self.sampler.restore(*before)
            raise
        self.loss = loss if math.isnan(self.loss) else 0.98 * self.loss + 0.02 * loss
        if share_done >= 1 - self.config.average:  # the optimizer continues from the parameters, not from the mean
            self.averaged += 1
            add_to_mean(self.mean, self.trained(), self.averaged)
        self.done += 1
        self._updating = False

    def _update(self, found: GradientSum, share_done: float) -> None:
        """Moves the rows whose gradients are finite; none if the loss is not, without asking which."""
        learned, rows = torch.as_tensor(found.loss).isfinite(), spoilt_rows(found.gradients)
        self.held |= learned & rows
        finite = rows.logical_not_().logical_and_(learned)
        rates = {name: rate * self.config.lr_final**share_done for name, rate in self.rates.items()}
        rates = self.gate.weaken(rates) if self.gate else rates
        for optimizer, rows in zip(self.optimizers, (found.kept.logical_and_(finite), finite), strict=True):
            if optimizer:
                optimizer.step(found.gradients, rows, rates)
        self.parameters[self.decay].clamp_(*self.decay_range)
        if self.config.growth == "on":
            self.parameters["growth_d"].clamp_(*GROWTH_RANGE)

    def state(self) -> TrainingState:
        """Everything that later steps depend on; its tensors are the trainer's own.

        Raises:
            ClodError: a step failed while it updated the parameters.
        """
        if self._updating:
            raise ClodError(f"step {self.done + 1} failed while it updated the parameters, so they cannot be saved")
        random, order = self.sampler.state()
        return TrainingState(
            tensors=self._changing(), attenuation=self.objective.attenuation, random=random, order=order,
            loss=self.loss, averaged=self.averaged, steps=self.done, seconds=self.seconds,
            start_seconds=self.start_seconds,
        )  # fmt: skip

    def restore(self, state: TrainingState) -> None:
        """The inverse of ``state``; copies its tensors.

        Raises:
            ClodError: it is of other Gaussians, views or settings, or damaged.
        """
        if state.averaged:
            self.mean = {name: torch.empty_like(value) for name, value in self.trained().items()}
        own = self._changing()
        state.check(own)
        self.sampler.restore(state.random, state.order)
        for name, tensor in own.items():
            tensor.copy_(state.tensors[name])
        self.loss, self.averaged = state.loss, state.averaged
        self.done, self.seconds, self.start_seconds = state.steps, state.seconds, state.start_seconds
        require_finite(self.gaussians(), "the training state", "start over")

    def gaussians(self) -> Gaussians:
        """The result so far, in world units: the mean where there is one, else the parameters."""
        found = self._assembled(self.parameters | self.averages())
        return in_world_units(found if self.empty_sh is None else found.replace(shN=self.empty_sh))

    def averages(self) -> dict[str, Tensor]:
        """The mean parameters, of all rows; none before there is a mean."""
        rest = slice(self.objective.trained, None)
        whole = all(len(self.parameters[name][rest]) == 0 for name in self.mean)
        return self.mean if whole else {n: torch.cat([m, self.parameters[n][rest]]) for n, m in self.mean.items()}

    def _assembled(self, parameters: dict[str, Tensor]) -> Gaussians:
        """Gaussians of these parameters."""
        values: Any = {name: parameters[name] for name in ATTRIBUTES}
        dial: Any = {
            "sigma_d": self.objective.sigma(parameters[self.decay]), "attenuation": self.objective.attenuation,
            "growth_d": parameters.get("growth_d"),
        }  # fmt: skip
        return Gaussians(**values, **dial, screen_filter=self.objective.screen_filter)

    def trained(self) -> dict[str, Tensor]:
        """Views of the rows of the parameters that steps change."""
        return {name: self.parameters[name][: self.objective.trained] for name in self.stepped}

    def return_to(self, trained: dict[str, Tensor]) -> None:
        """Continues from these values of the trained rows, without moments and mean."""
        for name, own in self.trained().items():
            own.copy_(trained[name])
        for optimizer in filter(None, self.optimizers):
            optimizer.forget()
        self.mean, self.averaged = {}, 0

    def _optimizer(self, names: set[str]) -> RowAdam | None:
        """Of these parameters; None without any."""
        own = {name: value for name, value in self.trained().items() if name in names}
        units = {"means": self.unit}
        betas = {"beta1": BETA1**self.config.batch, "beta2": BETA2**self.config.batch}
        return RowAdam(own, **betas, units=units) if own else None

    def _changing(self) -> dict[str, Tensor]:
        """All tensors that steps change, named as in ``TrainingState``."""
        found = {f"parameter.{name}": value for name, value in self.trained().items()}
        for optimizer, rows in zip(self.optimizers, ("kept", "all"), strict=True):
            if optimizer:
                moments = optimizer.moments().items()
                found |= {f"{kind}.{name}": value for kind, values in moments for name, value in values.items()}
                found[f"steps.{rows}"] = optimizer.steps
        found |= {f"mean.{name}": value for name, value in self.mean.items()}
        if self.gate:
            found |= {f"good.{name}": value for name, value in self.gate.good.items()} | {
                "gate.checks": self.gate.numbers
            }
        return found


def learning_rates(config: AdaptConfig) -> dict[str, float]:
    """By attribute, for a batch; that of means is in units of ``own_sizes``."""
    rates = {
        "means": config.lr_means, "quats": config.lr_quats, "log_scales": config.lr_scales,
        "opacity_logits": config.lr_opacities, "sh0": config.lr_sh0, "shN": config.lr_shN,
    }  # fmt: skip
    return {name: rate * math.sqrt(config.batch) for name, rate in rates.items()}


@torch.no_grad()
def own_sizes(log_scales: Tensor) -> Tensor:
    """``[N]`` the unit of each Gaussian's position steps, world units: the geometric mean of its scales.

    A length of the scene, 3DGS's unit, is a hundred times the size of most Gaussians in a scene of millions.
    """
    return log_scales.detach().float().mean(1).exp()
