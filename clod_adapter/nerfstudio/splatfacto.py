"""Between splatfacto's parameters and a dial; nothing here imports nerfstudio."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clod_adapter.cameras import Camera, intrinsics
from clod_adapter.config import AdaptConfig, AttenuationConfig, ScreenFilter
from clod_adapter.equation.attenuation import check_dial
from clod_adapter.errors import ClodError
from clod_adapter.integrations.splats import from_gsplat
from clod_adapter.io.checkpoint import save
from clod_adapter.training.dial import Dial, attach

VIRTUAL_SCALE = "CLOD_VIRTUAL_SCALE"
SETTINGS = "attenuation"
NEARLY = 1e-6  # the logit of an opacity this close to 0 or 1 has no useful gradient


def camera_of(camera: Any) -> Camera:
    """The first camera of nerfstudio's ``Cameras``.

    nerfstudio's cameras look along -z with y up; ``camera_to_worlds`` is ``[..., 3, 4]``.
    """
    pose = camera.camera_to_worlds.reshape(-1, 3, 4)[0].detach().cpu().float()
    rotation = pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0])
    viewmat = torch.eye(4, dtype=torch.float32)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ pose[:, 3]

    def number(name: str) -> float:
        return float(getattr(camera, name).flatten()[0])

    K = intrinsics(number("fx"), number("fy"), number("cx"), number("cy"))
    return Camera(viewmat, K, int(number("width")), int(number("height")))


def drawn_parameters(
    parameters: Mapping[str, Tensor], dial: Dial, camera: Camera, virtual_scale: float
) -> dict[str, Tensor]:
    """Tensors that splatfacto is to draw in place of its ``means``, ``scales`` and ``opacities``
    for a camera and dial value.

    Scales are logarithms and opacities logits, as splatfacto activates them itself. Culled
    Gaussians get the logit of opacity 0 and a centre behind the camera, where gsplat's projection
    culls them before it sorts. Differentiable in the parameters and the dial; culled rows have
    gradient 0.
    """
    attenuated = dial(camera, virtual_scale)
    means, opacities, scales = (parameters[name] for name in ("means", "opacities", "scales"))
    keep = attenuated.keep[:, None]
    logits = torch.logit(attenuated.drawn[:, None].where(keep, 0.5), eps=NEARLY)
    behind = (camera.position - camera.viewmat[2, :3]).to(means)
    return {
        "means": torch.where(keep, means, behind),
        "opacities": logits.where(keep, -torch.inf).to(opacities),
        "scales": scales + attenuated.growth.log().to(scales)[:, None],
    }


def new_dial(
    parameters: Mapping[str, Tensor],
    cameras: Sequence[Camera],
    config: AdaptConfig,
    saved: Mapping[str, Any],
) -> Dial:
    """The dial that ``saved`` describes (``state_of``), or an initialized one if it is empty."""
    if not saved:
        return attach(parameters, cameras, config)
    attenuation = AttenuationConfig(**saved[SETTINGS])
    if attenuation.max_sv != config.max_sv:
        raise ClodError(
            f"the dial was trained up to {attenuation.max_sv:g}; set --pipeline.model.max-sv to"
            " that"
        )
    tensors = {
        name: value.to(parameters["means"].device)
        for name, value in saved.items()
        if name != SETTINGS
    }
    start = from_gsplat({name: value.detach() for name, value in parameters.items()}).replace(
        sigma_d=tensors["log_sigma"].exp(),
        growth_d=tensors.get("growth_d"),
        attenuation=attenuation,
    )
    dial = Dial(parameters, start, cameras, config)
    dial.load_state_dict(tensors)
    return dial


def state_of(dial: Dial) -> dict[str, Any]:
    """Entries of a checkpoint for ``new_dial``: tensors, and the settings as plain numbers and
    names.
    """
    return {**dial.state_dict(), SETTINGS: asdict(dial.attenuation)}


def trained_rates(dial: Dial) -> dict[str, float]:
    """Those of the parameters, of splats and dial, that are trained."""
    groups = dial.param_groups(splats=True)
    return {group["name"]: group["lr"] for group in groups if group["lr"] > 0}


def chosen(default: float) -> float:
    """The dial value of ``CLOD_VIRTUAL_SCALE``, or the default."""
    text = os.environ.get(VIRTUAL_SCALE, "")
    try:
        value = float(text) if text else default
        check_dial(value)
    except (ValueError, ClodError) as error:
        raise ClodError(
            f"{VIRTUAL_SCALE} is {text!r}, it must be a number of at least 0"
        ) from error
    return value


def write_ply(
    path: str, columns: Mapping[str, np.ndarray[Any, Any]], dial: Dial, screen_filter: ScreenFilter
) -> None:
    """The rows that nerfstudio exports, with their dial, as an extended PLY.

    nerfstudio drops rows (faint, not finite, outside of a box) and keeps the order of the others;
    ``columns`` are ``[M]`` or ``[M, 1]`` each. The dial's rows are found by their attributes.
    """
    gaussians = dial.gaussians().cpu().replace(screen_filter=screen_filter)
    exported = np.stack([columns[name].ravel() for name in ("x", "y", "z", "opacity")], 1).astype(
        np.float32
    )
    values = torch.cat([gaussians.means, gaussians.opacity_logits[:, None]], 1).detach().numpy()
    of_dial = enumerate(row.tobytes() for row in values)
    rows = []
    for exported_row in map(np.ndarray.tobytes, exported):
        row = next((number for number, row in of_dial if row == exported_row), None)
        if row is None:
            raise ClodError(
                f"{path}: nerfstudio exports other rows than those of the dial; nothing is written"
            )
        rows.append(row)
    save(path, gaussians[rows])
