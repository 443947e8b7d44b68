"""Splatting on an NVIDIA GPU by the kernels of gsplat 1.4.0 to 1.6.0, restricted to the rows that
are drawn.

gsplat's projection tests the opacity last, and packed mode does all other work on a row twice. So
rows below 1/255, such as culled ones, are removed first, and harmonics are gathered only of rows
that the projection finds in the image. Gradients of removed rows are 0. gsplat sums over pixels in
no fixed order, so results repeat except for rounding. It leaves out the Gaussian that ends a pixel,
which the CPU's kernels draw (``_kernels/blend.py``).
"""

import contextlib
import inspect
import math
import re
import sys
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, ScreenFilter
from clod_adapter.rasterizers.protocol import drawable, require_float32

TILE = 16
OLDEST = (1, 4, 0)
INSTALL = "pip install gsplat==1.5.3"


@lru_cache(maxsize=1)
def unusable() -> str | None:
    """The reason why gsplat cannot render on a GPU here, with the command that fixes it; None if it
    can.

    The first call on a machine may compile gsplat's kernels, which takes minutes; gsplat prints a
    message.
    """
    try:
        # its messages would mix with results on stdout
        with contextlib.redirect_stdout(sys.stderr):
            import gsplat

            numbers = re.findall(r"\d+", gsplat.__version__)
            if tuple(map(int, numbers[:3])) < OLDEST:
                return (
                    f"gsplat {gsplat.__version__} is too old, its functions take other arguments:"
                    f" {INSTALL}"
                )
            from gsplat.cuda import _backend
    # a failed compilation is a RuntimeError, a missing library an OSError or ImportError
    except Exception as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return f"gsplat cannot be imported ({lines[0]}): {INSTALL}"
    if _backend._C is None:
        return (
            f"gsplat {gsplat.__version__} has no CUDA kernels, and there is no CUDA toolkit to"
            f" compile them with: install nvcc of CUDA {torch.version.cuda},"
            " https://developer.nvidia.com/cuda-toolkit-archive"
        )
    return None


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    camera: Camera,
    background: Tensor,
    screen_filter: ScreenFilter = CLASSIC,
) -> tuple[Tensor, Tensor]:
    """See ``clod_adapter.rasterizers.Splat``; of float32 tensors alone."""
    geometry = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    tensors = geometry | {"sh0": sh0, "shN": shN}
    inputs = tensors | {"background": background}
    on_gpu = {name: tensor for name, tensor in inputs.items() if tensor.is_cuda}
    require_float32("CUDA", **on_gpu)
    rows = drawable(quats, opacities).nonzero()[:, 0]
    geometry = {name: _Rows.apply(rows, x) for name, x in geometry.items()}
    projected = _project(geometry, sh0, shN, rows, camera, screen_filter) if len(rows) else None
    if projected is None or len(projected["means2d"]) == 0:
        # Nothing to draw; the gradients are 0.
        nothing = sum(_Rows.apply(rows[:0], x).sum() for x in tensors.values())
        empty = nothing + means.new_zeros(camera.height, camera.width)
        return background + empty[..., None], empty
    image, alpha = _blend(projected, camera)
    return image + (1 - alpha)[..., None] * background, alpha


