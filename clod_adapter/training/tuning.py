"""Tuning of plain Gaussians for the distances at which alone they are drawn: those of one file, or
the levels of a set.

A dial's Gaussians serve all dial values. A file that was baked from them serves one, so all its
attributes may follow what the views show of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from clod_adapter._kernels.threads import torch_on_one_thread
from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.bake import Level
from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians, nonfinite_rows, require_finite
from clod_adapter.initialization.importance import usable_views
from clod_adapter.losses import photometric_loss
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import splat
from clod_adapter.training.optimizer import RowAdam, add_to_mean, learning_rates, own_sizes
from clod_adapter.training.schedule import ViewSampler

STEPS = 1000
LAST_RATE = 0.1  # the last learning rates as a share of the first ones
AVERAGED = 0.2  # share of the steps, at the end, whose parameters are averaged


def tune(
    gaussians: Gaussians,
    views: Sequence[View],
    steps: int = STEPS,
    *,
    seed: int = 0,
    progress: Listener | None = None,
) -> Gaussians:
    """Plain Gaussians, such as ``bake`` gives, fine-tuned in all attributes; their number stays.

    Minimises ``losses.photometric_loss`` with Adam, one view a step, at learning rates that fall
    exponentially. The result is the mean of the parameters over the last fifth of the steps.

    Args:
        views: photographs, or ``render_pseudo_views(checkpoint, cameras).train``.
        progress: called in ``Phase.TUNING`` after each step.

    Raises:
        ClodError: there is a dial, no view with a Gaussian in front of it, or a value that is not
            finite.
        Stopped: ``progress`` returned False.

    Example:
        >>> model, scene = clod.load("model.ply"), clod.load_scene("scene")
        >>> small = clod.bake(model.gaussians, 3, cameras=model.viewpoints)
        >>> clod.save("small.ply", clod.tune(small, scene.train, steps=300))
    """
    (level,) = tune_levels([Level(0.0, gaussians)], views, steps, seed=seed, progress=progress)
    return level.gaussians


@torch.inference_mode(False)
@torch.enable_grad()
def tune_levels(
    levels: Sequence[Level],
    views: Sequence[View],
    steps: int = STEPS,
    *,
    seed: int = 0,
    progress: Listener | None = None,
) -> list[Level]:
    """The levels of ``bake_levels``, each but the finest tuned for its own band of distances.

    In a step a Gaussian of a level is drawn where its distance times s is in the level's band, as
    viewers draw it. s is log-uniform from 1 to the ratio of the distances at which the last level
    and the first coarser one begin. Otherwise as ``tune``; a single level is tuned itself.
    """
    tuning = _Tuning(levels, views, seed)
    for done in range(steps):
        tuning.step(done / steps)
        tell(progress, Phase.TUNING, done + 1, steps)
    return tuning.levels()


class _Tuning:
    """The Gaussians of all levels, the coarsest first: the first ``trained`` rows are tuned."""

    def __init__(self, levels: Sequence[Level], views: Sequence[View], seed: int) -> None:
        self.given = levels
        parts = [level.gaussians for level in reversed(levels)]
        for part in parts:
            if part.sigma_d is not None:
                raise ClodError("Gaussians with a dial cannot be tuned; bake a dial value first")
            require_finite(part, "the Gaussians", "leave out such rows")
        self.counts = [len(part) for part in parts]
        self.trained = sum(self.counts[:-1]) or self.counts[0]
        self.parameters = {
            name: torch.cat([getattr(part, name) for part in parts]).float().contiguous()
            for name in ATTRIBUTES
        }
        self.joint = parts[0].replace(**self.parameters)
        begins = [level.begins for level in reversed(levels)]
        counts = torch.tensor(self.counts)
        device = self.joint.means.device
        self.begin = torch.tensor(begins).repeat_interleave(counts).to(device)
        self.end = torch.tensor([math.inf, *begins[:-1]]).repeat_interleave(counts).to(device)
        self.farthest = begins[0] / begins[-2] if len(levels) > 1 else 1.0
        self.sampler = ViewSampler(
            usable_views(self.joint, views), AdaptConfig(max_sv=1, seed=seed)
        )
        self.tuned = {
            name: value[: self.trained] for name, value in self.parameters.items() if value.numel()
        }
        self.rates = learning_rates(AdaptConfig(), "log_sigma")
        sizes = own_sizes(self.tuned["log_scales"])
        self.optimizer = RowAdam(self.tuned, units={"means": sizes})
        self.mean = dict[str, Tensor]()
        self.averaged = 0

    @torch_on_one_thread()
    def step(self, share_done: float) -> None:
        """Tunes the rows that are drawn in the next view."""
        view = self.sampler.draw(0, share_done).view
        s = self.farthest ** self.sampler.random.random()
        means = self.parameters["means"]
        distances = s * (means - view.camera.position.to(means)).norm(dim=1)
        drawn = (self.begin <= distances) & (distances < self.end)
        rows = drawn.nonzero()[:, 0]
        leaves = {
            name: value[rows].requires_grad_(name in self.tuned)
            for name, value in self.parameters.items()
        }
        shown = self.joint.select(rows).replace(**leaves)
        loss = photometric_loss(splat(shown, shown.opacities, view.camera)[0], view.image)
        found = torch.autograd.grad(loss, [leaves[name] for name in self.tuned])
        moved = rows[rows < self.trained]
        gradients = dict[str, Tensor]()
        for (name, value), gradient in zip(self.tuned.items(), found, strict=True):
            gradients[name] = torch.zeros_like(value).index_copy(0, moved, gradient[: len(moved)])
        finite = ~nonfinite_rows(*gradients.values())
        rates = {name: LAST_RATE**share_done * self.rates[name] for name in self.tuned}
        self.optimizer.step(gradients, drawn[: self.trained] & finite, rates)
        if share_done >= 1 - AVERAGED:
            self.averaged += 1
            add_to_mean(self.mean, self.tuned, self.averaged)

    def levels(self) -> list[Level]:
        """The levels so far, the finest first."""
        result = self.parameters | {
            name: torch.cat([mean, self.parameters[name][self.trained :]])
            for name, mean in self.mean.items()
        }
        tuned = list[Level]()
        end = sum(self.counts)
        for level in self.given:
            rows = slice(end - len(level.gaussians), end)
            changed = {name: value[rows].clone() for name, value in result.items()}
            tuned.append(Level(level.begins, level.gaussians.replace(**changed)))
            end = rows.start
        return tuned
