"""The cells of the robustness experiment on disk."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clod_adapter._support.text import as_text
from clod_adapter._support.version import package_version
from clod_adapter.config import CLASSIC, AdaptConfig
from clod_adapter.evaluation.robustness import BASELINE_SHARES, CellResult
from clod_adapter.io.adapter_file import save_adapter
from clod_adapter.io.checkpoint import Checkpoint

from .commands.robustness import cell_name
from .shared.measure import machine
from .shared.outputs import write_report


@dataclass(frozen=True)
class Cell:
    """One checkpoint at one range, or its baseline.

    Attributes:
        label: names the checkpoint.
        config: of the adaptation; None for the baseline.
        points: dial values, or shares of the baseline, that are measured.
        inputs: fingerprints of checkpoint and scene.
        folder: of all cells.
    """

    label: str
    checkpoint: Checkpoint
    config: AdaptConfig | None
    points: tuple[float, ...]
    inputs: dict[str, str]
    folder: Path

    @property
    def name(self) -> str:
        return cell_name(self.label, self.config.max_sv if self.config else None)

    @property
    def rows_file(self) -> Path:
        return self.folder / f"{self.name}.json"

    @property
    def adapter_file(self) -> Path:
        return self.folder / f"{self.name}.safetensors"

    def key(self) -> dict[str, Any]:
        """Everything that the result depends on, as JSON."""
        config = asdict(self.config) if self.config else None
        return {"version": package_version(), "config": config, "points": list(self.points), **self.inputs}

    def read(self) -> dict[str, Any] | None:
        """The finished cell, or None if there is none with this key."""
        try:
            found = json.loads(self.rows_file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        same = isinstance(found, dict) and found.get("key") == self.key()
        return found if same and (self.config is None or self.adapter_file.is_file()) else None

    def write(self, result: CellResult) -> dict[str, Any]:
        """Writes the adapter and then the rows, which mark the cell as finished."""
        self.rows_file.unlink(missing_ok=True)
        if result.adapter:
            save_adapter(self.adapter_file, result.adapter)
        cell = {
            "checkpoint": as_text(self.label), "max_sv": self.config.max_sv if self.config else None,
            "adapter": str(self.adapter_file) if result.adapter else None, "seconds": round(result.seconds, 3),
            "rows": result.rows, "distribution": result.distribution, "machine": machine(), "key": self.key(),
        }  # fmt: skip
        write_report(self.rows_file, cell)
        return cell

    def cost(self, train_views: int, test_views: int) -> float:
        """Approximate cost in rendered frames; a training step counts as three."""
        measuring = float(len(self.points) * test_views)
        if self.config is None:
            return measuring
        return measuring + 3 * (self.config.batch * self.config.for_views(train_views).steps + min(train_views, 64))


def cells_of(
    label: str, checkpoint: Checkpoint, configs: list[AdaptConfig], dials: list[float], scene: str, folder: Path
) -> list[Cell]:
    """The baseline of a checkpoint and its ranges."""
    inputs = {"checkpoint_sha256": checkpoint.fingerprint, "scene_sha256": scene}
    if checkpoint.gaussians.screen_filter != CLASSIC:
        inputs["screen_filter"] = repr(checkpoint.gaussians.screen_filter)
    first = Cell(label, checkpoint, None, BASELINE_SHARES, inputs, folder)
    return [first, *(Cell(label, checkpoint, config, tuple(dials), inputs, folder) for config in configs)]
