"""Detects the screen-space filter of a checkpoint's training, which most files do not name.

With another filter, Gaussians of about a pixel render too opaque or too faint.
"""

from collections.abc import Sequence
from statistics import fmean

import torch
from torch import Tensor

from clod_adapter.alignment.check import DOUBTFUL
from clod_adapter.cameras import View, spread
from clod_adapter.config import FILTERS
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import unit
from clod_adapter.render import render

MOST_VIEWS = 8
# A wrong filter measured at least 0.48 dB worse than that of training.
CLEAR = 0.2  # dB, mean over the views
MOST = 0.75  # share of the views in which the chosen filter must be better


@torch.no_grad()
def compare_filters(gaussians: Gaussians, views: Sequence[View], expected: str = "off") -> tuple[str, dict[str, float]]:
    """The name in FILTERS of the filter that fits the photographs, and the mean PSNR with each.

    Renders at most MOST_VIEWS of the views, evenly spread, at s = 1. Another than ``expected`` is chosen if its mean
    PSNR is CLEAR dB higher, its PSNR is higher in MOST of the views and its pooled error is DOUBTFUL dB below that of
    the photographs' mean colours (in a wrong frame, fainter is closer).
    """
    views = spread(views, MOST_VIEWS)
    photographs = [unit(view.image, gaussians.means) for view in views]
    constant = fmean(float((image - image.mean((0, 1))).square().mean()) for image in photographs)
    errors, psnr = dict[str, Tensor](), dict[str, Tensor]()
    for name, each in FILTERS.items():
        filtered = gaussians.replace(screen_filter=each)
        pictures = [render(filtered, view.camera).image.clamp(0, 1) for view in views]
        pairs = zip(pictures, photographs, strict=True)
        errors[name] = torch.stack([(image - photograph).square().mean() for image, photograph in pairs])
        psnr[name] = -10 * errors[name].clamp(min=1e-10).log10()
    means = {name: float(each.mean()) for name, each in psnr.items()}
    clear = [
        name
        for name in FILTERS
        if float((psnr[name] - psnr[expected]).mean()) > CLEAR
        and float((psnr[name] > psnr[expected]).float().mean()) >= MOST
        and float(errors[name].mean()) < constant * 10 ** (-DOUBTFUL / 10)
    ]
    return max(clear, key=means.__getitem__, default=expected), means