def _project(
    geometry: dict[str, Tensor],
    sh0: Tensor,
    shN: Tensor,
    rows: Tensor,
    camera: Camera,
    screen_filter: ScreenFilter,
) -> dict[str, Tensor]:
    """Inputs of gsplat's tiles and pixels: one row for each Gaussian in the image, in row order."""
    import gsplat

    means = geometry["means"]
    opacities = geometry["opacities"]
    # In one transfer to the device.
    tensors = (camera.viewmat.flatten(), camera.K.flatten(), camera.position)
    flat = torch.cat([tensor.detach().to(means.dtype) for tensor in tensors])
    flat = flat.to(means.device, non_blocking=True)
    viewmat = flat[:16].view(1, 4, 4)
    K = flat[16:25].view(1, 3, 3)
    eye = flat[25:]
    projected = _call(
        gsplat.fully_fused_projection,
        means,
        None,
        geometry["quats"],
        geometry["scales"],
        viewmat,
        K,
        camera.width,
        camera.height,
        eps2d=screen_filter.variance,
        packed=True,
        near_plane=camera.near,
        far_plane=math.inf,
        radius_clip=0.0,
        sparse_grad=False,
        calc_compensations=screen_filter.compensate,
        camera_model="pinhole",
        opacities=opacities.detach(),
    )
    # of cameras, Gaussians; 1.5.3 has batches before them, 1.6.0 also the bounds of each image
    ids = projected[:-5][:3][-1]
    radii, means2d, depths = projected[-5:-2]
    conics, compensations = projected[-2:]
    harmonics = torch.cat([_Rows.apply(rows[ids], x) for x in (sh0, shN)], 1)
    degree = math.isqrt(harmonics.shape[1]) - 1
    centres = _Rows.apply(ids, means)
    # 1.6.0 finds the directions itself
    if "viewmats" in inspect.signature(gsplat.spherical_harmonics).parameters:
        colors = 0.5 + gsplat.spherical_harmonics(degree, centres, viewmat, harmonics)[0]
    else:
        colors = 0.5 + gsplat.spherical_harmonics(degree, centres - eye, harmonics)
    opacities = _Rows.apply(ids, opacities)
    if compensations is not None:
        opacities = opacities * compensations
    # Rows with values that are not finite are not drawn; the kernels would draw them opaque.
    sums = means2d.sum(1) + conics.sum(1) + colors.sum(1) + opacities
    finite = sums.detach().isfinite()
    finite_rows = finite[:, None]
    return {
        "means2d": means2d.where(finite_rows, 0),
        "conics": conics.where(finite_rows, 0),
        "radii": radii,
        "depths": depths,
        "colors": colors.where(finite_rows, 0).clamp(min=0),
        "opacities": opacities.where(finite, 0),
    }


def _blend(projected: dict[str, Tensor], camera: Camera) -> tuple[Tensor, Tensor]:
    """Image ``[H, W, 3]`` without a background and alpha ``[H, W]``: tile lists sorted by depth,
    then pixels.
    """
    import gsplat

    across = -(-camera.width // TILE)
    down = -(-camera.height // TILE)
    depths = projected["depths"]
    means2d = projected["means2d"]
    ids = torch.zeros(len(depths), dtype=torch.int64, device=depths.device)  # all of one image
    _, keys, order = _call(
        gsplat.isect_tiles,
        means2d,
        projected["radii"],
        depths,
        TILE,
        across,
        down,
        segmented=False,
        packed=True,
        n_images=1,
        image_ids=ids,
        n_cameras=1,
        camera_ids=ids,
        gaussian_ids=ids,
    )
    offsets = gsplat.isect_offset_encode(keys, 1, across, down)
    image, alpha = gsplat.rasterize_to_pixels(
        means2d,
        projected["conics"],
        projected["colors"],
        projected["opacities"],
        camera.width,
        camera.height,
        TILE,
        offsets,
        order,
        backgrounds=None,
        packed=True,
        absgrad=False,
    )
    return image[0], alpha[0, ..., 0]


def _call(function: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """The result of gsplat's function, without the options that the installed version does not
    have.
    """
    parameters = inspect.signature(function).parameters
    return function(*args, **{name: value for name, value in options.items() if name in parameters})


class _Rows(Function):
    """Selected rows of a tensor, each at most once.

    The backward pass replaces values that are not finite by 0: they are 0 times the projection of
    rows not drawn.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, values: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shape = values.shape
        return values.index_select(0, rows)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor]:
        (rows,) = ctx.saved_tensors
        finite = grad.nan_to_num(0.0, 0.0, 0.0)
        return None, grad.new_zeros(ctx.shape).index_copy_(0, rows, finite)
