"""Inria's rasterizer with a dial: diff-gaussian-rasterization, in whichever fork is installed.

from clod_adapter.integrations.inria import GaussianRasterizationSettings, GaussianRasterizer
color, radii, *others = GaussianRasterizer(raster_settings)(
    means3D=means, means2D=points, opacities=opacities, shs=shs, scales=scales, rotations=rotations,
    sigma_d=model.sigma_d, growth_d=model.growth_d, attenuation=model.attenuation, virtual_scale=3,
)

Forks differ in settings, further arguments and results, which all are passed on. Culled Gaussians
get opacity 0 and a position just behind the camera's centre, where every fork culls them first, by
depth or, for panoramas, by distance: they cost as much as a Gaussian out of view. All rows keep
their places, with radii of 0.
"""

import inspect
from typing import Any

import torch
from torch import Tensor

from clod_adapter.cameras import NEAR, intrinsics
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.hook import Hook, dropped_in

try:
    import diff_gaussian_rasterization as installed
    from diff_gaussian_rasterization import GaussianRasterizationSettings
except ImportError as error:
    raise ImportError(
        "diff_gaussian_rasterization cannot be imported; it needs torch and CUDA: pip install"
        " --no-build-isolation git+https://github.com/graphdeco-inria/diff-gaussian-rasterization"
    ) from error

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


class GaussianRasterizer(installed.GaussianRasterizer):  # type: ignore[misc]
    """The installed ``GaussianRasterizer`` with arguments for the dial."""

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        *args: Any,
        sigma_d: Tensor | None = None,
        virtual_scale: float = 1.0,
        attenuation: AttenuationConfig | None = None,
        growth_d: Tensor | None = None,
        **kwargs: Any,
    ) -> Any:
        """The installed fork's result with the opacities and scales of one dial value.

        Equals the fork called with the opacities of ``attenuation.attenuate``, ``scales`` times its
        growth (``cov3D_precomp``, where given, times its square) and without culled rows, plus rows
        of radius 0 for these. Differentiable in ``sigma_d`` and ``growth_d``; the distances are
        constants. A file's ``Gaussians.screen_filter`` belongs in the settings of forks that
        support it (``antialiasing``, Mip-Splatting's ``kernel_size``).

        Args:
            means3D, means2D, opacities, args, kwargs: those of the fork, by position or by name.
            sigma_d, virtual_scale, attenuation, growth_d: as for
                ``integrations.gsplat.rasterization``, each ``[N]``.

        Raises:
            ClodError: the dial is negative, growth_d comes without attenuation, a tensor holds
                integers, the shapes do not match, or the settings have ``prefiltered``, with which
                the rasterizer aborts at the first Gaussian out of view.
        """
        config = dropped_in(sigma_d, virtual_scale, attenuation, growth_d)
        if config is None or sigma_d is None:
            return super().forward(means3D, means2D, opacities, *args, **kwargs)
        settings = self.raster_settings
        if settings.prefiltered:
            raise ClodError(
                "raster_settings.prefiltered is True, but culled Gaussians are out of view; set it"
                " to False"
            )
        hook = Hook(sigma_d, config, virtual_scale, growth_d)
        viewmat = settings.viewmatrix.T  # Inria's matrices multiply from the right
        width = settings.image_width
        height = settings.image_height
        fx = width / (2 * settings.tanfovx)
        fy = height / (2 * settings.tanfovy)
        K = intrinsics(fx, fy, width / 2, height / 2)
        opacities_drawn, keep, growth = hook(means3D, opacities, viewmat, K, width, height)
        # opposite to the viewing direction
        hidden = settings.campos - NEAR * settings.viewmatrix[:3, 2]
        means3D = torch.where(keep[:, None], means3D, hidden.to(means3D))
        signature = inspect.signature(super().forward)
        bound = signature.bind(means3D, means2D, opacities_drawn, *args, **kwargs)
        for name, power in (("scales", 1), ("cov3D_precomp", 2)):
            if (value := bound.arguments.get(name)) is not None:
                bound.arguments[name] = value * growth.to(value)[:, None] ** power
        return super().forward(*bound.args, **bound.kwargs)
