"""Dial values: solved from budgets, measured with progress, and shown in tables."""

import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from clod_adapter import (
    Camera,
    Checkpoint,
    ClodError,
    Gaussians,
    Phase,
    Stopped,
    View,
    dial_for,
    evaluate,
)
from clod_adapter.evaluation.budget import dial_for_times, frame_times
from clod_adapter.evaluation.calibrate import with_frame_times
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.progress import GracefulStop
from clod_adapter.quality_table import Viewpoint

from .command import given_budget
from .console import Console
from .inputs import prepare_kernels
from .outputs import Report


class Stopwatch:
    """Named wall times, for the report."""

    def __init__(self) -> None:
        self.began = time.perf_counter()
        self.seconds: dict[str, float] = {}

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Adds the time of the block to ``name``."""
        began = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

    def report(self) -> dict[str, float]:
        return {
            name: round(value, 3) for name, value in {**self.seconds, "total": self.total()}.items()
        }

    def total(self) -> float:
        return time.perf_counter() - self.began


def by_dial(rows: Sequence[Row]) -> list[tuple[str, Row]]:
    return [(f"{row.virtual_scale:.5g}", row) for row in rows]


def table(marked: Sequence[tuple[str, Row]]) -> str:
    """A table of labelled rows; beside a frame time half the range of the passes."""
    width = max(6, *(len(label) for label, _ in marked))
    lines = [f"{'dial':>{width}}  PSNR dB    SSIM        kept            in view      frame ms"]
    for label, row in marked:
        kept = f"{row.kept:10,.0f}  {row.kept_share:6.1%}  {row.in_view:9,.0f}  {row.frame_ms:6.1f}"
        spread = "" if row.frame_ms_range is None else f"±{row.frame_ms_range / 2:.1f}"
        lines.append(f"{label:>{width}}  {row.psnr:7.2f}  {row.ssim:.4f}  {kept} {spread:5}")
    return "\n".join(lines)


POPPING = """\
popping: change of the image per step, in levels of 255 (RMS over the image,
largest change of a pixel). Halving the step halves the largest change of a
fade (0.5), but not that of a jump (1.0):
  steps     mean  largest     at  / mean  halved   pixel  halved"""


def popping_table(sweeps: Sequence[Report]) -> str:
    text = POPPING
    for sweep in sweeps:
        text += (
            "\n{moved}\n  {steps:5}  {mean:7.4f}  {largest:7.4f}  {at:5.2f}  {ratio:6.1f}"
            "  {persistence:6.2f}  {pixel:6.1f}  {pixel_persistence:6.2f}"
        ).format(**sweep)
    return text


DIALS = (1.0, 2.0, 3.0, 5.0)


def choose_dials(given: list[float] | None, model: Checkpoint, console: Console) -> list[float]:
    """The dial values to measure; a note if they are outside the trained range, or there is no
    dial.
    """
    attenuation = model.gaussians.attenuation
    if attenuation is None:
        dials = given or list(DIALS)
        if max(dials) > 1:
            console.note(f"{model.path} has no sigma_d, so every dial value renders all of it")
        return dials
    trained = attenuation.max_sv
    dials = given or [*(s for s in DIALS if s < trained), trained]
    if max(dials) > trained:
        console.note(f"trained up to s = {trained:g}; beyond, the dial is untrained")
    return dials


def measure(
    gaussians: Gaussians,
    views: Sequence[View],
    dials: Sequence[float],
    console: Console,
    stop: GracefulStop,
    label: str = "measure",
) -> list[Row]:
    """The rows of the dial values; those that were finished when ``stop`` heard a signal, none
    without views.
    """
    if stop.requests or not views:
        return []
    with console.meter(label) as meter:
        return evaluate(gaussians, views, dials, progress=stop.stop_on_signal(meter))


def comparable(
    measured: Sequence[tuple[Gaussians, list[Row]]],
    views: Sequence[View],
    console: Console,
    stop: GracefulStop,
) -> list[list[Row]]:
    """The rows of each model by ``with_frame_times``; unchanged after a signal, or where there are
    none.
    """
    unchanged = [rows for _, rows in measured]
    if stop.requests or not any(unchanged):
        return unchanged
    try:
        with console.meter(Phase.FRAME_TIMES) as meter:
            found, notes = with_frame_times(measured, views, stop.stop_on_signal(meter))
    except Stopped:
        return unchanged
    console.note(*notes)
    return found


def solve_dials(
    args: Namespace,
    model: Checkpoint,
    cameras: Sequence[Camera | Viewpoint],
    console: Console,
    *,
    baked: bool = False,
) -> list[float] | None:
    """The dial values of --sv or of a budget, None without either.

    Args:
        cameras: those that the command renders, or bakes for. Where none of them has an image size,
            as those stored in a file, frame times are those of the quality table.
        baked: whether a count is of the file baked for the cameras, and not the mean over them.
    """
    budget = given_budget(args)
    if budget is None:
        return args.sv
    name, option, values = budget
    renderable = [camera for camera in cameras if isinstance(camera, Camera)]
    quality_table = model.quality_table
    times, machine = None, ""
    if name == "fps" and renderable:
        prepare_kernels(console, model.gaussians.means.device, training=False)
        with console.meter("timing") as meter:
            times, notes = frame_times(model.gaussians, renderable, progress=meter)
        (first, slow), (last, fast) = times[0], times[-1]
        console.note(
            f"frames timed here: {slow:.1f} ms at s = {first:g}, {fast:.1f} ms at s = {last:g}",
            *notes,
        )
    elif name != "keep":
        if quality_table is None:
            why = [note for note in model.notes if "quality table" in note]
            why.append("there is no quality table in the header")
            raise ClodError(
                f"{model.path}: {option}: {why[0]}; adapt it again, or give --sv or --keep"
            )
        if name == "fps":
            size = f"{quality_table.width}x{quality_table.height}"
            machine = f" (frame times of {quality_table.machine} at {size})"
        elif quality_table.against == "checkpoint":
            console.note(
                "--psnr-drop uses a quality table made without photographs, against renders of the"
                " checkpoint"
            )
    dials = []
    for value in values:
        asked = f"{option} {value:.12g}"
        budget_for: dict[str, Any] = {name: value, "cameras": cameras, "baked": baked}
        try:
            if times:
                solved = dial_for_times(times, value)
            else:
                solved = dial_for(model.gaussians, quality_table=quality_table, **budget_for)
        except ClodError as error:
            raise ClodError(f"{asked}: {error}{machine}") from error
        dials.append(solved.virtual_scale)
        more = solved.note and f" ({solved.note})"
        console.note(f"{asked}: s = {solved.virtual_scale:.5g}{more}{machine}")
    return dials
