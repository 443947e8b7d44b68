from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap import load_points, read_colmap, write_model
from clod_adapter.io.scene.colmap_library import pycolmap
from clod_adapter.io.scene.load import load_scene
from photographs import as_text, camera, pixels, pose, write_scene


@pytest.mark.parametrize("form", ["binary", "text", "before rigs"])
@pytest.mark.usefixtures("library")
def test_scene_round_trips(tmp_path: Path, form: str) -> None:
    cameras, names = write_scene(tmp_path)
    if form == "text":
        as_text(tmp_path)
    if form == "before rigs":
        for name in ("rigs.bin", "frames.bin"):
            (tmp_path / "sparse" / "0" / name).unlink(missing_ok=True)
    loaded = load_scene(str(tmp_path))
    assert loaded.notes == ()
    order = sorted(range(10), key=lambda i: names[i])
    held_out = [order[0], order[8]]
    assert [view.camera.name for view in loaded.test] == [names[i] for i in held_out]
    assert [view.camera.name for view in loaded.train] == [names[i] for i in order if i not in held_out]
    for view in (*loaded.train, *loaded.test):
        i = names.index(view.camera.name)
        torch.testing.assert_close(view.camera.viewmat, cameras[i].viewmat, atol=1e-6, rtol=0)
        torch.testing.assert_close(view.camera.K, cameras[i].K, atol=0, rtol=0)
        assert view.camera.viewmat.dtype == view.camera.K.dtype == torch.float32
        np.testing.assert_array_equal(view.image, pixels(i))


def test_model_and_images_are_found_in_other_folders(tmp_path: Path) -> None:
    write_scene(tmp_path, 2)
    model = tmp_path / "sparse" / "0"
    assert len(load_scene(model).train) == 1  # images beside the model's parent
    for file in model.iterdir():
        file.rename(tmp_path / "sparse" / file.name)
    model.rmdir()
    assert len(load_scene(tmp_path).train) == 1
    assert len(load_scene(tmp_path / "images").train) == 1  # the images' own folder
    (tmp_path / "images" / "sub").rename(tmp_path / "sub")  # images beside sparse/
    assert len(load_scene(tmp_path).train) == 1
    with pytest.raises(ClodError, match="no COLMAP model"):
        load_scene(tmp_path / "images" / "deeper")


@pytest.mark.usefixtures("library")
def test_written_model_is_read_by_pycolmap(tmp_path: Path) -> None:
    xyz, rgb = np.arange(12.0).reshape(4, 3), np.arange(12, dtype=np.uint8).reshape(4, 3)
    cameras, names = [camera(0), camera(1), camera(2, focal=50.0)], ["a b.png", "c.png", "ü.png"]
    write_model(tmp_path, cameras, names, xyz, rgb)
    assert {p.name for p in (tmp_path / "sparse").iterdir()} == {"0"}
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert len(model.cameras) == 2 and {c.model_name for c in model.cameras.values()} == {"PINHOLE"}
    found = sorted(model.images.values(), key=lambda image: image.name)
    assert [image.name for image in found] == names
    for image, wanted in zip(found, cameras, strict=True):
        np.testing.assert_allclose(image.cam_from_world().matrix(), wanted.viewmat[:3], atol=1e-6)
    points = [model.points3D[i] for i in sorted(model.points3D)]
    np.testing.assert_array_equal([point.xyz for point in points], xyz)
    np.testing.assert_array_equal([point.color for point in points], rgb)
    assert sorted(load_points(tmp_path).tolist()) == xyz.tolist()
    for folder, names, message in (
        (tmp_path, ["a.png"], "not empty"),
        (tmp_path, ["a.png", "a.png"], "as many different names"),
        (tmp_path / "no", ["a.png"], "does not exist"),
    ):
        with pytest.raises(ClodError, match=message):
            write_model(folder, cameras[: len(names)], names)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "frames.bin", "rigs.bin"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_truncated_model_is_refused(tmp_path: Path, file: str, share: float) -> None:
    if file in ("frames.bin", "rigs.bin"):
        pytest.importorskip("pycolmap")  # which alone writes them
    # Handed to COLMAP as it is, a cut points3D.bin makes it allocate until memory runs out.
    xyz = np.zeros((4, 3))
    write_model(tmp_path, [camera(0), camera(1)], ["a.png", "b.png"], xyz)
    path = tmp_path / "sparse" / "0" / file
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(ClodError, match=f"{file}: is truncated"):
        load_scene(tmp_path)


