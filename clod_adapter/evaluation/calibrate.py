"""The table of quality against the dial that is stored with a file: its dial values, its
viewpoints.
"""

from collections.abc import Sequence
from dataclasses import replace

from clod_adapter._support.machine import machine_name
from clod_adapter.cameras import Scene, View, spread
from clod_adapter.equation.distances import viewpoint_of
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.gaussians import Gaussians
from clod_adapter.origin import Origin
from clod_adapter.progress import Listener
from clod_adapter.quality_table import QualityTable

# Round values, each about 1.4 times the last, or more between 1 and 5.
REPORT_DIALS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0)
VIEWPOINTS = 16  # most training cameras that are stored: all 84 baked 0.006 dB better


def report_dials(max_sv: float) -> list[float]:
    """The dial values of a report, in about even steps of their logarithm; the last one is
    ``max_sv``.
    """
    return [s for s in REPORT_DIALS if s < max_sv] + [max_sv]


def with_frame_times(
    measured: Sequence[tuple[Gaussians, Sequence[Row]]],
    views: Sequence[View],
    progress: Listener | None = None,
) -> tuple[list[list[Row]], list[str]]:
    """The rows of each model with frame times that can be compared (``time_frames``), and notes on
    them.
    """
    jobs = []
    for model, rows in measured:
        jobs.append((model, [row.virtual_scale for row in rows]))
    times = time_frames(jobs, [view.camera for view in views], progress)
    timed = []
    for (_, rows), *columns in zip(measured, times.milliseconds, times.ranges, strict=True):
        of_model = []
        for row, milliseconds, between in zip(rows, *columns, strict=True):
            of_model.append(replace(row, frame_ms=milliseconds, frame_ms_range=between))
        timed.append(of_model)
    return timed, times.notes


def make_quality_table(
    rows: Sequence[Row],
    measured: Gaussians,
    scene: Scene,
    against: str,
    origin: Origin,
) -> QualityTable:
    """The quality table of rows measured on this machine.

    Args:
        against: what the rows compare with: "photographs", or renders of the "checkpoint".
        origin: of the file.

    Raises:
        ClodError: a PSNR is infinite.
    """
    assert measured.attenuation is not None
    camera = scene.test[0].camera
    machine = machine_name(measured.means.device.type)
    stored = list(spread(tuple(dict.fromkeys(scene.train)), VIEWPOINTS))  # each once
    if against != "photographs":  # of placed cameras some look at little; viewers open at the first
        stored.sort(key=_interest, reverse=True)
    return QualityTable.of(
        rows,
        total=len(measured),
        views=len(scene.test),
        size=(camera.width, camera.height),
        machine=machine,
        against=against,
        viewpoints=[
            viewpoint_of(each.camera, measured.means, measured.attenuation).moved(origin)
            for each in stored
        ],
    )


def _interest(view: View) -> float:
    """The mean squared difference of neighbouring pixels: large for many sharp contrasts, and small
    behind a wall, where contrasts are blurred.
    """
    image = view.image.float().mean(2)
    down = image.diff(dim=0).square().mean()
    across = image.diff(dim=1).square().mean()
    return float(down + across)
