"""Solves the budgets of the command line for dial values, and makes the calibration that they use."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from torch import Tensor
from torch.nn.functional import avg_pool2d

from clod_adapter.calibration import Calibration, Viewpoint
from clod_adapter.cameras import Camera, Scene, View, spread
from clod_adapter.equation.distances import viewpoint_of
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.budget import dial_for, dial_for_times, frame_times
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.origin import Origin

from .console import Console
from .kernels import prepare_kernels
from .options import given_budget
from .report import machine_name

BLOCK = 8  # pixels
VIEWPOINTS = 16  # most training cameras stored in a calibration: all 84 baked 0.006 dB better


def solve_dials(
    args: argparse.Namespace,
    model: Checkpoint,
    cameras: Sequence[Camera | Viewpoint],
    console: Console,
    *,
    baked: bool = False,
) -> tuple[list[float] | None, list[str]]:
    """The dial values of --sv or of a budget, None without either; and notes on the solution.

    Args:
        cameras: those that the command renders, or bakes for. Where none of them has an image size, as those stored in
            a file, frame times are those of the calibration.
        baked: whether a count is of the file baked for the cameras, and not the mean over them.
    """
    budget = given_budget(args)
    if budget is None:
        return args.sv, []
    name, option, values = budget
    whole = [camera for camera in cameras if isinstance(camera, Camera)]
    times, notes = time_frames(model, whole, console) if name == "fps" and whole else (None, [])
    calibration, machine = None if times else _calibration_for(name, option, model), ""
    if name == "psnr_drop" and calibration is not None and calibration.against == "checkpoint":
        notes.append("--psnr-drop uses a calibration made without photographs, against renders of the checkpoint")
    if name == "fps" and calibration is not None:
        machine = f" (frame times of {calibration.machine} at {calibration.width}x{calibration.height})"
    dials = []
    for value in values:
        asked = f"{option} {value}" if isinstance(value, int) else f"{option} {value:g}"
        try:
            if times:
                solved = dial_for_times(times, value)
            else:
                budgets = {name: value}
                solved = dial_for(model.gaussians, **budgets, cameras=cameras, calibration=calibration, baked=baked)
        except ClodError as error:
            raise ClodError(f"{asked}: {error}{machine}") from error
        dials.append(solved.virtual_scale)
        note = solved.note and f" ({solved.note})"
        notes.append(f"{asked}: s = {solved.virtual_scale:.5g}{note}{machine}")
    return dials, notes


def _calibration_for(name: str, option: str, model: Checkpoint) -> Calibration | None:
    """The stored calibration, which every budget but a count needs."""
    if model.calibration is None and name != "keep":
        why = next((note for note in model.notes if "calibration" in note), "there is no calibration in the header")
        raise ClodError(f"{model.path}: {option}: {why}; adapt it again, or give --sv or --keep")
    return model.calibration


def time_frames(
    model: Checkpoint, cameras: Sequence[Camera], console: Console
) -> tuple[list[tuple[float, float]], list[str]]:
    """``budget.frame_times`` with a progress bar, and notes on the result."""
    prepare_kernels(console, model.gaussians.means.device, training=False)
    with console.meter("timing") as meter:
        times, notes = frame_times(model.gaussians, cameras, progress=meter)
    (first, slow), (last, fast) = times[0], times[-1]
    return times, [f"frames timed here: {slow:.1f} ms at s = {first:g}, {fast:.1f} ms at s = {last:g}", *notes]


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
