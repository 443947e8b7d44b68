"""The stand-in for pycolmap against pycolmap itself: the same models read, the same pictures undistorted."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clod_adapter.errors import ClodError
from clod_adapter.io.scene import colmap, colmap_plain, colmap_records, undistort
from clod_adapter.io.scene.colmap import read_colmap
from clod_adapter.io.scene.load import load_scene
from photographs import LENSES, SIZE, as_text, camera, damage, pixels, seen, write_scene


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The package without pycolmap."""
    for module in (colmap, colmap_records, undistort):
        monkeypatch.setattr(module, "pycolmap", colmap_plain)
    return colmap_plain


def test_camera_models_are_numbered_and_have_the_same_parameters() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    for number, (name, model) in enumerate(colmap_plain.MODELS.items()):
        theirs = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 9.0, 4, 3)
        assert theirs.model_name == name and len(theirs.params) == model.parameters
        assert theirs.is_perspective_pinhole() == (model.focals > 0 and not model.fisheye)
        assert theirs.is_perspective_fisheye() == model.fisheye
    for number in (-1, len(colmap_plain.MODELS)):
        with pytest.raises(ValueError, match="no valid"):
            colmap_plain.CameraModelId(number)


@pytest.mark.parametrize("kind", LENSES)
def test_lenses(kind: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=kind, params=LENSES[kind], **SIZE)
    ours = colmap_plain.Camera(kind, LENSES[kind], **SIZE)
    random = np.random.default_rng(0)
    points, places = random.uniform(-0.6, 0.6, (200, 2)), random.uniform(0, 1, (200, 2)) * [160, 120]
    there = theirs.img_from_cam(np.column_stack([points, np.ones(200)]))
    np.testing.assert_allclose(ours.img_from_plane(points), there, atol=1e-9)
    np.testing.assert_allclose(ours.cam_from_img(places), theirs.cam_from_img(places), atol=1e-8)
    assert ours.is_undistorted() == theirs.is_undistorted()
    picture = random.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    bitmap, pinhole = colmap_plain.undistort_image(
        colmap_plain.UndistortCameraOptions(), colmap_plain.Bitmap.from_array(picture), ours
    )
    want, wanted = pycolmap.undistort_image(
        pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(picture), theirs
    )
    np.testing.assert_allclose(pinhole.params, wanted.params, atol=1e-9)
    assert np.abs(bitmap.to_array().astype(int) - want.to_array()).max() <= 1  # one level is their rounding
    for one in (ours, theirs):
        one.rescale(100, 60)
    np.testing.assert_allclose(ours.params, theirs.params, rtol=1e-12)
    np.testing.assert_allclose(ours.calibration_matrix(), theirs.calibration_matrix(), rtol=1e-12)


@pytest.mark.parametrize("form", ["binary", "text"])
def test_models_are_read_alike(tmp_path: Path, plain: Any, monkeypatch: pytest.MonkeyPatch, form: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    monkeypatch.setattr(colmap, "pycolmap", pycolmap)
    write_scene(tmp_path)
    if form == "text":
        as_text(tmp_path)
    model = tmp_path / "sparse" / "0"
    monkeypatch.setattr(colmap, "pycolmap", plain)
    ours, notes = read_colmap(model)
    monkeypatch.setattr(colmap, "pycolmap", pycolmap)
    theirs, others = read_colmap(model)
    assert [image.name for image in ours] == [image.name for image in theirs] and notes == others
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one.viewmat, other.viewmat, atol=1e-12)
        assert one.camera.params.tolist() == other.camera.params.tolist()
        assert (one.camera.width, one.camera.height) == (other.camera.width, other.camera.height)


def test_written_models_are_read_by_pycolmap(tmp_path: Path, plain: Any) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    xyz, rgb = np.arange(12.0).reshape(4, 3), np.arange(12, dtype=np.uint8).reshape(4, 3)
    colmap.write_model(tmp_path, [camera(0), camera(1)], ["a b.png", "ü.png"], xyz, rgb)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    found = sorted(model.images.values(), key=lambda image: image.name)
    assert [image.name for image in found] == ["a b.png", "ü.png"]
    for i, image in enumerate(found):
        np.testing.assert_allclose(image.cam_from_world().matrix(), camera(i).viewmat[:3], atol=1e-6)
    points = [model.points3D[i] for i in sorted(model.points3D)]
    np.testing.assert_array_equal([point.xyz for point in points], xyz)
    np.testing.assert_array_equal([point.color for point in points], rgb)
    assert colmap.load_points(tmp_path).tolist() == xyz.tolist()


