from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from clod_adapter._support.workers import in_order
from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap import write_model
from clod_adapter.io.scene.images import read_image
from clod_adapter.io.scene.load import load_scene
from clod_adapter.progress import Stopped
from photographs import as_text, camera, pixels, write_scene


def test_missing_images_are_noted_or_refused(tmp_path: Path) -> None:
    """The held-out images stay the same; more than half missing is an error."""
    names = sorted(write_scene(tmp_path, 18)[1])
    for name in names[2:11]:
        (tmp_path / "images" / name).unlink()
    loaded = load_scene(tmp_path)
    assert loaded.notes == (
        "9 of 18 photographs are missing and left out (sub/003.png, sub/004.png, sub/005.png, ...)",
    )
    assert [view.camera.name for view in loaded.test] == [names[0], names[16]]  # the 8th is missing, the rest stay
    assert [view.camera.name for view in loaded.train] == [names[1], *names[11:16], names[17]]
    (tmp_path / "images" / names[0]).unlink()
    text = r"10 of 18 images of the model are missing \(sub/001.png, sub/003.png, sub/004.png, \.\.\.\), more than half"
    with pytest.raises(ClodError, match=text):
        load_scene(tmp_path)


def test_smaller_copies_replace_missing_images(tmp_path: Path) -> None:
    write_scene(tmp_path, 3)
    (tmp_path / "images").rename(tmp_path / "images_2")
    for name in ("images_4", "input"):
        (tmp_path / name / "sub").mkdir(parents=True)
    for file in (tmp_path / "images_2" / "sub").iterdir():
        with Image.open(file) as image:
            image.resize((8, 6)).save(tmp_path / "images_4" / "sub" / file.name)
            image.resize((20, 15)).save(file)
            image.save(tmp_path / "input" / "sub" / file.name)
    loaded = load_scene(tmp_path)
    assert loaded.notes == (
        "the photographs are those in images_2, as there are more than in images",
        "3 of 3 images are 20x15 where the model has 40x30: intrinsics scaled",
    )
    torch.testing.assert_close(loaded.test[0].camera.K[:2] * 2, camera(2, focal=30.0).K[:2])
    for file in (tmp_path / "images_2" / "sub").iterdir():
        file.unlink()
    assert "images_4" in load_scene(tmp_path, max_width=10).notes[0]
    for file in (tmp_path / "images_4" / "sub").iterdir():
        file.unlink()
    with pytest.raises(ClodError, match="images: 3 of 3 images of the model"):  # the raw ones are of other cameras
        load_scene(tmp_path)


