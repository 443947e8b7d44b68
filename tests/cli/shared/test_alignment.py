"""Checkpoints that do not match the photographs: errors, warnings, report."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps
from scipy.spatial.transform import Rotation

from clod_adapter.gaussians import Gaussians
from clod_adapter.io.scene.colmap import load_points, write_model
from clod_adapter.io.scene.load import load_scene
from clod_adapter.render import render
from nerfstudio_frames import APPLIED, trained

FAST = ("--iters", 1, "--max-sv", 4)


def scene_of(capture: Any, folder: Path, change: Any) -> Path:
    """The capture's scene with its photographs changed."""
    scene = folder / "changed"
    (scene / "images").mkdir(parents=True)
    (scene / "sparse").symlink_to(capture.scene / "sparse")
    for path in (capture.scene / "images").iterdir():
        change(Image.open(path)).save(scene / "images" / path.name)
    return scene


def transformed(g: Gaussians, scale: float, rotation: torch.Tensor, offset: torch.Tensor) -> Gaussians:
    """The Gaussians at ``scale (rotation x + offset)``, without harmonics, which would have to be turned too."""
    w, x, y, z = torch.from_numpy(Rotation.from_matrix(rotation).as_quat()[..., [3, 0, 1, 2]]).float()
    product = torch.stack([
        torch.stack([w, -x, -y, -z]), torch.stack([x, w, -z, y]), torch.stack([y, z, w, -x]),
        torch.stack([z, -y, x, w]),
    ])  # fmt: skip
    return g.replace(
        means=scale * (g.means @ rotation.float().T + offset.float()), quats=g.quats @ product.T,
        log_scales=g.log_scales + math.log(scale), shN=g.shN * 0,
    )  # fmt: skip


def poses_of(scene: Path) -> torch.Tensor:
    """``[V, 4, 4]`` float64, camera to world, of all cameras."""
    views = load_scene(scene)
    return torch.linalg.inv(torch.stack([view.camera.viewmat.double() for view in (*views.train, *views.test)]))


def by_gsplat(g: Gaussians, scene: Path) -> Gaussians:
    """The checkpoint as gsplat's trainer normalizes the world (``datasets/normalize.py``)."""
    poses = poses_of(scene).numpy()
    turn = Rotation.align_vectors([[0.0, -1, 0]], [-poses[:, :3, 1].mean(0)])[0].as_matrix()
    centres, forward = poses[:, :3, 3] @ turn.T, poses[:, :3, 2] @ turn.T
    focus = np.median(centres - (forward * centres).sum(1, keepdims=True) * forward, axis=0)
    size = 1 / np.median(np.linalg.norm(centres - focus, axis=1))
    points = (load_points(scene).double().numpy() @ turn.T - focus) * size
    middle = np.median(points, axis=0)
    axes = np.linalg.eigh(np.cov((points - middle).T))[1][:, ::-1].T
    axes = axes * np.sign(np.linalg.det(axes))
    offset = turn.T @ (-focus - axes.T @ axes @ middle / size)
    return transformed(g, float(size), torch.tensor(axes @ turn), torch.tensor(axes @ turn @ offset))


@pytest.fixture
def turned(capture: Any, tmp_path: Path) -> Path:
    """The checkpoint with y and z negated: half a turn about x."""
    flip = torch.diag(torch.tensor([1.0, -1, -1]))
    return capture.write(tmp_path / "turned.ply", transformed(capture.gaussians, 1.0, flip, torch.zeros(3)))


@pytest.fixture
def lost(capture: Any, tmp_path: Path) -> Path:
    """Another scene, far away."""
    random = torch.Generator().manual_seed(2)
    means, sh0 = (torch.randn(shape, generator=random) for shape in ((300, 3), (300, 1, 3)))
    return capture.write(tmp_path / "lost.ply", capture.gaussians.replace(means=means + 1e4, sh0=sh0))


def test_cameras_are_moved_into_gsplats_frame_in_every_command(clod: Any, capture: Any, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "images").symlink_to(capture.scene / "images")
    cameras = [view.camera for view in (*load_scene(capture.scene).train, *load_scene(capture.scene).test)]
    write_model(scene, cameras, [camera.name for camera in cameras], capture.gaussians.means.numpy())
    ply, out = capture.write(tmp_path / "normalized.ply", by_gsplat(capture.gaussians, scene)), tmp_path / "adapted.ply"
    done = clod(ply, "--images", scene, *FAST, "-o", out, "--json")
    said = f"the cameras are moved into the frame of {ply} (gsplat): renders have"
    assert done.code == 0 and len([line for line in done.err.splitlines() if said in line]) == 1, done
    report = json.loads(done.out)
    found, frame = report["alignment"], report["alignment"]["frame"]
    assert frame["name"] == "gsplat" and frame["psnr"] > found["mean_colour_psnr"] + 6 > found["psnr"] + 6
    assert any(said in note for note in report["notes"])
    # The stored viewpoints are training cameras in the file's frame, x_cameras = scale R x_file + offset.
    rotation, offset = torch.tensor(frame["rotation"]), torch.tensor(frame["offset"])
    centres = torch.tensor([[view[axis] for axis in "xyz"] for view in report["calibration"]["viewpoints"]])
    back = frame["scale"] * centres @ rotation.T + offset
    assert torch.cdist(back, poses_of(scene)[:, :3, 3].float()).min(1).values.max() < 1e-3
    again = clod("eval", out, "--images", scene, "--json")
    assert again.code == 0 and "(gsplat)" in again.err
    assert json.loads(again.out)["rows"][0]["psnr"] == pytest.approx(report["rows"][0]["psnr"], abs=0.01)
    done = clod("render", out, "--images", scene, "-o", tmp_path / "pictures")
    assert done.code == 0 and "(gsplat)" in done.err
    done = clod("export", out, "--images", scene, "--sv", 2, "-o", tmp_path / "baked.ply")
    assert done.code == 0 and "(gsplat)" in done.err


