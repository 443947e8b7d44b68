"""Checkpoints that do not match the photographs: errors, warnings, report."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from clod_adapter import View, load_scene, render
from models import write_model
from runs import names

FAST = "--iters 1 --max-sv 4"


def scene_of(capture: Any, folder: Path, shown: Callable[[View], Image.Image], count: int = 9) -> Path:
    """The first of the capture's cameras with other photographs."""
    scene = load_scene(capture.scene)
    views = [*scene.test, *scene.train][:count]
    write_model(folder, [view.camera for view in views], [view.camera.name for view in views])
    (folder / "images").mkdir()
    for view in views:
        shown(view).save(folder / "images" / view.camera.name)
    return folder


@pytest.fixture
def turned(capture: Any, tmp_path: Path) -> Path:
    """The checkpoint with y and z negated: half a turn about x; without harmonics, which would turn too."""
    g = capture.gaussians
    w, x, y, z = g.quats.unbind(-1)
    quats, means = torch.stack([-x, w, -z, y], -1), g.means * torch.tensor([1.0, -1, -1])
    return capture.write(tmp_path / "turned.ply", g.replace(means=means, quats=quats, shN=0 * g.shN))


def test_cameras_are_moved_into_another_frame_in_every_command(clod: Any, capture: Any, turned: Path) -> None:
    done = clod(turned, "--images SCENE", FAST, "-o adapted.ply --json")
    said = f"the cameras are moved into the frame of {turned} (axes x, -y, -z): renders have"
    report = done.report
    assert done.err.count(said) == 1 and any(said in note for note in report["notes"]), done
    found, frame = report["alignment"], report["alignment"]["frame"]
    assert frame["psnr"] > found["mean_colour_psnr"] + 6 > found["psnr"] + 6
    # The stored viewpoints are training cameras in the file's frame, x_cameras = scale R x_file + offset.
    rotation, offset = torch.tensor(frame["rotation"]), torch.tensor(frame["offset"])
    centres = torch.tensor([[view[axis] for axis in "xyz"] for view in report["calibration"]["viewpoints"]])
    back = frame["scale"] * centres @ rotation.T + offset
    poses = torch.stack([torch.linalg.inv(view.camera.viewmat) for view in load_scene(capture.scene).train])
    assert torch.cdist(back, poses[:, :3, 3]).min(1).values.max() < 1e-3
    again = clod("eval adapted.ply --images SCENE --json")
    assert "(axes x, -y, -z)" in again.err
    assert again.report["rows"][0]["psnr"] == pytest.approx(report["rows"][0]["psnr"], abs=0.01)
    assert "(axes x, -y, -z)" in clod("export adapted.ply --images SCENE --sv 2 -o baked.ply").err


def test_another_scene_is_refused_and_nothing_is_written(clod: Any, capture: Any, turned: Path, tmp_path: Path) -> None:
    random, scene = torch.Generator().manual_seed(2), scene_of(capture, tmp_path / "scene", photograph, 2)
    means, sh0 = (torch.randn(shape, generator=random) for shape in ((300, 3), (300, 1, 3)))
    lost = capture.write(tmp_path / "lost.ply", capture.gaussians.replace(means=means + 1e4, sh0=sh0))
    before = names(tmp_path)
    done = clod(lost, "--images", scene, FAST, code=2)
    assert f"error: {lost}: does not match {scene}" in done.err and "are in view" in done.err, done
    assert "--misaligned-ok" in done.err.splitlines()[-1]
    done = clod("robustness BASE", turned, "--images SCENE", FAST, code=2)
    assert f"error: {turned}: in another frame than {capture.ply}" in done.err, done
    assert names(tmp_path) == before


def photograph(view: View, share: float = 1.0) -> Image.Image:
    return Image.fromarray((share * view.image).byte().numpy())


def test_white_background_is_refused_unless_allowed(clod: Any, capture: Any, tmp_path: Path) -> None:
    few = capture.gaussians.select(torch.arange(300) < 40)  # so that there is a background
    ply = capture.write(tmp_path / "few.ply", few)

    def over_white(view: View) -> Image.Image:
        return Image.fromarray(render(few, view.camera, background=torch.ones(3)).pixels.numpy())

    words = (ply, "--images", scene_of(capture, tmp_path / "white", over_white), FAST)
    done = clod(*words, code=2)
    assert "over white the renders have" in done.err and "transparent background" in done.err, done
    done = clod(*words, "--misaligned-ok --json")
    assert f"warning: {ply}: does not match" in done.err and "to train anyway" not in done.err, done
    notes, alignment = done.report["notes"], done.report["alignment"]
    assert any(note.startswith("warning: ") for note in notes) and alignment["frame"] is None


@pytest.mark.parametrize(("said", "share"), [("another exposure", 0.2), ("have a single colour each", 0)])
def test_other_photographs_have_a_warning(clod: Any, capture: Any, tmp_path: Path, said: str, share: float) -> None:
    scene_of(capture, tmp_path / "scene", lambda view: photograph(view, share))
    done = clod("BASE --images scene", FAST, "--json")
    assert said in done.err and said in done.report["notes"][0], done
