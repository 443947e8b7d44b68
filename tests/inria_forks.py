"""Stand-ins for forks of diff-gaussian-rasterization: their signatures, drawn with the package's own rasterizer.

Signatures and results from their sources: Inria's of 2023 and of 2024, MonoGS's "w-pose", Mip-Splatting's with depth
and alpha, feature-3dgs. All of them cull what is nearer than 0.2 before anything else.
"""

from __future__ import annotations

from collections import namedtuple
from inspect import Parameter, Signature
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from clod_adapter.cameras import Camera
from clod_adapter.config import ScreenFilter
from clod_adapter.rasterizers.cpu import rasterize

NEAREST = 0.2
SETTINGS = (
    "image_height image_width tanfovx tanfovy bg scale_modifier viewmatrix projmatrix "
    "sh_degree campos prefiltered debug"
)
CALL = "means3D means2D opacities shs colors_precomp scales rotations cov3D_precomp"


class Fork(NamedTuple):
    """Settings in addition to SETTINGS, parameters of the call, and results."""

    settings: str
    call: str
    results: str

    @property
    def further(self) -> list[str]:
        """Parameters that others do not have."""
        return [name for name in self.call.split() if name not in CALL.split()]


FORKS = {
    "inria 2023": Fork("", CALL, "color radii"),
    "inria 2024": Fork("antialiasing", CALL, "color radii depth"),
    "w-pose": Fork("projmatrix_raw", f"{CALL} theta rho", "color radii depth alpha touched"),
    "mip-splatting": Fork("kernel_size subpixel_offset", CALL, "color depth alpha radii"),
    "feature-3dgs": Fork("", CALL.replace("shs", "shs semantic_feature"), "color features radii depth"),
}


def module(name: str) -> Any:
    """The module ``diff_gaussian_rasterization`` of this fork."""
    fork = FORKS[name]

    class GaussianRasterizer(nn.Module):
        def __init__(self, raster_settings: Any) -> None:
            super().__init__()
            self.raster_settings = raster_settings

        def markVisible(self, positions: Tensor) -> Tensor:
            return _depths(self.raster_settings, positions) > NEAREST

        def forward(self, *args: Any, **kwargs: Any) -> tuple[Tensor, ...]:
            given = dict(zip(fork.call.split(), args, strict=False)) | kwargs
            assert set(given) <= set(fork.call.split()) and set(fork.further) <= set(given)
            drawn = _draw(self.raster_settings, given)
            return tuple(drawn[result] for result in fork.results.split())

    forward: Any = GaussianRasterizer.forward
    forward.__signature__ = Signature(
        [Parameter(each, Parameter.POSITIONAL_OR_KEYWORD, default=None) for each in ("self", *fork.call.split())]
    )
    made: Any = ModuleType("diff_gaussian_rasterization")
    made.GaussianRasterizer = GaussianRasterizer
    made.GaussianRasterizationSettings = namedtuple("GaussianRasterizationSettings", f"{SETTINGS} {fork.settings}")
    return made


def settings_of(kind: Any, view: Camera, **others: Any) -> Any:
    """The fork's settings for a camera whose principal point is the image's middle."""
    values = {
        "image_height": view.height, "image_width": view.width, "tanfovx": view.width / (2 * float(view.K[0, 0])),
        "tanfovy": view.height / (2 * float(view.K[1, 1])), "bg": torch.tensor([0.2, 0.5, 0.1]),
        "viewmatrix": view.viewmat.T, "campos": view.position, "scale_modifier": 1.0, "sh_degree": 1,
        "prefiltered": False, "debug": False,
    }  # fmt: skip
    return kind(**{name: (values | others).get(name) for name in kind._fields})


def _depths(settings: Any, means: Tensor) -> Tensor:
    return means @ settings.viewmatrix[:3, 2] + settings.viewmatrix[3, 2]


def _filter(settings: Any) -> ScreenFilter:
    """The screen filter of the settings; the classic one where they name none."""
    if kernel := getattr(settings, "kernel_size", None):
        return ScreenFilter(variance=kernel, compensate=True)
    return ScreenFilter(compensate=bool(getattr(settings, "antialiasing", None)))


def _draw(settings: Any, given: dict[str, Any]) -> dict[str, Tensor]:
    """Every result of any fork; ``radii`` and ``touched`` have a row per Gaussian."""
    width, height = settings.image_width, settings.image_height
    fx, fy = width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)
    K = torch.tensor([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
    view = Camera(settings.viewmatrix.T, K, width, height)
    depths = _depths(settings, given["means3D"])
    seen = depths > NEAREST
    means, quats, scales, opacities, shs = (
        given[name][seen] for name in ("means3D", "rotations", "scales", "opacities", "shs")
    )
    image, alpha = rasterize(
        means, quats, scales, opacities[:, 0], shs[:, :1], shs[:, 1:], camera=view, background=settings.bg,
        screen_filter=_filter(settings),
    )  # fmt: skip
    radii = torch.where(seen, (99 * given["scales"].amax(1) / depths.clamp(min=NEAREST)).ceil(), 0).int()
    color = image.permute(2, 0, 1) + 0 * given["means2D"].sum()
    return {
        "color": color, "radii": radii, "alpha": alpha, "depth": 2 * alpha, "touched": 2 * radii,
        "features": given.get("semantic_feature"),
    }  # fmt: skip
