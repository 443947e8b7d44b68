"""The examples run as they stand."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import clod_adapter

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("[0-9]*.py"))


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs an example by its number with these arguments, in the test's folder; returns what it printed."""
    monkeypatch.chdir(tmp_path)

    def start(number: int, *words: object) -> str:
        monkeypatch.setattr(sys, "argv", [EXAMPLES[number - 1].name, *map(str, words)])
        runpy.run_path(str(EXAMPLES[number - 1]), run_name="__main__")
        return capsys.readouterr().out

    return start


def test_both(run: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    adapt = clod_adapter.adapt
    monkeypatch.setattr(
        clod_adapter, "adapt", lambda base, scene, config: adapt(base, scene, config.__class__(iters=5))
    )
    printed = run(1, capture.ply, capture.scene, "dial.ply")
    assert "dial 5:" in printed and clod_adapter.load("dial.ply").gaussians.sigma_d is not None
    for scene, size in (((), (320, 240)), ((capture.scene,), (64, 48))):
        assert "of 300 Gaussians" in run(2, "dial.ply", *scene)
        names = [f"dial_sv{dial}.png" for dial in (1, 2, 3, 5)]
        assert sorted(path.name for path in tmp_path.glob("*.png")) == names
        pictures = [Image.open(name) for name in names]
        assert {picture.size for picture in pictures} == {size}
        assert len({picture.tobytes() for picture in pictures}) == 4


def test_a_scene_without_held_out_views(run: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = clod_adapter.load_scene(capture.scene)
    monkeypatch.setattr(clod_adapter, "load_scene", lambda folder, **_: clod_adapter.Scene(scene.train, (), ()))
    assert "of 300 Gaussians" in run(2, capture.ply, capture.scene)


@pytest.mark.parametrize("number", [1, 2])
def test_misuse_is_explained(run: Any, number: int) -> None:
    with pytest.raises(SystemExit, match=f"python examples/{EXAMPLES[number - 1].name}"):
        run(number)
    with pytest.raises(SystemExit, match="error: missing.ply: .*check the path"):
        run(number, "missing.ply", "nowhere")


def test_numbers_have_no_gaps() -> None:
    assert [int(path.name[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))
