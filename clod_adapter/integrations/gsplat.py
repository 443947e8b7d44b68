"""gsplat's ``rasterization`` with a dial: same arguments plus four, same results.

from clod_adapter.integrations import gsplat as clod_gsplat
colors, alphas, meta = clod_gsplat.rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height,
    sigma_d=model.sigma_d, growth_d=model.growth_d, attenuation=model.attenuation, virtual_scale=3,
)

gsplat takes one opacity and scale per Gaussian for all cameras; the dial gives one for each camera. So each camera is
one call of gsplat, and the results are joined in gsplat's form, including ids, order and gradients. (A batch of scenes
could share a call, but gsplat 1.5.3's packed projection culls all scenes by the opacities of the first.) Culled
Gaussians get opacity 0: gsplat drops such rows in its projection, before colours, sorting and blending, so nothing has
to be gathered, and rows and ids stay those of the caller. Written for gsplat 1.5.3.
"""

from __future__ import annotations

import inspect
import math
import weakref
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.hook import Hook

try:
    import gsplat
except ImportError as error:
    raise ImportError("gsplat cannot be imported; it needs torch and CUDA: pip install gsplat==1.5.3") from error

PER_GAUSSIAN = ("means", "quats", "scales", "opacities", "covars", "sigma_d", "growth_d")
PER_CAMERA = (
    "viewmats", "Ks", "backgrounds", "viewmats_rs", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs",
)  # fmt: skip

Rendered = tuple[Tensor, Tensor, dict[str, Any]]


def rasterization(
    *args: Any,
    sigma_d: Tensor | None = None,
    virtual_scale: float = 1.0,
    attenuation: AttenuationConfig | None = None,
    growth_d: Tensor | None = None,
    **kwargs: Any,
) -> Rendered:
    """``gsplat.rasterization`` with the opacities and scales of one dial value, for each camera.

    Equals gsplat called with the opacities of ``attenuation.attenuate`` and ``scales`` times its growth (``covars``,
    where given, times its square), camera by camera for ``[..., C, 4, 4]``. Differentiable in ``sigma_d``, ``growth_d``
    and all that gsplat differentiates in; the distances are constants, so the dial adds nothing to the gradients of
    ``means`` and ``viewmats``. ``meta`` is gsplat's: ``means2d`` takes ``retain_grad()`` and, with ``absgrad``, has its
    ``absgrad``, as densification strategies need it. (With several cameras ``means2d`` is a copy, which
    ``torch.autograd.grad`` and hooks on it do not reach.)

    Pass a file's ``Gaussians.screen_filter`` as without a dial: ``eps2d`` is its variance, and
    ``rasterize_mode="antialiased"`` its compensation of opacities.

    Distances are from the centre of ``viewmats`` for every camera model: Gaussians fade as an orthographic camera moves
    back; for a rolling shutter it is the first pose. The normalizers ``max`` and ``quantile`` take the frustum of a
    pinhole camera with these ``Ks``; ``scene``, the default, needs none.

    Args:
        args, kwargs: those of gsplat, by position or by name.
        sigma_d: ``[..., N]`` like ``opacities``; None calls gsplat's function unchanged.
        virtual_scale: the dial s >= 1.
        attenuation: settings of the equation, ``Gaussians.attenuation`` of the file; by default
            ``AttenuationConfig()``, with distances in world units.
        growth_d: ``[..., N]`` exponents of the growth of the scales, which begins at ``reference_distance`` of the
            attenuation or, where that is 0, at 1 world unit; None for no growth.

    Returns:
        ``render_colors [..., C, H, W, X]``, ``render_alphas [..., C, H, W, 1]`` and ``meta``.

    Raises:
        ClodError: the dial is below 1, sigma_d or growth_d differs from opacities in shape, or ``distributed`` is set,
            with which the cameras of all processes share one opacity.
    """
    if sigma_d is None:
        return gsplat.rasterization(*args, **kwargs)
    bound = inspect.signature(gsplat.rasterization).bind(*args, **kwargs)
    bound.apply_defaults()
    ours = {"sigma_d": sigma_d, "growth_d": growth_d}
    given: dict[str, Any] = {**bound.arguments, **ours}
    if given["distributed"]:
        raise ClodError("distributed=True shares one opacity among all cameras, a dial needs one each; set it to False")
    for name, value in ours.items():
        if value is not None and value.shape != given["opacities"].shape:
            shapes = f"{name} is {tuple(value.shape)} and opacities {tuple(given['opacities'].shape)}"
            raise ClodError(f"{shapes}; both must be [..., N]")
    shape = given["viewmats"].shape[:-2]
    config = attenuation or AttenuationConfig()
    if math.prod(shape) == 1:
        return _one_camera(given, virtual_scale, config)
    parts = [_one_camera(one, virtual_scale, config) for one in _cameras(given, shape)]
    colors, alphas, metas = zip(*parts, strict=True)
    return torch.cat(colors).unflatten(0, shape), torch.cat(alphas).unflatten(0, shape), _joined(metas, shape)


def _signature() -> inspect.Signature:
    """Parameters of the installed gsplat followed by ours, for help() and editors."""
    ours = inspect.signature(rasterization).parameters
    added = [parameter for parameter in ours.values() if parameter.kind is parameter.KEYWORD_ONLY]
    theirs = inspect.signature(gsplat.rasterization)
    return theirs.replace(parameters=[*theirs.parameters.values(), *added])


