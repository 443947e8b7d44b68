"""Checkpoints that do not match the photographs: errors, warnings, report."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps
from scipy.spatial.transform import Rotation

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


@pytest.fixture
def turned(capture: Any, tmp_path: Path) -> Path:
    """The checkpoint with y and z negated: half a turn about x, a product with the quaternion (0, 1, 0, 0)."""
    g = capture.gaussians
    w, x, y, z = g.quats.unbind(1)
    flipped = g.replace(means=g.means * torch.tensor([1.0, -1, -1]), quats=torch.stack([-x, w, -z, y], 1))
    return capture.write(tmp_path / "turned.ply", flipped.replace(shN=g.shN * 0))


def test_base_in_other_axes(clod: Any, capture: Any, turned: Path, tmp_path: Path) -> None:
    """Nothing is written, except with --misaligned-ok."""
    done = clod(turned, "--images", capture.scene, *FAST)
    assert done.code == 2 and [path.name for path in tmp_path.iterdir()] == [turned.name]
    assert len([line for line in done.err.splitlines() if "does not match" in line]) == 1
    for said in (str(turned), str(capture.scene), "are in view", "x, y, z are the file's x, -y, -z", "--misaligned-ok"):
        assert said in done.err, done
    done = clod(turned, "--images", capture.scene, *FAST, "--misaligned-ok", "--json")
    assert done.code == 0 and "warning: " in done.err and "to train anyway" not in done.err, done
    report = json.loads(done.out)
    assert report["notes"][0].startswith("warning: ") and "x, -y, -z" in report["alignment"]["guess"]
    assert report["alignment"]["psnr"] < report["alignment"]["mean_colour_psnr"]


def test_distant_base_is_reported_with_both_positions(clod: Any, capture: Any, tmp_path: Path) -> None:
    random = torch.Generator().manual_seed(2)
    lost = capture.gaussians.replace(
        means=torch.randn(300, 3, generator=random) + 1e4, sh0=torch.randn(300, 1, 3, generator=random)
    )
    done = clod(capture.write(tmp_path / "lost.ply", lost), "--images", capture.scene, *FAST)
    for said in ("half of the Gaussians lie within", "the cameras look at about", "0% of its Gaussians are in view"):
        assert done.code == 2 and said in done.err, done
    assert re.search(r"of \(1e\+04, 1e\+04, 1e\+04\), .* at about \(-?[\d.]+, ", done.err), (
        done
    )  # in coordinates of the files


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
def test_robustness_checks_alignment(clod: Any, capture: Any, turned: Path, tmp_path: Path) -> None:
    done = clod("robustness", capture.ply, turned, "--images", capture.scene, "--max-sv", 2, "--iters", 1)
    assert done.code == 2 and f"{turned}: does not match" in done.err and "--misaligned-ok" in done.err, done
    assert [path.name for path in tmp_path.iterdir()] == [turned.name]
    words = ("--max-sv", 2, "--iters", 1, "--misaligned-ok", "--json")
    done = clod("robustness", turned, "--images", capture.scene, *words)
    assert done.code == 0 and "x, -y, -z" in json.loads(done.out)["notes"][0], done


def test_nerfstudio_export_matches_with_dataparser_transforms(clod: Any, capture: Any, tmp_path: Path) -> None:
    views = load_scene(capture.scene)
    viewmats = torch.stack([view.camera.viewmat.double() for view in (*views.train, *views.test)])
    opengl = torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
    turn = np.vstack([APPLIED["today"], [0, 0, 0, 1]])
    _, written = trained(turn @ torch.linalg.inv(viewmats).numpy() @ opengl.numpy(), APPLIED["today"])
    similarity, scale = np.array(written["transform"]), written["scale"]
    w, x, y, z = torch.from_numpy(Rotation.from_matrix(similarity[:, :3]).as_quat()[..., [3, 0, 1, 2]]).float()
    product = torch.stack([
        torch.stack([w, -x, -y, -z]), torch.stack([x, w, -z, y]), torch.stack([y, z, w, -x]),
        torch.stack([z, -y, x, w]),
    ])  # fmt: skip
    g, matrix = capture.gaussians, torch.from_numpy(similarity).float()
    exported = g.replace(
        means=scale * (g.means @ matrix[:, :3].T + matrix[:, 3]), quats=g.quats @ product.T,
        log_scales=g.log_scales + math.log(scale), shN=g.shN * 0,
    )  # fmt: skip
    splat = capture.write(tmp_path / "splat.ply", exported)
    scene = scene_of(capture, tmp_path, lambda picture: picture)
    done = clod(splat, "--images", scene, *FAST)
    assert done.code == 2 and "copy dataparser_transforms.json, which ns-train writes" in done.err, done
    (scene / "dataparser_transforms.json").write_text(json.dumps(written))
    done = clod(splat, "--images", scene, *FAST, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and "warning: the" not in done.err, done
    assert report["alignment"]["psnr"] > report["alignment"]["mean_colour_psnr"] + 6
    assert any("frame of dataparser_transforms.json" in note for note in report["notes"])
