"""The interface of every rasterizer, by which a dial value becomes a picture, and their common
checks.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from clod_adapter._kernels import ALPHA_MAX, ALPHA_MIN, QUAT_MAX, QUAT_MIN, T_MIN
from clod_adapter.cameras import Camera, numbers_of
from clod_adapter.config import CLASSIC, ScreenFilter
from clod_adapter.equation.attenuation import dial
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "T_MIN",
    "Rasterizer",
    "Splat",
    "drawable",
    "require_float32",
    "wait_for",
]


class Splat(Protocol):
    """Splats activated Gaussians into one camera, on ``background [3]``, differentiably in every
    tensor argument.

    ``means [N, 3]`` and the standard deviations ``scales [N, 3]`` are in world units,
    ``quats [N, 4]`` wxyz of any length from QUAT_MIN to QUAT_MAX, ``sh0 [N, 1, 3]``,
    ``shN [N, K-1, 3]``. Rows whose ``opacities [N]``, compensated by the ``screen_filter``, are
    below 1/255 are skipped. Returns the image ``[H, W, 3]``, not clamped, and the accumulated alpha
    ``[H, W]``.
    """

    def __call__(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh0: Tensor,
        shN: Tensor,
        camera: Camera,
        background: Tensor,
        screen_filter: ScreenFilter = CLASSIC,
    ) -> tuple[Tensor, Tensor]: ...


@dataclass(frozen=True)
class Rasterizer:
    """Renderer of Gaussians at a dial value. Whatever renders, trains or measures pictures calls
    ``draw``.

    The dial is composed with ``splat``. A subclass may have kernels with the dial in them, which
    give the same to rounding.
    """

    splat: Splat

    def draw(
        self,
        gaussians: Gaussians,
        camera: Camera,
        virtual_scale: float = 1.0,
        *,
        background: Tensor | np.ndarray | None = None,
        seen_from: Camera | None = None,
        trained: int | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Image ``[H, W, 3]`` and alpha ``[H, W]`` at one dial value, on black by default;
        differentiable throughout.

        ``seen_from`` is the camera of the dial's distances, where it is another. The first
        ``trained`` rows alone need gradients.
        """
        drawn, _, growth = dial(gaussians, seen_from or camera, virtual_scale)
        return self.draw_opacities(gaussians, drawn, growth, camera, background)

    def draw_opacities(
        self,
        gaussians: Gaussians,
        opacities: Tensor,
        growth: Tensor,
        camera: Camera,
        background: Tensor | np.ndarray | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The picture of activated ``opacities [N]`` and scales times ``growth [N]``."""
        return self.splat(
            gaussians.means,
            gaussians.quats,
            gaussians.scales * growth[:, None],
            opacities,
            gaussians.sh0,
            gaussians.shN,
            camera,
            behind(gaussians, background),
            gaussians.screen_filter,
        )

    def kept(self, gaussians: Gaussians, camera: Camera, virtual_scale: float) -> Tensor:
        """``[N]`` bool, the Gaussians that ``draw`` does not cull at this dial value, in the image
        or not.
        """
        return dial(gaussians, camera, virtual_scale).keep


def behind(gaussians: Gaussians, background: Tensor | np.ndarray | None = None) -> Tensor:
    """The background ``[3]`` as a tensor; black where None is given."""
    if background is None:
        return torch.zeros(3, dtype=torch.float32, device=gaussians.means.device)
    color = numbers_of("background", background)
    if color.shape != (3,):  # a kernel would read past its end
        raise ClodError(f"background is {tuple(color.shape)} and must be (3,)")
    return color


def drawable(quats: Tensor, opacities: Tensor) -> Tensor:
    """``[N]`` bool, the rows that are not too faint, and whose rotation has a usable length."""
    length = quats.detach().norm(dim=1)
    return (opacities.detach() >= ALPHA_MIN) & (length >= QUAT_MIN) & (length <= QUAT_MAX)


def require_float32(backend: str, **tensors: Tensor) -> None:
    """Raises ClodError, with the tensor's name, unless all tensors are float32."""
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32:
            raise ClodError(
                f"the {backend} rasterizer takes float32 only, and {name} is {tensor.dtype}: use"
                " .float()"
            )


def wait_for(device: torch.device) -> None:
    """Waits until the device has finished, for timing; nothing to wait for on the CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
