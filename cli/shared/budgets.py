"""Budgets of the command line, solved for a model and the cameras that a command has; and the calibration they use."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from clod_adapter.calibration import Calibration, Viewpoint
from clod_adapter.cameras import Camera, Scene
from clod_adapter.distances import viewpoint_of
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.budget import dial_for, dial_for_times, frame_times
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import spread
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.origin import Origin

from .console import Console
from .dials import given_budget
from .kernels import prepare_kernels
from .report import machine_name

VIEWPOINTS = 16  # training cameras that a calibration stores, at most, evenly spread: all 84 baked 0.006 dB better


def solve_dials(
    args: argparse.Namespace,
    model: Checkpoint,
    cameras: Sequence[Camera | Viewpoint],
    console: Console,
    *,
    baked: bool = False,
) -> tuple[list[float] | None, list[str]]:
    """The dial values of --sv or of a budget, None where neither is given; and notes on how they were found.

    Args:
        cameras: those that the command renders, or bakes for. Where none of them has a picture, as those stored with
            a file, frame times are what is stored.
        baked: whether a count is of the file that is baked for the cameras, and not the mean over them.
    """
    budget = given_budget(args)
    if budget is None:
        return args.sv, []
    name, option, values = budget
    seen = [camera for camera in cameras if isinstance(camera, Camera)]
    times, notes = time_frames(model, seen, console) if name == "fps" and seen else (None, [])
    stored = model.calibration
    if stored is None and times is None and name != "keep":  # what the header has, the reader has found unusable
        why = next((note for note in model.notes if "calibration" in note), "there is no calibration in the header")
        raise ClodError(f"{model.path}: {option}: {why}; adapt it again, or give --sv or --keep")
    if name == "psnr_drop" and stored is not None and stored.against == "checkpoint":
        notes.append(
            "--psnr-drop goes by the calibration, which no photographs were there for: it is against the checkpoint's "
            "own pictures"
        )
    origin = ""
    if name == "fps" and stored is not None and times is None:
        origin = f" (frame times of {stored.machine} at {stored.width}x{stored.height})"
    dials = []
    for value in values:
        try:
            if times:
                solved = dial_for_times(times, value)
            else:
                budgets = {name: value}
                solved = dial_for(model.gaussians, **budgets, cameras=cameras, calibration=stored, baked=baked)
        except ClodError as error:
            raise ClodError(f"{option} {value:g}: {error}{origin}") from error
        dials.append(solved.virtual_scale)
        notes.append(f"{option} {value:g}: s = {solved.virtual_scale:.5g}{solved.note and f' ({solved.note})'}{origin}")
    return dials, notes


def time_frames(
    model: Checkpoint, cameras: Sequence[Camera], console: Console
) -> tuple[list[tuple[float, float]], list[str]]:
    """``budget.frame_times``, with its progress, and a note on how long frames take."""
    prepare_kernels(console, model.gaussians.means.device, training=False)
    with console.meter("timing") as meter:
        times = frame_times(
            model.gaussians, cameras, progress=lambda done, total: meter.update(done / total, f"{done}/{total}")
        )
    (first, slow), (last, fast) = times[0], times[-1]
    return times, [f"frames timed here: {slow:.1f} ms at s = {first:g}, {fast:.1f} ms at s = {last:g}"]


def calibrate(rows: Sequence[Row], measured: Gaussians, scene: Scene, against: str, origin: Origin) -> Calibration:
    """The table of the rows just measured here, where the Gaussians are; a ClodError where a PSNR is infinite."""
    assert measured.attenuation is not None
    camera, machine = scene.test[0].camera, machine_name(measured.means.device.type)
    stored = [view.camera for view in spread(scene.train, VIEWPOINTS)]
    viewpoints = [viewpoint_of(each, measured.means, measured.attenuation).moved(origin) for each in stored]
    return Calibration.of(
        rows, total=len(measured), views=len(scene.test), size=(camera.width, camera.height), machine=machine,
        against=against, viewpoints=viewpoints,
    )  # fmt: skip
