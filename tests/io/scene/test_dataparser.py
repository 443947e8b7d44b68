"""nerfstudio's frames, made here as its source makes them, from poses to exported splat."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap import write_model
from clod_adapter.io.scene.load import load_scene
from nerfstudio_frames import APPLIED, trained
from photographs import INTRINSICS, camera, to_world, write_frames, write_images

NAMES = [f"images/{i:03d}.png" for i in range(9)]


def in_colmap(count: int, seed: int) -> np.ndarray:
    """``[N, 4, 4]`` camera to world of COLMAP, in OpenGL's axes, as nerfstudio has them before it turns the world."""
    return np.array([to_world(seed + i) for i in range(count)])


def turned(poses: np.ndarray, applied: Any) -> np.ndarray:
    """The same as ns-process-data writes them into transforms.json."""
    return np.vstack([applied, [0, 0, 0, 1.0]]) @ poses if applied is not None else poses


def write_data(folder: Path, poses: np.ndarray, **rest: Any) -> None:
    """Photographs, and a transforms.json of their poses."""
    frames = [{"file_path": name, "transform_matrix": p.tolist()} for name, p in zip(NAMES, poses, strict=False)]
    write_images(folder, NAMES[: len(poses)])
    write_frames(folder, frames, **INTRINSICS, **rest)


def require_poses(folder: Path, want: np.ndarray) -> None:
    """The loaded cameras are ``want [N, 3, 4]``, camera to world in OpenGL's axes, up to the unit of length."""
    scene = load_scene(folder)
    views = sorted((*scene.train, *scene.test), key=lambda view: view.camera.name)
    found = torch.linalg.inv(torch.stack([view.camera.viewmat.double() for view in views])).numpy()
    np.testing.assert_allclose(found[:, :3, :3] * [1, -1, -1], want[:, :3, :3], atol=2e-5)
    np.testing.assert_allclose(found[:, :3, 3], want[:, :3, 3], atol=2e-5)
    assert any("dataparser_transforms.json" in note for note in scene.notes)
    assert not any("applied_transform" in note for note in scene.notes)


@settings(deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(["today", "older", "none"]), st.integers(0, 50), st.sampled_from([1.0, 0.25]))
def test_cameras_of_nerfstudio_data(tmp_path: Path, turn: str, seed: int, applied_scale: float) -> None:
    applied = APPLIED.get(turn)
    given_poses = turned(in_colmap(9, seed), applied)
    up = given_poses[:, :3, 1].mean(0)
    assume(up[2] > -0.9 * np.linalg.norm(up))  # near half a turn nerfstudio's own matrix is no rotation
    want, written = trained(given_poses, applied, applied_scale)
    rest = {} if applied is None else {"applied_transform": applied}
    rest |= {"applied_scale": applied_scale} if applied_scale != 1 else {}
    write_data(tmp_path, given_poses, **rest)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(written))
    require_poses(tmp_path, want)


@pytest.mark.parametrize("turn", ["today", "older"])
def test_cameras_of_the_colmap_model(tmp_path: Path, turn: str) -> None:
    """The colmap dataparser, or ns-process-data and its model: the world that is turned is COLMAP's."""
    want, written = trained(turned(in_colmap(9, 0), APPLIED[turn]), APPLIED[turn])
    write_model(tmp_path, [camera(i) for i in range(9)], [Path(name).name for name in NAMES])
    write_images(tmp_path, NAMES)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(written))
    require_poses(tmp_path, want)


def test_poses_that_nerfstudio_did_not_change(tmp_path: Path) -> None:
    """--orientation-method none --center-method none --auto-scale-poses False writes no more than applied_transform."""
    poses = turned(in_colmap(9, 3), APPLIED["today"])
    write_data(tmp_path, poses, applied_transform=APPLIED["today"])
    written = {"transform": APPLIED["today"], "scale": 1.0}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(written))
    require_poses(tmp_path, poses)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2]", "is no JSON object"),
        ("{", "is no JSON or damaged"),
        ("{}", "transform is no 3x4 or 4x4 matrix"),
        ('{"transform": "x"}', "transform is no 3x4 or 4x4 matrix"),
        ('{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1e400]]}', "transform is no 3x4 or 4x4 matrix"),
        ('{"transform": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}', "transform is no rotation"),
        ('{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]]}', "transform is no rotation"),
        *((f'{{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": {scale}}}', f"scale is {message}")
          for scale, message in (("0", "0"), ("NaN", "nan"), ("[1]", ""), ("true", "True"))),
    ],
)  # fmt: skip
def test_damaged_file_is_refused(tmp_path: Path, content: str, message: str) -> None:
    write_data(tmp_path, in_colmap(3, 0))
    (tmp_path / "dataparser_transforms.json").write_text(content)
    with pytest.raises(ClodError, match=f"dataparser_transforms.json: {message}"):
        load_scene(tmp_path)


@pytest.mark.parametrize("extra", [{"applied_transform": [[1]]}, {"applied_scale": -1}])
def test_invalid_applied_transform_is_refused(tmp_path: Path, extra: dict[str, Any]) -> None:
    write_data(tmp_path, in_colmap(3, 0), **extra)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(trained(in_colmap(3, 0), None)[1]))
    with pytest.raises(ClodError, match=f"transforms.json: {next(iter(extra))} is"):
        load_scene(tmp_path)
