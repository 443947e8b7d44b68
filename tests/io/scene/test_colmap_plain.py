"""``colmap_plain`` against pycolmap: camera models and lenses; for whole models see test_colmap."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from clod_adapter.errors import ClodError
from clod_adapter.io.scene import colmap_plain
from clod_adapter.io.scene.colmap import read_colmap
from photographs import LENSES, SIZE


def test_camera_models_have_the_numbers_and_parameters_of_pycolmap() -> None:
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
def test_lenses_match_pycolmap(kind: str) -> None:
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


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text("0123456789 .-#\nnaPINHOLE", max_size=60), st.sampled_from(["cameras", "images", "points3D"]))
@example("1 0 0 1 -1 0 0 0.5\n", "points3D")  # a colour that is no uint8
@pytest.mark.parametrize("library", ["plain"], indirect=True)
@pytest.mark.usefixtures("library")
def test_damaged_text_raises_only_clod_error(tmp_path: Path, text: str, file: str) -> None:
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


def test_replaces_a_missing_pycolmap() -> None:
    code = (
        "import sys; sys.modules['pycolmap'] = None\n"
        "from clod_adapter.io.scene import colmap_plain, load, colmap_library\n"
        "assert colmap_library.pycolmap is colmap_plain"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
