"""The folder in which the documentation's commands run: a tiny capture, its checkpoints and results."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats import without_comments


@pytest.fixture(scope="session")
def desk(capture: Any, dialled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``scene/``, ``pretrained.ply``, ``pretrained_mask.ply`` (MaskGaussian's old layout), ``pretrained_clod.*``, and
    ``demo/`` with the demo's file names."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(capture.scene, folder / "scene")
    shutil.copyfile(capture.ply, folder / "pretrained.ply")
    masks = {"masks_0": np.where(np.arange(len(capture.gaussians)) % 10 == 0, -4, 4), "masks_1": 0}
    without_comments(folder / "pretrained.ply", **masks).rename(folder / "pretrained_mask.ply")
    for suffix in (".ply", ".safetensors", ".json"):
        shutil.copyfile(dialled.with_suffix(suffix), folder / f"pretrained_clod{suffix}")
    shutil.copytree(capture.scene, folder / "demo" / "capture")
    shutil.copyfile(capture.ply, folder / "demo" / "base.ply")
    shutil.copyfile(dialled, folder / "demo" / "gallery.ply")
    return folder
