"""gsplat's functions with opacities and scales of one dial value: one call for each camera, whose
images are stacked as gsplat's.

Which arguments and results there are is read from the installed gsplat. Rows of opacity 0 have to
be culled before tiles and sorting: where gsplat's projection does not do that, their centres move
behind the camera.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.hook import Hook

PER_ROW = ("sigma_d", "growth_d")
PER_GAUSSIAN = ("means", "quats", "scales", "opacities", "covars")
PER_CAMERA = (
    "viewmats",
    "Ks",
    "backgrounds",
    "viewmats_rs",
    "radial_coeffs",
    "tangential_coeffs",
    "thin_prism_coeffs",
)
# arguments by Gaussian or by camera and Gaussian, and the SH degree of each
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
    several = math.prod(shape) > 1
    if several and len(shape) > 1:
        raise ClodError(
            f"viewmats is {tuple(arguments['viewmats'].shape)}, of several scenes, and the dial's"
            " settings are of one; render one scene at a time"
        )
    arguments = dict(arguments)
    sigma_d, growth_d = (arguments.pop(name) for name in PER_ROW)
    if growth_d is not None:
        growth_d = growth_d.flatten()
    hook = Hook(sigma_d.flatten(), config, virtual_scale, growth_d)
    results = []
    for of_camera in _cameras(arguments) if several else [arguments]:
        results.append(_one_camera(function, of_camera, hook, hide))
    return _joined(results) if several else results[0]


def _one_camera(
    function: Callable[..., Any],
    arguments: dict[str, Any],
    hook: Hook,
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
    opacities = arguments["opacities"]
    means = arguments["means"]
    attenuated = hook.attenuate(means.reshape(-1, 3), opacities.flatten(), camera)
    drawn_arguments["opacities"] = attenuated.drawn.to(opacities).reshape(opacities.shape)
    if hook.growth_d is not None:
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


def _cameras(arguments: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Arguments for each camera."""
    tensors = {name: value for name, value in arguments.items() if isinstance(value, Tensor)}
    of_camera = [name for name in PER_CAMERA if name in tensors]
    for name, degree in PER_EITHER.items():
        # a dimension of cameras, before N rows or N rows of K coefficients
        dimensions = 3 if arguments.get(degree) is None else 4
        if name in tensors and tensors[name].dim() == dimensions:
            of_camera.append(name)
    count = len(tensors["viewmats"])
    if "rays" in tensors:  # the only one that gsplat broadcasts
        tensors["rays"] = tensors["rays"].expand(count, -1, -1, -1)
        of_camera.append("rays")
    unknown = tensors.keys() - {*PER_GAUSSIAN, *PER_EITHER, *of_camera}
    if unknown:
        raise ClodError(
            f"{min(unknown)} may differ between cameras in a way unknown here; render one camera at"
            " a time"
        )
    for k in range(count):
        yield arguments | {name: tensors[name][k : k + 1] for name in of_camera}


def _joined(results: Sequence[Any]) -> Any:
    """gsplat's result for several cameras from that of each, ``meta`` as a list."""
    first = results[0]
    if isinstance(first, tuple):
        return tuple(_joined(same) for same in zip(*results, strict=True))
    if isinstance(first, dict):
        return list(results)
    if first is None:
        return None
    # as gsplat squeezes some
    return torch.cat([image.reshape(-1, *image.shape[-3:]) for image in results])
