"""Tile-based splatting on the CPU, compiled by Numba: forward and backward pass on several threads."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from clod_adapter._kernels import conventions, dial, threads
from clod_adapter._kernels.memory import recycled
from clod_adapter._kernels.project_gradient import project_gradient
from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, ScreenFilter
from clod_adapter.equation.attenuation import check_dial
from clod_adapter.equation.distances import camera_unit
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers.frame import camera_vector, dial_vector, prepare, workers_for
from clod_adapter.rasterizers.protocol import Rasterizer, behind, require_float32


def _arrays(tensors: Any) -> list[np.ndarray]:
    """Contiguous float32 arrays; those of harmonics flat."""
    arrays = [x.detach().contiguous().numpy() for x in tensors]
    return [array.reshape(-1) if array.ndim == 3 else array for array in arrays]


class _Picture(torch.autograd.Function):
    """Of Gaussians as they are stored, at one dial value; of activated ones where ``dialling`` is None.

    Without a dial, ``sigma_d`` is empty, without growth its exponents.
    """

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx: Any, means, quats, scales, opacities, sigma_d, growth_d, sh0, shN, background, camera, screen_filter,
        dialling, trained,
    ):  # fmt: skip
        inputs = (means, quats, scales, opacities, sigma_d, growth_d, sh0, shN)
        ctx.degree = math.isqrt(shN.shape[1] + 1) - 1
        frame = prepare(_arrays(inputs), ctx.degree, camera, screen_filter, dialling)
        image, alpha = frame.blend(background.detach().contiguous().numpy())
        ctx.frame, ctx.dialling, ctx.trained = frame, dialling, trained
        ctx.save_for_backward(*inputs, background, image, alpha)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor):  # type: ignore[no-untyped-def, override]
        *inputs, _background, image, alpha = ctx.saved_tensors
        frame, need = ctx.frame, ctx.needs_input_grad
        # Unused sums are skipped. Above SH degree 0, a mean changes the colour too.
        shaped = any(need[:3]) or need[5]
        colored = any(need[6:8]) or (shaped and ctx.degree > 0)
        pair_sums = frame.blend_gradient(image, alpha, *gradients, shaped, colored)
        wanted = [shaped] * 3 + [True] * 3 + [need[6], need[7]]
        found = [recycled(x.shape if want else (0, *x.shape[1:])) for x, want in zip(inputs, wanted, strict=True)]
        *arrays, _sh0, shN = _arrays(inputs)
        threads.run(
            project_gradient, len(frame.counts), *arrays, shN, ctx.degree, frame.camera, ctx.dialling, frame.records,
            frame.packed_ids, frame.counts, frame.slots, pair_sums, frame.compensated, ctx.trained, *_arrays(found),
        )  # fmt: skip
        slopes = [g if asked else None for g, asked in zip(found, need, strict=False)]
        behind = ((1 - alpha)[..., None] * gradients[0]).sum((0, 1)) if need[8] else None
        return *slopes, behind, None, None, None, None


class _Compiled(Rasterizer):
    """The dial is the first part of the projection, and the last of its gradient: what it culls is not touched again,
    and nothing is copied. Tensors that are not float32 take the composed way."""

    def draw(
        self, gaussians: Gaussians, camera: Camera, virtual_scale: float = 1.0, *,
        background: Tensor | np.ndarray | None = None, seen_from: Camera | None = None, trained: int | None = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        background = behind(gaussians, background)
        if seen_from is not None or not _all_float32(*gaussians.tensors().values(), background):
            return super().draw(gaussians, camera, virtual_scale, background=background, seen_from=seen_from)
        check_dial(virtual_scale)
        g, nothing = gaussians, _nothing()
        sigma_d, growth_d = (nothing if x is None else x for x in (g.sigma_d, g.growth_d))
        return _Picture.apply(  # type: ignore[no-any-return, no-untyped-call]
            g.means, g.quats, g.log_scales, g.opacity_logits, sigma_d, growth_d, g.sh0, g.shN, background, camera,
            g.screen_filter, _dial_vector(g, camera, virtual_scale), len(g) if trained is None else trained,
        )  # fmt: skip

    @torch.no_grad()
    def kept(self, gaussians: Gaussians, camera: Camera, virtual_scale: float) -> Tensor:
        if gaussians.sigma_d is None or not _all_float32(*gaussians.tensors().values()):
            return super().kept(gaussians, camera, virtual_scale)
        found = np.empty(len(gaussians), np.uint8)
        given = _arrays((gaussians.means, gaussians.opacity_logits, gaussians.sigma_d))
        settings = camera_vector(camera, gaussians.screen_filter), _dial_vector(gaussians, camera, virtual_scale)
        threads.run(dial.mark_kept, workers_for(len(found)), *given, *settings, found)
        return torch.from_numpy(found).view(torch.bool)


def _all_float32(*tensors: Tensor) -> bool:
    return all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)


def _nothing() -> Tensor:
    return torch.empty(0, dtype=torch.float32, device="cpu")


def _dial_vector(gaussians: Gaussians, camera: Camera, virtual_scale: float) -> np.ndarray:
    config = gaussians.attenuation
    if config is None:
        return np.zeros(conventions.DIAL, np.float32)
    return dial_vector(config, virtual_scale, camera_unit(gaussians.means, camera, config))


def rasterize(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh0: Tensor, shN: Tensor, camera: Camera,
    background: Tensor, screen_filter: ScreenFilter = CLASSIC,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """See ``clod_adapter.rasterizers.Splat``.

    Raises:
        ClodError: a tensor is not float32.
    """
    require_float32(
        "CPU", means=means, quats=quats, scales=scales, opacities=opacities, sh0=sh0, shN=shN, background=background
    )
    return _Picture.apply(  # type: ignore[no-any-return, no-untyped-call]
        means, quats, scales, opacities, _nothing(), _nothing(), sh0, shN, background, camera, screen_filter, None,
        len(means),
    )  # fmt: skip


RASTERIZER = _Compiled(rasterize)
