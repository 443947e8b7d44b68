"""Quality, count and time over dial values, on held-out views; and the errors of levels for 3D
Tiles.
"""

import statistics
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
import torch

from clod_adapter.cameras import View
from clod_adapter.equation.attenuation import check_dial
from clod_adapter.equation.distances import in_frustum
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.frame_times import timed_frame
from clod_adapter.gaussians import Gaussians
from clod_adapter.losses import psnr_ssim
from clod_adapter.progress import Listener, Phase, Progress, Stopped
from clod_adapter.render import render

SCORED = 4  # views whose SSIM is computed at a time: each takes 83 bytes a pixel


@dataclass(frozen=True)
class Row:
    """One dial value, means over the views.

    Attributes:
        virtual_scale: the dial s.
        psnr: dB; ssim: in [-1, 1] (``losses.psnr_ssim``).
        kept: Gaussians the dial leaves in, of all; kept_share: that divided by all.
        in_view: kept Gaussians whose centre is in the image.
        frame_ms: median time of a frame, milliseconds.
        frame_ms_range: between the quartiles of several passes, where ``frame_times.time_frames``
            measured times that can be compared.
    """

    virtual_scale: float
    psnr: float
    ssim: float
    kept: float
    kept_share: float
    in_view: float
    frame_ms: float
    frame_ms_range: float | None = None

    def as_dict(self) -> dict[str, float]:
        """The fields that were measured."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@torch.no_grad()
def evaluate(
    gaussians: Gaussians,
    views: Sequence[View] | View,
    virtual_scales: Sequence[float] | float,
    *,
    progress: Listener | None = None,
) -> list[Row]:
    """Renders ``views`` at each dial value and compares with the photographs.

    Args:
        gaussians: adapted or not; without ``sigma_d`` every dial value shows the base.
        views: one or several; virtual_scales: one dial value or several.
        progress: called in ``Phase.EVALUATION`` after each view of each dial value; False returns
            the rows so far.

    Raises:
        ClodError: no views, no dial values, or one below 1 or not finite.

    Example:
        >>> model, scene = clod.load("model.ply"), clod.load_scene("scene")
        >>> for row in clod.evaluate(model.gaussians, scene.test, [1, 3]):
        ...     print(row.virtual_scale, row.psnr, row.kept)
    """
    views = [views] if isinstance(views, View) else views
    virtual_scales = list(np.atleast_1d(virtual_scales))
    if len(views) == 0:
        raise ClodError("there are no held-out views to evaluate on")
    if not virtual_scales:
        raise ClodError("there are no dial values to evaluate at")
    for virtual_scale in virtual_scales:
        check_dial(virtual_scale)
    gaussians = gaussians.without_empty_bands()
    dials = [1.0 if gaussians.sigma_d is None else float(s) for s in virtual_scales]
    render(gaussians, views[0].camera, max(dials))  # compiled and warm before the clock starts
    rows = list[Row]()
    for virtual_scale, dial in zip(virtual_scales, dials, strict=True):
        measured = list[_Measured]()
        for measured_view in _measured(gaussians, views, dial):
            measured.append(measured_view)
            done = len(rows) * len(views) + len(measured)
            now = Progress(Phase.EVALUATION, done, len(dials) * len(views))
            stopped = progress is not None and progress(now) is False
            if stopped and len(measured) < len(views):
                return rows
        rows.append(_row(float(virtual_scale), measured, gaussians.whole))
        if stopped:
            break
    return rows


def evaluate_all(
    gaussians: Gaussians,
    views: Sequence[View],
    virtual_scales: Sequence[float],
    progress: Listener | None = None,
) -> list[Row]:
    """``evaluate`` of every dial value.

    Raises:
        ClodError: as ``evaluate``.
        Stopped: ``progress`` returned False before the last row.
    """
    rows = evaluate(gaussians, views, virtual_scales, progress=progress)
    if len(rows) < len(virtual_scales):
        raise Stopped(f"stopped after {len(rows)} of {len(virtual_scales)} rows")
    return rows


class _Measured(NamedTuple):
    """One view at one dial value: the time of its frame, and ``Row``'s other numbers."""

    seconds: float
    psnr: float
    ssim: float
    kept: float
    in_view: float


def _row(virtual_scale: float, measured: Sequence[_Measured], total: int) -> Row:
    mean = _Measured(*np.mean(measured, axis=0).tolist())
    return Row(
        virtual_scale,
        psnr=mean.psnr,
        ssim=mean.ssim,
        kept=mean.kept,
        kept_share=mean.kept / max(total, 1),
        in_view=mean.in_view,
        frame_ms=1e3 * statistics.median(view.seconds for view in measured),
    )


def _measured(
    gaussians: Gaussians,
    views: Sequence[View],
    virtual_scale: float,
) -> Iterator[_Measured]:
    """Renders each view; PSNR and SSIM are computed of several at a time."""
    workers = min(torch.get_num_threads(), SCORED)
    with ThreadPoolExecutor(workers) as pool:
        for first in range(0, len(views), workers):
            scored = views[first : first + workers]
            frames = [timed_frame(gaussians, view.camera, virtual_scale) for view in scored]
            scores = pool.map(
                psnr_ssim,
                [rendering.image for rendering, _ in frames],
                [view.image for view in scored],
            )
            for (rendering, seconds), score in zip(frames, scores, strict=True):
                kept = rendering.kept
                inside = kept & in_frustum(gaussians.means, rendering.camera)
                yield _Measured(seconds, *score, int(kept.sum()), int(inside.sum()))
