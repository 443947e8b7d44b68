"""viewers/kit, the files that authors of renderers test with, is what the library draws and writes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import clod_adapter as clod

KIT = Path(__file__).parents[2] / "viewers" / "kit"
CAMERAS = json.loads((KIT / "cameras.json").read_text(encoding="utf-8"))["cameras"]


@pytest.mark.parametrize(("suffix", "levels"), [("ply", 1), ("glb", 1), ("spz", 12)])
def test_pictures_and_counts_are_those_of_the_library(suffix: str, levels: int) -> None:
    gaussians = clod.load(KIT / f"kit.{suffix}").gaussians
    for about in CAMERAS:
        width, height, focal = about["width"], about["height"], about["focal"]
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        camera = clod.Camera(torch.tensor(about["world_to_camera"]), K, width, height)
        for frame in about["frames"]:
            shown = clod.render(gaussians, camera, frame["s"])
            assert int(shown.kept.sum()) == pytest.approx(frame["kept"], rel=0.005 if suffix == "spz" else 0)
            stored = np.asarray(Image.open(KIT / frame["picture"], formats=["PNG"]), np.float64)
            assert np.abs(shown.image.clamp(0, 1).numpy() * 255 - stored).max() < levels