def test_another_scene_is_refused_and_nothing_is_written(clod: Any, capture: Any, lost: Path, tmp_path: Path) -> None:
    """Except with --misaligned-ok."""
    done = clod(lost, "--images", capture.scene, *FAST)
    assert done.code == 2 and [path.name for path in tmp_path.iterdir()] == [lost.name]
    assert len([line for line in done.err.splitlines() if "does not match" in line]) == 1
    for said in (str(lost), str(capture.scene), "are in view", "--misaligned-ok"):
        assert said in done.err, done
    done = clod(lost, "--images", capture.scene, *FAST, "--misaligned-ok", "--accept-loss", "--json")
    assert done.code == 0 and "warning: " in done.err and "to train anyway" not in done.err, done
    report = json.loads(done.out)
    assert any(note.startswith("warning: ") for note in report["notes"]) and report["alignment"]["frame"] is None
    done = clod("eval", lost, "--images", capture.scene)
    assert done.code == 0 and f"warning: {lost}: does not match" in done.err, done


def test_white_background_is_named(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = capture.gaussians.select(torch.arange(300) < 40)  # so that there is a background
    ply = capture.write(tmp_path / "few.ply", few)
    scene = scene_of(capture, tmp_path, lambda image: image)
    loaded = load_scene(capture.scene)
    for view in (*loaded.train, *loaded.test):
        pixels = render(few, view.camera, background=torch.ones(3)).pixels
        Image.fromarray(pixels.numpy()).save(scene / "images" / view.camera.name)
    done = clod(ply, "--images", scene, *FAST)
    assert done.code == 2 and "over white the renders have" in done.err, done
    assert "transparent background (PNG" in done.err


def test_warnings_for_another_exposure_and_black_photographs(clod: Any, capture: Any, tmp_path: Path) -> None:
    for said, change in (
        ("another exposure", lambda image: image.point(lambda value: value // 5)),
        ("have a single colour each", lambda image: ImageOps.colorize(image.convert("L"), "black", "black")),
    ):
        scene = scene_of(capture, tmp_path / said, change)
        done = clod(capture.ply, "--images", scene, *FAST, "--json")
        assert done.code == 0 and said in done.err and said in json.loads(done.out)["notes"][0], done


@pytest.mark.usefixtures("blank_figure")
def test_robustness_checks_alignment(clod: Any, capture: Any, turned: Path, lost: Path, tmp_path: Path) -> None:
    words = ("--images", capture.scene, "--max-sv", 2, "--iters", 1)
    done = clod("robustness", capture.ply, lost, *words)
    assert done.code == 2 and f"{lost}: does not match" in done.err and "--misaligned-ok" in done.err, done
    done = clod("robustness", capture.ply, turned, *words)
    assert done.code == 2 and f"{turned}: in another frame than {capture.ply}" in done.err, done
    assert sorted(path.name for path in tmp_path.iterdir()) == [lost.name, turned.name]
    done = clod("robustness", turned, *words, "--json")
    assert done.code == 0 and "(axes x, -y, -z)" in json.loads(done.out)["notes"][0], done


def test_nerfstudio_export_matches_with_and_without_dataparser_transforms(
    clod: Any, capture: Any, tmp_path: Path
) -> None:
    opengl = torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
    turn = np.vstack([APPLIED["today"], [0, 0, 0, 1]])
    _, written = trained(turn @ poses_of(capture.scene).numpy() @ opengl.numpy(), APPLIED["today"])
    matrix = torch.tensor(written["transform"])
    exported = transformed(capture.gaussians, written["scale"], matrix[:, :3], matrix[:, 3])
    splat = capture.write(tmp_path / "splat.ply", exported)
    scene = scene_of(capture, tmp_path, lambda picture: picture)
    done = clod(splat, "--images", scene, *FAST)
    assert done.code == 0 and "(nerfstudio)" in done.err, done
    (scene / "dataparser_transforms.json").write_text(json.dumps(written))
    done = clod(splat, "--images", scene, *FAST, "-o", tmp_path / "second.ply", "--json")
    report = json.loads(done.out)
    assert done.code == 0 and "does not match" not in done.err and "(nerfstudio)" not in done.err, done
    assert report["alignment"]["psnr"] > report["alignment"]["mean_colour_psnr"] + 6
    assert any("frame of dataparser_transforms.json" in note for note in report["notes"])
