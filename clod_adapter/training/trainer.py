"""One training run: parameters, optimizer and view sampler, and the step that changes them."""

import math
import time
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from clod_adapter._kernels.threads import torch_on_one_thread
from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.units import in_world_units
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians, LossNotFinite, nonfinite_rows, require_finite
from clod_adapter.losses import photometric_loss
from clod_adapter.rasterizers import for_device
from clod_adapter.training.distributed import ProcessGroup
from clod_adapter.training.optimizer import (
    GradientSum,
    RowAdam,
    add_to_mean,
    learning_rates,
    own_sizes,
)
from clod_adapter.training.paper import form_of
from clod_adapter.training.schedule import Sample, ViewSampler
from clod_adapter.training.state import TrainingState

# Adam's decay rates per view. A batch takes their powers and multiplies learning rates by its
# square root, so that each view has the same effect (Zhao et al., "On Scaling Up 3D Gaussian
# Splatting Training", ICLR 2025).
BETA1 = 0.9
BETA2 = 0.999


class Trainer:
    """Holds everything that training steps change. The start has a growth_d if the config has
    growth.

    Attributes:
        count: the number of trained rows, the first ones.
        parameters: tensors by name, those of the dial too; ``stepped``: names of those that are
            trained.
        mean: the mean of the trained parameters over the last steps, by the schedule; averaged: how
            many steps it has.
        loss: running mean of the photometric loss, NaN before the first step.
        ever_nonfinite: ``[trained]`` bool, rows that some step did not move because their gradient
            was not finite.
    """

    def __init__(
        self,
        start: Gaussians,
        views: tuple[View, ...],
        config: AdaptConfig,
        group: ProcessGroup | None = None,
    ) -> None:
        # Places of the result's rows in training, where far ones come first.
        self.order: Tensor | None = None
        if start.near is not None:
            far_first = start.near.int().argsort(stable=True)
            self.order = far_first.argsort()
            start = start.select(far_first)
        form = form_of(config)
        self.rates = learning_rates(config, form.decay)
        # A frozen attribute requests no gradient from the rasterizer.
        tuned = []
        attributes: Any = {}
        for name in ATTRIBUTES:
            values = getattr(start, name).detach().float().contiguous()
            if name == "opacity_logits" or (self.rates[name] > 0 and values.numel()):
                tuned.append(name)
                values = values.clone()
            attributes[name] = values
        splats = Gaussians(**attributes, screen_filter=start.screen_filter)
        self.dial = form(splats, start, [view.camera for view in views], config)
        dials = {name: value.detach() for name, value in self.dial.named_parameters()}
        self.parameters = attributes | dials
        self.stepped = (*tuned, *dials)
        self.config = config
        self.group = group
        self.count = self.dial.trained
        self.sampler = ViewSampler(views, config, self.dial.schedule)
        self.screen_filter = start.screen_filter
        self.optimizers = self._optimizers(own_sizes(start.log_scales[: self.count]))
        self.done = 0
        self.seconds = 0.0
        self.start_seconds = 0.0
        self.loss = math.nan
        self.mean: dict[str, Tensor] = {}
        self.averaged = 0
        self.ever_nonfinite = torch.zeros(self.count, dtype=torch.bool, device=start.means.device)
        self._updating = False

    def _optimizers(self, sizes: Tensor) -> dict[str, RowAdam]:
        """Two, by the rows that they move: ``kept``, those that the dial keeps, and ``all``, for
        the parameters of which culled rows have a gradient too, from the count term.

        ``sizes [N]``: the Gaussians' own, in units of which their means move.
        """
        parameters_by_rows = {"kept": self.trained(), "all": dict[str, Tensor]()}
        for name in (self.dial.decay, *self.dial.everywhere):
            parameters_by_rows["all"][name] = parameters_by_rows["kept"].pop(name)
        return {
            rows: RowAdam(
                parameters,
                beta1=BETA1**self.config.batch,
                beta2=BETA2**self.config.batch,
                units={"means": sizes},
            )
            for rows, parameters in parameters_by_rows.items()
            if parameters
        }

    @torch_on_one_thread()
    def step(self, share_done: float, until: float = math.inf) -> None:
        """Samples views and dial values, sums the gradients of their losses, and updates the
        parameters once.

        Nothing has changed after LossNotFinite, or an error of the rasterizer. A view is not begun
        after ``until``.
        """
        before = self.sampler.state()
        numbers = range(self.done * self.config.batch, (self.done + 1) * self.config.batch)
        samples = [self.sampler.draw(number, share_done) for number in numbers]
        try:  # if it fails, the next step samples the same views again
            if self.group:
                gradients = self.group.sum(self.gradient_sum(self.group.share(samples), until))
            else:
                gradients = self.gradient_sum(samples, until)
            self._updating = True
            self._update(gradients, share_done)
            # float() waits for a GPU, the one time in a step besides what gsplat does
            loss = float(gradients.loss) / gradients.views
            if not math.isfinite(loss):
                self._updating = False
                cameras = [sample.view.camera for sample in samples]
                names = ", ".join(camera.name or "a view without a name" for camera in cameras)
                raise LossNotFinite(f"the loss of step {self.done + 1} is not finite ({names})")
        except Exception:
            self.sampler.restore(*before)
            raise
        self.loss = loss if math.isnan(self.loss) else 0.98 * self.loss + 0.02 * loss
        # The optimizer continues from the parameters, not from the mean.
        if share_done >= 1 - self.dial.schedule.average:
            self.averaged += 1
            add_to_mean(self.mean, self.trained(), self.averaged)
        self.done += 1
        self._updating = False

    def gradient_sum(self, samples: Sequence[Sample], until: float = math.inf) -> GradientSum:
        """The gradients summed over the first sample and those begun before ``until``
        (``perf_counter``).
        """
        total = self._view_gradients(samples[0])
        for sample in samples[1:]:
            if time.perf_counter() >= until:
                break
            total += self._view_gradients(sample)
        return total

    def _view_gradients(self, sample: Sample) -> GradientSum:
        """Renders one view at its dial value, and differentiates the objective."""
        camera = sample.view.camera
        s = sample.dial
        trained_rows = slice(self.count)
        leaves = {
            name: value.detach().requires_grad_(name in self.stepped)
            for name, value in self.parameters.items()
        }
        gaussians = self._assembled(leaves)
        if sample.halved:
            gaussians = gaussians.replace(screen_filter=self.screen_filter.halved())
        rasterizer = for_device(gaussians.means.device)
        kept = rasterizer.kept(gaussians, camera, s)[trained_rows]
        image = rasterizer.draw(gaussians, camera, s, trained=self.count)[0]
        loss = photometric_loss(image, sample.view.image, self.config.ssim_weight)
        total = self.dial.objective(loss, gaussians, camera, s)
        stepped_gradients = torch.autograd.grad(total, [leaves[name] for name in self.stepped])
        gradients = {
            name: gradient[trained_rows]
            for name, gradient in zip(self.stepped, stepped_gradients, strict=True)
        }
        unweighted = loss.detach().double()
        decay = self.dial.decay
        parameter = self.parameters[decay][trained_rows]
        for counted_dial, weighted in self.dial.counts(s, sample.counted, unweighted):
            gradient = self.dial.count_gradient(parameter, counted_dial, weighted)
            gradients[decay] = gradients[decay] + gradient
        return GradientSum(gradients, kept, unweighted)

    def _update(self, total: GradientSum, share_done: float) -> None:
        """Moves the rows whose gradients are finite, and none if the loss is not. On a GPU nothing
        here waits for these results.
        """
        loss_finite = torch.as_tensor(total.loss).isfinite()
        nonfinite = nonfinite_rows(*total.gradients.values())
        self.ever_nonfinite |= loss_finite & nonfinite
        finite = nonfinite.logical_not_().logical_and_(loss_finite)
        rates = {
            name: rate * self.dial.schedule.lr_final**share_done
            for name, rate in self.rates.items()
        }
        moved_rows = {"kept": total.kept.logical_and_(finite), "all": finite}
        for rows, optimizer in self.optimizers.items():
            optimizer.step(total.gradients, moved_rows[rows], rates)
        self.dial.clamp()

    def state(self) -> TrainingState:
        """Everything that later steps depend on; its tensors are the trainer's own."""
        if self._updating:
            raise ClodError(
                f"step {self.done + 1} failed while it updated the parameters, so they cannot be"
                " saved"
            )
        return TrainingState(
            self._changing(),
            self.dial.attenuation,
            *self.sampler.state(),
            self.loss,
            self.averaged,
            self.done,
            self.seconds,
            self.start_seconds,
        )

    def restore(self, state: TrainingState) -> None:
        """The inverse of ``state``; copies its tensors. Raises ClodError if it is of another run,
        or damaged.
        """
        if state.averaged:
            self.mean = {name: torch.empty_like(value) for name, value in self.trained().items()}
        changing = self._changing()
        state.check(changing)
        self.sampler.restore(state.random, state.order)
        for name, tensor in changing.items():
            tensor.copy_(state.tensors[name])
        self.loss = state.loss
        self.averaged = state.averaged
        self.done = state.steps
        self.seconds = state.seconds
        self.start_seconds = state.start_seconds
        require_finite(self.gaussians(), "the training state", "start over")

    def gaussians(self) -> Gaussians:
        """The result so far, in world units: the mean where there is one, else the parameters."""
        parameters = dict(self.parameters)
        for name, mean in self.mean.items():
            parameters[name] = torch.cat([mean, parameters[name][self.count :]])
        gaussians = self._assembled(parameters)
        if self.order is not None:
            gaussians = gaussians.select(self.order)
        return in_world_units(gaussians)

    def _assembled(self, parameters: dict[str, Tensor]) -> Gaussians:
        """Gaussians with their dial from parameters by name, in the order and units of training."""
        values: Any = {name: parameters[name] for name in ATTRIBUTES}
        return Gaussians(
            **values,
            sigma_d=self.dial.sigma_of(parameters[self.dial.decay]),
            attenuation=self.dial.attenuation,
            growth_d=parameters.get("growth_d"),
            screen_filter=self.screen_filter,
        )

    def trained(self) -> dict[str, Tensor]:
        """Views of the rows of the parameters that steps change."""
        return {name: self.parameters[name][: self.count] for name in self.stepped}

    def _changing(self) -> dict[str, Tensor]:
        """All tensors that steps change, named as in ``TrainingState``."""
        tensors = {f"parameter.{name}": value for name, value in self.trained().items()}
        for rows, optimizer in self.optimizers.items():
            for kind, values in optimizer.moments.items():
                tensors |= {f"{kind}.{name}": value for name, value in values.items()}
            tensors[f"steps.{rows}"] = optimizer.steps
        tensors |= {f"mean.{name}": value for name, value in self.mean.items()}
        return tensors
