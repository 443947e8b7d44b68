"""The method ``clod-splatfacto``, which nerfstudio finds by the entry point
``nerfstudio.method_configs``.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification
from nerfstudio.viewer.viewer_elements import ViewerSlider
from torch import Tensor
from torch.nn import Parameter

from clod_adapter.cameras import Camera
from clod_adapter.config import AdaptConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.nerfstudio.splatfacto import (
    camera_of,
    chosen,
    drawn_parameters,
    new_dial,
    state_of,
    trained_rates,
    write_ply,
)
from clod_adapter.training.dial import Dial
from clod_adapter.training.schedule import OURS

OWN = "_model.dial."
EXPORTER = "nerfstudio.scripts.exporter"
TRAINED = 30000
"""Step from which splatfacto uses whole photographs and all SH degrees, as when it loads a
checkpoint.
"""

# Learning rates in nerfstudio's checkpoints are numpy's numbers, which torch 2.6 and newer reject
# to read, in nerfstudio's own commands too. These names run no code. Older versions of torch cannot
# be told of them.
if torch.__version__ >= "2.6":
    SCALAR: Any = np.float64(0).__reduce__()[0]
    torch.serialization.add_safe_globals(
        [
            (SCALAR, "numpy._core.multiarray.scalar"),
            (SCALAR, "numpy.core.multiarray.scalar"),
            np.dtype,
            type(np.dtype("f8")),
        ]
    )


@dataclass
class ClodSplatfactoModelConfig(SplatfactoModelConfig):  # type: ignore[misc]
    """splatfacto's settings and those of the dial; densification has none, as the Gaussians stay
    the same.
    """

    _target: type = field(default_factory=lambda: ClodSplatfactoModel)
    max_sv: float = 5.0
    """largest dial value to train for"""
    exponent: float = 1.5
    """target-count curve: the target share of Gaussians at s is s^-exponent"""
    virtual_scale: float = 1.0
    """dial value of the viewer's first picture and of ns-render; CLOD_VIRTUAL_SCALE overrides it"""


