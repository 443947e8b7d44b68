from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from clod_adapter.cameras import Scene, View
from clod_adapter.errors import ClodError
from clod_adapter.io.scene import colmap_plain
from clod_adapter.io.scene.colmap_library import pycolmap
from clod_adapter.io.scene.load import load_scene
from photographs import LENSES, SIZE, model_of, psnr_of, seen


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def capture(folder: Path, kind: str, params: list[float]) -> Path:
    """A scene of one photograph, of ``seen``, by this lens."""
    model_of(folder, kind, params, **SIZE)
    (folder / "images").mkdir()
    Image.fromarray(seen(pycolmap.Camera(model=kind, params=params, **SIZE))).save(folder / "images" / "a.png")
    return folder


def ideal(view: View, across: float = 0.0, down: float = 0.0) -> np.ndarray:
    """What the pinhole camera of the view would have seen, or one whose axis is these pixels beside."""
    K = view.camera.K.double().numpy()
    params = [K[0, 0], K[1, 1], K[0, 2] + across, K[1, 2] + down]
    size = {"width": view.camera.width, "height": view.camera.height}
    return seen(pycolmap.Camera(model="PINHOLE", params=params, **size))


@pytest.mark.parametrize(
    ("kind", "library"), [*((kind, "pycolmap") for kind in LENSES), ("OPENCV", "plain")], indirect=["library"]
)
@pytest.mark.usefixtures("library")
def test_undistorted_image_is_that_of_the_pinhole_camera(tmp_path: Path, cache: Path, kind: str) -> None:
    loaded = load_scene(capture(tmp_path / "scene", kind, LENSES[kind]))
    view = loaded.train[0]
    right = psnr_of(view.image.numpy(), ideal(view))
    shifted = [psnr_of(view.image.numpy(), ideal(view, *by)) for by in ((0.1, 0), (-0.1, 0), (0, 0.1), (0, -0.1))]
    assert right > 45 and right > max(shifted), (right, shifted)
    assert "undistortion" not in dict(loaded.left_out)
    folder = next((cache / "clod-adapter" / "undistorted").iterdir())
    assert loaded.notes == (
        f"1 of 1 images undistorted from {kind} into {folder}, which may be deleted; the sources are untouched",
    )


@pytest.mark.parametrize(
    ("kind", "params", "fy"), [("OPENCV", [140, 142, 82, 58, 0, 0, 0, 0], 142), ("SIMPLE_PINHOLE", [140, 82, 58], 140)]
)
def test_lens_without_distortion_is_a_pinhole(
    tmp_path: Path, cache: Path, kind: str, params: list[float], fy: float
) -> None:
    scene = capture(tmp_path / "scene", kind, params)
    loaded = load_scene(scene)
    with Image.open(scene / "images" / "a.png") as image:
        np.testing.assert_array_equal(loaded.train[0].image, np.asarray(image))
    assert loaded.train[0].camera.K.tolist() == [[140, 0, 82], [0, fy, 58], [0, 0, 1]]
    assert loaded.notes == () and not cache.exists()


def test_scaled_photographs_are_undistorted(tmp_path: Path) -> None:
    scene = capture(tmp_path / "scene", "OPENCV", LENSES["OPENCV"])
    whole = load_scene(scene, max_width=80)
    assert whole.train[0].camera.width == 80
    assert psnr_of(whole.train[0].image.numpy(), ideal(whole.train[0])) > 40
    half = pycolmap.Camera(model="OPENCV", params=LENSES["OPENCV"], **SIZE)
    half.rescale(80, 60)
    Image.fromarray(seen(half)).save(scene / "images" / "a.png")
    loaded = load_scene(scene)
    assert loaded.notes[0] == "1 of 1 images are 80x60 where the model has 160x120: intrinsics scaled"
    assert psnr_of(loaded.train[0].image.numpy(), ideal(loaded.train[0])) > 40  # of twice the waves per pixel


def test_several_lenses_in_one_model(tmp_path: Path) -> None:
    """Three lenses over ten photographs: each is right, and the order and what is held out are as ever."""
    lenses = {1: "PINHOLE", 2: "OPENCV", 3: "SIMPLE_FISHEYE"}
    params = {"PINHOLE": [140, 142, 82, 58], **LENSES}
    reconstruction = pycolmap.Reconstruction()
    for i, kind in lenses.items():
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(model=kind, params=params[kind], camera_id=i, **SIZE)
        )
    (tmp_path / "scene" / "sparse").mkdir(parents=True)
    for i in range(10):
        camera = reconstruction.cameras[1 + i % 3]
        image = pycolmap.Image(name=f"{i}.png", camera_id=camera.camera_id, image_id=20 - i)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        Image.fromarray(seen(camera)).save(tmp_path / "scene" / f"{i}.png")
    reconstruction.write_binary(str(tmp_path / "scene" / "sparse"))
    loaded = load_scene(tmp_path / "scene")
    assert [view.camera.name for view in loaded.test] == ["0.png", "8.png"]
    assert [view.camera.name for view in loaded.train] == [f"{i}.png" for i in (1, 2, 3, 4, 5, 6, 7, 9)]
    assert loaded.notes[0].startswith("6 of 10 images undistorted from OPENCV into")
    assert "(and 1 more)" in loaded.notes[0]
    for view in (*loaded.train, *loaded.test):
        assert psnr_of(view.image.numpy(), ideal(view)) > 42, view.camera.name


