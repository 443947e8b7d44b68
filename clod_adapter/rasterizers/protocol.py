"""The interface of every rasterizer, and their common checks."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from clod_adapter._kernels import ALPHA_MAX, ALPHA_MIN, QUAT_MAX, QUAT_MIN, T_MIN
from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, ScreenFilter
from clod_adapter.errors import ClodError

__all__ = ["ALPHA_MAX", "ALPHA_MIN", "T_MIN", "Rasterizer", "drawable", "require_float32", "wait_for"]


class Rasterizer(Protocol):
    """Splats activated Gaussians into one camera.

    Args:
        means: ``[N, 3]`` world units.
        quats: ``[N, 4]`` wxyz, any length from QUAT_MIN to QUAT_MAX.
        scales: ``[N, 3]`` standard deviations, world units.
        opacities: ``[N]`` in [0, 1]; rows below 1/255 are skipped before any other work.
        sh0: ``[N, 1, 3]``; shN: ``[N, K-1, 3]``.
        camera: the viewpoint; gets no gradient.
        background: ``[3]``.
        screen_filter: variance added to the projected covariances, and whether opacities are compensated for it; rows
            whose compensated opacity is below 1/255 are skipped.

    Returns:
        The image ``[H, W, 3]``, not clamped, and the accumulated alpha ``[H, W]``; both
        differentiable in every tensor argument.
    """

    def __call__(
        self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh0: Tensor, shN: Tensor,
        camera: Camera, background: Tensor, screen_filter: ScreenFilter = CLASSIC,
    ) -> tuple[Tensor, Tensor]: ...  # fmt: skip


def drawable(quats: Tensor, opacities: Tensor) -> Tensor:
    """``[N]`` bool, the rows that are not too faint, and whose rotation has a usable length."""
    length = quats.detach().norm(dim=1)
    return (opacities.detach() >= ALPHA_MIN) & (length >= QUAT_MIN) & (length <= QUAT_MAX)


def require_float32(backend: str, **tensors: Tensor) -> None:
    """Raises ClodError, with the tensor's name, unless all tensors are float32."""
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32:
            raise ClodError(f"the {backend} rasterizer takes float32 only, and {name} is {tensor.dtype}: use .float()")


def wait_for(device: torch.device) -> None:
    """Waits until the device has finished, for timing; nothing to wait for on the CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
