"""Rasterizers behind one protocol, by which a dial value becomes a picture."""

from collections.abc import Callable

import torch

from clod_adapter.errors import ClodError
from clod_adapter.rasterizers.protocol import ALPHA_MAX, Rasterizer, Splat, wait_for

__all__ = ["ALPHA_MAX", "BACKENDS", "Rasterizer", "Splat", "for_device", "wait_for"]


def _cpu() -> Rasterizer:
    from clod_adapter.rasterizers import cpu

    return cpu.RASTERIZER


def _cuda() -> Rasterizer:
    from clod_adapter.rasterizers import cuda

    if reason := cuda.unusable():
        raise ClodError(f"no rasterizer for the GPU: {reason}; or use the CPU (--device cpu)")
    return Rasterizer(cuda.rasterize)


BACKENDS: dict[str, Callable[[], Rasterizer]] = {"cpu": _cpu, "cuda": _cuda}
"""By the type of a device, a function that returns its rasterizer; another backend is another
entry.
"""


def for_device(device: torch.device) -> Rasterizer:
    """The rasterizer for tensors on ``device``, imported on first use; ClodError where there is
    none that works.
    """
    if device.type not in BACKENDS:
        raise ClodError(
            f"no rasterizer for device {device}: move the Gaussians to the CPU with .to('cpu')"
        )
    return BACKENDS[device.type]()
