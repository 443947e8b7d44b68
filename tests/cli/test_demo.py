"""``clod-adapt demo``, with the long parts replaced."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from clod_adapter import config
from clod_adapter.cli import demo
from clod_adapter.cli.adapt import report, resume, saver
from clod_adapter.cli.adapt.result import Measurements
from clod_adapter.cli.main import build_parser

PICTURES = ("dial.png", "curve.png")


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch, capture: Any) -> None:
    """The tests' own capture in place of the gallery, a few steps, and empty pictures."""

    def unpack(scene: Path, base: Path) -> None:
        shutil.copytree(capture.scene, scene, dirs_exist_ok=True)
        shutil.copyfile(capture.ply, base)

    def draw(scene: Path, base: Path, model: Path, report: dict[str, Any], pictures: dict[str, Path]) -> None:
        for path in pictures.values():
            path.write_bytes(b"")

    monkeypatch.setattr(demo, "unpack", unpack)
    monkeypatch.setattr(demo, "draw", draw)
    monkeypatch.setattr(config, "STEPS", 2)
    monkeypatch.setattr(config, "STEPS_PER_VIEW", 0)
    monkeypatch.setattr(report, "LOST", (99.0, 99.0))  # two steps cannot keep full quality


def test_demo_names_its_files_and_the_next_command(clod: Any, short: None, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    done = clod("demo", "--out", "here")
    assert done.code == 0, done
    assert f"everything is in {tmp_path / 'here'}" in done.out and "clod-adapt YOURS.ply" in done.out
    found = json.loads(clod("demo", "--out", "here", "--quiet", "--json").out)
    assert found["command"] == "demo" and found["folder"] == "here"
    assert found["pictures"] == {"dial": "here/dial.png", "curve": "here/curve.png"}
    made = {path.name for path in (tmp_path / "here").iterdir()}
    assert made == {"capture", "base.ply", "gallery.ply", "gallery.safetensors", "gallery.json", *PICTURES}


def test_figures_that_were_not_drawn_are_not_reported(
    clod: Any, short: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(report, "measure_result", lambda *_: Measurements(interrupted=True))
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "dial.png").write_text("of an earlier run of clod_adapter")
    done = clod("demo", "--json")
    assert done.code == 0 and json.loads(done.out)["pictures"] == {} and "no figures" in done.err
    assert not any((tmp_path / "demo" / name).exists() for name in PICTURES)


def test_missing_package_is_named_at_the_start(clod: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    done = clod("demo")
    assert done.code == 2 and "matplotlib: pip install matplotlib" in done.err
    assert list(tmp_path.iterdir()) == []


def test_arguments_for_adapting() -> None:
    flags = ["--quiet", "--json"]
    args = build_parser("demo").parse_args(["--out=-odd", *flags])
    files = [Path("-odd") / name for name in ("base.ply", "capture", "gallery.ply")]
    given = demo.adapt_arguments(args, *files)
    words = ["--images=-odd/capture", "--max-sv=5", "--out=-odd/gallery.ply", *flags, "--"]
    words.append("-odd/base.ply")
    assert vars(given) == vars(build_parser("").parse_args(words))


def test_interrupted_demo_is_resumed(
    clod: Any, short: None, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A state that cannot be resumed is an error that does not name --resume, which the demo does not have."""
    pytest.importorskip("matplotlib")

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(saver.Saver, "keep", stop)
        assert clod("demo").code == 130
    state = tmp_path / "demo" / "gallery.resume.safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(resume, "package_version", lambda: "0.0.7")
        done = clod("demo")
    assert done.code == 2 and f"{state.relative_to(tmp_path)}: is of version" in done.err, done
    assert "delete it to start over" in done.err and "--resume" not in done.err and state.exists()
    done = clod("demo", "--json")
    assert done.code == 0 and json.loads(done.out)["resumed_from"] == 1 and not state.exists(), done
