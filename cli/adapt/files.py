"""Writes adapter, PLY and report, which appear together."""

from __future__ import annotations

from typing import Any

from clod_adapter.adapter import Adapter
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.adapter_file import save_adapter
from clod_adapter.io.atomic import atomic_paths
from clod_adapter.io.checkpoint import Checkpoint, save

from ..shared.files import Outputs
from ..shared.report import write_report


def write(
    base: Checkpoint, adapter: Adapter, result: Gaussians, outputs: Outputs, report: dict[str, Any]
) -> dict[str, Any]:
    """Writes the three files; returns the report with the calibration and the sizes of the other two.

    All three are complete, beside those of an earlier run, before the first replaces its predecessor. Only a kill
    between two renames leaves files of different runs; if one cannot be written, the earlier files stay.
    """
    with atomic_paths(outputs.adapter, outputs.ply, outputs.report) as (small, large, about):
        save_adapter(small, adapter)
        save(large, result, base, version=adapter.version, calibration=adapter.calibration)
        sizes = {"adapter_bytes": small.stat().st_size, "ply_bytes": large.stat().st_size}
        full = report | {"calibration": adapter.calibration and adapter.calibration.as_dict(), **sizes}
        write_report(about, full)
    return full
