"""Rows of dial values as commands measure them: with progress, ended by Ctrl-C between frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from clod_adapter.cameras import View
from clod_adapter.config import AttenuationConfig
from clod_adapter.evaluation.evaluate import Row, evaluate
from clod_adapter.evaluation.perceptual import Metric
from clod_adapter.gaussians import Gaussians

from .console import Console
from .interrupts import GracefulStop

DIALS = (1.0, 2.0, 3.0, 5.0)


def choose_dials(given: list[float] | None, attenuation: AttenuationConfig | None) -> tuple[list[float], list[str]]:
    """The dial values to measure, and a note where they are beyond what the file was trained for."""
    trained = attenuation.max_sv if attenuation else None
    if given is None:
        return [s for s in DIALS if trained is None or s < trained] + ([trained] if trained else []), []
    if trained is None or max(given) <= trained:
        return given, []
    return given, [f"trained up to s = {trained:g}; beyond that nothing was learned"]


def measure(
    gaussians: Gaussians,
    views: Sequence[View],
    virtual_scales: Sequence[float],
    console: Console,
    label: str = "measure",
    metrics: Mapping[str, Metric] | None = None,
) -> tuple[list[Row], bool]:
    """The rows of the dial values, none where there are no views, and whether Ctrl-C cut them short."""
    rows, stop = list[Row](), GracefulStop()  # raised between frames: within a kernel it would be a SystemError
    with console.meter(label) as meter, stop.listening():
        try:
            for i, virtual_scale in enumerate(virtual_scales if views else ()):

                def report(done: int, total: int, before: int = i, s: float = virtual_scale) -> None:
                    meter.update((before + done / total) / len(virtual_scales), f"s={s:g}")
                    if stop.requests:
                        raise KeyboardInterrupt

                rows += evaluate(gaussians, views, [virtual_scale], metrics=metrics, progress=report)
        except KeyboardInterrupt:
            return rows, True
    return rows, stop.requests > 0
