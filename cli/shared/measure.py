"""Dial values: solved from budgets, measured with progress, and shown in tables."""

import os
import platform
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from clod_adapter.calibration import Calibration, Viewpoint
from clod_adapter.cameras import Camera, Scene, View, spread
from clod_adapter.equation.distances import viewpoint_of
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.budget import dial_for, dial_for_times, frame_times
from clod_adapter.evaluation.evaluate import Row, evaluate
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.evaluation.popping import Popping
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.origin import Origin
from clod_adapter.progress import GracefulStop, Phase, Stopped

from .command import given_budget, no_calibration
from .console import Console
from .inputs import prepare_kernels

# Round values, each about 1.4 times the last, or more between 1 and 5.
REPORT_DIALS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0)


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
        return {name: round(value, 3) for name, value in {**self.seconds, "total": self.total()}.items()}

    def total(self) -> float:
        return time.perf_counter() - self.began


def machine() -> dict[str, Any]:
    gpu = {"gpu": torch.cuda.get_device_name()} if torch.cuda.is_available() else {}
    versions = {"python": platform.python_version(), "torch": torch.__version__, "numba": numba.__version__}
    return gpu | {"cpu": _cpu_name(), "cores": os.cpu_count(), "threads": torch.get_num_threads()} | versions


def machine_name(device: str = "cpu") -> str:
    """The hardware that determines frame times on that type of device."""
    about = machine()
    return about["gpu"] if device == "cuda" else f"{about['cpu']}, {about['threads']} threads"


def _cpu_name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def report_dials(max_sv: float) -> list[float]:
    """The dial values of a report, in about even steps of their logarithm; the last one is ``max_sv``."""
    return [s for s in REPORT_DIALS if s < max_sv] + [max_sv]


def by_dial(rows: Sequence[Row]) -> list[tuple[str, Row]]:
    return [(f"{row.virtual_scale:.5g}", row) for row in rows]


def table(marked: Sequence[tuple[str, Row]]) -> str:
    """A table of labelled rows."""
    width = max(6, *(len(label) for label, _ in marked))
    lines = [f"{'dial':>{width}}  PSNR dB    SSIM        kept            in view  frame ms"]
    for label, row in marked:
        kept = f"{row.kept:10,.0f}  {row.kept_share:6.1%}  {row.in_view:9,.0f}  {row.frame_ms:8.1f}"
        lines.append(f"{label:>{width}}  {row.psnr:7.2f}  {row.ssim:.4f}  {kept}")
    return "\n".join(lines)


POPPING = """\
popping: change of the image per step, in levels of 255 (RMS over the image,
largest change of a pixel). Halving the step halves the largest change of a
fade (0.5), but not that of a jump (1.0):
  steps     mean  largest     at  / mean  halved   pixel  halved"""


def popping_table(results: Sequence[tuple[str, Popping]]) -> str:
    text = POPPING
    for moved, p in results:
        text += f"\n{moved}\n  {p.steps:5}  {p.mean:7.4f}  {p.largest:7.4f}  {p.at:5.2f}  {p.ratio:6.1f}"
        text += f"  {p.persistence:6.2f}  {p.pixel:6.1f}  {p.pixel_persistence:6.2f}"
    return text


DIALS = (1.0, 2.0, 3.0, 5.0)


def choose_dials(given: list[float] | None, model: Checkpoint, console: Console) -> list[float]:
    """The dial values to measure; a note if they are outside the trained range, or there is no dial."""
    attenuation = model.gaussians.attenuation
    trained = attenuation.max_sv if attenuation else None
    dials = given or [s for s in DIALS if trained is None or s < trained] + ([trained] if trained else [])
    if max(dials) > (trained or 1):
        untrained = f"trained up to s = {trained or 0:g}; larger dial values were not trained"
        console.note(untrained if trained else f"{model.path} has no sigma_d, so every dial value renders all of it")
    return dials


def measure(
    gaussians: Gaussians, views: Sequence[View], dials: Sequence[float], console: Console, stop: GracefulStop,
    label: str = "measure",
) -> list[Row]:  # fmt: skip
    """The rows of the dial values; those that were finished when ``stop`` heard a signal, none without views."""
    with console.meter(label) as meter:
        return evaluate(gaussians, views, dials, progress=stop.heeding(meter)) if views and not stop.requests else []


