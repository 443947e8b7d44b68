"""LPIPS and FLIP, from the packages that define them, where these are installed; never from the network."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from clod_adapter.losses import unit

INSTALL = "pip install lpips flip-evaluator"
WEIGHTS = """python -c "import torchvision; torchvision.models.alexnet(weights='DEFAULT')\""""

Metric = Callable[[Tensor, Tensor], float]
"""Of a ``[H, W, 3]`` float render, which it clamps to [0, 1], against a uint8 photograph."""


class Unavailable(Exception):
    """A metric cannot be computed here.

    Args:
        found: why; without it, because its package is not installed.
        fix: what to run; empty where ``found`` says all there is to say.
    """

    def __init__(self, found: str = "", fix: str = "") -> None:
        super().__init__("; once, online: ".join(each for each in (found, fix) if each))
        self.found, self.fix = found or "not installed", fix


def available_metrics() -> tuple[dict[str, Metric], list[str]]:
    """The metrics that are there, by name in the reports, and at most one note on those that are not.

    ``lpips``: LPIPS 0.1 with AlexNet, its authors' choice for evaluation, inputs scaled to [-1, 1]; 0 for equal
    pictures. Papers that use Inria's evaluation report VGG on inputs in [0, 1], which are other numbers.
    ``flip``: the mean over pixels of LDR-FLIP at 67 pixels per degree (FLIP's default viewing distance), in [0, 1].
    """
    found: dict[str, Metric] = {}
    missing: dict[str, list[str]] = {}
    for name, make in METRICS.items():
        try:
            found[name] = make()
        except Unavailable as reason:
            missing.setdefault(str(reason), []).append(name.upper())
    notes = [f"without {' and '.join(names)} ({reason})" for reason, names in missing.items()]
    return found, ["; ".join(notes)] if notes else []


def _make_lpips() -> Metric:
    try:
        import lpips
        from torchvision.models import AlexNet_Weights
    except ImportError as error:
        raise Unavailable(fix=INSTALL) from error
    except RuntimeError as error:  # torchvision's, where it was built for another torch
        raise Unavailable(f"torchvision does not fit this torch: {' '.join(str(error).split())}") from error
    weights = Path(torch.hub.get_dir()) / "checkpoints" / Path(AlexNet_Weights.IMAGENET1K_V1.url).name
    if not weights.is_file():  # lpips would download it
        raise Unavailable(f"its network's weights are not at {weights}", WEIGHTS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # lpips calls torchvision in a way that is deprecated
        return partial(_lpips, lpips.LPIPS(net="alex", verbose=False))


def _make_flip() -> Metric:
    try:
        import flip_evaluator
    except ImportError as error:
        raise Unavailable(fix=INSTALL) from error
    return partial(_flip, flip_evaluator.evaluate)


# How each is made; raises Unavailable.
METRICS: dict[str, Callable[[], Metric]] = {"lpips": _make_lpips, "flip": _make_flip}


@torch.no_grad()
def _lpips(network: Any, image: Tensor, target: Tensor) -> float:
    ours, theirs = (x.permute(2, 0, 1)[None].contiguous() for x in _both(image, target))
    return float(network.to(ours.device)(ours, theirs, normalize=True))


def _flip(evaluate: Any, image: Tensor, target: Tensor) -> float:
    ours, theirs = (x.cpu().numpy() for x in _both(image, target))
    return float(evaluate(theirs, ours, "LDR", applyMagma=False)[1])


def _both(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    image = image.detach().float().clamp(0, 1).contiguous()
    return image, unit(target, image)
