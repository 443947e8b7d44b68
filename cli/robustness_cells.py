"""The cells of the robustness experiment on disk: what each is, whether it is there already, and writing it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clod_adapter._support.text import as_text
from clod_adapter.config import CLASSIC, AdaptConfig
from clod_adapter.evaluation.robustness import BASELINE_SHARES, Outcome
from clod_adapter.io.adapter_file import save_adapter
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.version import package_version

from .shared.report import machine, write_report


@dataclass(frozen=True)
class Cell:
    """One checkpoint at one range, or its baseline.

    Attributes:
        label: names the checkpoint.
        config: of the adaptation; None of the baseline.
        points: where it is measured: dial values, or shares of the baseline.
        inputs: fingerprints of checkpoint and scene.
        folder: of the cells.
    """

    label: str
    checkpoint: Checkpoint
    config: AdaptConfig | None
    points: tuple[float, ...]
    inputs: dict[str, str]
    folder: Path

    @property
    def name(self) -> str:
        return f"{self.label}_sv{self.config.max_sv:g}" if self.config else f"{self.label}_base"

    @property
    def rows_file(self) -> Path:
        return self.folder / f"{self.name}.json"

    @property
    def adapter_file(self) -> Path:
        return self.folder / f"{self.name}.safetensors"

    def key(self) -> dict[str, Any]:
        """What the result depends on, as JSON gives it back."""
        config = asdict(self.config) if self.config else None
        return {"version": package_version(), "config": config, "points": list(self.points), **self.inputs}

    def read(self) -> dict[str, Any] | None:
        """The finished cell, or None where there is none of this key."""
        try:
            found = json.loads(self.rows_file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        same = isinstance(found, dict) and found.get("key") == self.key()
        return found if same and (self.config is None or self.adapter_file.is_file()) else None

    def write(self, outcome: Outcome) -> dict[str, Any]:
        """Writes the adapter and then the rows, whose presence says that the cell is finished."""
        self.rows_file.unlink(missing_ok=True)
        if outcome.adapter:
            save_adapter(self.adapter_file, outcome.adapter)
        cell = {
            "checkpoint": as_text(self.label), "max_sv": self.config.max_sv if self.config else None,
            "adapter": str(self.adapter_file) if outcome.adapter else None, "seconds": round(outcome.seconds, 3),
            "rows": outcome.rows, "distribution": outcome.distribution, "machine": machine(), "key": self.key(),
        }  # fmt: skip
        write_report(self.rows_file, cell)
        return cell

    def cost(self, train_views: int, test_views: int) -> float:
        """About how long it takes, in rendered frames; a training step is taken for three."""
        measuring = float(len(self.points) * test_views)
        if self.config is None:
            return measuring
        return measuring + 3 * (self.config.batch * self.config.iters + min(train_views, 64))


def cells_of(
    label: str, checkpoint: Checkpoint, configs: list[AdaptConfig], dials: list[float], scene: str, folder: Path
) -> list[Cell]:
    """The baseline of a checkpoint, which is quick, and its ranges."""
    inputs = {"checkpoint_sha256": checkpoint.fingerprint, "scene_sha256": scene}
    if checkpoint.gaussians.screen_filter != CLASSIC:
        inputs["screen_filter"] = repr(checkpoint.gaussians.screen_filter)
    first = Cell(label, checkpoint, None, BASELINE_SHARES, inputs, folder)
    return [first, *(Cell(label, checkpoint, config, tuple(dials), inputs, folder) for config in configs)]
