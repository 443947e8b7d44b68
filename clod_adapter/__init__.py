"""A quality dial for Gaussian splats that are already trained.

import clod_adapter as clod
base = clod.load("pretrained.ply")
scene = clod.load_scene("scene/", origin=base.origin)
result = clod.adapt_checkpoint(base, scene, clod.AdaptConfig(max_sv=5))
result.save("model.ply")
image = clod.render(result.gaussians, scene.test[0].camera, virtual_scale=3).image
"""

import os
import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if "torch" not in sys.modules:
    # GNU OpenMP's idle threads spin by default and take the cores from the splatting threads:
    # measured at up to six times the time of a training step. Only the first import of torch reads
    # this.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from clod_adapter.adapter import Adapter, detach, extract, with_dial
    from clod_adapter.bake import bake, bake_levels, order_by_extinction
    from clod_adapter.calibration import Calibration
    from clod_adapter.cameras import Camera, Scene, View
    from clod_adapter.config import AdaptConfig, AttenuationConfig, ScreenFilter
    from clod_adapter.errors import ClodError
    from clod_adapter.evaluation.budget import DialValue, dial_for
    from clod_adapter.evaluation.evaluate import evaluate
    from clod_adapter.gaussians import Gaussians
    from clod_adapter.hook import Hold, Hook
    from clod_adapter.integrations.splats import from_gsplat, to_gsplat
    from clod_adapter.io.adapter_file import load_adapter, save_adapter
    from clod_adapter.io.checkpoint import Checkpoint, load, save
    from clod_adapter.io.scene.load import load_scene
    from clod_adapter.pipeline import Result, adapt_checkpoint
    from clod_adapter.progress import Phase, Progress, Stopped
    from clod_adapter.render import Rendering, render
    from clod_adapter.training.camera_placement import place_cameras
    from clod_adapter.training.dial import Dial, attach
    from clod_adapter.training.loop import Adapted, adapt
    from clod_adapter.training.plan import Decision, Override, Plan
    from clod_adapter.training.planner import make_plan
    from clod_adapter.training.pseudo_views import add_pseudo_views, render_pseudo_views
    from clod_adapter.training.tuning import tune, tune_levels

# Imported on first use: torch takes a second or two, which the command's --help and most of its
# errors do without.
_names = {
    "adapter": "Adapter detach extract with_dial",
    "bake": "bake bake_levels order_by_extinction",
    "calibration": "Calibration",
    "cameras": "Camera Scene View",
    "config": "AdaptConfig AttenuationConfig ScreenFilter",
    "errors": "ClodError",
    "evaluation.budget": "DialValue dial_for",
    "evaluation.evaluate": "evaluate",
    "gaussians": "Gaussians",
    "hook": "Hold Hook",
    "integrations.splats": "from_gsplat to_gsplat",
    "io.adapter_file": "load_adapter save_adapter",
    "io.checkpoint": "Checkpoint load save",
    "io.scene.load": "load_scene",
    "pipeline": "Result adapt_checkpoint",
    "progress": "Phase Progress Stopped",
    "render": "Rendering render",
    "training.camera_placement": "place_cameras",
    "training.dial": "Dial attach",
    "training.loop": "Adapted adapt",
    "training.plan": "Decision Override Plan",
    "training.planner": "make_plan",
    "training.pseudo_views": "add_pseudo_views render_pseudo_views",
    "training.tuning": "tune tune_levels",
}
_homes = dict[str, str]()
for _home in _names:
    _homes |= dict.fromkeys(_names[_home].split(), f"{__name__}.{_home}")


class _Lazy(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name not in _homes:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        value = self.__dict__[name] = getattr(import_module(_homes[name]), name)
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # Importing a submodule binds its name in the package, where the function of that name
        # (render) stands.
        if not (name in _homes and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*_homes, *(name for name in self.__dict__ if name.startswith("__"))})


sys.modules[__name__].__class__ = _Lazy

__all__ = [
    "AdaptConfig",
    "Adapted",
    "Adapter",
    "AttenuationConfig",
    "Calibration",
    "Camera",
    "Checkpoint",
    "ClodError",
    "Decision",
    "Dial",
    "DialValue",
    "Gaussians",
    "Hold",
    "Hook",
    "Override",
    "Phase",
    "Plan",
    "Progress",
    "Rendering",
    "Result",
    "Scene",
    "ScreenFilter",
    "Stopped",
    "View",
    "adapt",
    "adapt_checkpoint",
    "add_pseudo_views",
    "attach",
    "bake",
    "bake_levels",
    "detach",
    "dial_for",
    "evaluate",
    "extract",
    "from_gsplat",
    "load",
    "load_adapter",
    "load_scene",
    "make_plan",
    "order_by_extinction",
    "place_cameras",
    "render",
    "render_pseudo_views",
    "save",
    "save_adapter",
    "to_gsplat",
    "tune",
    "tune_levels",
    "with_dial",
]
