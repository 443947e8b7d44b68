"""Scenes of nerfstudio, instant-ngp and Blender; and nerfstudio's frames, made here as its source
makes them.
"""

import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from refusals import refused
from torch.testing import assert_close

from clod_adapter._support.text import file_name
from clod_adapter.cameras import intrinsics
from clod_adapter.io.scene.folder import UNUSED, scene_files
from clod_adapter.io.scene.load import load_cameras, load_scene
from formats import examples
from models import write_model
from photographs import (
    INTRINSICS,
    camera,
    model_of,
    names_of,
    pixels,
    pose,
    to_world,
    views_of,
    write_frames,
    write_images,
)


def frame(i, path="", **rest):
    name = path or f"images/{i:03d}.png"
    return {"file_path": name, "transform_matrix": to_world(i), **rest}


def test_nerfstudio_file(tmp_path):
    # sorted by name, whatever the order in the file
    frames = [frame(i) for i in reversed(range(10))]
    frames[0]["fl_x"] = 33.0  # its own camera
    write_frames(
        tmp_path,
        frames,
        camera_model="OPENCV",
        k1=0,
        k2=0,
        p1=0,
        p2=0,
        ply_file_path="no.ply",
        **INTRINSICS,
    )
    write_images(tmp_path, [f"images/{i:03d}.png" for i in range(10)])
    loaded = load_scene(tmp_path)
    assert loaded.notes == ()
    assert names_of(loaded.test) == ["images/000.png", "images/008.png"]
    for view in (*loaded.train, *loaded.test):
        i = int(view.camera.name[7:10])
        assert_close(view.camera.viewmat, pose(i), atol=1e-5, rtol=0)
        want = camera(i, focal=30.0).K
        want[0, 0] = 33 if i == 9 else 30
        assert_close(view.camera.K, want)
        assert_array_equal(view.image, pixels(i))


def test_blender_files(tmp_path):
    """Names without an extension, a field of view and no size, and files for training and
    testing.
    """
    angle = 2 * math.atan(20 / 50)
    for split, count in (("train", 3), ("test", 2), ("val", 1)):
        names = [f"./{split}/r_{i}" for i in range(count)]
        frames = [frame(2, name, rotation=0.01) for name in names]
        write_frames(tmp_path, frames, f"transforms_{split}.json", camera_angle_x=angle)
        write_images(tmp_path, [f"{name}.png" for name in names])
    loaded = load_scene(tmp_path)
    assert names_of(loaded.train) == [
        "train/r_0.png",
        "train/r_1.png",
        "train/r_2.png",
    ]
    assert names_of(loaded.test) == ["test/r_0.png", "test/r_1.png"]
    assert loaded.notes == ("held out are the photographs of transforms_test.json",)
    assert_close(loaded.train[0].camera.K, intrinsics(50.0, 50, 20, 15))
    (tmp_path / "transforms_test.json").unlink()
    loaded = load_scene(tmp_path)
    assert (names_of(loaded.test), len(loaded.train)) == (["train/r_0.png"], 2)


def test_lists_of_nerfstudio_are_its_split(tmp_path):
    """Photographs that it does not train on are held out, in a list or in none; paths without an
    extension as in the frames.
    """
    names = [f"./images/{i}" for i in range(6)]
    frames = [frame(i, name) for i, name in enumerate(names)]
    write_images(tmp_path, [f"{name}.png" for name in names])
    both = {"val_filenames": names[1:2], "test_filenames": names[4:5]}
    elsewhere = {"val_filenames": ["1.JPG"], "test_filenames": ["/there/images/4.png"]}
    training = {"train_filenames": names[2:], **both}
    for lists, want in ((training, [0, 1]), (both, [1, 4]), (elsewhere, [1, 4])):
        write_frames(tmp_path, frames, **INTRINSICS, **lists)
        loaded = load_scene(tmp_path)
        assert names_of(loaded.test) == [f"images/{i}.png" for i in want]
        assert loaded.notes == (
            "held out are 2 photographs, those of the lists of transforms.json",
        )
    write_frames(tmp_path, frames, **INTRINSICS, test_filenames=[3])
    with refused("transforms.json: test_filenames is no list of file names"):
        load_scene(tmp_path)


