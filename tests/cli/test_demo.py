"""``clod-adapt demo``, with a few steps on the tests' own capture."""

import json
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest

from clod_adapter import config
from clod_adapter.cli.adapt import listeners
from clod_adapter.cli.adapt import run as adapt_run
from clod_adapter.demo import gallery
from runs import pressing

PICTURES = {"dial.png", "curve.png"}


def test_demo(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It names its files and the next command, resumes, and reports no figures that were not drawn.

    A state that cannot be resumed is an error that does not name --resume, which the demo does not have.
    """
    pytest.importorskip("matplotlib")

    def unpack(scene: Path, base: Path) -> None:
        shutil.copytree(capture.scene, scene, dirs_exist_ok=True)
        shutil.copyfile(capture.ply, base)

    monkeypatch.setattr(gallery, "unpack", unpack)  # the tests' own capture, a few steps, and empty pictures
    monkeypatch.setattr(gallery, "draw", lambda *given: [path.write_bytes(b"") for path in given[-1].values()])
    monkeypatch.setattr(config, "STEPS", 2)
    monkeypatch.setattr(config, "STEPS_PER_VIEW", 0)
    monkeypatch.setattr(adapt_run, "LOST", (99.0, 99.0))  # two steps cannot keep full quality
    folder = tmp_path / "-odd"
    state = folder / "gallery.resume.safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(listeners, "save_state", pressing(listeners.save_state, signal.SIGINT, signal.SIGTERM, at=2))
        assert clod("demo", "--out=-odd").code == 130
    with monkeypatch.context() as patch:
        patch.setattr(listeners, "package_version", lambda: "0.0.7")
        done = clod("demo", "--out=-odd")
    assert done.code == 2 and f"{state.relative_to(tmp_path)}: is of " in done.err, done
    assert "delete it to start over" in done.err and "--resume" not in done.err and state.exists()
    done = clod("demo", "--out=-odd", "--json")
    assert done.code == 0 and json.loads(done.out)["resumed_from"] == 1 and not state.exists(), done
    done = clod("demo", "--out=-odd")
    assert f"everything is in {folder}" in done.out and "clod-adapt YOURS.ply" in done.out and done.code == 0, done
    found = json.loads(clod("demo", "--out=-odd", "--quiet", "--json").out)
    assert found["command"] == "demo" and found["folder"] == "-odd" and found["scene"] == "-odd/capture"
    assert found["pictures"] == {"dial": "-odd/dial.png", "curve": "-odd/curve.png"} and found["config"]["max_sv"] == 5
    made = {path.name for path in folder.iterdir()}
    assert made == {"capture", "base.ply", "gallery.ply", "gallery.safetensors", "gallery.json", *PICTURES}
    monkeypatch.setattr(adapt_run, "extract", pressing(adapt_run.extract, signal.SIGINT))  # nothing is measured
    done = clod("demo", "--out=-odd", "--json")
    assert done.code == 0 and json.loads(done.out)["pictures"] == {} and "no figures" in done.err
    assert not PICTURES & {path.name for path in folder.iterdir()}
