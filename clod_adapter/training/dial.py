"""The method as a component of a training loop of one's own (docs/python.md), for any rasterizer
and optimizer.

Initialization, dial values and objective are those of ``training.loop.adapt``, which drives a dial
too, steps the kept rows alone, and averages the last steps. The number of splats is fixed: densify
and prune before.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from clod_adapter.cameras import Camera, Scene, StoredView, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.attenuation import GROWTH_RANGE, SIGMA_MAX, Attenuated, reach_fade
from clod_adapter.equation.attenuation import dial as attenuate_gaussians
from clod_adapter.equation.distances import typical_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians, require_finite
from clod_adapter.initialization.importance import (
    MOST_VIEWS,
    for_training,
    initialize,
    usable_views,
)
from clod_adapter.integrations.splats import NAMES, from_gsplat
from clod_adapter.progress import Listener, progress_bar
from clod_adapter.training.far import with_far
from clod_adapter.training.optimizer import learning_rates, own_sizes
from clod_adapter.training.schedule import FAR, OURS, Schedule, ViewSampler
from clod_adapter.training.target_count import count_gradient, target_share

ATTRIBUTE_OF = {**NAMES, "features_dc": "sh0", "features_rest": "shN"}
# Sigma stays where the equation still resolves it; below, a Gaussian would be culled for good.
SIGMA_RANGE = (1e-4, SIGMA_MAX)

Splats = Gaussians | Mapping[str, Tensor]


class Dial(nn.Module):
    """A dial that a training loop learns; ``attach`` makes it.

    ``parameters()`` and ``state_dict()`` are those of the dial alone. The splats stay the caller's:
    they are read anew each time, never copied, and no part of the module.

    Attributes:
        log_sigma: ``[N]`` parameter, the logarithm of sigma_d.
        growth_d: ``[N]`` parameter, or None if the config has no growth.
        attenuation: settings of the equation that reads both; distances are in units of the
            reference distance.
        config: settings of the training.
        typical: ``[N]`` normalised distances at which Gaussians are counted, typical of all views.
            At one view's own distances the counts differ from their mean; the gradients that would
            correct such differences cancel out over the views, and only add noise.
    """

    # decay: name of the parameter that sigma_d is trained through; everywhere: of the others whose
    # culled rows have gradients too; limits: of ``decay``; weight_slope: k of ``weight``.
    decay: ClassVar[str] = "log_sigma"
    everywhere: ClassVar[frozenset[str]] = frozenset()
    limits: ClassVar[tuple[float, float]] = (math.log(SIGMA_RANGE[0]), math.log(SIGMA_RANGE[1]))
    schedule: Schedule = OURS
    weight_slope: ClassVar[float] = 0.25
    begin = staticmethod(with_far)  # the Gaussians that training begins with, with their dial

    typical: Tensor
    log_sigma: Tensor
    growth_d: Tensor | None
    if TYPE_CHECKING:  # a module's call is untyped

        def __call__(self, camera: Camera, virtual_scale: float) -> Attenuated: ...

    def __init__(
        self,
        splats: Splats,
        start: Gaussians,
        cameras: Sequence[Camera],
        config: AdaptConfig,
    ) -> None:
        super().__init__()
        assert start.sigma_d is not None and start.attenuation is not None
        # a ParameterDict that is an attribute would be a part of the module
        self._splats = (splats,)
        # Far Gaussians come first: they alone are trained, and their target counts are shares of
        # the near ones' number.
        self.trained = len(start)
        self.total = len(start)
        self.attenuation = start.attenuation
        self.config = config.for_views(len(cameras))
        if start.near is not None:
            self.schedule = FAR
            config = replace(config, start_share=1.0)
            self.trained = len(start) - start.whole
            self.total = start.whole
        self._counted = config  # of the target-count curve
        self.register_parameter(self.decay, nn.Parameter(self.parameter_of(start.sigma_d)))
        self.growth_d = None
        if start.growth_d is not None:
            self.growth_d = nn.Parameter(start.growth_d.detach().float().clamp(*GROWTH_RANGE))
        typical = typical_distance(start.means, spread(cameras, MOST_VIEWS), start.attenuation)
        self.register_buffer("typical", typical[: self.trained], persistent=False)
        self._median_size = float(own_sizes(start.log_scales).median())
        self.sampler = ViewSampler((), config, self.schedule)
        self._sampled = 0

    @staticmethod
    def sigma_of(parameter: Tensor) -> Tensor:
        """``[N]`` sigma_d from the parameter ``decay``, differentiable; ``parameter_of`` is the
        inverse, clamped.
        """
        return parameter.exp()

    @staticmethod
    def parameter_of(sigma_d: Tensor) -> Tensor:
        sigma = sigma_d.detach().float()
        return torch.where(sigma > 0, sigma.clamp(*SIGMA_RANGE).log(), -math.inf)

    def __repr__(self) -> str:
        return (
            f"Dial({len(self.typical):,} Gaussians, s from 1 to {self.config.max_sv:g},"
            f" {self.typical.device})"
        )

    @property
    def sigma_d(self) -> Tensor:
        """``[N]`` for ``attenuation``, differentiable."""
        return self.sigma_of(getattr(self, self.decay))

    def param_groups(self, splats: bool = False) -> list[dict[str, Any]]:
        """Groups for an optimizer, with the learning rates of ``config`` and the ``name`` of each.

        ``adapt`` decays all rates exponentially to ``schedule.lr_final`` of them over its steps.

        Args:
            splats: also those of the caller's parameters that require a gradient. Not where the
                loop has optimizers for them.

        Raises:
            ClodError: ``splats``, and none requires a gradient, as of a file that was read.
        """
        rates = learning_rates(self.config, self.decay)
        rates["means"] *= self._median_size  # an optimizer has one rate for all rows
        parameters: dict[str, Any] = {}
        if splats:
            (attached,) = self._splats
            candidates = attached.tensors() if isinstance(attached, Gaussians) else attached
            for name, value in candidates.items():
                if getattr(value, "requires_grad", False):
                    parameters[name] = value
            if not parameters:
                raise ClodError(
                    "no splat requires a gradient: attach copies with requires_grad_(), or leave"
                    " out splats=True"
                )
        parameters |= self.named_parameters()  # growth_d is the dial's own
        groups = []
        for name, value in parameters.items():
            attribute = ATTRIBUTE_OF.get(name, name)
            if attribute in rates:
                groups.append({"params": [value], "lr": rates[attribute], "name": name})
        return groups

    def sample(self) -> float:
        """The next dial value, by ``schedule`` over ``config.steps`` calls.

        Called once a step, it also keeps the parameters in the range in which the equation has a
        gradient. Dial values are evenly spread, not random: take the views in random order, or some
        meet the same dial values each round.
        """
        self.clamp()
        number = self._sampled
        self._sampled += 1
        return self.sampler.dial(number, min(number / max(self.config.steps, 1), 1.0))

    def forward(self, camera: Camera, virtual_scale: float) -> Attenuated:
        """The opacities ``drawn [N]`` and the factor ``growth [N]`` of the scales, for one camera
        and dial value.

        Differentiable in the splats' opacities and the dial's parameters. ``growth`` is 1 without
        growth. ``integrations.gsplat.rasterization`` takes ``sigma_d``, ``growth_d`` and
        ``attenuation`` instead.
        """
        return attenuate_gaussians(self.gaussians(), camera, virtual_scale)

    def loss(self, virtual_scale: float, rendering_loss: Tensor) -> Tensor:
        """0-d, the objective of one rendering at s: ``w_s rendering_loss`` and the target-count
        term.

        ``w_s`` is ``weight``. Gaussians are counted at s, if it is 1 or more, and at a random dial
        value up to 1.5 times ``max_sv``.

        Args:
            rendering_loss: 0-d, of an image rendered at s.
        """
        total = self.weight(virtual_scale) * rendering_loss
        for at, loss in self.counts(virtual_scale, self.sampler.counted(), rendering_loss):
            total = total + self.count_loss(at, loss)
        return total

    def weight(self, virtual_scale: float) -> float:
        """``w_s = max(0, 1 - k s / max_sv)^2``, the weight of the loss at the dial value s."""
        return max(1 - self.weight_slope * virtual_scale / self.config.max_sv, 0.0) ** 2

    def counts(
        self,
        virtual_scale: float,
        counted: float | None,
        loss: Tensor,
    ) -> list[tuple[float, Tensor]]:
        """The dial values, from 1 on, at which Gaussians are counted, and the losses that weigh the
        count term there.

        The weight at ``counted`` is 1: with half of w_s, counts at the far end were 1.25 times the
        target.
        """
        if counted is None:
            return []
        terms = [(counted, loss)]
        if virtual_scale >= 1:
            terms.insert(0, (virtual_scale, self.weight(virtual_scale) * loss))
        return terms

    def objective(
        self,
        loss: Tensor,
        gaussians: Gaussians,
        camera: Camera,
        virtual_scale: float,
    ) -> Tensor:
        """0-d, what ``adapt`` differentiates: the weighted photometric ``loss`` of a rendering."""
        return self.weight(virtual_scale) * loss

    def count_loss(self, virtual_scale: float, rendering_loss: Tensor) -> Tensor:
        """0-d, the target-count term ``L reg_weight (eta / target - 1)^2`` alone; eta is the share
        kept.

        L is ``rendering_loss``, a constant. The gradient, of ``log_sigma`` only, is
        ``target_count.count_gradient``. 0 below s = 1, where there is no target.
        """
        if virtual_scale < 1:
            return self.log_sigma.new_zeros(())
        loss = torch.as_tensor(rendering_loss).detach().double()
        gradient = self.count_gradient(self.log_sigma.detach(), virtual_scale, loss)
        sigma = self.sigma_d.detach()
        _, keep = reach_fade(sigma, self.typical.double() * virtual_scale)
        eta = keep.sum() / len(sigma)
        excess = eta / self.target_share(virtual_scale) - 1
        value = loss * self.config.reg_weight * excess**2
        change = self.log_sigma - self.log_sigma.detach()  # 0, with a gradient
        return value.to(sigma) + (change * gradient).sum()

    @torch.no_grad()
    def count_gradient(self, parameter: Tensor, virtual_scale: float, loss: Tensor) -> Tensor:
        """``[trained]`` the count term's gradient by the parameter ``decay`` at one dial value, for
        the trained rows.
        """
        sigma = self.sigma_of(parameter)
        target = self.target_share(virtual_scale)
        return count_gradient(self.typical, sigma, virtual_scale, loss, self.config, target)

    def target_share(self, virtual_scale: float) -> float:
        """The share of the splats that the target-count curve keeps at s, in (0, 1]; 1 below
        s = 1.
        """
        return target_share(virtual_scale, self.trained, self._counted, self.total)

    def gaussians(self) -> Gaussians:
        """The splats with this dial, for ``render`` in the loop and ``save`` after it: gradients
        reach both.

        Raises:
            ClodError: their number has changed.
        """
        (splats,) = self._splats
        current = splats if isinstance(splats, Gaussians) else from_gsplat(splats)
        count = len(getattr(self, self.decay))
        if len(current) != count:
            raise ClodError(
                f"there are {len(current)} splats now, but the dial is for {count}; attach it after"
                " densification and pruning"
            )
        return current.replace(
            sigma_d=self.sigma_d,
            attenuation=self.attenuation,
            growth_d=self.growth_d,
        )

    @torch.no_grad()
    def clamp(self) -> None:
        """Keeps the parameters in their ranges."""
        getattr(self, self.decay)[: self.trained].clamp_(*self.limits)
        if self.growth_d is not None:
            self.growth_d.clamp_(*GROWTH_RANGE)


@torch.inference_mode(False)
@torch.enable_grad()
def attach(
    splats: Splats,
    scene: Scene | Sequence[View] | Sequence[Camera],
    config: AdaptConfig | None = None,
    progress: Listener | Literal[False] | None = None,
    **settings: Any,
) -> Dial:
    """A dial for trained splats, initialized as ``adapt`` does: renders up to 64 views, at most
    once each.

    Args:
        splats: ``Gaussians``, or the parameters of gsplat's ``simple_trainer`` or splatfacto
            (``from_gsplat``), on any device that can render. They are not changed.
        scene: the training views, or their cameras, in the frame of the splats.
        progress: as for ``adapt``.
        settings: fields of ``AdaptConfig`` that replace those of ``config``.

    Raises:
        ClodError: as ``adapt``; or the config has the paper's form.

    Example:
        >>> base, scene = clod.load("base.ply"), clod.load_scene("scene")
        >>> dial = clod.attach(base.gaussians, scene, max_sv=5)
        >>> optimizer = torch.optim.Adam(dial.param_groups())
        >>> s = dial.sample()
        >>> attenuated = dial(scene.train[0].camera, s)  # rasterize, then dial.loss(s, loss)
    """
    config = replace(config or AdaptConfig(), **settings)
    if config.form != "ours":
        raise ClodError(f"attach has no form {config.form}: call adapt, or leave the form out")
    views = tuple(
        item if isinstance(item, View) else StoredView(item, _no_photograph)
        for item in (scene.train if isinstance(scene, Scene) else scene)
    )
    base = splats if isinstance(splats, Gaussians) else from_gsplat(splats)
    constants = {name: value.detach() for name, value in base.tensors().items()}
    base = base.replace(**constants)
    require_trainable(base, Scene(views, ()), config)
    views = usable_views(base, views)
    with progress_bar(progress) as listener:
        start = for_training(initialize(base, views, config, listener))
    return Dial(splats, start, [view.camera for view in views], config)


def require_trainable(
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig,
    processes: int = 1,
) -> None:
    """Raises ClodError if there are no Gaussians or views to train, or a value is not finite."""
    if not scene.train:
        raise ClodError(
            "the scene has no training views: give at least one photograph that is not held out"
        )
    if len(base) == 0:
        raise ClodError("the checkpoint has no Gaussians, so there is nothing to adapt")
    if config.batch < processes:
        raise ClodError(
            f"batch is {config.batch}, it must be at least {processes}, a view for each of the"
            " processes"
        )
    require_finite(base, "the checkpoint", "leave out such rows")


def _no_photograph() -> Tensor:
    raise AssertionError("only the camera of this view is used")
