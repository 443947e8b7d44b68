"""CLoD-GS's own training (section 3.3), with the settings of ``AdaptConfig.paper``.

Chosen here: sigma_d begins as 1, the count's sigmoid is SOFTNESS wide, learning rates decay to a
twentieth.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from clod_adapter.cameras import Camera, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.paper import soft_count
from clod_adapter.equation.units import in_world_units
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import (
    MOST_VIEWS,
    has_dial,
    initialize,
    scene_distance,
    with_growth,
)
from clod_adapter.progress import Listener
from clod_adapter.training.dial import SIGMA_RANGE, Dial
from clod_adapter.training.schedule import PAPER

SOFTNESS = 0.5  # of the sigmoid of the straight-through count, in log opacity


class PaperDial(Dial):
    """The paper's form: sigma_d itself is trained, and the count term reaches it and the opacities
    in each view.

    The objective is ``w_s (L_render + lambda L_reg)`` with ``w_s = (1 - 0.5 s / max_sv)^2``, and
    ``L_reg = (s - 1)^2 relu(eta - s^-p)^2``, eta the share kept.
    """

    decay = "sigma"
    limits = SIGMA_RANGE
    everywhere = frozenset({"opacity_logits"})
    schedule = PAPER
    weight_slope = 0.5

    @staticmethod
    def begin(
        base: Gaussians,
        views: Sequence[View],
        config: AdaptConfig,
        progress: Listener | None = None,
    ) -> Gaussians:
        """sigma_d = 1 in units of the largest distance in the frustum, no dial of its own; a dial
        it has is kept.
        """
        if has_dial(base):
            return initialize(base, views, config)
        distance = scene_distance(base, spread(views, MOST_VIEWS))
        attenuation = config.attenuation(distance)
        initial = base.replace(
            sigma_d=torch.ones_like(base.opacity_logits), attenuation=attenuation
        )
        return in_world_units(with_growth(initial, config))

    @staticmethod
    def sigma_of(parameter: Tensor) -> Tensor:
        return parameter

    @staticmethod
    def parameter_of(sigma_d: Tensor) -> Tensor:
        return sigma_d.detach().float().clamp(*SIGMA_RANGE)

    def objective(
        self,
        loss: Tensor,
        gaussians: Gaussians,
        camera: Camera,
        virtual_scale: float,
    ) -> Tensor:
        if self.config.reg_weight > 0 and virtual_scale >= 1:
            loss = loss + self.count_term(gaussians, camera, virtual_scale)
        return self.weight(virtual_scale) * loss

    def count_term(self, gaussians: Gaussians, camera: Camera, virtual_scale: float) -> Tensor:
        """0-d, ``lambda L_reg``."""
        assert gaussians.sigma_d is not None
        far = (
            normalized_distances(gaussians.means, camera, self.attenuation).double() * virtual_scale
        )
        count = soft_count(
            gaussians.opacity_logits,
            gaussians.sigma_d,
            far,
            virtual_scale,
            SOFTNESS,
        )
        excess = (count - virtual_scale**-self.config.exponent).clamp(min=0)
        return self.config.reg_weight * (virtual_scale - 1) ** 2 * excess**2


def form_of(config: AdaptConfig) -> type[Dial]:
    """The dial of a form of training."""
    return PaperDial if config.form == "paper" else Dial
