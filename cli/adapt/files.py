"""What a run leaves: adapter, PLY and report, which appear together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from clod_adapter.adapter import Adapter
from clod_adapter.cameras import Scene
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.adapter_file import save_adapter
from clod_adapter.io.atomic import atomic_paths
from clod_adapter.io.checkpoint import Checkpoint, save

from ..shared.budgets import calibrate
from ..shared.console import Console
from ..shared.files import Outputs
from ..shared.interrupts import GracefulStop
from ..shared.report import write_report


def write(base: Checkpoint, adapter: Adapter, result: Gaussians, outputs: Outputs, report: dict[str, Any]) -> None:
    """Writes the three files, and adds to the report what it says of the other two.

    All are complete, beside those of an earlier run, before the first takes its place: nothing but a kill between two
    renames leaves files of which one is of another run, and where one cannot be written the earlier ones stay.
    """
    with atomic_paths(outputs.adapter, outputs.ply, outputs.report) as (small, large, about):
        save_adapter(small, adapter)
        save(large, result, base, version=adapter.version, calibration=adapter.calibration)
        sizes = {"adapter_bytes": small.stat().st_size, "ply_bytes": large.stat().st_size}
        full = report | {"calibration": adapter.calibration and adapter.calibration.as_dict(), **sizes}
        write_report(about, full)
    report |= full


def write_measured(
    base: Checkpoint, adapter: Adapter, result: Gaussians, rows: Sequence[Row], scene: Scene,
    outputs: Outputs, report: dict[str, Any], console: Console, stop: GracefulStop,
) -> None:  # fmt: skip
    """Writes the three files again, with the calibration that ``rows`` are.

    Where that is not possible, or a PSNR is infinite, those without it stay, and the console says so.
    """
    try:
        with stop.listening():
            calibrated = replace(adapter, calibration=calibrate(rows, result, scene, report["teacher"], base.origin))
            write(base, calibrated, result, outputs, report)
    except ClodError as error:
        console.say(f"the files are without the calibration, so --fps and --psnr-drop will not know it: {error}")
        write_report(outputs.report, report)
