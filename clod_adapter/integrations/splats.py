"""The parameters that gsplat's ``simple_trainer`` and nerfstudio's splatfacto train, as
``Gaussians`` and back.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clod_adapter._support.arrays import float_tensor
from clod_adapter.config import CLASSIC, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians

NAMES = {
    "means": "means",
    "quats": "quats",
    "scales": "log_scales",
    "opacities": "opacity_logits",
    "sh0": "sh0",
    "shN": "shN",
}
"""By the name of gsplat's trainer, that of ``Gaussians``."""


def from_gsplat(
    splats: Mapping[str, Tensor | np.ndarray], *, screen_filter: ScreenFilter = CLASSIC
) -> Gaussians:
    """The Gaussians of a ``splats`` dictionary, without a dial; they share its tensors, and so its
    gradients.

    Scales are logarithms and opacities logits, ``[N]`` or ``[N, 1]``. Colours are gsplat's
    ``sh0 [N, 1, 3]`` and ``shN [N, K-1, 3]`` or splatfacto's ``features_dc [N, 3]`` and
    ``features_rest``; without higher SH degrees the second may be absent. Of splatfacto with SH
    degree 0 ``features_dc`` are logits of colours, which are converted.

    Args:
        splats: a dictionary or ``torch.nn.ParameterDict``; numpy arrays become float32 tensors.
        screen_filter: ``ScreenFilter(compensate=True)`` where it was trained with
            ``rasterize_mode="antialiased"``.

    Raises:
        ClodError: a parameter is missing or has the wrong shape.
    """
    tensors = {name: float_tensor(value) for name, value in splats.items()}
    degree_0 = (
        "features_dc" in tensors and tensors.get("features_rest", torch.empty(0, 0)).shape[1] == 0
    )
    if "features_dc" in tensors:
        colours = tensors["features_dc"]
        tensors["sh0"] = ((colours.sigmoid() - 0.5) / SH_C0 if degree_0 else colours).unsqueeze(1)
        tensors["shN"] = tensors.get("features_rest", colours.new_zeros(len(colours), 0, 3))
    missing = [name for name in NAMES if name not in tensors and name != "shN"]
    if missing:
        hint = (
            "; with appearance optimisation there are no spherical harmonics"
            if "features" in tensors
            else ""
        )
        raise ClodError(f"splats needs {', '.join(missing)} too, it has {', '.join(splats)}{hint}")
    tensors.setdefault("shN", tensors["sh0"].new_zeros(len(tensors["sh0"]), 0, 3))
    if tensors["opacities"].dim() == 2 and tensors["opacities"].shape[1] == 1:
        tensors["opacities"] = tensors["opacities"].squeeze(1)
    values: Any = {ours: tensors[theirs] for theirs, ours in NAMES.items()}
    return Gaussians(**values, screen_filter=screen_filter)


def to_gsplat(gaussians: Gaussians) -> dict[str, Tensor]:
    """The six parameters by gsplat's names; they share the tensors of ``gaussians``.

    A dial is not among them: pass ``sigma_d``, ``growth_d`` and ``attenuation`` to
    ``clod_adapter.integrations.gsplat.rasterization``.
    """
    return {theirs: getattr(gaussians, ours) for theirs, ours in NAMES.items()}
