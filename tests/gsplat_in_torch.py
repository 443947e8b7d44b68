"""gsplat's own ``rasterization`` without CUDA: its Python, with torch for its kernels.

Slow: for a few dozen Gaussians in small images, each of which counts as one tile. It follows the
kernels of the installed version, 1.4.0 or 1.5.3: where the projection has opacities, rows below
1/255 are dropped in it and narrow by their opacity; packed rows and keys are in the kernels' order,
and what the packed kernels cannot do (a background, gsplat's issue 764) is refused.
"""

import inspect
from itertools import pairwise

import pytest
import torch

ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4


def install(monkeypatch):
    """Replaces the kernels in gsplat and its rendering module; skips the test where there is no
    gsplat.
    """
    gsplat = pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    from gsplat import rendering
    from gsplat.cuda import _torch_impl

    def spherical_harmonics(degree, dirs, coeffs, masks=None):
        return _torch_impl._spherical_harmonics(degree, dirs, coeffs)

    replaced = {
        "fully_fused_projection": fully_fused_projection,
        "isect_tiles": isect_tiles,
        "isect_offset_encode": _torch_impl._isect_offset_encode,
        "rasterize_to_pixels": rasterize_to_pixels,
        "spherical_harmonics": spherical_harmonics,
    }
    for name, function in replaced.items():
        monkeypatch.setattr(
            function, "__signature__", inspect.signature(getattr(gsplat, name)), raising=False
        )
        for module in (rendering, gsplat):
            monkeypatch.setattr(module, name, function)


def fully_fused_projection(
    means,
    covars,
    quats,
    scales,
    viewmats,
    Ks,
    width,
    height,
    *,
    eps2d,
    near_plane,
    far_plane,
    radius_clip,
    packed,
    sparse_grad,
    calc_compensations,
    camera_model,
    opacities=None,
):
    """Without opacities gsplat 1.4.0's: one radius for both directions, no batches."""
    from gsplat.cuda import _torch_impl

    if covars is None:
        # as the kernel: of any length, and NaN where it is 0
        quats = quats / quats.norm(dim=-1, keepdim=True)
        covars, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
    else:
        # from the upper triangle
        covars = covars[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))
    radii, *values, compensations = _torch_impl._fully_fused_projection(
        means,
        covars,
        viewmats,
        Ks,
        width,
        height,
        eps2d,
        near_plane,
        far_plane,
        calc_compensations,
        camera_model,
    )
    if opacities is None:
        radii = radii.amax(-1) if radii.dim() == 3 else radii  # later torch code has two
        seen = radii > 0
    else:
        shown = opacities[..., None, :] * (1 if compensations is None else compensations)
        narrower = (2 * (shown / ALPHA_MIN).clamp(min=1).log()).sqrt() / 3.33
        radii = (
            torch.ceil(radii * narrower.clamp(max=1)[..., None]).int()
            * (shown >= ALPHA_MIN)[..., None].int()
        )
        seen = (radii > 0).all(-1)
    found = radii, *values, compensations
    if not packed:
        return found
    flat = seen if opacities is None else seen.reshape(-1, *seen.shape[-2:])  # [C, N], or [B, C, N]
    ids = torch.nonzero(flat, as_tuple=True)
    rows = (
        None if x is None else x.reshape(*flat.shape, *x.shape[seen.dim() :])[ids] for x in found
    )
    return *ids, *rows


@torch.no_grad()
def isect_tiles(
    means2d,
    radii,
    depths,
    tile_size,
    tile_width,
    tile_height,
    *,
    packed,
    gaussian_ids,
    segmented=False,
    n_images=0,
    n_cameras=0,
    image_ids=None,
    camera_ids=None,
):
    image_ids = camera_ids if image_ids is None else image_ids
    if image_ids is None:
        image_ids = torch.arange(n_images or n_cameras, device=depths.device).repeat_interleave(
            means2d.shape[-2]
        )
    shown = (radii > 0).reshape(depths.numel(), -1).all(-1)
    bits = (tile_width * tile_height).bit_length()
    keys = (image_ids[shown] << 32 + bits) | depths.flatten()[shown].float().view(
        torch.int32
    ).long()
    keys, order = torch.sort(keys, stable=True)
    return shown.int().reshape(depths.shape), keys, shown.nonzero()[order, 0].int()


def rasterize_to_pixels(
    means2d,
    conics,
    colors,
    opacities,
    width,
    height,
    tile_size,
    isect_offsets,
    flatten_ids,
    *,
    backgrounds,
    packed,
    absgrad,
):
    assert not packed or backgrounds is None
    # the kernel sums the absolute values of all pixels: more than this
    if absgrad and means2d.requires_grad:
        means2d.register_hook(lambda gradient: setattr(means2d, "absgrad", gradient.abs()))
    table = [
        means2d.reshape(-1, 2),
        conics.reshape(-1, 3),
        opacities.flatten(),
        colors.reshape(-1, colors.shape[-1]),
    ]
    images = isect_offsets.shape[:-2]
    bounds = [*isect_offsets[..., 0, 0].flatten().tolist(), len(flatten_ids)]
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in (height, width)), indexing="ij")
    canvases = []
    for begin, end in pairwise(bounds):
        ids = flatten_ids[begin:end].long()
        rows = [values[ids] for values in table]
        canvases.append(_blend(x.to(colors), y.to(colors), *rows))
    canvas = torch.stack(canvases)
    drawn = canvas[..., :-1]
    alphas = canvas[..., -1:]
    if backgrounds is not None:
        drawn = drawn + (1 - alphas) * backgrounds.reshape(len(canvas), 1, 1, -1)
    return drawn.unflatten(0, images), alphas.unflatten(0, images)


def _blend(x, y, centres, conics, opacities, colors):
    """Colours and alpha ``[H, W, D + 1]`` of Gaussians in order of depth."""

    dx = x[..., None] - centres[:, 0]
    dy = y[..., None] - centres[:, 1]
    a, b, c = conics.unbind(-1)
    alpha = (opacities * torch.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))).clamp(
        max=ALPHA_MAX
    )
    alpha = alpha * (alpha >= ALPHA_MIN)
    after = torch.cumprod(1 - alpha, -1)
    weights = (
        alpha
        * torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
        * (after > TRANSMITTANCE_MIN)
    )
    return torch.cat([weights @ colors, weights.sum(-1, keepdim=True)], -1)
