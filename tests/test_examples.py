"""The examples run as they stand."""

import re
import runpy
import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from PIL import Image

import clod_adapter
import gsplat_in_torch

FOLDER = Path(__file__).resolve().parents[1] / "examples"
EXAMPLES = {int(path.name[:2]): path for path in sorted(FOLDER.glob("[0-9]*.py"))}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs an example by its number in the test's folder, with 5 steps of training; returns what it printed."""
    monkeypatch.chdir(tmp_path)
    adapt = clod_adapter.adapt
    monkeypatch.setattr(clod_adapter, "adapt", lambda base, scene, config: adapt(base, scene, type(config)(iters=5)))

    def start(number: int, *words: object) -> str:
        monkeypatch.setattr(sys, "argv", [EXAMPLES[number].name, *map(str, words)])
        runpy.run_path(str(EXAMPLES[number]), run_name="__main__")
        return capsys.readouterr().out

    return start


def test_training_and_rendering(run: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures by the library, by gsplat, with torch in place of its kernels, and by a renderer of one's own."""
    gsplat_in_torch.install(monkeypatch)
    printed = run(1, capture.ply, capture.scene, "dial.ply")
    assert "dial 5:" in printed and clod_adapter.load("dial.ply").gaussians.sigma_d is not None

    def by_gsplat() -> str:
        runpy.run_path(str(EXAMPLES[3]))["main"]("dial.ply", str(capture.scene), "cpu")
        return "of 300 Gaussians"

    for draw, stem, size in (
        (lambda: run(2, "dial.ply"), "dial_sv", (320, 240)),
        (lambda: run(2, "dial.ply", capture.scene), "dial_sv", (64, 48)),
        (by_gsplat, "dial_gsplat_sv", (64, 48)),
        (lambda: run(4, "dial.ply"), "dial_dots_sv", (320, 240)),
    ):
        assert "of 300 Gaussians" in draw()
        pictures = [Image.open(f"{stem}{dial}.png") for dial in (1, 2, 3, 5)]
        assert {picture.size for picture in pictures} == {size}
        assert len({picture.tobytes() for picture in pictures}) == 4
    for dial in (1, 2, 3, 5):
        own, theirs = (np.asarray(Image.open(f"{stem}{dial}.png"), float) for stem in ("dial_sv", "dial_gsplat_sv"))
        assert np.abs(own - theirs).mean() < 0.1
    scene = clod_adapter.load_scene(capture.scene)
    monkeypatch.setattr(clod_adapter, "load_scene", lambda folder, origin: clod_adapter.Scene(scene.train, (), ()))
    assert "of 300 Gaussians" in run(2, "dial.ply", capture.scene)  # without held-out views


def test_budgets(run: Any, dialled: Path, capture: Any) -> None:
    printed = run(5, dialled, capture.scene).splitlines()
    names = ["50% of", "25% of", "10% of", "0.1 dB", "0.5 dB", "1 dB", "10 frames", "30 frames", "60 frames"]
    assert len(printed) == 9 and all(line.startswith(name) for line, name in zip(printed, names, strict=True))
    found = [float(line.partition("s = ")[2].split()[0]) for line in (printed[0], *printed[3:6])]
    assert 1 < found[0] < 4 and 1 < found[1] <= found[2] <= found[3] <= 4
    assert "out of reach: at s = 4" in printed[2]  # a tenth is less than the far end keeps, and that is said


def test_adapter_is_applied_and_removed(run: Any, dialled: Path, capture: Any, tmp_path: Path) -> None:
    printed = run(6, capture.ply, dialled.with_suffix(".safetensors"), "again.ply")
    assert "changed: sigma_d, " in printed and f"{capture.ply}, bit for bit" in printed
    assert (tmp_path / "again.ply").read_bytes() == dialled.read_bytes()
    other = capture.write(tmp_path / "other.ply", capture.gaussians.replace(sh0=capture.gaussians.sh0 + 1))
    with pytest.raises(SystemExit, match="a different base was given"):
        run(6, other, dialled.with_suffix(".safetensors"), "other_again.ply")
    assert not (tmp_path / "other_again.ply").exists()


def test_a_loop_of_gsplat_trains_a_dial(
    capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With torch in place of its kernels; in at most 20 lines more than the loop has without a dial."""
    gsplat_in_torch.install(monkeypatch)
    torch.manual_seed(0)  # the order of the views
    source = EXAMPLES[7].read_text(encoding="utf-8")
    assert 0 < len(re.findall(r"# dial\b", source)) <= 20
    runpy.run_path(str(EXAMPLES[7]))["main"](str(capture.ply), str(capture.scene), str(tmp_path / "d.ply"), "cpu", 24)
    rows = re.findall(r"dial \S+: (.+) dB before, (.+) dB after, (\d+)% .*target (\d+)%", capsys.readouterr().out)
    for before, after, kept, target in (map(float, row) for row in rows):
        assert after > before + 1 and abs(kept - target) < 15
    model = clod_adapter.load(tmp_path / "d.ply").gaussians
    assert len(rows) == 2 and model.growth_d.abs().max() > 0.05 and len(model) == 300


def test_the_slider_turns_the_dial_while_it_trains(run: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """With mocks in place of viser; it is interrupted in the third step."""
    viser = MagicMock()
    monkeypatch.setitem(sys.modules, "viser", viser)
    monkeypatch.setitem(sys.modules, "viser.transforms", viser.transforms)
    moved = viser.transforms.SE3.from_rotation_and_translation.return_value.inverse.return_value
    moved.as_matrix.return_value = clod_adapter.load_scene(capture.scene).train[0].camera.viewmat.numpy()
    server, client = viser.ViserServer.return_value, MagicMock()
    server.get_clients.side_effect = [{0: client}, {0: client}, KeyboardInterrupt]
    server.gui.add_slider.return_value.value, client.camera.aspect, client.camera.fov = 5.0, 4 / 3, 0.9
    run(8, capture.ply, capture.scene)
    (picture,) = client.scene.set_background_image.call_args.args
    assert picture.shape == (360, 480, 3) and picture.any()
    assert re.fullmatch(r"\d\d of 300, step 2", server.gui.add_text.return_value.value)
    assert clod_adapter.load("slider.ply").gaussians.attenuation.max_sv == 5


def test_bad_arguments_are_refused(run: Any) -> None:
    for number in (1, 2, 5, 6):
        with pytest.raises(SystemExit, match=f"python examples/{EXAMPLES[number].name}"):
            run(number)
        with pytest.raises(SystemExit, match="error: (missing.ply|nowhere): .*check the path"):
            run(number, "missing.ply", "nowhere")


def test_the_readme_lists_every_example() -> None:
    listed = re.findall(r"\]\((.+?)\)", (FOLDER / "README.md").read_text(encoding="utf-8"))
    assert listed == [path.name for path in EXAMPLES.values()]
    assert list(EXAMPLES) == list(range(1, len(EXAMPLES) + 1))
