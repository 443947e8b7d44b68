"""gsplat 1.5.3 on a CPU: its own torch code, with plain torch in place of its CUDA-only functions.

Timed by ``rasterize.py``; not part of the library. gsplat's ``rasterization()`` fails without its CUDA
library. Its ``_rasterization()`` does all that is differentiated in torch, but calls four functions of
the CUDA library and two of nerfacc, which has no CPU path either. This file replaces those six calls and nothing else.

Runs as gsplat wrote it:
    ``rendering._rasterization``: the whole frame, from the covariances to the background;
    ``_torch_impl._quat_scale_to_covar_preci``, ``_fully_fused_projection``, ``_rasterize_to_pixels``, ``accumulate``;
    ``_torch_impl._spherical_harmonics`` and ``_isect_offset_encode``, its own torch twins of two of the CUDA functions.

Shimmed here:
    ``isect_tiles``: gsplat's torch twin is a Python loop over Gaussians and their tiles, which would double the
        forward pass. The same lists, vectorised.
    ``rasterize_to_indices_in_range`` (CUDA only): which pixel meets which Gaussian, a loop over batches of tiles.
    ``nerfacc.render_weight_from_alpha`` (a CUDA scan, with its backward) and ``nerfacc.accumulate_along_rays``
        (the ``index_add_`` that nerfacc has).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

VERSION = "1.5.3"
ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4  # of the CUDA kernel
BELOW_MIN = torch.nextafter(torch.tensor(ALPHA_MIN), torch.tensor(0.0)).item()  # an alpha of ALPHA_MIN is drawn
ROOM = 2**21  # pairs of pixel and Gaussian that are looked at in one go


def available() -> str | None:
    """None where gsplat can be timed, else the reason in a line."""
    try:
        import gsplat
    except ImportError as error:
        return f"gsplat cannot be imported ({error}): pip install gsplat=={VERSION}"
    if gsplat.__version__ != VERSION:
        return f"gsplat is {gsplat.__version__}, and the shims fit {VERSION} only: pip install gsplat=={VERSION}"
    return None


def render(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, viewmat: Tensor, K: Tensor,
    width: int, height: int, background: Tensor,
) -> Tensor:  # fmt: skip
    """The image ``[H, W, 3]``, not clamped; ``sh`` is ``[N, K, 3]``."""
    from gsplat import rendering

    with _patched():
        colors, _, _ = rendering._rasterization(
            means, quats, scales, opacities, sh, viewmat[None], K[None], width, height, near_plane=0.01, eps2d=0.3,
            tile_size=16, sh_degree=math.isqrt(sh.shape[1]) - 1, backgrounds=background[None],
        )  # fmt: skip
    return colors[0]


@contextmanager
def _patched() -> Iterator[None]:
    """While it lasts, gsplat finds the shims where it looks for its CUDA functions and for nerfacc."""
    from gsplat import rendering
    from gsplat.cuda import _torch_impl, _wrapper

    def isect_tiles(*args: Any, packed: bool, n_images: int, image_ids: None, gaussian_ids: None) -> Any:
        return _isect_tiles(*args)

    def spherical_harmonics(degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor) -> Tensor:
        return _torch_impl._spherical_harmonics(degree, dirs, coeffs)  # the mask only saves work

    nerfacc = SimpleNamespace(
        render_weight_from_alpha=_render_weight_from_alpha, accumulate_along_rays=_accumulate_along_rays
    )
    shims = [
        (vars(rendering), "isect_tiles", isect_tiles),
        (vars(rendering), "isect_offset_encode", _torch_impl._isect_offset_encode),
        (vars(rendering), "spherical_harmonics", spherical_harmonics),
        (vars(_wrapper), "rasterize_to_indices_in_range", _rasterize_to_indices_in_range),
        (sys.modules, "nerfacc", nerfacc),
    ]
    before = [where.get(name) for where, name, _ in shims]
    for where, name, shim in shims:
        where[name] = shim
    try:
        yield
    finally:
        for (where, name, _), old in zip(shims, before, strict=True):
            if old is None:
                del where[name]
            else:
                where[name] = old


@torch.no_grad()
def _isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Tiles per Gaussian; and sorted, a key of tile and depth and the Gaussian's number for each tile it touches."""
    means2d, radii, depths = means2d[0], radii[0], depths[0]  # one image
    most = torch.tensor([tile_width, tile_height])
    low = torch.floor(means2d / tile_size - radii / tile_size).long().clamp(min=torch.zeros(2).long(), max=most)
    high = torch.ceil(means2d / tile_size + radii / tile_size).long().clamp(min=torch.zeros(2).long(), max=most)
    counts = (high - low).prod(-1) * (radii > 0).all(-1)
    ids = torch.repeat_interleave(counts)
    nth = torch.arange(len(ids)) - (counts.cumsum(0) - counts)[ids]
    across = (high - low)[:, 0][ids]
    tiles = (low[ids, 1] + nth // across) * tile_width + low[ids, 0] + nth % across
    keys, order = torch.sort((tiles << 32) | depths.view(torch.int32).long()[ids])
    return counts.int()[None], keys, ids[order].int()


@torch.no_grad()
def _rasterize_to_indices_in_range(
    start: int, end: int, transmittances: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor,
    width: int, height: int, tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Gaussian, pixel and image of all that is blended: each pixel's in one run, by depth, the pixels tile by tile."""
    (down, across), block = isect_offsets.shape[-2:], tile_size * tile_size  # start and end count so many Gaussians
    # A row of zeros at the end for lists that are padded; no light where a tile reaches past the image.
    table = torch.cat([means2d[0], conics[0] * torch.tensor([0.5, 1.0, 0.5]), opacities[0, :, None]], -1)
    table = F.pad(table, (0, 0, 0, 1))
    light = F.pad(transmittances[0], (0, across * tile_size - width, 0, down * tile_size - height))
    firsts = isect_offsets.flatten().long()
    lasts = torch.minimum(F.pad(firsts[1:], (0, 1), value=len(flatten_ids)), firsts + end * block)
    firsts = firsts + start * block
    lengths, order = torch.sort((lasts - firsts).clamp_(min=0), descending=True)
    sizes, at = lengths.tolist(), 0
    gaussians, pixels = [torch.empty(0, dtype=torch.long)], [torch.empty(0, dtype=torch.long)]
    while at < len(sizes) and sizes[at]:
        nth, to = torch.arange(sizes[at]), at + max(1, ROOM // (block * sizes[at]))  # tiles with lists of like length
        tiles, beyond = order[at:to], nth >= lengths[at:to, None]
        ids = flatten_ids[(firsts[tiles, None] + nth).clamp_(max=len(flatten_ids) - 1)].long()
        ids.masked_fill_(beyond, len(table) - 1)
        rows = (tiles // across * tile_size)[:, None, None] + torch.arange(tile_size)[:, None]  # [tiles, rows, 1]
        columns = (tiles % across * tile_size)[:, None, None] + torch.arange(tile_size)  # [tiles, 1, columns]
        x, y, a, b, c, opacity = table[ids].movedim(-1, 0)[:, :, None, None].contiguous()
        dx, dy = columns[..., None] + 0.5 - x, rows[..., None] + 0.5 - y
        # In place, without masks and denormal numbers, all three slow: what is not drawn gets the sigma 20, alpha 0.
        sigma = (a * dx * dx + c * dy * dy).addcmul_(b * dy, dx)  # [tiles, rows, columns, Gaussians by depth]
        alpha = F.threshold_(sigma, -1e-38, 20.0).clamp_(max=20).neg_().exp_().mul_(opacity).clamp_(max=ALPHA_MAX)
        F.threshold_(alpha, BELOW_MIN, 0.0)
        least = TRANSMITTANCE_MIN / light[rows, columns][..., None]
        kept = (alpha > 0).logical_and_(torch.cumprod(1 - alpha, -1) > least)
        tile, pixel, nth = torch.nonzero(kept.flatten(1, 2), as_tuple=True)
        gaussians.append(ids[tile, nth])
        pixels.append((rows * width + columns).flatten(1)[tile, pixel])
        at = to
    out = torch.cat(gaussians), torch.cat(pixels)
    return *out, torch.zeros(1, dtype=torch.long).expand(len(out[0]))


class _Weights(torch.autograd.Function):
    """Weight and transmittance of each alpha on its ray; in float64, for one running sum serves many rays."""

    @staticmethod
    def forward(ctx: Any, alphas: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        lengths = torch.unique_consecutive(rays, return_counts=True)[1]
        transmittances = torch.empty_like(alphas)
        for counts, alpha, out in _by_rays(lengths, alphas, transmittances):
            logs = alpha.double().neg_().log1p_()
            sums = logs.cumsum(0).sub_(logs)
            before = sums[counts.cumsum(0) - counts]
            out.copy_(sums.sub_(torch.repeat_interleave(before, counts, output_size=len(sums))).exp_())
        weights = transmittances * alphas
        ctx.save_for_backward(alphas, transmittances, weights, lengths)
        ctx.mark_non_differentiable(transmittances)  # gsplat drops it
        return weights, transmittances

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> tuple[Tensor, None]:
        *saved, lengths = ctx.saved_tensors
        result = torch.empty_like(gradient)
        for counts, given, alpha, transmittance, weight, out in _by_rays(lengths, gradient, *saved, result):
            sums = (given * weight).double().cumsum_(0)
            totals = sums[counts.cumsum(0) - 1]
            later = torch.repeat_interleave(totals, counts, output_size=len(sums)).sub_(sums).float()
            torch.addcdiv(given * transmittance, later, 1 - alpha, value=-1, out=out)
        return result, None


def _by_rays(lengths: Tensor, *tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """The tensors in pieces of whole rays, small enough for the cache, each after the lengths of its rays."""
    counts = lengths.split(4096)
    sizes = [int(count.sum()) for count in counts]
    return zip(counts, *(tensor.split(sizes) for tensor in tensors), strict=True)


def _render_weight_from_alpha(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    return _Weights.apply(alphas, ray_indices)


def _accumulate_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
    source = weights[:, None] if values is None else weights[:, None] * values
    return torch.zeros(n_rays, source.shape[-1]).index_add_(0, ray_indices, source)
