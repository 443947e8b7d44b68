"""splatfacto with a dial: the model of ``clod-splatfacto``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.viewer.viewer_elements import ViewerSlider
from torch import Tensor
from torch.nn import Parameter

from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.nerfstudio.splatfacto import chosen, new_dial, shown, view_of
from clod_adapter.training.dial import Dial

TRAINED = 30000
"""Step from which splatfacto uses whole photographs and all SH degrees, as when it loads a checkpoint."""


@dataclass
class ClodSplatfactoModelConfig(SplatfactoModelConfig):  # type: ignore[misc]
    """splatfacto's settings and those of the dial; densification has none, as the Gaussians stay the same."""

    _target: type = field(default_factory=lambda: ClodSplatfactoModel)
    max_sv: float = 5.0
    """largest dial value to train for"""
    exponent: float = 1.5
    """target-count curve: the target share of Gaussians at s is s^-exponent"""
    virtual_scale: float = 1.0
    """dial value of the viewer's first picture and of ns-render; CLOD_VIRTUAL_SCALE overrides it"""

    @property
    def adapt(self) -> AdaptConfig:
        """The same for ``attach``."""
        return AdaptConfig(max_sv=self.max_sv, exponent=self.exponent, ssim_weight=self.ssim_lambda)


class ClodSplatfactoModel(SplatfactoModel):  # type: ignore[misc]
    """A trained splatfacto whose Gaussians fade out by the dial.

    splatfacto reads its parameters through properties while it draws; there they are those of the dial value.
    """

    config: ClodSplatfactoModelConfig
    dial: Dial | None
    _shown: Mapping[str, Tensor] = {}

    def populate_modules(self) -> None:
        super().populate_modules()
        self.dial = None
        start = chosen(self.config.virtual_scale)
        self.slider = ViewerSlider("Dial s", start, 1.0, max(self.config.max_sv, start), 0.01)
        self.virtual_scale = start

    def attach(self, views: Sequence[View], saved: Mapping[str, Any]) -> None:
        """Gives the loaded Gaussians their dial, a saved or an initialized one (``new_dial``)."""
        self.dial = new_dial(self.gauss_params, views, self.config.adapt, saved).to(self.device)
        groups = {group["name"] for group in self.dial.param_groups(splats=True) if group["lr"] > 0}
        for name, parameter in self.gauss_params.items():
            parameter.requires_grad_(name in groups)

    @property
    def means(self) -> Tensor:
        return self._shown.get("means", super().means)

    @property
    def scales(self) -> Tensor:
        return self._shown.get("scales", super().scales)

    @property
    def opacities(self) -> Tensor:
        return self._shown.get("opacities", super().opacities)

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:
        if self.dial is None or not isinstance(camera, Cameras):
            return super().get_outputs(camera)  # type: ignore[no-any-return]
        self.virtual_scale = self.dial.sample() if self.training else float(self.slider.value)
        self._shown = shown(self.gauss_params, self.dial, view_of(camera).camera, self.virtual_scale)
        try:
            return super().get_outputs(camera)  # type: ignore[no-any-return]
        finally:
            self._shown = {}

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, Tensor]:
        losses: dict[str, Tensor] = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.dial is not None and self.training:
            losses["main_loss"] = self.dial.loss(self.virtual_scale, losses["main_loss"])
        return losses

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        groups = super().get_param_groups()
        groups = {name: values for name, values in groups.items() if all(value.requires_grad for value in values)}
        return groups | {name: [value] for name, value in (self.dial.named_parameters() if self.dial else ())}

    def step_cb(self, optimizers: Optimizers, step: int) -> None:
        super().step_cb(optimizers, TRAINED + step)

    def step_post_backward(self, step: int) -> None:
        """No densification, pruning or reset of opacities: the dial is of these Gaussians."""
