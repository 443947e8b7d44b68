"""Stand-ins for diff-gaussian-rasterization, drawn with the package's own rasterizer: Inria's of
2024, and a fork with what others add.

These are Mip-Splatting's ``kernel_size``, arguments of feature-3dgs among Inria's and of MonoGS
after them, and results in another order. All cull what is nearer than 0.2 before anything else.
"""

from collections import namedtuple
from inspect import Parameter, Signature
from types import ModuleType
from typing import Any

import torch
from torch import nn

from clod_adapter import Camera, ScreenFilter
from clod_adapter.cameras import intrinsics
from clod_adapter.rasterizers.cpu import rasterize

SETTINGS = (
    "image_height image_width tanfovx tanfovy bg scale_modifier viewmatrix projmatrix "
    "sh_degree campos prefiltered debug"
)
CALL = "means3D means2D opacities shs colors_precomp scales rotations cov3D_precomp"
FORKS = {  # settings in addition to SETTINGS, parameters of the call, results
    "inria": ("antialiasing", CALL, "color radii depth"),
    "other": (
        "kernel_size",
        f"{CALL.replace('shs', 'shs semantic_feature')} theta rho",
        "color features depth alpha radii touched",
    ),
}


def module(name, nearest=0.2):
    """The module ``diff_gaussian_rasterization`` of this fork; its rasterizer notes the arguments
    in ``given``.
    """
    settings, call, results = FORKS[name]

    class GaussianRasterizer(nn.Module):
        given: dict[str, Any]

        def __init__(self, raster_settings):
            super().__init__()
            self.raster_settings = raster_settings

        def forward(self, *args, **kwargs):
            self.given = dict(zip(call.split(), args, strict=False)) | kwargs
            assert set(self.given) <= set(call.split())
            drawn = _draw(self.raster_settings, self.given, nearest)
            return tuple(drawn[result] for result in results.split())

    forward = GaussianRasterizer.forward
    parameters = [
        Parameter(each, Parameter.POSITIONAL_OR_KEYWORD, default=None)
        for each in ("self", *call.split())
    ]
    forward.__signature__ = Signature(parameters)
    made = ModuleType("diff_gaussian_rasterization")
    made.GaussianRasterizer = GaussianRasterizer
    made.GaussianRasterizationSettings = namedtuple(
        "GaussianRasterizationSettings", f"{SETTINGS} {settings}"
    )
    return made


def arguments_of(g):
    """What the rasterizer is given of Gaussians, by name."""
    return {
        "means3D": g.means,
        "means2D": torch.zeros_like(g.means),
        "opacities": g.opacities[:, None],
        "shs": torch.cat([g.sh0, g.shN], 1),
        "scales": g.scales,
        "rotations": torch.nn.functional.normalize(g.quats),
    }


def settings_of(kind, view, **others):
    """The fork's settings for a camera whose principal point is the image's middle."""
    values = {
        "image_height": view.height,
        "image_width": view.width,
        "tanfovx": view.width / (2 * float(view.K[0, 0])),
        "tanfovy": view.height / (2 * float(view.K[1, 1])),
        "bg": torch.zeros(3),
        "viewmatrix": view.viewmat.T,
        "campos": view.position,
    }
    return kind(**{name: (values | others).get(name) for name in kind._fields})


def _draw(settings, given, nearest):
    """Every result of either fork; ``radii`` and ``touched`` have a row per Gaussian."""
    width = settings.image_width
    height = settings.image_height
    fx = width / (2 * settings.tanfovx)
    fy = height / (2 * settings.tanfovy)
    K = intrinsics(fx, fy, width / 2, height / 2)
    depths = given["means3D"] @ settings.viewmatrix[:3, 2] + settings.viewmatrix[3, 2]
    seen = depths > nearest
    result = {"radii": (99 * seen / depths).int(), "features": given.get("semantic_feature")}
    if given.get("scales") is None:
        return result | dict.fromkeys(("color", "alpha", "depth", "touched"))
    kernel = getattr(settings, "kernel_size", None)
    compensate = bool(kernel or getattr(settings, "antialiasing", None))
    screen_filter = ScreenFilter(variance=kernel or 0.3, compensate=compensate)
    names = ("means3D", "rotations", "scales", "opacities", "shs")
    rows = {name: given[name][seen] for name in names}
    image, alpha = rasterize(
        rows["means3D"],
        rows["rotations"],
        rows["scales"],
        rows["opacities"][:, 0],
        rows["shs"][:, :1],
        rows["shs"][:, 1:],
        screen_filter=screen_filter,
        camera=Camera(settings.viewmatrix.T, K, width, height),
        background=settings.bg,
    )
    color = image.permute(2, 0, 1) + 0 * given["means2D"].sum()
    touched = 2 * result["radii"]
    return result | {"color": color, "alpha": alpha, "depth": 2 * alpha, "touched": touched}