def test_images_of_another_size_scale_the_intrinsics(tmp_path: Path) -> None:
    cameras = [camera(0), camera(1, 64, 48), camera(2, 30, 40)]
    write_model(tmp_path, cameras, ["a.png", "b.png", "c.png"])
    (tmp_path / "images").mkdir()
    for i, name in enumerate("abc"):
        image = Image.fromarray(pixels(i, cameras[i].width, cameras[i].height))
        image.resize((image.width // 2, image.height // 2)).save(tmp_path / "images" / f"{name}.png")
    loaded = load_scene(tmp_path)
    views = [*loaded.test, *loaded.train]
    for view, was in zip(views, cameras, strict=True):
        torch.testing.assert_close(view.camera.K, was.K / torch.tensor([[2.0], [2.0], [1.0]]))
    assert [(view.camera.width, view.camera.height) for view in views] == [(20, 15), (32, 24), (15, 20)]
    assert loaded.notes == ("3 of 3 images are 20x15 where the model has 40x30 (and 2 more): intrinsics scaled",)


def test_duplicate_image_names_are_refused(tmp_path: Path) -> None:
    write_scene(tmp_path, 2)
    as_text(tmp_path)
    listed = tmp_path / "sparse" / "0" / "images.txt"
    listed.write_text(listed.read_text().replace("sub/001.png", "sub/002.png"))
    with pytest.raises(ClodError, match="has image sub/002.png more than once"):
        load_scene(tmp_path)


def test_stopped_load_reads_no_more_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scene(tmp_path, 40)
    read: list[Path] = []

    def slowly(path: Path, width: int, height: int, max_width: int) -> object:
        read.append(path)
        time.sleep(0.01)
        return read_image(path, width, height, max_width)

    monkeypatch.setattr("clod_adapter.io.scene.load.read_image", slowly)
    with pytest.raises(Stopped):
        load_scene(tmp_path, progress=lambda now: False)
    assert len(read) < 10


def test_wide_images_are_scaled_with_their_intrinsics(tmp_path: Path) -> None:
    write_scene(tmp_path, 3)
    loaded = load_scene(tmp_path, max_width=15)
    assert loaded.notes == ("3 of 3 images scaled from 40x30 to 15x11 (Pillow bicubic, as in Inria's code)",)
    view, names = loaded.train[0], [view.camera.name for view in loaded.train]
    assert tuple(view.image.shape) == (11, 15, 3) and names == ["sub/002.png", "sub/003.png"]
    original = camera(1, focal=31.0).K  # names count down: 002 is the model's second image
    scale = torch.tensor([[15 / 40], [11 / 30], [1.0]])
    torch.testing.assert_close(view.camera.K, original * scale)
    expected = Image.fromarray(pixels(1)).resize((15, 11), Image.Resampling.BICUBIC)
    np.testing.assert_array_equal(view.image, np.asarray(expected))
    assert load_scene(tmp_path, max_width=40).notes == ()


def test_train_and_test_split(tmp_path: Path) -> None:
    (tmp_path / "ten").mkdir()
    (tmp_path / "one").mkdir()
    write_scene(tmp_path / "ten")
    seen: list[tuple[int, int]] = []
    loaded = load_scene(tmp_path / "ten", test_every=3, progress=lambda now: seen.append((now.done, now.total)))
    assert (len(loaded.train), len(loaded.test)) == (6, 4) and seen == [(k + 1, 10) for k in range(10)]
    write_scene(tmp_path / "one", 1)
    loaded = load_scene(tmp_path / "one")
    assert (len(loaded.train), len(loaded.test)) == (1, 0)
    with pytest.raises(ClodError, match="test_every is 1"):
        load_scene(tmp_path / "one", test_every=1)
    (tmp_path / "two").mkdir()
    names = write_scene(tmp_path / "two", 2)[1]
    (tmp_path / "two" / "images" / max(names)).unlink()
    with pytest.raises(ClodError, match="no photograph to train on"):
        load_scene(tmp_path / "two")


def test_left_out_names_skipped_steps_only(tmp_path: Path) -> None:
    """Each with its reason; nothing that the scene does not have and no default would do."""
    (tmp_path / "plain").mkdir()
    write_scene(tmp_path / "plain", 3)
    spared = dict(load_scene(tmp_path / "plain").left_out)
    assert set(spared) == {"undistortion", "scaling"}
    assert spared["undistortion"] == "all 3 cameras are pinholes"
    assert spared["scaling"] == "all 3 photographs are used at full resolution"
    scaled = dict(load_scene(tmp_path / "plain", max_width=20).left_out)
    assert set(scaled) == {"undistortion"}


def test_undistortion_is_not_imported_for_pinholes(tmp_path: Path) -> None:
    write_scene(tmp_path, 2)
    code = (
        "import sys, clod_adapter.io.checkpoint, clod_adapter.io.adapter_file\n"
        "assert 'pycolmap' not in sys.modules\n"
        "import clod_adapter\n"
        "clod_adapter.load_scene('.')\n"
        "assert 'clod_adapter.io.scene.undistort' not in sys.modules"
    )
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)
    assert not (tmp_path / "cache").exists()


def test_rgb_image_is_not_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``Image.convert`` would copy it at full size."""
    Image.fromarray(pixels(0, 64, 48)).save(tmp_path / "a.jpg")
    monkeypatch.setattr(Image.Image, "convert", lambda *_, **__: pytest.fail("copies"))
    read, *_ = read_image(tmp_path / "a.jpg", 64, 48, 1600)
    assert read.mode == "RGB" and np.asarray(read).shape == (48, 64, 3)


@pytest.mark.parametrize(("threads", "workers"), [(1, 2), (5, 5), (99, 8)])
def test_number_of_decoding_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: int, workers: int
) -> None:
    """That of torch, within 2 to 8; the views do not depend on it."""
    write_scene(tmp_path, 12)
    before, used = load_scene(tmp_path), list[int]()
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    name = "clod_adapter.io.scene.load.in_order"
    monkeypatch.setattr(name, lambda loads, count: used.append(count) or in_order(loads, count))
    after = load_scene(tmp_path)
    pairs = zip((*before.train, *before.test), (*after.train, *after.test), strict=True)
    assert all(a.image.equal(b.image) and a.camera.name == b.camera.name for a, b in pairs) and used == [workers]