def test_instant_ngp_file(tmp_path):
    """Angles in place of focal lengths; one focal length for both axes; JPEGs under names without
    an extension.
    """
    angles = {"camera_angle_x": 1.0, "camera_angle_y": 0.8}
    one = write_frames(tmp_path / "one", [frame(0)], aabb_scale=16, w=40, h=30, **angles)
    two = write_frames(
        tmp_path / "two",
        [frame(0), frame(1, "images/ä.001")],
        fl_x=30.0,
        scale=0.3,
    )
    write_images(one, ["images/000.png"])
    write_images(two, ["images/000.png", "images/ä.001.jpg"])
    K = load_scene(one).train[0].camera.K
    assert_close(K.diag()[:2], torch.tensor([20 / math.tan(0.5), 15 / math.tan(0.4)]))
    view = load_scene(two).train[0]
    assert view.camera.name == "images/ä.001.jpg"
    assert view.camera.K.tolist() == [[30, 0, 20], [0, 30, 15], [0, 0, 1]]


def test_size_of_a_photograph_of_another_suffix(tmp_path):
    write_frames(tmp_path, [frame(0, "a.jpg"), frame(0, "b")], fl_x=30.0)
    write_images(tmp_path, ["a.png", "b.WEBP"])
    loaded = load_scene(tmp_path)
    assert (loaded.train[0].camera.width, loaded.test[0].camera.width) == (40, 40)
    assert loaded.notes == (
        f"2 of 2 photographs have another suffix or case, such as a.png in {tmp_path.name}",
    )


LENS = {"k1": -0.15, "k2": 0.05, "p1": 0.004, "p2": -0.003}
ROUND = {"k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": 0.001}


