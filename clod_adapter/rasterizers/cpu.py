"""Tile-based splatting on the CPU, compiled by Numba: forward and backward pass on several threads."""

from __future__ import annotations

import math
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from clod_adapter._kernels import blend, blocks, conventions, dial, project, project_gradient, threads, tiles
from clod_adapter._kernels.memory import aligned, recycled, release
from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, ScreenFilter
from clod_adapter.equation.attenuation import culling_threshold, log_threshold
from clod_adapter.equation.distances import camera_unit
from clod_adapter.equation.growth import growth_distance
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers.protocol import require_float32

FEW = 4096  # rows that one thread projects or lists in about a tenth of a millisecond


class _Buffers:
    """Scratch arrays kept between calls: page faults of a new large array cost more than the work on it."""

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}

    def get(self, name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        size = math.prod(shape)
        flat = self._arrays.get(name)
        if flat is None or flat.size < size:
            flat = self._arrays[name] = aligned(size + size // 4, dtype)
        return flat[:size].reshape(shape)


_idle: list[_Buffers] = []


def _take() -> _Buffers:
    try:
        return _idle.pop()
    except IndexError:
        return _Buffers()


def _give(buffers: _Buffers) -> None:
    # No lock: this runs as a finalizer, perhaps within _take of the same thread. List operations are atomic.
    if len(_idle) < 4:
        _idle.append(buffers)


def release_memory() -> None:
    """Frees the scratch memory of earlier renders."""
    _idle.clear()
    release()


@dataclass
class _Frame:
    """State of the forward pass for the backward pass. The arrays are views of pooled buffers."""

    buffers: _Buffers
    camera: np.ndarray
    width: int
    height: int
    across: int
    records: np.ndarray
    packed_ids: np.ndarray
    counts: np.ndarray
    slots: np.ndarray
    entries: np.ndarray
    entry_slots: np.ndarray
    masks: np.ndarray
    offsets: np.ndarray
    tiles: np.ndarray
    compensated: bool | None
    workers: int

    def room(self, size: int) -> np.ndarray:
        """Scratch floats for each worker."""
        return self.buffers.get("room", (self.workers, size), np.float32)


def camera_vector(camera: Camera, screen_filter: ScreenFilter = CLASSIC) -> np.ndarray:
    """Camera and screen-space filter in the layout of the kernels (``_kernels/conventions.py``)."""
    out = np.empty(conventions.CAMERA, np.float32)
    viewmat, K = (x.detach().cpu().double().numpy() for x in (camera.viewmat, camera.K))
    fx, fy, cx, cy = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    out[:16] = viewmat.reshape(-1)
    out[16:22] = fx, fy, cx, cy, camera.width, camera.height
    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    out[22:24] = -(cx / fx + margin_x), (camera.width - cx) / fx + margin_x
    out[24:26] = -(cy / fy + margin_y), (camera.height - cy) / fy + margin_y
    out[26:29] = -viewmat[:3, 3] @ viewmat[:3, :3]
    out[conventions.NEAR] = camera.near
    out[conventions.BLUR], out[conventions.COMPENSATE] = screen_filter.variance, screen_filter.compensate
    return out


def _workers_for(rows: int) -> int:
    """One for few rows, whose work takes less time than waking another thread."""
    return threads.worker_count() if rows >= FEW else 1


def _sorted(
    buffers: _Buffers, kernel: Any, n: int, inputs: tuple[Any, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Runs a projection. Packed records of the visible of n Gaussians, their row numbers, the count of each worker, and
    the depth order."""
    workers = _workers_for(n)
    records = buffers.get("records", ((n + workers) * conventions.RECORD,), np.float32)
    depths, packed_ids = buffers.get("depths", (n,), np.float32), buffers.get("packed_ids", (n,), np.int32)
    counts = np.zeros(workers, np.int64)
    threads.run(kernel, workers, *inputs, records, depths, packed_ids, counts)
    visible = int(counts.sum())
    keys, order = buffers.get("keys", (visible,), np.uint32), buffers.get("order", (visible,), np.int32)
    other = buffers.get("keys2", (visible,), np.uint32), buffers.get("order2", (visible,), np.int32)
    return records, packed_ids, counts, tiles.depth_order(depths.view(np.uint32), counts, keys, order, *other)


def _prepare(
    kernel: Any, arrays: list[np.ndarray], degree: int, camera: Camera, screen_filter: ScreenFilter, *more: np.ndarray
) -> _Frame:
    """Projection, depth order and tile lists. The kernel takes ``arrays``, the SH degree, the camera and ``more``."""
    buffers, cam, n = _take(), camera_vector(camera, screen_filter), len(arrays[0])
    records, packed_ids, counts, order = _sorted(buffers, kernel, n, (*arrays, degree, cam, *more))
    across, down = -(-camera.width // conventions.TILE), -(-camera.height // conventions.TILE)
    listing = _workers_for(len(order))
    histogram, totals = np.empty((listing, across * down), np.int64), np.empty(listing, np.int64)
    offsets, slots = np.empty(across * down + 1, np.int64), buffers.get("slots", (2 * n,), np.int64)
    threads.run(tiles.count_tiles, listing, records, order, across, histogram, totals)
    total = tiles.tile_offsets(histogram, offsets, totals)
    entries, entry_slots = buffers.get("entries", (total,), np.int32), buffers.get("entry_slots", (total,), np.int32)
    threads.run(tiles.fill_tiles, listing, records, order, across, histogram, totals, slots, entries, entry_slots)
    # Longest lists first: no thread starts a long tile when the others are done.
    longest_first = np.argsort(-np.diff(offsets), kind="stable")
    return _Frame(
        buffers, cam, camera.width, camera.height, across, records, packed_ids, counts, slots, entries,
        entry_slots, buffers.get("masks", (total * blocks.WORDS,), np.uint64), offsets, longest_first,
        screen_filter.compensate or None, threads.worker_count(),
    )  # fmt: skip


def _blend(frame: _Frame, background: np.ndarray) -> tuple[Tensor, Tensor]:
    """The image and its alpha."""
    image, alpha = recycled((frame.height, frame.width, 3)), recycled((frame.height, frame.width))
    threads.run(
        blend.blend, frame.workers, frame.records, frame.entries, frame.offsets, frame.across, frame.width,
        frame.height, background, frame.tiles, np.zeros(1, np.int64), frame.room(blocks.FORWARD_STATE), frame.masks,
        image.numpy(), alpha.numpy(),
    )  # fmt: skip
    return image, alpha


def _arrays(tensors: Any) -> list[np.ndarray]:
    """Contiguous float32 arrays of means, quats, scales, opacities, sh0 and shN; the SH flat."""
    arrays = [x.detach().contiguous().numpy() for x in tensors]
    return [*arrays[:4], arrays[4].reshape(-1), arrays[5].reshape(-1)]


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, sh0, shN, background, camera, screen_filter, degree):  # type: ignore[no-untyped-def]
        arrays = _arrays((means, quats, scales, opacities, sh0, shN))
        frame = _prepare(project.project, arrays, degree, camera, screen_filter)
        image, alpha = _blend(frame, background.detach().contiguous().numpy())
        ctx.frame, ctx.degree = frame, degree
        ctx.save_for_backward(means, quats, scales, opacities, sh0, shN, background, image, alpha)
        weakref.finalize(frame, _give, frame.buffers)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor):  # type: ignore[no-untyped-def, override]
        *inputs, background, image, alpha = ctx.saved_tensors
        frame: _Frame = ctx.frame
        v_image, v_alpha = (g.contiguous().numpy() for g in gradients)
        *arrays, _sh0, shN = _arrays(inputs)
        # Unused sums are skipped. Above SH degree 0, a mean changes the colour too.
        shaped = any(ctx.needs_input_grad[:3])
        colored = any(ctx.needs_input_grad[4:6]) or (shaped and ctx.degree > 0)
        # Reads of the last pair are sixteen floats wide too.
        pair_sums = frame.buffers.get("pair_sums", (len(frame.entries) * conventions.PAIR + 16,), np.float32)
        threads.run(
            blend.blend_gradient, frame.workers, frame.records, frame.entries, frame.entry_slots, frame.offsets,
            frame.across, frame.width, frame.height, image.numpy(), alpha.numpy(), v_image, v_alpha, frame.tiles,
            np.zeros(1, np.int64), frame.room(blocks.BACKWARD_STATE), frame.masks, shaped, colored, pair_sums,
        )  # fmt: skip
        wanted = [shaped] * 3 + [True, ctx.needs_input_grad[4], ctx.needs_input_grad[5]]
        grads = [recycled(x.shape if want else (0, *x.shape[1:])) for x, want in zip(inputs, wanted, strict=True)]
        threads.run(
            project_gradient.project_gradient, len(frame.counts), *arrays, shN, ctx.degree, frame.camera, frame.records,
            frame.packed_ids, frame.counts, frame.slots, pair_sums, frame.compensated, *_arrays(grads),
        )  # fmt: skip
        v_background = ((1 - alpha)[..., None] * gradients[0]).sum((0, 1)) if ctx.needs_input_grad[6] else None
        wanted = [g if need else None for g, need in zip(grads, ctx.needs_input_grad, strict=False)]
        return *wanted, v_background, None, None, None


@torch.no_grad()
def draw(gaussians: Gaussians, camera: Camera, virtual_scale: float, background: Tensor) -> tuple[Tensor, Tensor]:
    """Image and alpha at one dial value, as ``attenuate`` and ``rasterize`` give them, without gradients.

    The dial is the first part of the projection: what it culls is not touched again, and nothing is copied. All tensors
    are float32.
    """
    frame = _prepare_dialled(gaussians, camera, virtual_scale)
    found = _blend(frame, background.detach().contiguous().numpy())
    _give(frame.buffers)
    return found


def _prepare_dialled(gaussians: Gaussians, camera: Camera, virtual_scale: float) -> _Frame:
    """``_prepare`` of Gaussians as they are stored, at one dial value."""
    g, nothing = gaussians, torch.empty(0)
    learned = (nothing if x is None else x for x in (g.sigma_d, g.growth_d))
    stored = (g.means, g.quats, g.log_scales, g.opacity_logits, *learned)
    arrays = [x.detach().contiguous().numpy() for x in stored]
    arrays += [x.detach().contiguous().numpy().reshape(-1) for x in (g.sh0, g.shN)]
    dial_vector = _dial_vector(g, camera, virtual_scale)
    return _prepare(dial.project_dialled, arrays, g.sh_degree, camera, g.screen_filter, dial_vector)


@torch.no_grad()
def work(gaussians: Gaussians, camera: Camera, virtual_scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """``[N]`` float32, what drawing each Gaussian takes: the tiles that list it, and the 4x4 blocks that blend it.

    A block whose pixels are all opaque already blends no more, so work depends on what is in front.
    """
    frame = _prepare_dialled(gaussians, camera, virtual_scale)
    _blend(frame, np.zeros(3, np.float32))
    n, counted = len(gaussians), np.zeros((2, len(gaussians)), np.float32)
    tiles.tally(frame.entries, frame.masks, blocks.WORDS, *counted)
    found = np.zeros_like(counted)
    for worker, count in enumerate(frame.counts.tolist()):
        first = n * worker // len(frame.counts)
        packed = slice(first, first + count)
        found[:, frame.packed_ids[packed]] = counted[:, packed]
    _give(frame.buffers)
    return torch.from_numpy(found[0]), torch.from_numpy(found[1])


def _dial_vector(gaussians: Gaussians, camera: Camera, virtual_scale: float) -> np.ndarray:
    """The dial in the layout of the kernels."""
    out, config = np.zeros(conventions.DIAL, np.float32), gaussians.attenuation
    if config is not None:
        rate = virtual_scale / camera_unit(gaussians.means, camera, config)
        out[conventions.RATE], out[conventions.GROWTH_RATE] = rate, rate / growth_distance(config)
        out[conventions.HALF_EPS], out[conventions.SOFT] = config.eps / 2, config.cut == "soft"
        out[conventions.THRESHOLD] = culling_threshold(config.tau, virtual_scale)
        out[conventions.LOG_THRESHOLD] = log_threshold(config.tau, virtual_scale)
    return out


def rasterize(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh0: Tensor, shN: Tensor, camera: Camera,
    background: Tensor, screen_filter: ScreenFilter = CLASSIC,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """See ``clod_adapter.rasterizers.Rasterizer``.

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
