from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap import read_colmap
from clod_adapter.io.scene.colmap_records import check_records
from clod_adapter.io.scene.load import load_scene
from photographs import damage, write_images

pycolmap = pytest.importorskip("pycolmap")  # which alone writes rigs, frames and text
FORMS = ("binary", "text")


def model(folder: Path, form: str, names: tuple[str, ...] = ("a.png", "sub/b.png")) -> Path:
    """Images of one camera, and points that they see."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", params=[9, 9, 4, 3], camera_id=1, width=8, height=6)
    reconstruction.add_camera_with_trivial_rig(camera)
    for number, name in enumerate(names, start=1):
        keypoints = [pycolmap.Point2D(np.array([k, number], float)) for k in range(2)]
        image = pycolmap.Image(name=name, camera_id=1, image_id=number, points2D=keypoints)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for k in range(2):
        track = pycolmap.Track([pycolmap.TrackElement(number, k) for number in range(1, len(names) + 1)])
        reconstruction.add_point3D(np.array([k, 1, 5], float), track, np.zeros(3, np.uint8))
    target = folder / "sparse" / "0"
    target.mkdir(parents=True, exist_ok=True)
    getattr(reconstruction, f"write_{form}")(str(target))
    return target


@settings(deadline=None, max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data(), st.sampled_from(FORMS), st.booleans())
@pytest.mark.usefixtures("library")
def test_damage_raises_only_clod_error(tmp_path: Path, data: st.DataObject, form: str, rigs: bool) -> None:
    whole = model(tmp_path / form, form)
    damaged = tmp_path / "damaged"
    shutil.rmtree(damaged, ignore_errors=True)
    shutil.copytree(whole, damaged)
    for path in sorted(damaged.iterdir()):
        if not rigs and path.stem in ("rigs", "frames"):
            path.unlink()
    damage(data, sorted(damaged.iterdir()))
    try:
        read_colmap(damaged)
    except ClodError as error:
        assert str(damaged) in str(error)


@pytest.mark.parametrize("file", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("count", [1 << 31, 1 << 62, (1 << 64) - 1])
def test_counts_beyond_the_file_are_refused(tmp_path: Path, file: str, count: int) -> None:
    path = model(tmp_path, "binary") / f"{file}.bin"
    path.write_bytes(count.to_bytes(8, "little") + path.read_bytes()[8:])
    with pytest.raises(ClodError, match=f"{file}.bin: is truncated or damaged"):
        check_records(path.parent)


@pytest.mark.parametrize("file", ["rigs.bin", "frames.txt"])
def test_pipes_are_refused(tmp_path: Path, file: str) -> None:
    target = model(tmp_path, "binary")
    (target / file).unlink(missing_ok=True)
    os.mkfifo(target / file)
    with pytest.raises(ClodError, match=f"{file}: .*not a regular file"):
        read_colmap(target)


@pytest.mark.parametrize("form", FORMS)
def test_long_names_and_control_characters_are_refused(tmp_path: Path, form: str) -> None:
    for name in ("a" * 300 + ".png", "\x1b[2Ja.png"):
        target = model(tmp_path, form, (name,))
        with pytest.raises(ClodError, match="is no file's name") as caught:
            read_colmap(target)
        assert "\x1b" not in str(caught.value)


@pytest.mark.skipif(sys.getfilesystemencoding() != "utf-8", reason="files have ASCII names here")
def test_unusual_names_are_read(tmp_path: Path) -> None:
    names = ("$HOME.png", "a.b/c d.png", "sub\\of windows.png", "~/a.png", "äö ü/日本 (1).png")
    model(tmp_path, "binary", names)
    write_images(tmp_path / "images", [name.replace("\\", "/") for name in names], width=8, height=6)
    scene = load_scene(tmp_path)
    assert [view.camera.name for view in (*scene.test, *scene.train)] == list(names)


@pytest.mark.skipif(sys.platform == "win32", reason="links take rights there")
def test_symbolic_links_to_images_are_followed(tmp_path: Path) -> None:
    """They are the user's; a name in a model cannot create one."""
    model(tmp_path / "scene", "binary")
    write_images(tmp_path / "elsewhere", ["a.png", "sub/b.png"], width=8, height=6)
    (tmp_path / "scene" / "images").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    assert len(load_scene(tmp_path / "scene").train) == 1
