"""Inria's rasterizer with a dial, diff-gaussian-rasterization in whichever fork is installed.

from clod_adapter.integrations.inria import GaussianRasterizationSettings, GaussianRasterizer
color, radii, *others = GaussianRasterizer(raster_settings)(
    means3D=means, means2D=points, opacities=opacities, shs=shs, scales=scales, rotations=rotations,
    sigma_d=model.sigma_d, attenuation=model.attenuation, virtual_scale=3,
)

Forks differ in their settings, in further arguments and in what they return; this class is the installed one's own and
passes all of it on. Who is left out is handed over with opacity 0 and just behind the camera's centre, where a fork
culls it first of all, whether by depth (0.2, or nearer where someone has changed that) or, as for panoramas, by
distance: it costs what a Gaussian out of sight costs, which opacity 0 alone would not save. All rows stay in their
places: radii are 0 there, and the gradients of every input keep their shapes.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from clod_adapter.cameras import NEAR
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.hook import Hook

try:
    import diff_gaussian_rasterization as installed
    from diff_gaussian_rasterization import GaussianRasterizationSettings
except ImportError as error:
    raise ImportError(
        "diff_gaussian_rasterization cannot be imported; it needs torch and CUDA: "
        "pip install --no-build-isolation git+https://github.com/graphdeco-inria/diff-gaussian-rasterization"
    ) from error

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


class GaussianRasterizer(installed.GaussianRasterizer):  # type: ignore[misc]
    """The installed ``GaussianRasterizer``, whose call takes the dial as well."""

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        *args: Any,
        sigma_d: Tensor | None = None,
        virtual_scale: float = 1.0,
        attenuation: AttenuationConfig | None = None,
        **kwargs: Any,
    ) -> Any:
        """What the installed fork returns for the Gaussians that one dial value keeps, faded as the camera sees them.

        Equals the fork called with ``attenuation.attenuate``'s opacities and only the rows that are kept, with those
        that are not as rows of radius 0. Differentiable in ``sigma_d``; the distances are constants. A file's
        ``Gaussians.screen_filter`` is to be given in the settings of forks that have it (``antialiasing``,
        Mip-Splatting's ``kernel_size``).

        Args:
            means3D, means2D, opacities, args, kwargs: the fork's own, by position or by name.
            sigma_d: ``[N]``; without it this is the fork's function.
            virtual_scale: the dial s >= 1.
            attenuation: how ``sigma_d`` is to be read, the file's (``Gaussians.attenuation``); by default
                ``AttenuationConfig()``, whose distances are in world units.

        Raises:
            ClodError: the dial is below 1, the shapes do not fit, or the settings say ``prefiltered``, with which
                the rasterizer stops at the first Gaussian out of sight.
        """
        if sigma_d is None:
            return super().forward(means3D, means2D, opacities, *args, **kwargs)
        settings = self.raster_settings
        if settings.prefiltered:
            raise ClodError("raster_settings.prefiltered is True, and who the dial leaves out is not; set it to False")
        hook = Hook(sigma_d, attenuation or AttenuationConfig(), virtual_scale)
        viewmat = settings.viewmatrix.T  # Inria's matrices multiply from the right
        drawn, keep = hook(
            means3D, opacities, viewmat, _intrinsics(settings), settings.image_width, settings.image_height
        )
        hidden = settings.campos - NEAR * settings.viewmatrix[:3, 2]  # against the way the camera looks
        means3D = torch.where(keep[:, None], means3D, hidden.to(means3D))
        return super().forward(means3D, means2D, drawn, *args, **kwargs)


def _intrinsics(settings: Any) -> Tensor:
    """``[3, 3]`` in pixels; the principal point is the image's middle."""
    width, height = settings.image_width, settings.image_height
    fx, fy = width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)
    return torch.tensor([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
