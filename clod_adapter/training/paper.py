"""CLoD-GS's own training (section 3.3), with the settings of ``AdaptConfig.paper``.

Chosen here: sigma_d begins as 1, the count's sigmoid is SOFTNESS wide, learning rates decay to a twentieth.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from clod_adapter.cameras import Camera, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.attenuation import Attenuated, conform, dial, log_threshold
from clod_adapter.equation.units import in_world_units
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import MOST_VIEWS, has_dial, initialize, scene_distance, with_growth
from clod_adapter.progress import Listener
from clod_adapter.training.dial import SIGMA_RANGE, Dial
from clod_adapter.training.schedule import PAPER
from clod_adapter.training.target_count import slope_of_sigmoid

SOFTNESS = 0.5  # of the sigmoid of the straight-through count, in log opacity


class PaperDial(Dial):
    """The paper's form: sigma_d itself is trained, and the count term reaches it and the opacities in each view.

    The objective is ``w_s (L_render + lambda L_reg)`` with ``w_s = (1 - 0.5 s / max_sv)^2``, and
    ``L_reg = (s - 1)^2 relu(eta - s^-p)^2``, eta the share kept.
    """

    decay = "sigma"
    limits = SIGMA_RANGE
    everywhere = frozenset({"opacity_logits"})
    schedule = PAPER
    weight_slope = 0.5
    measured = False

    @staticmethod
    def initial(
        base: Gaussians, views: Sequence[View], config: AdaptConfig, progress: Listener | None = None,
        error: Tensor | None = None,
    ) -> Gaussians:  # fmt: skip
        """sigma_d = 1 in units of the largest distance in the frustum, a hard threshold; a dial it has is kept."""
        if has_dial(base):
            return initialize(base, views, config)
        distance = scene_distance(base, spread(views, MOST_VIEWS))
        attenuation = replace(config.attenuation(distance), cut="hard", normalizer="max")
        initial = base.replace(sigma_d=torch.ones_like(base.opacity_logits), attenuation=attenuation)
        return in_world_units(with_growth(initial, config))

    @staticmethod
    def sigma_of(parameter: Tensor) -> Tensor:
        return parameter

    @staticmethod
    def parameter_of(sigma_d: Tensor) -> Tensor:
        return sigma_d.detach().float().clamp(*SIGMA_RANGE)

    def objective(self, loss: Tensor, shown: Gaussians, camera: Camera, virtual_scale: float) -> Tensor:
        if self.config.reg_weight > 0 and virtual_scale >= 1:
            dialled = dial(shown, camera, virtual_scale)
            loss = loss + paper_count(dialled, virtual_scale, self.attenuation.tau, self.config, self.part.total)
        return self.weight(virtual_scale) * loss


def form_of(config: AdaptConfig) -> type[Dial]:
    """The dial of a form of training."""
    return PaperDial if config.form == "paper" else Dial


def paper_count(
    dialled: Attenuated, virtual_scale: float, tau: float, config: AdaptConfig, total: int | None = None
) -> Tensor:
    """0-d, the paper's ``lambda L_reg = lambda (s - 1)^2 relu(eta - s^-p)^2``; eta is ``soft_count``, of ``total``."""
    count = soft_count(dialled.log_opacities, virtual_scale, tau, SOFTNESS)
    count = count * (len(dialled.log_opacities) / (total or len(dialled.log_opacities)))
    excess = (count - virtual_scale**-config.exponent).clamp(min=0)
    return config.reg_weight * (virtual_scale - 1) ** 2 * excess**2


def soft_count(log_opacities: Tensor, virtual_scale: float, tau: float, temperature: float) -> Tensor:
    """0-d, the share of Gaussians kept, in [0, 1]: the mean of ``log a'' > log(tau s)``; 0 for no Gaussians.

    Its gradient is that of the mean of ``sigmoid((log a'' - log(tau s)) / temperature)``, 0 at log a'' = -inf.
    """
    (log_opacities,) = conform(log_opacities=log_opacities)
    fixed, threshold = log_opacities.detach(), log_threshold(tau, virtual_scale)
    share = (fixed > threshold).sum() / fixed.new_full((), max(len(fixed), 1))
    nothing = (log_opacities - fixed).nan_to_num()  # -inf less itself is NaN
    return share + (nothing * slope_of_sigmoid(fixed, threshold, temperature)).sum()