def test_poses_of_a_rig_are_composed(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")  # which alone writes rigs
    reconstruction = pycolmap.Reconstruction()
    for i in (1, 2, 3):
        size = {"width": 40, "height": 30}
        reconstruction.add_camera(pycolmap.Camera(model="PINHOLE", params=[33, 33, 20, 15], camera_id=i, **size))
    rig = pycolmap.Rig(rig_id=1)
    sensors = [pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=i) for i in (1, 2, 3)]
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], pycolmap.Rigid3d(pose(1)[:3].double().numpy()))
    rig.add_sensor(sensors[2], None)
    reconstruction.add_rig(rig)
    frame = pycolmap.Frame(rig_id=1, frame_id=1)
    frame.add_data_id(pycolmap.data_t(sensor_id=sensors[0], id=1))
    frame.add_data_id(pycolmap.data_t(sensor_id=sensors[1], id=2))
    frame.rig_from_world = pycolmap.Rigid3d(pose(2)[:3].double().numpy())
    reconstruction.add_frame(frame)
    for i in (1, 2):
        image = pycolmap.Image(name=f"{i}.png", camera_id=i, image_id=i)
        image.frame_id = 1
        reconstruction.add_image(image)
        Image.fromarray(pixels(i)).save(tmp_path / f"{i}.png")
    reconstruction.register_frame(1)
    (tmp_path / "sparse").mkdir()
    reconstruction.write_binary(str(tmp_path / "sparse"))
    loaded = load_scene(tmp_path)
    torch.testing.assert_close(loaded.test[0].camera.viewmat, pose(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(loaded.train[0].camera.viewmat, pose(1) @ pose(2), atol=1e-5, rtol=0)
    rigs = (tmp_path / "sparse" / "rigs.bin").read_bytes()
    (tmp_path / "sparse" / "rigs.bin").write_bytes(rigs[:-1])
    with pytest.raises(ClodError, match="rigs.bin: is truncated"):
        load_scene(tmp_path)


def test_empty_and_damaged_models_are_refused(tmp_path: Path) -> None:
    write_model(tmp_path, [], [])
    with pytest.raises(ClodError, match="no registered image"):
        load_scene(tmp_path)
    as_text(tmp_path)
    (tmp_path / "sparse" / "0" / "images.txt").write_text("1 nonsense\n\n")
    with pytest.raises(ClodError, match="COLMAP cannot read this model"):
        load_scene(tmp_path)
    (tmp_path / "sparse" / "0" / "cameras.txt").write_text(f"1 PINHOLE 40 30 {'1' * 10_000} 33 20 15\n")
    with pytest.raises(ClodError, match="cameras.txt: .*a number of more than 1,000 digits"):
        load_scene(tmp_path)


@pytest.mark.usefixtures("library")
def test_a_quaternion_of_zeros_is_refused(tmp_path: Path) -> None:
    """COLMAP reads it as no rotation."""
    write_scene(tmp_path, 2)
    for name, at in (("images.bin", 12), ("frames.bin", 16)):
        if (path := tmp_path / "sparse" / "0" / name).exists():
            data = path.read_bytes()
            path.write_bytes(data[:at] + bytes(32) + data[at + 32 :])
    with pytest.raises(ClodError, match=r"sparse/0: image '.*png' has a camera or pose that is not usable"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("name", "train", "test", "size"),
    [("ci_banana", 12, 2, (332, 221)), ("plush_half", 84, 13, (494, 370)), ("bonsai146", 127, 19, (798, 531))],
)
def test_real_scenes_load(
    shared_data: Callable[[str], Path], name: str, train: int, test: int, size: tuple[int, int]
) -> None:
    loaded = load_scene(shared_data(name))
    assert (len(loaded.train), len(loaded.test), loaded.notes) == (train, test, ())
    first = loaded.test[0].camera
    assert (first.width, first.height) == size and first.name < loaded.train[0].camera.name
    assert first.K[0, 2] == size[0] / 2
    rotation = first.viewmat[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)


def test_unreadable_model_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cameras.bin").write_bytes(b"")

    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(ClodError, match="cameras.bin: cannot be read .Permission denied"):
        read_colmap(tmp_path)
