"""Tile-based splatting on the CPU, compiled by Numba: forward and backward pass on several threads."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from clod_adapter._kernels import conventions, dial, dial_gradient, project, project_gradient, threads
from clod_adapter._kernels.memory import recycled
from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, ScreenFilter
from clod_adapter.equation.attenuation import check_dial
from clod_adapter.equation.distances import camera_unit
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers.frame import Frame, camera_vector, dial_vector, give, prepare, workers_for
from clod_adapter.rasterizers.protocol import Rasterizer, behind, require_float32


def _arrays(tensors: Any) -> list[np.ndarray]:
    """Contiguous float32 arrays; those of harmonics flat."""
    arrays = [x.detach().contiguous().numpy() for x in tensors]
    return [array.reshape(-1) if array.ndim == 3 else array for array in arrays]


def _gradients(kernel: Any, frame: Frame, inputs: list[Tensor], wanted: list[bool], *given: Any) -> list[Tensor]:
    """Runs the gradient of a projection; the gradients of its inputs, empty for those that are not wanted."""
    found = [recycled(x.shape if want else (0, *x.shape[1:])) for x, want in zip(inputs, wanted, strict=True)]
    threads.run(kernel, len(frame.counts), *given, *_arrays(found))
    return found


class _Splat(torch.autograd.Function):
    """Of activated opacities and scales."""

    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, sh0, shN, background, camera, screen_filter, degree):  # type: ignore[no-untyped-def]
        arrays = _arrays((means, quats, scales, opacities, sh0, shN))
        frame = prepare(project.project, arrays, degree, camera, screen_filter)
        image, alpha = frame.blend(background.detach().contiguous().numpy())
        ctx.frame, ctx.degree = frame, degree
        ctx.save_for_backward(means, quats, scales, opacities, sh0, shN, background, image, alpha)
        weakref.finalize(frame, give, frame.buffers)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor):  # type: ignore[no-untyped-def, override]
        *inputs, _background, image, alpha = ctx.saved_tensors
        frame, need = ctx.frame, ctx.needs_input_grad
        # Unused sums are skipped. Above SH degree 0, a mean changes the colour too.
        shaped = any(need[:3])
        colored = any(need[4:6]) or (shaped and ctx.degree > 0)
        pair_sums = frame.blend_gradient(image, alpha, *gradients, shaped, colored)
        *arrays, _sh0, shN = _arrays(inputs)
        found = _gradients(
            project_gradient.project_gradient, frame, inputs, [shaped] * 3 + [True, need[4], need[5]], *arrays, shN,
            ctx.degree, frame.camera, frame.records, frame.packed_ids, frame.counts, frame.slots, pair_sums,
            frame.compensated,
        )  # fmt: skip
        wanted = [g if asked else None for g, asked in zip(found, need, strict=False)]
        return *wanted, _of_background(need[6], alpha, gradients[0]), None, None, None


class _Drawn(torch.autograd.Function):
    """Of Gaussians as they are stored, at one dial value. Without a dial, ``sigma_d`` is empty, without growth its."""

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx: Any, means, quats, log_scales, logits, sigma_d, growth_d, sh0, shN, background, camera, screen_filter,
        degree, dialling, trained,
    ):  # fmt: skip
        inputs = (means, quats, log_scales, logits, sigma_d, growth_d, sh0, shN)
        frame = prepare(dial.project_dialled, _arrays(inputs), degree, camera, screen_filter, dialling)
        image, alpha = frame.blend(background.detach().contiguous().numpy())
        ctx.frame, ctx.degree, ctx.dialling, ctx.trained = frame, degree, dialling, trained
        ctx.save_for_backward(*inputs, background, image, alpha)
        weakref.finalize(frame, give, frame.buffers)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor):  # type: ignore[no-untyped-def, override]
        *inputs, _background, image, alpha = ctx.saved_tensors
        frame, need = ctx.frame, ctx.needs_input_grad
        shaped = any(need[:3]) or need[5]
        colored = any(need[6:8]) or (shaped and ctx.degree > 0)
        pair_sums = frame.blend_gradient(image, alpha, *gradients, shaped, colored)
        *arrays, _sh0, shN = _arrays(inputs)
        found = _gradients(
            dial_gradient.project_dialled_gradient, frame, inputs, [shaped] * 3 + [True] * 3 + [need[6], need[7]],
            *arrays, shN, ctx.degree, frame.camera, ctx.dialling, frame.records, frame.packed_ids, frame.counts,
            frame.slots, pair_sums, frame.compensated, ctx.trained,
        )  # fmt: skip
        wanted = [g if asked else None for g, asked in zip(found, need, strict=False)]
        return *wanted, _of_background(need[8], alpha, gradients[0]), None, None, None, None, None


def _of_background(needed: bool, alpha: Tensor, v_image: Tensor) -> Tensor | None:
    return ((1 - alpha)[..., None] * v_image).sum((0, 1)) if needed else None


class _Compiled(Rasterizer):
    """The dial is the first part of the projection, and the last of its gradient: what it culls is not touched again,
    and nothing is copied. Tensors that are not float32 take the composed way."""

    def draw(
        self, gaussians: Gaussians, camera: Camera, virtual_scale: float = 1.0, *,
        background: Tensor | np.ndarray | None = None, seen_from: Camera | None = None, trained: int | None = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        black = behind(gaussians, background)
        if seen_from is not None or not _all_float32(*gaussians.tensors().values(), black):
            return super().draw(gaussians, camera, virtual_scale, background=black, seen_from=seen_from)
        check_dial(virtual_scale)
        return _Drawn.apply(  # type: ignore[no-any-return, no-untyped-call]
            *_stored(gaussians), black, camera, gaussians.screen_filter, gaussians.sh_degree,
            _dial_vector(gaussians, camera, virtual_scale), len(gaussians) if trained is None else trained,
        )  # fmt: skip

    @torch.no_grad()
    def kept(self, gaussians: Gaussians, camera: Camera, virtual_scale: float) -> Tensor:
        if gaussians.sigma_d is None or not _all_float32(*gaussians.tensors().values()):
            return super().kept(gaussians, camera, virtual_scale)
        found = np.empty(len(gaussians), np.uint8)
        means, _, _, logits, sigma_d, *_ = _arrays(_stored(gaussians))
        given = camera_vector(camera, gaussians.screen_filter), _dial_vector(gaussians, camera, virtual_scale)
        threads.run(dial.mark_kept, workers_for(len(found)), means, logits, sigma_d, *given, found)
        return torch.from_numpy(found).view(torch.bool)


def _all_float32(*tensors: Tensor) -> bool:
    return all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)


def _stored(g: Gaussians) -> tuple[Tensor, ...]:
    """What the kernels of the dial read, in their order."""
    nothing = torch.empty(0, dtype=torch.float32, device="cpu")
    sigma_d, growth_d = (nothing if x is None else x for x in (g.sigma_d, g.growth_d))
    return g.means, g.quats, g.log_scales, g.opacity_logits, sigma_d, growth_d, g.sh0, g.shN


def _prepare_dialled(g: Gaussians, camera: Camera, virtual_scale: float) -> Frame:
    dialling = _dial_vector(g, camera, virtual_scale)
    return prepare(dial.project_dialled, _arrays(_stored(g)), g.sh_degree, camera, g.screen_filter, dialling)


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
    degree = round((shN.shape[1] + 1) ** 0.5) - 1
    return _Splat.apply(  # type: ignore[no-any-return, no-untyped-call]
        means, quats, scales, opacities, sh0, shN, background, camera, screen_filter, degree
    )


RASTERIZER = _Compiled(rasterize)