def test_photographs_of_a_distorted_camera(tmp_path: Path, plain: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene as a user has it, read without pycolmap."""
    from PIL import Image

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    model = plain.Reconstruction()
    model.add_camera_with_trivial_rig(plain.Camera("OPENCV", LENSES["OPENCV"], **SIZE))
    for i in range(2):
        model.add_image_with_trivial_frame(plain.Image(name=f"{i}.png", camera_id=1, image_id=i + 1), plain.Rigid3d())
        Image.fromarray(seen(model.cameras[1])).save(tmp_path / f"{i}.png")
    (tmp_path / "sparse").mkdir()
    model.write_binary(str(tmp_path / "sparse"))
    loaded = load_scene(tmp_path)
    K = loaded.train[0].camera.K
    assert K[0, 0] == 140 and "undistorted from OPENCV" in loaded.notes[0]
    pinhole = plain.Camera("PINHOLE", [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], *loaded.train[0].image.shape[1::-1])
    off = np.abs(loaded.train[0].image.numpy().astype(int) - seen(pinhole))
    assert off.mean() < 1


@pytest.mark.parametrize("k", [-5.0, 1e8, -1e8])
def test_lenses_that_fold_give_a_picture_or_a_plain_error(k: float) -> None:
    folding = colmap_plain.Camera("OPENCV", [140, 140, 80, 60, k, 0, 0, 0], **SIZE)
    try:
        picture, pinhole = colmap_plain.undistort_image(
            colmap_plain.UndistortCameraOptions(), colmap_plain.Bitmap(pixels(0, 160, 120)), folding
        )
    except ValueError as error:
        assert "no picture" in str(error)
    else:
        assert picture.to_array().shape == (pinhole.height, pinhole.width, 3) and pinhole.width <= 320


@settings(deadline=None, max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_is_never_another_exception(tmp_path: Path, plain: Any, data: st.DataObject) -> None:
    whole, damaged = tmp_path / "whole", tmp_path / "damaged"
    if not whole.exists():
        whole.mkdir()
        colmap.write_model(whole, [camera(0), camera(1)], ["a.png", "b.png"], np.zeros((2, 3)))
    shutil.copytree(whole / "sparse" / "0", damaged, dirs_exist_ok=True)
    damage(data, sorted(damaged.iterdir()))
    try:
        read_colmap(damaged)
    except ClodError as error:
        assert str(damaged) in str(error)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text("0123456789 .-#\nnaPINHOLE", max_size=60), st.sampled_from(["cameras", "images", "points3D"]))
def test_damaged_text_is_never_another_exception(tmp_path: Path, plain: Any, text: str, file: str) -> None:
    (tmp_path / "cameras.txt").write_text("# of one camera\n1 PINHOLE 8 6 9 9 4 3\n")
    (tmp_path / "images.txt").write_text(
        "# two lines each\n1 1 0 0 0 0 0 0 1 a b.png\n\n2 1 0 0 0 0 0 1 1 c.png\n1 2 -1\n"
    )
    (tmp_path / "points3D.txt").write_text("1 0 0 1 255 0 0 0.5\n")
    assert [image.name for image in read_colmap(tmp_path)[0]] == ["a b.png", "c.png"]
    (tmp_path / f"{file}.txt").write_text(text)
    try:
        read_colmap(tmp_path)
    except ClodError as error:
        assert str(tmp_path) in str(error)


def test_it_stands_in_where_pycolmap_is_missing() -> None:
    code = (
        "import sys; sys.modules['pycolmap'] = None\n"
        "from clod_adapter.io.scene import colmap_plain, load, colmap_library\n"
        "assert colmap_library.pycolmap is colmap_plain"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
