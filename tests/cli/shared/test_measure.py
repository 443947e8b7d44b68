"""Frame times of reports and calibrations: those that were timed together, and the note of a busy machine."""

from __future__ import annotations

import json
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli.shared import measure
from clod_adapter.evaluation import frame_times
from clod_adapter.evaluation.frame_times import FrameTimes, Model
from runs import pressing


@pytest.fixture
def timed(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """Frames take 1000/s ms, and those of the k-th model k times that; returns the counts of the models."""
    seen = list[list[int]]()

    def times(models: Sequence[Model], cameras: Any, progress: Any) -> FrameTimes:
        seen.append([len(some) for some, _ in models])
        found = tuple(tuple(1000.0 * (k + 1) / s for s in dials) for k, (_, dials) in enumerate(models))
        return FrameTimes(found, 0.5)

    monkeypatch.setattr(measure, "time_frames", times)
    monkeypatch.setattr(frame_times, "NOISY", 0.2)
    return seen


def test_adapt_times_base_and_result_together(clod: Any, capture: Any, tmp_path: Path, timed: list[list[int]]) -> None:
    words = (capture.ply, "--images", capture.scene, "--iters", 2, "--max-sv", 4, "--out", "dial.ply", "--json")
    done = clod(*words)
    report, table = json.loads(done.out), clod_adapter.load(tmp_path / "dial.ply").calibration
    assert timed == [[300, 300, 300]] and table is not None
    assert [row.frame_ms * row.virtual_scale for row in table.rows] == pytest.approx([2000] * 5)
    assert (report["base_rows"][0]["frame_ms"], report["detached_row"]["frame_ms"]) == (1000, 3000)
    assert any("frame times are rough: they varied by 50%" in note for note in report["notes"])
    assert done.err.count("frame times are rough") == 1


def test_eval_keeps_the_order_of_its_rows(clod: Any, capture: Any, dialled: Path, timed: list[list[int]]) -> None:
    words = ("eval", dialled, "--images", capture.scene, "--sv", 3, 1, "--json")
    report = json.loads(clod(*words).out)
    assert [(row["virtual_scale"], row["frame_ms"]) for row in report["rows"]] == [
        (3, pytest.approx(1000 / 3)),
        (1, 1000),
    ]
    assert any("frame times are rough" in note for note in report["notes"])


def test_an_interrupt_keeps_the_rows(clod: Any, capture: Any, dialled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_times, "render", pressing(frame_times.render, signal.SIGINT, at=7))
    done = clod("eval", dialled, "--images", capture.scene, "--sv", 1, 3, "--json")
    report = json.loads(done.out)
    assert report["interrupted"] and len(report["rows"]) == 2 and report["rows"][0]["frame_ms"] > 0, done
