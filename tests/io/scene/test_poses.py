"""Cameras without photographs."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
import scenes
from clod_adapter.cameras import camera_extent
from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap import write_model
from clod_adapter.io.scene.poses import load_cameras


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (10.0, -20.0, 30.0)])
def test_cameras_equal_those_of_load_scene(capture: Any, origin: tuple[float, float, float]) -> None:
    scene = clod_adapter.load_scene(capture.scene, origin=origin)
    views = sorted([*scene.train, *scene.test], key=lambda view: view.camera.name)
    cameras, notes = load_cameras(capture.scene, origin)
    assert notes == [] and [camera.name for camera in cameras] == [view.camera.name for view in views]
    for camera, view in zip(cameras, views, strict=True):
        assert torch.equal(camera.viewmat, view.camera.viewmat) and torch.equal(camera.K, view.camera.K)
        assert (camera.width, camera.height) == (view.camera.width, view.camera.height)
    names = [camera.name for camera in load_cameras(capture.scene, training=True)[0]]
    assert names == [view.camera.name for view in scene.train] and len(names) == 8


def test_cameras_are_in_the_frame_of_nerfstudio(capture: Any, tmp_path: Path) -> None:
    shutil.copytree(capture.scene, tmp_path / "scene")
    frame = {"transform": [[0, 1, 0, 1], [-1, 0, 0, 2], [0, 0, 1, 3]], "scale": 0.5}
    (tmp_path / "scene" / "dataparser_transforms.json").write_text(json.dumps(frame))
    want = clod_adapter.load_scene(tmp_path / "scene").train[0].camera
    camera = load_cameras(tmp_path / "scene", training=True)[0][0]
    assert torch.equal(camera.viewmat, want.viewmat) and camera.near == want.near


def test_near_plane_follows_the_unit_of_length(tmp_path: Path) -> None:
    size = 1e-3
    cameras = [replace(c, viewmat=_moved(c.viewmat, size)) for c in scenes.ring(4, 20, 10)]
    write_model(tmp_path, cameras, [camera.name for camera in cameras])
    assert {camera.near for camera in load_cameras(tmp_path)[0]} == {0.01 * camera_extent(cameras)}


def _moved(viewmat: torch.Tensor, by: float) -> torch.Tensor:
    """The pose in a world that is ``by`` times as large."""
    return torch.cat([viewmat[:, :3], viewmat[:, 3:] * torch.tensor([[by], [by], [by], [1.0]])], 1)


def test_missing_photographs_are_no_error(capture: Any, tmp_path: Path) -> None:
    shutil.copytree(capture.scene / "sparse", tmp_path / "sparse")
    assert len(load_cameras(tmp_path)[0]) == 10
    shutil.rmtree(tmp_path / "sparse")
    with pytest.raises(ClodError, match="no COLMAP model"):
        load_cameras(tmp_path)


def test_camera_without_a_size_is_left_out(tmp_path: Path) -> None:
    frames = [{"file_path": f"{k}.png", "transform_matrix": torch.eye(4).tolist()} for k in range(2)]
    frames[1] |= {"w": 20, "h": 10}
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    cameras, notes = load_cameras(tmp_path)
    assert [camera.name for camera in cameras] == ["1.png"]
    assert notes == ["1 of 2 cameras left out: neither transforms.json nor a photograph has a size"]
    del frames[1]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    with pytest.raises(ClodError, match="transforms.json: has no size of a photograph.*put them beside it, or w"):
        load_cameras(tmp_path)
