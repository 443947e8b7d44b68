"""The demo scene: camera positions, the point cloud, and the capture on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clod_adapter.cameras import Camera
from clod_adapter.demo import gallery as module
from clod_adapter.demo.gallery import HIGH, LOW, Gallery, unlit_room, write_gallery
from clod_adapter.demo.raytrace import camera_rays, trace_rays
from clod_adapter.demo.textures import photograph
from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap_library import pycolmap


@pytest.fixture(scope="module")
def gallery() -> Gallery:
    """The gallery without baked light, which takes seconds and does not change the geometry."""
    return Gallery(unlit_room(), samples=2)


def depth_map(gallery: Gallery, camera: Camera) -> np.ndarray:
    """``[H, W]`` distance along the ray through each pixel's centre."""
    eye, rays = camera_rays(camera)
    y, x = np.indices((camera.height, camera.width)).reshape(2, -1) + 0.5
    directions = np.column_stack([x, y, np.ones(len(x))]) @ rays.T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    out = np.empty((len(x), 4))
    trace_rays(gallery.tables, np.tile(eye, (len(x), 1)), directions, 1e-3, out)
    return out[:, 3].reshape(camera.height, camera.width)


def test_cameras_are_in_the_room_upright_and_named_in_order(gallery: Gallery) -> None:
    """None is inside an object; surfaces are near and far; a training view is near each test view."""
    cameras = gallery.cameras(40, 30)
    eyes = np.array([camera.position.numpy() for camera in cameras])
    assert (eyes > LOW + 0.3).all() and (eyes < HIGH - 0.3).all()
    groups = gallery.tables.groups
    low, high = (np.stack([groups[f"{end}_{axis}"] for axis in "xyz"], 1) for end in ("low", "high"))
    gap = np.maximum(np.maximum(low[None] - eyes[:, None], eyes[:, None] - high[None]), 0)
    assert np.linalg.norm(gap, axis=2).min() > 0.15
    assert [camera.name for camera in cameras] == [f"view_{k:03d}.png" for k in range(64)]
    for camera in cameras:
        R = camera.viewmat[:3, :3].double().numpy()
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(R) > 0 and abs(R[0, 1]) < 1e-6 and R[1, 1] > 0.8  # image down is world down
    middle = np.array([np.median(depth_map(gallery, camera)) for camera in cameras])
    assert middle.min() < 1.5 and middle.max() > 4
    assert np.isfinite(depth_map(gallery, cameras[0])).all()
    axes, train = np.stack([camera.viewmat[2, :3].numpy() for camera in cameras]), np.arange(64) % module.HOLD_OUT > 0
    for k in np.flatnonzero(~train):
        beside = np.linalg.norm(eyes - eyes[k], axis=1)[train & (axes @ axes[k] > 0.85)]
        assert np.sort(beside)[1] < 1.1, cameras[k].name
    for count in (1, 7, 24, 100):
        assert len(gallery.cameras(count=count)) == count


def test_points_lie_on_visible_surfaces(gallery: Gallery) -> None:
    first, again, other = (gallery.sample_points(50, seed)[0] for seed in (0, 0, 1))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    points, colors = gallery.sample_points(4000, seed=1)
    assert points.shape == colors.shape == (4000, 3) and points.dtype == np.float32 and colors.dtype == np.uint8
    for camera in gallery.cameras()[3:50:20]:
        local = points @ camera.viewmat[:3, :3].numpy().T + camera.viewmat[:3, 3].numpy()
        pixel = local @ camera.K.numpy().T
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (pixel[:, :2] / pixel[:, 2:]).T
        inside = (local[:, 2] > 0.1) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        x, y, distance = x[inside].astype(int), y[inside].astype(int), np.linalg.norm(local[inside], axis=1)
        visible = np.abs(depth_map(gallery, camera)[y, x] / distance - 1) < 0.02
        assert visible.sum() > 50
        difference = np.abs(gallery.render(camera)[y, x].astype(int) - colors[inside])[visible]
        assert np.median(difference) < 12, camera.name


def test_capture_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "bake_light", lambda tables: tables)
    seen: list[tuple[int, int]] = []
    folder = tmp_path / "capture"
    write_gallery(
        folder, width=32, height=24, count=9, points=500, progress=lambda now: seen.append((now.done, now.total))
    )
    assert seen == [(k, 9) for k in range(1, 10)]
    names = [f"view_{k:03d}.png" for k in range(9)]
    assert sorted(p.name for p in (folder / "images").iterdir()) == names
    image = np.asarray(Image.open(folder / "images" / names[0]))
    assert image.shape == (24, 32, 3) and image.std() > 20
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    assert sorted(image.name for image in model.images.values()) == names and len(model.points3D) == 500
    with pytest.raises(ClodError, match="not empty"):
        write_gallery(folder)
    with pytest.raises(ClodError, match="count"):
        write_gallery(tmp_path / "one", count=1)
    with pytest.raises(ClodError, match="no_such.png"):
        photograph("no_such.png")
