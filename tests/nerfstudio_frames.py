"""nerfstudio's transformation of cameras before training, from its source."""

from typing import Any

import numpy as np

APPLIED = {  # how nerfstudio turned COLMAP's world: today, and before
    "today": [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
    "older": [[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]],
}


def orient_and_center(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """nerfstudio's ``auto_orient_and_center_poses`` with its defaults, "up" and "poses": the poses and ``[3, 4]``."""
    centre, up = poses[:, :3, 3].mean(0), poses[:, :3, 1].mean(0)
    up /= np.linalg.norm(up)
    v, cosine = np.cross(up, [0, 0, 1.0]), up[2]
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    rotation = np.eye(3) + skew + skew @ skew * ((1 - cosine) / (np.linalg.norm(v) ** 2 + 1e-8))
    transform = np.concatenate([rotation, rotation @ -centre[:, None]], 1)
    return transform @ poses, transform


def trained(poses: np.ndarray, applied: Any, applied_scale: float = 1.0) -> tuple[np.ndarray, dict[str, Any]]:
    """The poses that nerfstudio trains with, and what it writes into dataparser_transforms.json."""
    oriented, transform = orient_and_center(poses)
    scale = 1 / np.abs(oriented[:, :3, 3]).max()
    oriented[:, :3, 3] *= scale
    if applied is not None:
        transform = transform @ np.vstack([applied, [0, 0, 0, 1.0]])
    return oriented, {"transform": transform.tolist(), "scale": float(scale * applied_scale)}
