"""Adapting: virtual distance scaling, after the fact, on a checkpoint someone else trained."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from clod_adapter._kernels.threads import torch_on_one_thread
from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.cameras import Scene, View, camera_extent
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.finite import LossNotFinite, largest_colour, require_finite, spoilt_rows
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import for_training, initialize, usable_views
from clod_adapter.training.distributed import ProcessGroup, ProcessLost
from clod_adapter.training.objective import GradientSum, Objective, TrainableSubset
from clod_adapter.training.optimizer import RowAdam, add_to_mean
from clod_adapter.training.state import Adapted, Progress, StateRefused, TrainingState
from clod_adapter.training.view_sampler import ViewSampler
from clod_adapter.units import in_world_units, with_distance

__all__ = ["Adapted", "Progress", "TrainingState", "adapt"]

# Adam's decays, a view; of a batch their powers, and step sizes times its root: what a view does then stays the same
# (Zhao et al., "On Scaling Up 3D Gaussian Splatting Training", ICLR 2025).
BETA1, BETA2 = 0.9, 0.999


def adapt(
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig | None = None,
    progress: Callable[[Progress], None] | None = None,
    resume: TrainingState | None = None,
    *,
    part: TrainableSubset | None = None,
    peers: ProcessGroup | None = None,
) -> Adapted:
    """Learns sigma_d for ``base`` on the training views of ``scene``, and updates the rest lightly.

    Each step draws ``batch`` views (1 by default) and goes by the sum of their gradients. Each is rendered at full
    detail and at one log-uniform dial value s in [1, max_sv], to minimise ``full_weight w_1 L_render(1) +
    w_s L_render(s)``, L_render being ``losses.photometric_loss`` and ``w_s = (1 - weight_slope s / max_sv)^2``, while
    ``counting.count_gradient`` presses the share of Gaussians kept towards its law by way of sigma_d. The outcome is
    the mean of the parameters over the last ``average`` of the steps: step sizes can then stay long to the end. A base
    that already has a sigma_d is continued from. Training divides sigma_d by the typical distance; the outcome has it
    in world units.

    ``AdaptConfig.paper`` gives CLoD-GS's own objective instead (section 3.3): one s a step and
    ``w_s (L_render + reg_weight L_reg)`` with ``L_reg = (s - 1)^2 relu(eta - s^-exponent)^2``, eta the share kept.

    A KeyboardInterrupt ends training and returns what there is: before the last ``average`` of the steps, no mean. So
    does the loss of a process that trains along, after a last call of ``progress``; of several processes that were
    given the same, a KeyboardInterrupt that ``progress`` raises in one ends all of them after the same step.

    The outcome is finite where the base is (an opacity logit of +-inf stays). A row whose gradient is not finite is not
    moved by that step, and counted in ``Adapted.held``. Before a step whose loss is not finite training ends, and what
    there is is returned. Any other error while a view is drawn is raised; both come after a last call of ``progress``.

    Args:
        resume: goes on from here (``Progress.state`` of an earlier call with the same base, views and config) and
            ends, on as many threads and processes, with the same bits as an undisturbed run; a time budget counts from
            the first beginning.
        part: what is trained, where ``base`` is not all that there is, or not all of it is trained.
        peers: the processes that train along, with the same arguments but ``progress``. Each takes its part of a
            step's views, and all have the same outcome: but for rounding, that of one process.

    Raises:
        ClodError: no training views, none that has a Gaussian before it, no Gaussians, an attribute that is not
            finite, a first step whose loss is not, ``resume`` is of something else or damaged (StateRefused), fewer
            views a step than processes, or one of these was lost before the first step.
    """
    config = config or AdaptConfig()
    if not scene.train:
        raise ClodError("the scene has no training views: give at least one photograph that is not held out")
    if len(base) == 0:
        raise ClodError("the checkpoint has no Gaussians, so there is nothing to adapt")
    if peers and config.batch < peers.size:
        raise ClodError(f"batch is {config.batch}, it must be at least {peers.size}, a view for each of the processes")
    require_finite(base, "the checkpoint", "leave out such rows")
    began = time.perf_counter()

    def report(phase: str, done: int, total: int) -> None:
        if progress:
            seconds = time.perf_counter() - began
            progress(Progress(phase, done, total, seconds, done / total, math.nan, lambda: base))

    # Where the higher bands are not tuned, empty ones stay empty.
    lean = base if config.lr_shN > 0 else base.without_empty_bands()
    views = usable_views(base, scene.train)
    if resume is None:
        begun = for_training(initialize(lean, views, config, report), views, config)
        if peers:  # the same bits in all of them
            own = {"sigma_d": begun.sigma_d, "attenuation": begun.attenuation}
            begun = begun.replace(**peers.broadcast(own)).to(begun.means.device)
    else:
        reading = resume.attenuation
        unset = torch.ones_like(base.opacity_logits)  # what is trained is in the state
        dialled = with_distance(in_world_units(lean), reading.scene_distance)  # by the same roundings as at first
        sigma = unset if lean.sigma_d is None else dialled.sigma_d
        begun = lean.replace(sigma_d=sigma, attenuation=reading)
    run = _Run(begun, views, config, progress, part, peers)
    run.empty_bands = None if lean is base else base.shN.clone()
    run.start_seconds = time.perf_counter() - began
    if resume is not None:
        try:
            run.restore(resume)
        except ClodError as error:
            raise StateRefused(str(error)) from error
    del resume  # by now a copy of what is in the run
    return run.run()


class _Run:
    """One training run: parameters, optimiser, random state."""

    def __init__(
        self,
        start: Gaussians,
        views: tuple[View, ...],
        config: AdaptConfig,
        progress: Callable[[Progress], None] | None,
        part: TrainableSubset | None = None,
        peers: ProcessGroup | None = None,
    ):
        self.config, self.progress, self.peers, self.draws = config, progress, peers, ViewSampler(views, config)
        part = part or TrainableSubset(len(start))
        assert start.sigma_d is not None and start.attenuation is not None
        # Cameras all in one place say nothing of the scene's unit; the distances in their pictures do.
        extent = part.extent or camera_extent([view.camera for view in views]) or start.attenuation.scene_distance
        rates = {
            "means": config.lr_means * extent, "quats": config.lr_quats, "log_scales": config.lr_scales,
            "opacity_logits": config.lr_opacities, "sh0": config.lr_sh0, "shN": config.lr_shN,
        }  # fmt: skip
        # What is stepped by row; a frozen attribute asks the rasterizer for no gradient.
        tuned = [n for n in ATTRIBUTES if n != "opacity_logits" and rates[n] > 0 and getattr(start, n).numel()]
        self.objective = Objective(config, start.attenuation, tuple(tuned), part, start.screen_filter)
        self.decay, self.stepped, self.range = self.objective.decay, self.objective.stepped, self.objective.decay_range
        self.rates = {name: rate * math.sqrt(config.batch) for name, rate in rates.items()}
        self.rates[self.decay] = config.lr_sigma * math.sqrt(config.batch)
        own = {"dtype": torch.float32, "memory_format": torch.contiguous_format}
        self.parameters = {
            name: getattr(start, name).detach().to(**own, copy=name in self.stepped) for name in ATTRIBUTES
        }
        self.parameters[self.decay] = self.objective.parameter(start.sigma_d)
        self.optimizer = RowAdam(self._trained(), beta1=BETA1**config.batch, beta2=BETA2**config.batch)
        self.empty_bands: Tensor | None = None  # the base's whole shN, where what was left out of it comes back
        self.done, self.seconds, self.start_seconds = 0, 0.0, 0.0
        self.loss = math.nan
        self.mean: dict[str, Tensor] = {}  # of the parameters over the last ``average`` of the steps
        self.averaged = 0
        # Rows that had a gradient that was not finite.
        self.held = torch.zeros(part.trained, dtype=torch.bool, device=start.means.device)

    def _trained(self) -> dict[str, Tensor]:
        """What steps change: views of the first rows of the parameters."""
        return {name: self.parameters[name][: self.objective.trained] for name in self.stepped}

    def run(self) -> Adapted:
        began, going = time.perf_counter() - self.seconds, True
        lost: str | None = None
        failed: str | None = None
        before = self._with_peers()
        try:
            while True:
                share = self._share_done(self.done, time.perf_counter() - began)
                if self.peers:  # all of them end after the same step, by the first one's clock
                    share, going = self.peers.agree(share, going)
                if share >= 1 or not going:
                    break
                self.step(share)
                self.done += 1
                self.seconds = time.perf_counter() - began
                going = self._tell()
        except KeyboardInterrupt:
            going = False
        except ProcessLost as error:
            going, lost = False, str(error)
            self._tell(lost)
        except LossNotFinite as error:
            if self.done == 0:
                raise ClodError(f"{error}, so nothing can be learned; {largest_colour(self.gaussians())}") from error
            going, failed = False, str(error)
        self.seconds = time.perf_counter() - began
        waiting, exchanging = (now - then for now, then in zip(self._with_peers(), before, strict=True))
        return Adapted(
            self.gaussians(), self.done, self.seconds, self.start_seconds, not going, lost, waiting, exchanging,
            failed, int(self.held.sum()),
        )  # fmt: skip

    def _with_peers(self) -> tuple[float, float]:
        return (self.peers.waiting, self.peers.exchanging) if self.peers else (0.0, 0.0)

    def _tell(self, lost: str | None = None) -> bool:
        """Says how far it is, and what ends it here; whether to go on."""
        if self.progress:
            share = self._share_done(self.done, self.seconds)
            told = ("train", self.done, self.config.iters, self.seconds, share, self.loss)
            try:
                self.progress(Progress(*told, self.gaussians, self.state, lost))
            except KeyboardInterrupt:
                return False
        return True

    def state(self) -> TrainingState:
        random, order = self.draws.state()
        return TrainingState(
            tensors=self._changing(), attenuation=self.objective.attenuation, random=random, order=order,
            loss=self.loss, averaged=self.averaged, steps=self.done, seconds=self.seconds,
            start_seconds=self.start_seconds,
        )  # fmt: skip

    def restore(self, state: TrainingState) -> None:
        """The inverse of ``state``."""
        if state.averaged:
            self.mean = {name: torch.empty_like(value) for name, value in self._trained().items()}
        own = self._changing()
        state.check(own)
        self.draws.restore(state.random, state.order)
        for name, tensor in own.items():
            tensor.copy_(state.tensors[name])
        self.loss, self.averaged = state.loss, state.averaged
        self.done, self.seconds, self.start_seconds = state.steps, state.seconds, state.start_seconds
        require_finite(self.gaussians(), "the training state", "start afresh")

    def _changing(self) -> dict[str, Tensor]:
        """The tensors themselves that steps change, named as in ``TrainingState``."""
        kinds = {"parameter": self._trained(), **self.optimizer.state(), "mean": self.mean}
        return {
            f"{kind}.{name}": values[name] for kind, values in kinds.items() for name in self.stepped if name in values
        }

    def _share_done(self, done: int, seconds: float) -> float:
        by_steps = done / self.config.iters if self.config.iters else 1.0
        return max(by_steps, seconds / self.config.time_budget) if self.config.time_budget else by_steps

    def gaussians(self) -> Gaussians:
        rest = slice(self.objective.trained, None)
        whole = all(len(self.parameters[name][rest]) == 0 for name in self.mean)
        mean = self.mean if whole else {n: torch.cat([m, self.parameters[n][rest]]) for n, m in self.mean.items()}
        parameters = self.parameters | mean
        values = {name: parameters[name] for name in ATTRIBUTES}
        if self.empty_bands is not None:
            values["shN"] = self.empty_bands
        sigma = self.objective.sigma(parameters[self.decay])
        dial: Any = {"sigma_d": sigma, "attenuation": self.objective.attenuation}
        return in_world_units(Gaussians(**values, **dial, screen_filter=self.objective.screen_filter))

    def _pull(self) -> GradientSum:
        """Of the next views; those of a batch that other processes have are pulled by them.

        Where that fails the state is as after the last step, with these views still to come, and is told.
        """
        before = self.draws.state()
        draws = [self.draws.draw() for _ in range(self.config.batch)]
        try:
            pull = self.objective.gradient_sum(self.parameters, self.peers.share(draws) if self.peers else draws)
            pull = self.peers.sum(pull) if self.peers else pull
            if not math.isfinite(pull.loss):
                names = ", ".join(view.camera.name or "a view without a name" for view, _ in draws)
                raise LossNotFinite(f"the loss of step {self.done + 1} is not finite ({names})")
            return pull
        except Exception as error:
            self.draws.restore(*before)
            if self.done > 0 and not isinstance(error, ProcessLost):  # which is told by who ends the run
                self._tell(str(error) or type(error).__name__)
            raise

    @torch_on_one_thread()
    def step(self, share_done: float) -> None:
        """Some views, their dial values, one update."""
        pull = self._pull()
        sound = ~spoilt_rows(pull.gradients)
        self.held |= ~sound
        now = pull.loss / self.config.batch
        self.loss = now if math.isnan(self.loss) else 0.98 * self.loss + 0.02 * now
        rates = {name: rate * self.config.lr_final**share_done for name, rate in self.rates.items()}
        # The paper's count term moves opacities too, of those that have left as well.
        everywhere = {self.decay} | ({"opacity_logits"} if self.config.count_term == "paper" else set())
        for rows, names in ((pull.kept & sound, set(self.stepped) - everywhere), (sound, everywhere)):
            self.optimizer.step({name: pull.gradients[name] for name in self.stepped if name in names}, rows, rates)
        self.parameters[self.decay].clamp_(*self.range)
        if share_done >= 1 - self.config.average:  # into the mean as they stand; the optimiser goes on from there
            self.averaged += 1
            add_to_mean(self.mean, self._trained(), self.averaged)
