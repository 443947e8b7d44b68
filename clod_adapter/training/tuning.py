"""Tuning of plain Gaussians: those of one dial value, for that alone.

A dial's Gaussians serve all dial values. A file that was baked from them serves one, so all its
attributes may follow what the photographs show of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from clod_adapter._kernels.threads import torch_on_one_thread
from clod_adapter.adapter import ATTRIBUTES
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


@torch.inference_mode(False)
@torch.enable_grad()
@torch_on_one_thread()
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
        views: photographs to train on.
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
    if gaussians.sigma_d is not None:
        raise ClodError("Gaussians with a dial cannot be tuned; bake a dial value first")
    require_finite(gaussians, "the Gaussians", "leave out such rows")
    config = AdaptConfig(max_sv=1, seed=seed)
    sampler = ViewSampler(usable_views(gaussians, views), config)
    parameters = dict[str, Tensor]()
    for name in ATTRIBUTES:
        value = getattr(gaussians, name).detach()
        parameters[name] = value.to(torch.float32, memory_format=torch.contiguous_format, copy=True)
    tuned = {name: value for name, value in parameters.items() if value.numel()}
    optimizer = RowAdam(tuned, units={"means": own_sizes(gaussians.log_scales)})
    rates = learning_rates(config, "log_sigma")
    mean = dict[str, Tensor]()
    averaged = 0
    for done in range(steps):
        share = done / steps
        view = sampler.draw(done, share).view
        leaves = {name: value.detach().requires_grad_() for name, value in parameters.items()}
        shown = gaussians.replace(**leaves)
        loss = photometric_loss(splat(shown, shown.opacities, view.camera)[0], view.image)
        found = torch.autograd.grad(loss, [leaves[name] for name in tuned])
        gradients = dict(zip(tuned, found, strict=True))
        now = {name: LAST_RATE**share * rates[name] for name in tuned}
        optimizer.step(gradients, ~nonfinite_rows(*found), now)
        if share >= 1 - AVERAGED:
            averaged += 1
            add_to_mean(mean, tuned, averaged)
        tell(progress, Phase.TUNING, done + 1, steps)
    return gaussians.replace(**(parameters | mean))
