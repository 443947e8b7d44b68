"""Frame times of reports and calibrations: those that were timed together, and the note of a busy machine."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli.shared import measure
from clod_adapter.evaluation import frame_times
from clod_adapter.evaluation.frame_times import FrameTimes, Model


def test_frames_are_timed_together(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of base, result and plain file; frames take 1000/s ms, and those of the k-th model k times that."""
    seen = list[list[int]]()

    def times(models: Sequence[Model], cameras: Any, progress: Any) -> FrameTimes:
        seen.append([len(some) for some, _ in models])
        found = tuple(tuple(1000.0 * (k + 1) / s for s in dials) for k, (_, dials) in enumerate(models))
        return FrameTimes(found, 0.5)

    monkeypatch.setattr(measure, "time_frames", times)
    monkeypatch.setattr(frame_times, "NOISY", 0.2)
    scene = ("--images", capture.scene, "--json")
    done = clod(capture.ply, *scene, "--iters", 2, "--max-sv", 4, "--out", "dial.ply")
    report, table = json.loads(done.out), clod_adapter.load("dial.ply").calibration
    assert seen == [[300, 300, 300]] and table is not None
    assert [row.frame_ms * row.virtual_scale for row in table.rows] == pytest.approx([2000] * 5)
    assert (report["base_rows"][0]["frame_ms"], report["detached_row"]["frame_ms"]) == (1000, 3000)
    assert any("frame times are rough: they varied by 50%" in note for note in report["notes"])
    assert done.err.count("frame times are rough") == 1
    rows = json.loads(clod("eval", "dial.ply", *scene, "--sv", 3, 1).out)["rows"]
    assert [(row["virtual_scale"], round(row["frame_ms"])) for row in rows] == [(3, 333), (1, 1000)]
