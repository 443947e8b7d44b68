"""The folder in which a reader of the documentation is: a tiny capture, its checkpoints, and what was made of them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement


@pytest.fixture(scope="session")
def desk(capture: Any, dialled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``scene/``, ``pretrained.ply``, ``pretrained_mask.ply`` (MaskGaussian's old layout), ``pretrained_clod.*``, and
    ``demo/`` with the names that the demo leaves."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(capture.scene, folder / "scene")
    shutil.copyfile(capture.ply, folder / "pretrained.ply")
    write_masked(capture.ply, folder / "pretrained_mask.ply")
    for suffix in (".ply", ".safetensors", ".json"):
        shutil.copyfile(dialled.with_suffix(suffix), folder / f"pretrained_clod{suffix}")
    shutil.copytree(capture.scene, folder / "demo" / "capture")
    shutil.copyfile(capture.ply, folder / "demo" / "base.ply")
    shutil.copyfile(dialled, folder / "demo" / "gallery.ply")
    return folder


def write_masked(source: Path, path: Path) -> None:
    """The same file with masks_0 and masks_1 before scale_0; every tenth Gaussian is masked out."""
    vertex = PlyData.read(str(source))["vertex"].data
    names = list(vertex.dtype.names)
    names[names.index("scale_0") : names.index("scale_0")] = ["masks_0", "masks_1"]
    masked = np.zeros(len(vertex), [(name, "<f4") for name in names])
    for name in vertex.dtype.names:
        masked[name] = vertex[name]
    masked["masks_0"] = np.where(np.arange(len(vertex)) % 10 == 0, -4, 4)
    PlyData([PlyElement.describe(masked, "vertex")], byte_order="<").write(str(path))