@pytest.mark.parametrize(
    ("message", "model", "params"),
    [
        ({"camera_model": "OPENCV", **LENS}, "OPENCV", [*LENS.values()]),
        ({**LENS, "k3": 0.02}, "FULL_OPENCV", [*LENS.values(), 0.02, 0, 0, 0]),
        ({"camera_model": "OPENCV_FISHEYE", **ROUND}, "OPENCV_FISHEYE", [*ROUND.values()]),
        ({"is_fisheye": True, **ROUND}, "OPENCV_FISHEYE", [*ROUND.values()]),
    ],
)
def test_distorted_photographs_are_undistorted(tmp_path, monkeypatch, message, model, params):
    """They equal those of a COLMAP model with the same lens."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    size, views = {"fl_x": 120, "fl_y": 122, "cx": 82, "cy": 58, "w": 160, "h": 120}, []
    write_frames(tmp_path / "a", [frame(0, "a.png")], **size, **message)
    model_of(tmp_path / "b", model, [120, 122, 82, 58, *params], 160, 120)
    for scene in (tmp_path / "a", tmp_path / "b"):
        Image.fromarray(pixels(0, 160, 120)).save(scene / "a.png")
        loaded = load_scene(scene)
        views.append(loaded.train[0])
        assert f"undistorted from {model} into" in loaded.notes[0]
    assert torch.equal(views[0].image, views[1].image)
    assert torch.equal(views[0].camera.K, views[1].camera.K)


def test_colmap_model_takes_precedence(tmp_path):
    model_of(tmp_path, "PINHOLE", [33, 33, 20, 15])
    write_frames(tmp_path, [frame(0)], **INTRINSICS)
    write_images(tmp_path, ["images/a.png"])
    loaded = load_scene(tmp_path)
    assert loaded.notes == ("the cameras are the COLMAP model's, not those of transforms.json",)
    assert loaded.train[0].camera.K[0, 0] == 33
    deeper = write_frames(tmp_path / "images", [frame(0, "a")], **INTRINSICS)
    # nearer than the model beside the folder
    assert load_scene(deeper).train[0].camera.K[0, 0] == 30


def test_missing_photographs_and_unused_entries_are_noted(tmp_path):
    frames = [frame(i, mask_path="masks/0.png") for i in range(10)]
    write_frames(
        tmp_path, frames, fl_x=30.0, applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    )
    write_images(tmp_path, [f"images/{i:03d}.png" for i in range(10) if i != 3])
    assert load_scene(tmp_path).notes == (
        (
            "transforms.json turned COLMAP's world (applied_transform): a checkpoint of the turned"
            " one is needed"
        ),
        f"the masks of transforms.json are {UNUSED}",
        "1 of 10 photographs are missing and left out (images/003.png)",
    )
    for i in range(4, 9):
        (tmp_path / "images" / f"{i:03d}.png").unlink()
    with refused("6 of 10 images of transforms.json are missing"):
        load_scene(tmp_path)


@pytest.mark.parametrize("start", ["/home/other/scene/", "C:\\scenes\\", "../", "../scene/./"])
def test_paths_of_another_machine_end_in_the_folder(tmp_path, start):
    """A file of the whole path, outside of the folder, is never read."""
    scene, names = tmp_path / "scene", [f"images/{i}" for i in range(3)]
    frames = [frame(i, start + name) for i, name in enumerate(names)]
    write_frames(scene, frames, **INTRINSICS, test_filenames=[start + names[1]])
    write_images(tmp_path, [f"{name}.png" for name in names])
    with refused("transforms.json: image name .* leaves the images folder .*; put the photograph"):
        load_scene(scene)
    write_images(scene, [f"{name}.png" for name in names])
    loaded = load_scene(scene)
    assert names_of((*loaded.train, *loaded.test)) == [f"images/{i}.png" for i in (0, 2, 1)]
    assert (
        "paths of transforms.json lead out of its folder: photographs are those in it"
        in loaded.notes
    )


def changed(row, column, value):
    matrix = np.eye(4)
    matrix[row, column] = value
    return {"transform_matrix": matrix.tolist()}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *(
            ({"file_path": name}, "image name .*leaves the images folder")
            for name in ("../a.png", "sub/../../a.png", "/etc/a.png", "..\\a.png", "C:\\a.png", "")
        ),
        *(
            ({"file_path": name}, "image name .*is no file's name")
            for name in ("a" * 300 + ".png", "a/" * 2500 + "b.png", "\u00e9" * 130, "\x1b[2J.png")
        ),
        ({"file_path": "\ud800.png"}, "is not UTF-8"),
        ({"file_path": 3}, "frame 0 has no file_path"),
        ({"transform_matrix": None}, "frame a.png: transform_matrix is no 3x4 or 4x4 matrix"),
        *(
            ({"transform_matrix": matrix}, "no 3x4 or 4x4 matrix of finite")
            for matrix in ("none", [[1, 0, 0], [0, 1, 0]], [[10**400, 0, 0, 0]] * 4)
        ),
        (changed(0, 0, math.nan), "no 3x4 or 4x4 matrix of finite"),
        (changed(0, 3, 1e12), "'a.png' has a camera or pose that is not usable"),
        *(
            (changed(*entry), "frame a.png: transform_matrix is no rotation")
            for entry in ((0, 0, 1e200), (0, 0, 1.1), (1, 1, -1), (3, 0, 1))
        ),
        *(({"fl_x": value}, "fl_x is no number") for value in ("wide", math.inf)),
        *(
            (change, "neither fl_x nor camera_angle_x")
            for change in ({"fl_x": -30}, {"fl_x": 0, "camera_angle_x": 4})
        ),
        ({"w": 1e30}, "w is no number between"),
        ({"cx": [1]}, "cx is no number"),
        ({"k1": math.nan}, "k1 is no number"),
        ({"k4": 0.1}, "k4 of a camera that is no fisheye"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model 'EQUIRECTANGULAR' is not known"),
        ({"camera_model": {"a": 1}}, "camera_model .* is not known"),
        *(
            (content, "transforms.json: .*no JSON or damaged")
            for content in (b"", b'{"frames": [', b"\xff\xfe\x00", b"[" * 100_000)
        ),
        (
            b'{"frames": ' + b"9" * 10_000 + b"}",
            "transforms.json: .*a number of more than 1,000 digits",
        ),
        (b"[]", "transforms.json: is no JSON object"),
        (b'{"frames": [3]}', "frame 0 has no file_path"),
        *(
            (content, "transforms.json: .*no list of frames")
            for content in (b'{"frames": []}', b'{"frames": {}}')
        ),
        (b"{", "transforms.json: is larger than 256 MB"),
    ],
)
def test_invalid_files_and_frames_are_refused(tmp_path, change, message):
    if isinstance(change, bytes):
        (tmp_path / "transforms.json").write_bytes(change)
        os.truncate(
            tmp_path / "transforms.json", 300 * 2**20 if "256 MB" in message else len(change)
        )
    else:
        write_frames(tmp_path, [frame(0, "a.png") | INTRINSICS | change])
    with refused(message) as caught:
        load_scene(tmp_path)
    assert str(caught.value).isprintable()


def test_camera_without_a_size_is_left_out(tmp_path):
    frames = [frame(0, "0.png"), frame(1, "1.png", w=20, h=10)]
    write_frames(tmp_path, frames, camera_angle_x=1.0)
    cameras, notes = load_cameras(tmp_path)
    assert [camera.name for camera in cameras] == ["1.png"]
    assert notes == ["1 of 2 cameras left out: neither transforms.json nor a photograph has a size"]
    write_frames(tmp_path, frames[:1], camera_angle_x=1.0)
    with refused("transforms.json: has no size of a photograph.*put them beside it, or w"):
        load_cameras(tmp_path)


def test_files_of_transforms_scenes(tmp_path):
    train = {
        "frames": [
            {"file_path": "./train/r_0", "mask_path": "masks/0.png"},
            {"file_path": "rgb\\ü.jpg"},
            7,
        ]
    }
    test = {
        "frames": [
            {"file_path": "test/r_0.png", "depth_file_path": "depth/0.tif"},
            {"file_path": "a\0\ud800"},
        ]
    }
    (tmp_path / "transforms_train.json").write_text(json.dumps(train))
    (tmp_path / "transforms_test.json").write_text(json.dumps(test))
    (tmp_path / "transforms.json").write_text("no JSON")
    names = [
        *map(
            file_name, ["train/r_0.png", "rgb/ü.jpg", "masks/0.png", "test/r_0.png", "depth/0.tif"]
        )
    ]
    for name in [*names, "train/r_1.png"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = {str(path.relative_to(tmp_path)) for path in scene_files(tmp_path) if path.is_file()}
    assert found == {*names, "transforms.json", "transforms_train.json", "transforms_test.json"}


NAMES = [f"images/{i:03d}.png" for i in range(9)]
APPLIED = {  # how nerfstudio turned COLMAP's world: today, and before
    "today": [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
    "older": [[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]],
}


def trained(poses, applied, applied_scale=1.0):
    """Poses after nerfstudio's ``auto_orient_and_center_poses`` by default, and its
    dataparser_transforms.json.
    """
    centre, up = poses[:, :3, 3].mean(0), poses[:, :3, 1].mean(0)
    up /= np.linalg.norm(up)
    v, cosine = np.cross(up, [0, 0, 1.0]), up[2]
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    rotation = np.eye(3) + skew + skew @ skew * ((1 - cosine) / (np.linalg.norm(v) ** 2 + 1e-8))
    transform = np.concatenate([rotation, rotation @ -centre[:, None]], 1)
    oriented = transform @ poses
    scale = 1 / np.abs(oriented[:, :3, 3]).max()
    oriented[:, :3, 3] *= scale
    if applied is not None:
        transform = transform @ np.vstack([applied, [0, 0, 0, 1.0]])
    return oriented, {"transform": transform.tolist(), "scale": float(scale * applied_scale)}


def in_colmap(count, seed):
    """``[N, 4, 4]`` camera to world of COLMAP, in OpenGL's axes, as nerfstudio has them before it
    turns the world.
    """
    return np.array([to_world(seed + i) for i in range(count)])


def write_data(folder, poses, **rest):
    frames = [
        {"file_path": name, "transform_matrix": p.tolist()}
        for name, p in zip(NAMES, poses, strict=False)
    ]
    write_images(folder, NAMES[: len(poses)])
    write_frames(folder, frames, **INTRINSICS, **rest)


@examples(15)
@given(
    st.sampled_from(["today", "older", "none"]),
    st.integers(0, 50),
    st.sampled_from([1.0, 0.25, None]),
)
@example("today", 0, None)
@example("older", 0, None)
def test_cameras_of_nerfstudio(tmp_path, turn, seed, applied_scale):
    """Cameras of its transforms.json; or, without a scale, of a COLMAP model, whose own world is
    turned.
    """
    applied = APPLIED.get(turn)
    poses = in_colmap(9, seed)
    # as ns-process-data
    turned = poses if applied is None else np.vstack([applied, [0, 0, 0, 1.0]]) @ poses
    up = turned[:, :3, 1].mean(0)
    # near half a turn nerfstudio's own matrix is no rotation
    assume(up[2] > -0.9 * np.linalg.norm(up))
    want, written = trained(turned, applied, applied_scale or 1.0)
    shutil.rmtree(tmp_path / "scene", ignore_errors=True)
    scene = tmp_path / "scene"
    if applied_scale is None:
        write_model(
            scene, [camera(seed + i) for i in range(9)], [Path(name).name for name in NAMES]
        )
        write_images(scene, NAMES)
    else:
        rest = {} if applied is None else {"applied_transform": applied}
        write_data(
            scene,
            turned,
            **rest,
            **({} if applied_scale == 1 else {"applied_scale": applied_scale}),
        )
    (scene / "dataparser_transforms.json").write_text(json.dumps(written))
    loaded = load_scene(scene)
    views = views_of(loaded)
    found = torch.linalg.inv(torch.stack([view.camera.viewmat.double() for view in views])).numpy()
    assert_allclose(found[:, :3, :3] * [1, -1, -1], want[:, :3, :3], atol=2e-5)
    assert_allclose(found[:, :3, 3], want[:, :3, 3], atol=2e-5)
    assert any("dataparser_transforms.json" in note for note in loaded.notes)
    assert not any("applied_transform" in note for note in loaded.notes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "transform is no 3x4 or 4x4 matrix"),
        ('{"transform": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}', "transform is no rotation"),
        (
            '{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0}',
            "scale is no number",
        ),
    ],
)
def test_damaged_frame_of_nerfstudio_is_refused(tmp_path, content, message):
    write_data(tmp_path, in_colmap(3, 0))
    (tmp_path / "dataparser_transforms.json").write_text(content)
    with refused(f"dataparser_transforms.json: {message}"):
        load_scene(tmp_path)
    (tmp_path / "dataparser_transforms.json").write_text(
        json.dumps(trained(in_colmap(3, 0), None)[1])
    )
    for extra in ({"applied_transform": [[1]]}, {"applied_scale": -1}):
        write_data(tmp_path, in_colmap(3, 0), **extra)
        with refused(f"transforms.json: {next(iter(extra))} is"):
            load_scene(tmp_path)