rasterization.__signature__ = _signature()  # type: ignore[attr-defined]


def _one_camera(given: dict[str, Any], virtual_scale: float, config: AttenuationConfig) -> Rendered:
    """gsplat's result for a single camera with any batch dimensions."""
    camera = Camera(
        given["viewmats"].reshape(4, 4), given["Ks"].reshape(3, 3), given["width"], given["height"],
        near=given["near_plane"],
    )  # fmt: skip
    arguments = dict(given)
    sigma_d, growth_d = (arguments.pop(name) for name in ("sigma_d", "growth_d"))
    hook = Hook(sigma_d.flatten(), config, virtual_scale, None if growth_d is None else growth_d.flatten())
    opacities = given["opacities"]
    shown = hook.attenuate(given["means"].reshape(-1, 3), opacities.flatten(), camera)
    arguments["opacities"] = shown.drawn.to(opacities).reshape(opacities.shape)
    if shown.growth is not None:
        name, growth = ("scales", shown.growth) if given.get("covars") is None else ("covars", shown.growth.square())
        old = given[name]
        arguments[name] = old * growth.to(old).reshape(opacities.shape + (1,) * (old.dim() - opacities.dim()))
    return gsplat.rasterization(**arguments)


def _cameras(given: dict[str, Any], shape: torch.Size) -> Iterator[dict[str, Any]]:
    """Arguments for each camera, without batch dimensions, in gsplat's order of images."""
    values = 1 if given["sh_degree"] is None else 2  # dimensions of one Gaussian's colour
    for index in np.ndindex(*shape):
        batch, camera = index[:-1], slice(index[-1], index[-1] + 1)
        of_scene, of_camera = batch or ..., (*batch, camera)
        colors = of_camera if given["colors"].dim() == len(shape) + 1 + values else of_scene
        places = dict.fromkeys(PER_GAUSSIAN, of_scene) | dict.fromkeys(PER_CAMERA, of_camera) | {"colors": colors}
        yield {
            name: value[places[name]] if name in places and value is not None else value
            for name, value in given.items()
        }


def _joined(metas: Sequence[dict[str, Any]], shape: torch.Size) -> dict[str, Any]:
    """gsplat's ``meta`` of all images from that of each: rows concatenated, ids offset."""
    first, images = metas[0], range(len(metas))
    packed = first["gaussian_ids"] is not None
    rows = [0, *accumulate(meta["depths"].numel() for meta in metas)]
    pairs = [0, *accumulate(len(meta["isect_ids"]) for meta in metas)]
    tile_bits = (first["tile_width"] * first["tile_height"]).bit_length()
    counted = {
        "batch_ids": [image // shape[-1] for image in images],
        "camera_ids": [image % shape[-1] for image in images],
        "flatten_ids": rows,
        "isect_offsets": pairs,
        "isect_ids": [image << 32 + tile_bits for image in images],  # image, tile, depth: gsplat's sorting key
    }
    joined = {**first, "n_batches": math.prod(shape[:-1]), "n_cameras": shape[-1]}
    for name, value in first.items():
        if isinstance(value, Tensor):
            values = [meta[name] for meta in metas]
            if name in counted:
                values = [ids + start for ids, start in zip(values, counted[name], strict=False)]
            joined[name] = torch.cat(values)
            if name == "isect_offsets" or not (packed or name in counted):
                joined[name] = joined[name].unflatten(0, shape)
    _pass_gradients_on([meta["means2d"] for meta in metas], joined["means2d"], rows)
    return joined


def _pass_gradients_on(parts: list[Tensor], whole: Tensor, rows: list[int]) -> None:
    """Gives ``whole`` the ``grad`` and ``absgrad`` of the parts, which gsplat rendered from.

    As with gsplat: ``grad`` if it is retained, summed over backward passes; ``absgrad`` of the last one.
    """
    if not whole.requires_grad:
        return
    whole.parts = parts  # type: ignore[attr-defined]
    weak: Any = weakref.ref(whole)  # the graph of whole holds the hooks; a strong reference would be a cycle
    seen: list[Any] = [0] * len(parts)  # gradients that came through whole and are in its grad already

    def by_whole(gradient: Tensor) -> None:
        seen[:] = gradient.reshape(-1, 2).split([stop - start for start, stop in pairwise(rows)])

    def by_part(gradient: Tensor, number: int) -> None:
        drawn, seen[number] = gradient.reshape(-1, 2) - seen[number], 0
        if (whole := weak()) is None:
            return
        place = slice(rows[number], rows[number + 1])
        if whole.retains_grad:
            whole.grad = torch.zeros_like(whole) if whole.grad is None else whole.grad.clone()
            whole.grad.view(-1, 2)[place] += drawn
        if hasattr(whole.parts[number], "absgrad"):
            whole.absgrad = getattr(whole, "absgrad", torch.zeros_like(whole))
            whole.absgrad.view(-1, 2)[place] = whole.parts[number].absgrad.view(-1, 2)

    whole.register_hook(by_whole)
    for number, part in enumerate(parts):
        part.register_hook(partial(by_part, number=number))
