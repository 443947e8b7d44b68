"""Photographs without the distortion of COLMAP's lenses, in plain numpy.

Source: COLMAP, ``src/colmap/image/undistortion.cc``.
"""

from __future__ import annotations

import numpy as np

from clod_adapter.io.scene.colmap_lenses import Lens


def undistorted_camera(camera: Lens) -> Lens:
    """The pinhole camera of the same focal length whose picture has no blank pixel, 0.2 to 2 times as wide and high.

    Raises:
        ValueError: no point of the picture's border has a direction.
    """
    fx, fy = camera.focal_length_x, camera.focal_length_y
    cx, cy = camera.center
    down, across = np.arange(camera.height) + 0.5, np.arange(camera.width) + 0.5
    sides = {
        "left": np.column_stack([np.full_like(down, 0.5), down]),
        "right": np.column_stack([np.full_like(down, camera.width - 0.5), down]),
        "top": np.column_stack([across, np.full_like(across, 0.5)]),
        "bottom": np.column_stack([across, np.full_like(across, camera.height - 0.5)]),
    }
    seen = {name: camera.cam_from_img(border) * (fx, fy) + (cx, cy) for name, border in sides.items()}
    if any(np.isnan(points).all() for points in seen.values()):
        raise ValueError("the lens leaves no picture")
    left, top = np.nanmax(seen["left"][:, 0]), np.nanmax(seen["top"][:, 1])
    right, bottom = np.nanmin(seen["right"][:, 0]), np.nanmin(seen["bottom"][:, 1])
    with np.errstate(divide="ignore"):
        scale_x = 1 / max(cx / (cx - left), (camera.width - 0.5 - cx) / (right - cx))
        scale_y = 1 / max(cy / (cy - top), (camera.height - 0.5 - cy) / (bottom - cy))
    width = max(1, int(np.clip(scale_x, 0.2, 2) * camera.width))
    height = max(1, int(np.clip(scale_y, 0.2, 2) * camera.height))
    params = np.array([fx, fy, cx * width / camera.width, cy * height / camera.height])
    return Lens("PINHOLE", width, height, params)


def warp(values: np.ndarray, source: Lens, target: Lens) -> np.ndarray:
    """``[H, W, C]`` uint8 of the target, bilinear from that of the source; black where the source has no pixel."""
    fx, fy, cx, cy = target.params
    y = (np.arange(target.height) + 0.5 - cy) / fy
    out = np.zeros((target.height, target.width, *values.shape[2:]), np.uint8)
    x = (np.arange(target.width) + 0.5 - cx) / fx
    for row, v in enumerate(y):  # by rows: whole photographs in float64 take ten times their memory
        out[row] = _bilinear(values, source.img_from_plane(np.column_stack([x, np.full_like(x, v)])) - 0.5)
    return out


def _bilinear(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    height, width = values.shape[:2]
    out = np.zeros((len(at), *values.shape[2:]), np.uint8)
    with np.errstate(invalid="ignore"):
        inside = np.all((at >= 0) & (at < [width - 1, height - 1]), axis=1)
    at = at[inside]
    (x, y), (dx, dy) = at.astype(int).T, (at % 1).T[..., None]
    upper = values[y, x] * (1 - dx) + values[y, x + 1] * dx
    lower = values[y + 1, x] * (1 - dx) + values[y + 1, x + 1] * dx
    out[inside] = np.rint(upper * (1 - dy) + lower * dy)
    return out
