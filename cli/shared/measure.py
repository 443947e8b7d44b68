"""Measuring dial values with progress; Ctrl-C ends it between frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from clod_adapter.cameras import View
from clod_adapter.config import AttenuationConfig
from clod_adapter.evaluation.evaluate import Row, evaluate
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.evaluation.perceptual import Metric
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Phase, Progress, Stopped

from .console import Console
from .interrupts import GracefulStop
from .launch import launched

DIALS = (1.0, 2.0, 3.0, 5.0)


def choose_dials(given: list[float] | None, attenuation: AttenuationConfig | None) -> tuple[list[float], list[str]]:
    """The dial values to measure, and a note if they are outside the trained range."""
    trained = attenuation.max_sv if attenuation else None
    if given is None:
        return [s for s in DIALS if trained is None or s < trained] + ([trained] if trained else []), []
    if trained is None or max(given) <= trained:
        return given, []
    return given, [f"trained up to s = {trained:g}; larger dial values were not trained"]


def measure(
    gaussians: Gaussians,
    views: Sequence[View],
    virtual_scales: Sequence[float],
    console: Console,
    label: str = "measure",
    metrics: Mapping[str, Metric] | None = None,
    stop: GracefulStop | None = None,
) -> tuple[list[Row], bool]:
    """The rows of the dial values, none without views, and whether Ctrl-C ended the measurement early.

    Args:
        stop: counts the signals, if it is not a new one.
    """
    stop = stop or GracefulStop(aborts=launched().size == 1)  # launchers repeat signals
    if not views:
        return [], False
    with console.meter(label) as meter, stop.listening():

        def show(now: Progress) -> bool:
            meter.update(now.share, f"s={virtual_scales[(now.done - 1) // len(views)]:g}")
            return stop.requests == 0

        rows = evaluate(gaussians, views, virtual_scales, metrics=metrics, progress=show)
    return rows, stop.requests > 0


def with_frame_times(
    measured: Sequence[tuple[Gaussians, Sequence[Row]]],
    views: Sequence[View],
    console: Console,
    stop: GracefulStop | None = None,
) -> tuple[list[list[Row]], list[str], bool]:
    """The rows of each model with frame times that can be compared, notes, and whether Ctrl-C ended the timing.

    Then and without rows they are returned unchanged.
    """
    stop = stop or GracefulStop(aborts=launched().size == 1)
    rows = [list(each) for _, each in measured]
    dials = [sorted({row.virtual_scale for row in each}) for each in rows]
    if not any(rows):
        return rows, [], False
    try:
        with console.meter(Phase.FRAME_TIMES) as meter, stop.listening():

            def show(now: Progress) -> bool:
                meter(now)
                return stop.requests == 0

            models = [(some, each) for (some, _), each in zip(measured, dials, strict=True)]
            times = time_frames(models, [view.camera for view in views], show)
    except Stopped:
        return rows, [], True
    for note in times.notes:
        console.say(note)
    for each, scales, found in zip(rows, dials, times.milliseconds, strict=True):
        taken = dict(zip(scales, found, strict=True))
        each[:] = [replace(row, frame_ms=taken[row.virtual_scale]) for row in each]
    return rows, times.notes, False