class ClodSplatfactoModel(SplatfactoModel):  # type: ignore[misc]
    """A trained splatfacto whose Gaussians fade out by the dial.

    splatfacto reads its parameters through properties while it draws; there they are those of the
    dial value.
    """

    config: ClodSplatfactoModelConfig
    dial: Dial | None
    _drawn_parameters: Mapping[str, Tensor] = {}

    def populate_modules(self) -> None:
        super().populate_modules()
        self.dial = None
        start = chosen(self.config.virtual_scale)
        self.slider = ViewerSlider("Dial s", start, 1.0, max(self.config.max_sv, start), 0.01)
        self.virtual_scale = start

    def attach(self, cameras: Sequence[Camera], saved: Mapping[str, Any]) -> None:
        """Gives the loaded Gaussians their dial, a saved or an initialized one (``new_dial``)."""
        settings = self.config
        config = AdaptConfig(
            max_sv=settings.max_sv, exponent=settings.exponent, ssim_weight=settings.ssim_lambda
        )
        self.dial = new_dial(self.gauss_params, cameras, config, saved).to(self.device)
        rates = trained_rates(self.dial)
        for name, parameter in self.gauss_params.items():
            parameter.requires_grad_(name in rates)

    @property
    def means(self) -> Tensor:
        return self._drawn_parameters.get("means", super().means)

    @property
    def scales(self) -> Tensor:
        return self._drawn_parameters.get("scales", super().scales)

    @property
    def opacities(self) -> Tensor:
        return self._drawn_parameters.get("opacities", super().opacities)

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:
        if self.dial is None or not isinstance(camera, Cameras):
            return super().get_outputs(camera)  # type: ignore[no-any-return]
        self.virtual_scale = self.dial.sample() if self.training else float(self.slider.value)
        self._drawn_parameters = drawn_parameters(
            self.gauss_params, self.dial, camera_of(camera), self.virtual_scale
        )
        try:
            return super().get_outputs(camera)  # type: ignore[no-any-return]
        finally:
            self._drawn_parameters = {}

    def get_loss_dict(
        self, outputs: Any, batch: Any, metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        losses: dict[str, Tensor] = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.dial is not None and self.training:
            losses["main_loss"] = self.dial.loss(self.virtual_scale, losses["main_loss"])
        return losses

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        groups = dict[str, list[Parameter]]()
        for name, values in super().get_param_groups().items():
            if all(value.requires_grad for value in values):
                groups[name] = values
        for name, value in self.dial.named_parameters() if self.dial else ():
            groups[name] = [value]
        return groups

    def step_cb(self, optimizers: Optimizers, step: int) -> None:
        super().step_cb(optimizers, TRAINED + step)

    def step_post_backward(self, step: int) -> None:
        """No densification, pruning or reset of opacities: the dial is of these Gaussians."""


class ClodPipeline(VanillaPipeline):  # type: ignore[misc]
    """Attaches the dial once the Gaussians are loaded, in ns-train and in all commands that read
    its result.
    """

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        others = dict[str, Any]()
        saved = dict[str, Any]()
        for name, value in loaded_state.items():
            state = saved if name.startswith(OWN) else others
            state[name.removeprefix(OWN)] = value
        super().load_pipeline(others, step)
        cameras = self.datamanager.train_dataset.cameras
        self.model.attach([camera_of(cameras[i : i + 1]) for i in range(len(cameras))], saved)
        self._export_with_dial()

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        state: dict[str, Any] = super().state_dict(*args, **kwargs)
        dial = self.model.dial
        return (
            state
            if dial is None
            else state | {OWN + name: value for name, value in state_of(dial).items()}
        )

    def _export_with_dial(self) -> None:
        """Replaces the function of ns-export, to which no plugin can add commands, that writes the
        PLY's rows.
        """
        exporter = getattr(
            sys.modules.get(EXPORTER) or sys.modules["__main__"], "ExportGaussianSplat", None
        )
        if exporter is None:
            return
        plain = exporter.write_ply
        compensate = self.model.config.rasterize_mode != "classic"
        adapted = partial(
            write_ply, dial=self.model.dial, screen_filter=ScreenFilter(compensate=compensate)
        )

        def write(filename: str, count: int, map_to_tensors: dict[str, Any]) -> None:
            if "f_dc_0" in map_to_tensors:
                adapted(filename, map_to_tensors)
            else:
                plain(filename, count, map_to_tensors)  # --ply-color-mode rgb: another kind of file

        exporter.write_ply = staticmethod(write)


def decaying(rate: float, final: float, steps: int) -> dict[str, Any]:
    """nerfstudio's Adam, with a learning rate that decays to ``final`` in so many steps."""
    scheduler = ExponentialDecaySchedulerConfig(lr_final=final, max_steps=steps)
    return {"optimizer": AdamOptimizerConfig(lr=rate, eps=1e-15), "scheduler": scheduler}


class ClodTrainer(Trainer):  # type: ignore[misc]
    """Starts from a trained splatfacto; its optimizers are made anew, for the loaded Gaussians and
    the dial.
    """

    def setup_optimizers(self) -> Optimizers:
        dial = self.pipeline.model.dial
        if dial is None:  # before the checkpoint is loaded
            return Optimizers({}, {})
        steps = self.config.max_num_iterations
        final = OURS.lr_final
        optimizers = {
            name: decaying(rate, final * rate, steps) for name, rate in trained_rates(dial).items()
        }
        return Optimizers(self.config.optimizers | optimizers, self.pipeline.get_param_groups())

    def _load_checkpoint(self) -> None:
        """Loads splatfacto's Gaussians, for a new dial from step 0, or everything of this method's
        checkpoint, from the next step.
        """
        if torch.__version__ < "2.6":
            raise ClodError(
                "clod-splatfacto needs torch 2.6 or newer to read checkpoints, not"
                f" {torch.__version__}"
            )
        state = torch.load(self._checkpoint(), map_location="cpu", weights_only=True)
        resumed = any(name.startswith(OWN) for name in state["pipeline"])
        self._start_step = state["step"] + 1 if resumed else 0
        self.pipeline.load_pipeline(state["pipeline"], state["step"])
        self.optimizers = self.setup_optimizers()
        if resumed:
            self.optimizers.load_optimizers(state["optimizers"])
            self.optimizers.load_schedulers(state["schedulers"])
            self.grad_scaler.load_state_dict(state["scalers"])

    def _checkpoint(self) -> Path:
        folder = self.config.load_dir
        step = self.config.load_step
        if folder is None and self.config.load_checkpoint is None:
            where = (
                "--load-dir outputs/SCENE/splatfacto/DATE/nerfstudio_models, or a file with"
                " --load-checkpoint"
            )
            raise ClodError(
                f"clod-splatfacto adapts a trained splatfacto: give its folder with {where}"
            )
        if folder is None:
            return Path(self.config.load_checkpoint)
        checkpoints = sorted(
            Path(folder).glob("step-*.ckpt" if step is None else f"step-{step:09d}.ckpt")
        )
        if not checkpoints:
            raise ClodError(
                f"{folder}: has no checkpoint{'' if step is None else f' of step {step}'}"
                " (step-*.ckpt)"
            )
        return checkpoints[-1]


method = MethodSpecification(
    config=TrainerConfig(
        _target=ClodTrainer,
        method_name="clod-splatfacto",
        steps_per_eval_image=100,
        steps_per_eval_batch=0,
        steps_per_save=2000,
        steps_per_eval_all_images=1000,
        max_num_iterations=AdaptConfig().steps,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            _target=ClodPipeline,
            datamanager=FullImageDatamanagerConfig(
                dataparser=NerfstudioDataParserConfig(load_3D_points=True),
                cache_images_type="uint8",
            ),
            model=ClodSplatfactoModelConfig(),
        ),
        optimizers={
            "camera_opt": decaying(1e-4, 5e-7, 30000),
            "bilateral_grid": decaying(2e-3, 1e-4, 30000),
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description=(
        "A quality dial for a trained splatfacto (clod-adapter); needs --load-dir or"
        " --load-checkpoint."
    ),
)
