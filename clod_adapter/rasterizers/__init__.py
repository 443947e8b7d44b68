"""Rasterizers behind one protocol. They take final opacities; ``sigma_d`` is applied before."""

from __future__ import annotations

import torch

from clod_adapter.errors import ClodError
from clod_adapter.rasterizers.protocol import ALPHA_MAX, Rasterizer, wait_for

__all__ = ["ALPHA_MAX", "Rasterizer", "for_device", "wait_for"]


def for_device(device: torch.device) -> Rasterizer:
    """The fastest rasterizer for tensors on ``device``, imported on first use.

    Raises:
        ClodError: there is none for that kind of device, or gsplat is not installed or does not work.
    """
    if device.type == "cpu":
        from clod_adapter.rasterizers import cpu

        return cpu.rasterize
    if device.type == "cuda":
        from clod_adapter.rasterizers import cuda

        cuda.require_gsplat()
        return cuda.rasterize
    raise ClodError(f"no rasterizer for device {device}: move the Gaussians to the CPU with .to('cpu')")
