"""The method as a component of a training loop of one's own, for any rasterizer and optimizer.

    dial = clod_adapter.attach(splats, cameras)
    optimizer = torch.optim.Adam(dial.param_groups(splats=True), eps=1e-15)
    for camera, photograph in loader:
        s = dial.sample()
        shown = dial(camera, s)
        image = rasterize(opacities=shown.drawn, scales=scales * shown.growth[:, None], ...)
        dial.loss(s, photometric_loss(image, photograph)).backward()
        optimizer.step()
        optimizer.zero_grad()
    clod_adapter.save("dial.ply", dial.gaussians())

Initialization, dial values and objective are those of ``training.loop.adapt``, whose own step is faster on a CPU: it
computes the count term's gradient in compiled passes, steps the kept rows alone, and averages the last steps.

The splats are trained already, and their number is fixed: densify and prune before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn

from clod_adapter.cameras import Camera, Scene, StoredView, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.attenuation import Attenuated, attenuate
from clod_adapter.equation.attenuation import dial as dialled_by
from clod_adapter.equation.distances import typical_distance
from clod_adapter.equation.growth import GROWTH_RANGE
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, for_training, initialize, usable_views
from clod_adapter.integrations.splats import NAMES, from_gsplat
from clod_adapter.progress import Listener, shown
from clod_adapter.training.loop import require_trainable
from clod_adapter.training.objective import SIGMA_RANGE, loss_weight
from clod_adapter.training.target_count import count_gradient, target_share
from clod_adapter.training.trainer import learning_rates, own_sizes
from clod_adapter.training.view_sampler import ViewSampler

ATTRIBUTE_OF = {**NAMES, "features_dc": "sh0", "features_rest": "shN"}

Splats = Gaussians | Mapping[str, Tensor]


class Dial(nn.Module):
    """A dial that a training loop learns; ``attach`` makes it.

    ``parameters()`` and ``state_dict()`` are those of the dial alone. The splats stay the caller's: they are read anew
    each time, never copied, and no part of the module.

    Attributes:
        log_sigma: ``[N]`` parameter, the logarithm of sigma_d.
        growth_d: ``[N]`` parameter, or None if the config has no growth.
        attenuation: settings of both; distances are in units of the reference distance.
        config: settings of the training.
        typical: ``[N]`` normalised distances at which Gaussians are counted.
    """

    typical: Tensor
    growth_d: Tensor | None
    if TYPE_CHECKING:  # a module's call is untyped

        def __call__(self, camera: Camera, virtual_scale: float) -> Attenuated: ...

    def __init__(self, splats: Splats, start: Gaussians, views: Sequence[View], config: AdaptConfig) -> None:
        super().__init__()
        assert start.sigma_d is not None and start.attenuation is not None
        self._given = (splats,)  # a ParameterDict that is an attribute would be a part of the module
        config = config.for_views(len(views))
        self.attenuation, self.config = start.attenuation, config
        self.log_sigma = nn.Parameter(start.sigma_d.detach().float().clamp(*SIGMA_RANGE).log())
        growth_d = (
            None if start.growth_d is None else nn.Parameter(start.growth_d.detach().float().clamp(*GROWTH_RANGE))
        )
        self.register_parameter("growth_d", growth_d)
        cameras = [view.camera for view in spread(views, MOST_VIEWS)]
        self.register_buffer("typical", typical_distance(start.means, cameras, start.attenuation), persistent=False)
        self._rates = learning_rates(config)
        self._rates["means"] *= float(own_sizes(start.log_scales).median())  # an optimizer has one rate for all rows
        self._sampler, self._sampled = ViewSampler((), config, start.attenuation.tau), 0

    def __repr__(self) -> str:
        return f"Dial({len(self.log_sigma):,} Gaussians, s from 1 to {self.config.max_sv:g}, {self.log_sigma.device})"

    @property
    def sigma_d(self) -> Tensor:
        """``[N]`` for ``attenuation``, differentiable."""
        return self.log_sigma.exp()

    def param_groups(self, splats: bool = False) -> list[dict[str, Any]]:
        """Groups for an optimizer, with the learning rates of ``config`` and the ``name`` of each.

        ``adapt`` decays all rates exponentially to ``config.lr_final`` of them over its steps.

        Args:
            splats: also those of the caller's parameters that require a gradient. Not where the loop has optimizers
                for them.
        """
        root = self.config.batch**0.5
        rates = {"log_sigma": root * self.config.lr_sigma, "growth_d": root * self.config.lr_growth}
        found = [{"params": [value], "lr": rates[name], "name": name} for name, value in self.named_parameters()]
        if splats:
            (given,) = self._given
            for name, value in (given.tensors() if isinstance(given, Gaussians) else given).items():
                rate = self._rates.get(ATTRIBUTE_OF.get(name, name))
                if rate is not None and getattr(value, "requires_grad", False):
                    found.append({"params": [value], "lr": rate, "name": name})
        return found

    def sample(self) -> float:
        """The next dial value: s = 1 in ``full_share`` of the steps, a quarter of these s = 0, else (log-)uniform.

        The share falls over ``config.steps`` calls.

        Called once a step, it also keeps the parameters in the range in which the equation has a gradient. Dial values
        are evenly spread, not random: take the views in random order, or some meet the same dial values each round.
        """
        self._clamp()
        self._sampled += 1
        return self._sampler.dial(self._sampled - 1, min((self._sampled - 1) / max(self.config.steps, 1), 1.0))

    def forward(self, camera: Camera, virtual_scale: float) -> Attenuated:
        """The opacities ``drawn [N]`` and the factor ``growth [N]`` of the scales, for one camera and dial value.

        Differentiable in the splats' opacities and the dial's parameters. ``growth`` is 1 without growth.
        ``integrations.gsplat.rasterization`` takes ``sigma_d``, ``growth_d`` and ``attenuation`` instead.
        """
        return dialled_by(self.gaussians(), camera, virtual_scale)

    def loss(self, virtual_scale: float, rendering_loss: Tensor) -> Tensor:
        """0-d, the objective of one rendering at s: ``w_s rendering_loss`` and the target-count term.

        ``w_s = (1 - weight_slope s / max_sv)^2``. Gaussians are counted at s, if it is 1 or more, and at a random dial
        value up to 1.5 times ``max_sv``.

        Args:
            rendering_loss: 0-d, of an image rendered at s.
        """
        weighted = loss_weight(virtual_scale, self.config) * rendering_loss
        counted = self._sampler.counted()
        if counted is None:
            return weighted
        return weighted + self.count_loss(virtual_scale, weighted) + self.count_loss(counted, rendering_loss)

    def count_loss(self, virtual_scale: float, rendering_loss: Tensor) -> Tensor:
        """0-d, the target-count term ``L reg_weight (eta / target - 1)^2`` alone; eta is the share kept.

        L is ``rendering_loss``, a constant. The gradient, of ``log_sigma`` only, is ``target_count.count_gradient``.
        0 below s = 1, where there is no target.
        """
        if virtual_scale < 1:
            return self.log_sigma.new_zeros(())
        logits, sigma = self.gaussians().opacity_logits.detach(), self.sigma_d.detach()
        loss = torch.as_tensor(rendering_loss).detach().double()
        target = target_share(virtual_scale, len(logits), self.config)
        dialled = attenuate(logits, sigma, self.typical, virtual_scale, self.attenuation)
        gradient = count_gradient(dialled, logits, virtual_scale, self.attenuation.tau, loss, self.config, target)
        eta = dialled.keep.sum() / len(logits)
        value = loss * self.config.reg_weight * (eta / target.share - 1) ** 2
        return value.to(sigma) + ((self.log_sigma - self.log_sigma.detach()) * gradient).sum()

    def target_share(self, virtual_scale: float) -> float:
        """The share of the splats that the target-count curve keeps at s, in (0, 1]; 1 below s = 1."""
        return target_share(virtual_scale, len(self.log_sigma), self.config).share

    def gaussians(self) -> Gaussians:
        """The splats with this dial, for ``render`` in the loop and ``save`` after it: gradients reach both.

        It has the splats' own tensors.

        Raises:
            ClodError: their number has changed.
        """
        (given,) = self._given
        current = given if isinstance(given, Gaussians) else from_gsplat(given)
        if len(current) != len(self.log_sigma):
            raise ClodError(
                f"there are {len(current)} splats now, but the dial is for {len(self.log_sigma)}; attach it after "
                "densification and pruning"
            )
        return current.replace(sigma_d=self.sigma_d, attenuation=self.attenuation, growth_d=self.growth_d)

    @torch.no_grad()
    def _clamp(self) -> None:
        low, high = map(math.log, SIGMA_RANGE)
        self.log_sigma.clamp_(low, high)
        if self.growth_d is not None:
            self.growth_d.clamp_(*GROWTH_RANGE)


@torch.inference_mode(False)
@torch.enable_grad()
def attach(
    splats: Splats, scene: Scene | Sequence[View] | Sequence[Camera], config: AdaptConfig | None = None,
    progress: Listener | Literal[False] | None = None, **settings: Any,
) -> Dial:  # fmt: skip
    """A dial for trained splats, initialized as ``adapt`` does: renders up to 64 views, at most once each.

    Args:
        splats: ``Gaussians``, or the parameters of gsplat's ``simple_trainer`` or splatfacto (``from_gsplat``), on any
            device that can render. They are not changed.
        scene: the training views, or their cameras, in the frame of the splats.
        progress: as for ``adapt``.
        settings: fields of ``AdaptConfig`` that replace those of ``config``.

    Raises:
        ClodError: as ``adapt``; or the config has the paper's count term or its linear parameter.
    """
    config = replace(config or AdaptConfig(), **settings)
    if config.count_term != "law" or config.parameter != "log":
        raise ClodError(
            "attach has the count term law and the parameter log; for others, as AdaptConfig.paper, call adapt"
        )
    given = scene.train if isinstance(scene, Scene) else scene
    views = tuple(each if isinstance(each, View) else _without_photograph(each) for each in given)
    base = splats if isinstance(splats, Gaussians) else from_gsplat(splats)
    base = base.replace(**{name: value.detach() for name, value in base.tensors().items()})
    require_trainable(base, Scene(views, ()), config)
    views = usable_views(base, views)
    with shown(progress) as listener:
        start = for_training(initialize(base, views, config, listener), views, config)
    return Dial(splats, start, views, config)


def _without_photograph(camera: Camera) -> View:
    """A view for functions that only take its camera."""
    return StoredView(camera, lambda: torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8))