def same(one: Scene, other: Scene) -> bool:
    pairs = list(zip((*one.train, *one.test), (*other.train, *other.test), strict=True))
    equal = all(a.image.equal(b.image) and a.camera.K.equal(b.camera.K) for a, b in pairs)
    return equal and one.notes == other.notes and one.left_out == other.left_out


def test_cached_images_are_reused(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = capture(tmp_path / "scene", "OPENCV", LENSES["OPENCV"])
    sources = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in scene.rglob("*") if path.is_file()}
    first = load_scene(scene, max_width=100)
    assert len(first.notes) == 2 and "scaled" in first.notes[0]
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in sources} == sources
    assert {path for path in scene.rglob("*") if path.is_file()} == set(sources)
    made: list[Path] = []
    real = pycolmap.undistort_image
    monkeypatch.setattr(pycolmap, "undistort_image", lambda *args: (made.append(args), real(*args))[1])
    assert same(load_scene(scene, max_width=100), first) and not made
    load_scene(scene, max_width=90)
    assert len(made) == 1
    os.utime(scene / "images" / "a.png", ns=(1, 1))
    load_scene(scene, max_width=100)
    assert len(made) == 2
    files = sorted(cache.rglob("*.png"))
    assert len(files) == 3
    for file in files:
        file.write_bytes(file.read_bytes()[:-500])
    assert same(load_scene(scene, max_width=100), first) and len(made) == 3
    model_of(tmp_path / "other", "OPENCV", [*LENSES["OPENCV"][:4], 0.01, 0, 0, 0], **SIZE)  # calibrated again
    shutil.copytree(tmp_path / "other" / "sparse", scene / "sparse", dirs_exist_ok=True)
    assert not same(load_scene(scene, max_width=100), first) and len(made) == 4


def test_interrupt_leaves_no_partial_file(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = capture(tmp_path / "scene", "OPENCV", LENSES["OPENCV"])
    real = Image.Image.save

    def stop(self: Image.Image, file: Path, **options: object) -> None:
        real(self, file, **options)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Image.Image, "save", stop)
        load_scene(scene)
    assert not [path for path in cache.rglob("*") if path.is_file()]
    assert len(load_scene(scene).train) == 1


def test_cache_folder_must_be_writable(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = capture(tmp_path / "scene", "OPENCV", LENSES["OPENCV"])
    cache.write_text("a file, so that no folder can be made")
    with pytest.raises(ClodError, match="undistorted photographs cannot be kept there .*set XDG_CACHE_HOME"):
        load_scene(scene)
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    load_scene(scene)
    assert len(list((tmp_path / "home").rglob("clod-adapter/undistorted/scene-*/*.png"))) == 1


@pytest.mark.parametrize(
    ("kind", "params", "message"),
    [
        ("EQUIRECTANGULAR", [160, 120], "EQUIRECTANGULAR, no perspective camera"),
        ("OPENCV", [140, 140, 80, 60, float("nan"), 0, 0, 0], "not usable"),
        ("OPENCV", [140, 140, 80, 60, 1e300, 0, 0, 0], "not usable"),
        ("SIMPLE_RADIAL", [-140, 80, 60, 0.1], "not usable"),
        ("PINHOLE", [140, 140, float("inf"), 60], "not usable"),
        ("PINHOLE", [0, 140, 80, 60], "not usable"),
        *(("OPENCV", [140, 140, 80, 60, k, 0, 0, 0], "") for k in (-5.0, 1e8, -1e8)),
    ],
)
def test_bad_lenses_are_refused(tmp_path: Path, library: Any, kind: str, params: list[float], message: str) -> None:
    model_of(tmp_path, kind, params, **SIZE)
    Image.new("RGB", (160, 120)).save(tmp_path / "a.png")
    if message:
        with pytest.raises(ClodError, match=f"image 'a.png' has .*{message}"):
            load_scene(tmp_path)
        return
    try:  # the lens folds
        assert load_scene(tmp_path).train[0].camera.width <= 320
    except ClodError as error:
        assert library is colmap_plain and "leaves no picture" in str(error)