def with_frame_times(
    measured: Sequence[tuple[Gaussians, list[Row]]], views: Sequence[View], console: Console, stop: GracefulStop
) -> list[list[Row]]:
    """The rows of each model with frame times that can be compared; unchanged after a signal."""
    jobs = [(model, sorted({row.virtual_scale for row in rows})) for model, rows in measured]
    found = [rows for _, rows in measured]
    if stop.requests or not any(found):
        return found
    try:
        with console.meter(Phase.FRAME_TIMES) as meter:
            times = time_frames(jobs, [view.camera for view in views], stop.heeding(meter))
    except Stopped:
        return found
    console.note(*times.notes)
    for k, ((_, dials), taken) in enumerate(zip(jobs, times.milliseconds, strict=True)):
        found[k] = [replace(row, frame_ms=taken[dials.index(row.virtual_scale)]) for row in found[k]]
    return found


BLOCK = 8  # pixels
VIEWPOINTS = 16  # most training cameras stored in a calibration: all 84 baked 0.006 dB better


def solve_dials(
    args: Namespace, model: Checkpoint, cameras: Sequence[Camera | Viewpoint], console: Console, *, baked: bool = False
) -> list[float] | None:
    """The dial values of --sv or of a budget, None without either.

    Args:
        cameras: those that the command renders, or bakes for. Where none of them has an image size, as those stored in
            a file, frame times are those of the calibration.
        baked: whether a count is of the file baked for the cameras, and not the mean over them.
    """
    budget = given_budget(args)
    if budget is None:
        return args.sv
    name, option, values = budget
    whole, calibration = [camera for camera in cameras if isinstance(camera, Camera)], model.calibration
    times, machine = None, ""
    if name == "fps" and whole:
        prepare_kernels(console, model.gaussians.means.device, training=False)
        with console.meter("timing") as meter:
            times, notes = frame_times(model.gaussians, whole, progress=meter)
        (first, slow), (last, fast) = times[0], times[-1]
        console.note(f"frames timed here: {slow:.1f} ms at s = {first:g}, {fast:.1f} ms at s = {last:g}", *notes)
    elif name != "keep" and calibration is None:
        why = next((note for note in model.notes if "calibration" in note), "")
        raise no_calibration(model.path, option, why)
    elif name == "fps" and calibration is not None:
        machine = f" (frame times of {calibration.machine} at {calibration.width}x{calibration.height})"
    elif name == "psnr_drop" and calibration is not None and calibration.against == "checkpoint":
        console.note("--psnr-drop uses a calibration made without photographs, against renders of the checkpoint")
    dials = []
    for value in values:
        asked = f"{option} {value}" if isinstance(value, int) else f"{option} {value:g}"
        wanted: dict[str, Any] = {name: value, "cameras": cameras, "calibration": calibration, "baked": baked}
        try:
            solved = dial_for_times(times, value) if times else dial_for(model.gaussians, **wanted)
        except ClodError as error:
            raise ClodError(f"{asked}: {error}{machine}") from error
        dials.append(solved.virtual_scale)
        more = solved.note and f" ({solved.note})"
        console.note(f"{asked}: s = {solved.virtual_scale:.5g}{more}{machine}")
    return dials


def _interest(view: View) -> float:
    """Contrast times detail times sharpness: a camera behind a wall sees contrasts, but no sharp ones.

    The standard deviation of its image, the mean difference of neighbouring pixels, and that over the mean difference
    of neighbouring blocks of BLOCK pixels.
    """
    image = view.image.float().mean(2)
    detail, coarse = (_change(pixels) for pixels in (image, avg_pool2d(image[None], min(BLOCK, *image.shape))[0]))
    return float(image.std()) * detail**2 / max(coarse, 1e-6)


def _change(image: Tensor) -> float:
    return sum(float(image.diff(dim=dim).abs().mean()) for dim in (0, 1) if image.shape[dim] > 1)


def calibrate(rows: Sequence[Row], measured: Gaussians, scene: Scene, against: str, origin: Origin) -> Calibration:
    """The calibration of rows measured on this machine; a ClodError if a PSNR is infinite."""
    assert measured.attenuation is not None
    camera, machine = scene.test[0].camera, machine_name(measured.means.device.type)
    stored = list(spread(scene.train, VIEWPOINTS))
    if against != "photographs":  # of placed cameras some look at little; viewers open at the first
        stored.sort(key=_interest, reverse=True)
    viewpoints = [viewpoint_of(each.camera, measured.means, measured.attenuation).moved(origin) for each in stored]
    return Calibration.of(
        rows, total=len(measured), views=len(scene.test), size=(camera.width, camera.height), machine=machine,
        against=against, viewpoints=viewpoints,
    )  # fmt: skip
