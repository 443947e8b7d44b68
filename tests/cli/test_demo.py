"""``clod-adapt demo``, with a few steps on the tests' own capture; the scene of the package, and its pictures."""

import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from clod_adapter import config, evaluate, load, load_scene
from clod_adapter.cli.adapt import listeners
from clod_adapter.cli.adapt import run as adapt_run
from clod_adapter.demo import gallery
from clod_adapter.report.page import Picture
from runs import pressing

pytest.importorskip("matplotlib")
PICTURES = {"dial.png", "curve.png"}


def test_demo(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It names its files and the next command, resumes, and reports no figures that were not drawn.

    A state that cannot be resumed is an error that does not name --resume, which the demo does not have.
    """

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
        clod("demo --out=-odd", code=130)
    with monkeypatch.context() as patch:
        patch.setattr(listeners, "package_version", lambda: "0.0.7")
        done = clod("demo --out=-odd", code=2)
    assert f"{state.relative_to(tmp_path)}: is of " in done.err and "delete it to start over" in done.err, done
    assert "--resume" not in done.err and state.exists()
    assert clod("demo --out=-odd --json").report["resumed_from"] == 1 and not state.exists()
    done = clod("demo --out=-odd")
    assert f"everything is in {folder}" in done.out and "clod-adapt YOURS.ply" in done.out, done
    found = clod("demo --out=-odd --quiet --json").report
    assert found["command"] == "demo" and found["folder"] == "-odd" and found["scene"] == "-odd/capture"
    assert found["pictures"] == {"dial": "-odd/dial.png", "curve": "-odd/curve.png"} and found["config"]["max_sv"] == 5
    made = {path.name for path in folder.iterdir()}
    assert made == {"capture", "base.ply", "gallery.ply", "gallery.safetensors", "gallery.json", *PICTURES}
    monkeypatch.setattr(adapt_run, "extract", pressing(adapt_run.extract, signal.SIGINT))  # nothing is measured
    done = clod("demo --out=-odd --json")
    assert done.report["pictures"] == {} and "no figures" in done.err
    assert not PICTURES & {path.name for path in folder.iterdir()}


def test_scene_and_base_of_the_package(tmp_path: Path) -> None:
    """The base is trained to its end, and packing it and the photographs cost little."""
    files = [Path(gallery.__file__).with_name(name) for name in ("base.spz", "capture.zip")]
    assert files[0].stat().st_size < 2e6 and sum(path.stat().st_size for path in files) < 3e6
    capture, base = tmp_path / "capture", tmp_path / "base.ply"
    for _ in range(2):  # what exists is left
        gallery.unpack(capture, base)
    scene, checkpoint = load_scene(capture), load(base)
    assert (len(scene.train), len(scene.test), checkpoint.notes, scene.notes) == (70, 10, (), ())
    assert evaluate(checkpoint.gaussians, scene.test[:2], [0])[0].psnr > 30


def test_strip_shows_every_panel(tmp_path: Path) -> None:
    colours = [(200, 30, 30), (30, 160, 30), (30, 30, 200)]
    images = [np.full((30, 40, 3), colour, np.uint8) for colour in colours]
    panels = [Picture(image / 255 if k == 1 else image, "s = 1", "29.0 dB") for k, image in enumerate(images)]
    gallery.dial_strip(tmp_path / "strip.png", panels, "one view", crop=(10, 5, 16, 12))
    picture = np.asarray(Image.open(tmp_path / "strip.png").convert("RGB"))
    for k, colour in enumerate(colours):
        third = picture[:, k * picture.shape[1] // 3 : (k + 1) * picture.shape[1] // 3]
        assert (np.abs(third.astype(int) - colour).max(2) <= 1).mean() > 0.6
    assert (picture[0] == 255).all() and picture.shape[0] > 2 * 12 / 16 * picture.shape[1] / 3
