"""gsplat's functions with opacities and scales of one dial value: one call for each camera, whose
images are stacked as gsplat's.

Which arguments and results there are is read from the installed gsplat. Rows of opacity 0 have to
be culled before tiles and sorting: where gsplat's projection does not do that, their centres move
behind the camera.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.hook import Hook

PER_ROW = ("sigma_d", "growth_d")
PER_GAUSSIAN = ("means", "quats", "scales", "opacities", "covars", *PER_ROW)
PER_CAMERA = (
    "viewmats",
    "Ks",
    "backgrounds",
    "viewmats_rs",
    "radial_coeffs",
    "tangential_coeffs",
    "thin_prism_coeffs",
    "rays",
)
# arguments by Gaussian or by view and Gaussian, and the SH degree of each
PER_EITHER = {"colors": "sh_degree", "extra_signals": "extra_signals_sh_degree"}


def render(
    function: Callable[..., Any],
    arguments: dict[str, Any],
    virtual_scale: float,
    config: AttenuationConfig,
    hide: bool,
) -> Any:
    """``function``'s result for arguments by name, with ``sigma_d`` and ``growth_d`` among them.

    With ``hide``, culled centres move behind the camera, as this function draws rows of opacity 0.
    """
    if arguments.get("distributed"):
        raise ClodError(
            "distributed=True shares one opacity among all cameras, a dial needs one each; set it"
            " to False"
        )
    for name in PER_ROW:
        if arguments[name] is not None and arguments[name].shape != arguments["opacities"].shape:
            raise ClodError(
                f"{name} is {tuple(arguments[name].shape)} and opacities"
                f" {tuple(arguments['opacities'].shape)}; both must be [..., N]"
            )
    shape = arguments["viewmats"].shape[:-2]
    render_one = partial(
        _one_camera, function, virtual_scale=virtual_scale, config=config, hide=hide
    )
    if math.prod(shape) == 1:
        return render_one(arguments)
    return _joined(
        [render_one(camera_arguments) for camera_arguments in _cameras(arguments, shape)], shape
    )


def _one_camera(
    function: Callable[..., Any],
    arguments: dict[str, Any],
    virtual_scale: float,
    config: AttenuationConfig,
    hide: bool,
) -> Any:
    """gsplat's result for a single camera with any batch dimensions."""
    camera = Camera(
        arguments["viewmats"].reshape(4, 4),
        arguments["Ks"].reshape(3, 3),
        arguments["width"],
        arguments["height"],
        near=arguments["near_plane"],
    )
    drawn_arguments = dict(arguments)
    sigma_d, growth_d = (drawn_arguments.pop(name) for name in PER_ROW)
    hook = Hook(
        sigma_d.flatten(), config, virtual_scale, None if growth_d is None else growth_d.flatten()
    )
    opacities = arguments["opacities"]
    means = arguments["means"]
    attenuated = hook.attenuate(means.reshape(-1, 3), opacities.flatten(), camera)
    drawn_arguments["opacities"] = attenuated.drawn.to(opacities).reshape(opacities.shape)
    if growth_d is not None:
        name = "scales"
        growth = attenuated.growth
        if arguments.get("covars") is not None:
            name = "covars"
            growth = growth.square()
        sizes = arguments[name]
        further = (1,) * (sizes.dim() - opacities.dim())
        drawn_arguments[name] = sizes * growth.to(sizes).reshape(opacities.shape + further)
    if hide and not arguments.get("sparse_grad"):  # sparse gradients do not pass through where
        behind = (camera.position - camera.viewmat[2, :3]).detach().to(means)
        keep = attenuated.keep.reshape(opacities.shape)
        drawn_arguments["means"] = torch.where(keep[..., None], means, behind)
    return function(**drawn_arguments)


def _cameras(arguments: dict[str, Any], shape: torch.Size) -> Iterator[dict[str, Any]]:
    """Arguments for each camera, without batch dimensions, in gsplat's order of images."""
    with_cameras = {*PER_GAUSSIAN, *PER_CAMERA, *PER_EITHER}
    if unknown := [
        name
        for name, value in arguments.items()
        if isinstance(value, Tensor) and name not in with_cameras
    ]:
        raise ClodError(
            f"{unknown[0]} may differ between cameras in a way unknown here; render one camera at a"
            " time"
        )
    if isinstance(arguments.get("rays"), Tensor):  # the only one that gsplat broadcasts
        arguments = {**arguments, "rays": arguments["rays"].expand(*shape, *[-1] * 3)}
    for index in np.ndindex(*shape):
        batch = index[:-1] or ...
        camera = (*index[:-1], slice(index[-1], index[-1] + 1))
        places = dict.fromkeys(PER_GAUSSIAN, batch) | dict.fromkeys(PER_CAMERA, camera)
        for name, degree in PER_EITHER.items():
            if isinstance(value := arguments.get(name), Tensor):
                # before N rows, or before N rows of K coefficients
                leading = value.dim() - (2 if arguments[degree] is None else 3)
                places[name] = camera if leading == len(shape) else batch if leading else ...
        yield {
            name: value[places[name]] if isinstance(value, Tensor) else value
            for name, value in arguments.items()
        }


def _joined(results: Sequence[Any], shape: torch.Size) -> Any:
    """gsplat's result for all images from that of each, ``meta`` as a list; ``shape`` has batch
    dimensions and cameras.
    """
    first = results[0]
    if isinstance(first, tuple):
        return tuple(_joined(same, shape) for same in zip(*results, strict=True))
    if isinstance(first, dict):
        return list(results)
    if first is None:
        return None
    each = [result.reshape(result.shape[-3:]) for result in results]
    images = torch.stack(each).unflatten(0, shape)
    return images.squeeze(0) if first.dim() == 3 else images  # as gsplat squeezes some
