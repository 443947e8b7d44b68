"""The demo's pictures are drawn and are not empty."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clod_adapter.demo.gallery import dial_strip
from clod_adapter.report.page import Picture

pytest.importorskip("matplotlib")


def test_strip_shows_every_panel(tmp_path: Path) -> None:
    colours = [(200, 30, 30), (30, 160, 30), (30, 30, 200)]
    images = [np.full((30, 40, 3), colour, np.uint8) for colour in colours]
    panels = [Picture(image / 255 if k == 1 else image, "s = 1", "29.0 dB") for k, image in enumerate(images)]
    dial_strip(tmp_path / "strip.png", panels, "one view", crop=(10, 5, 16, 12))
    picture = np.asarray(Image.open(tmp_path / "strip.png").convert("RGB"))
    for k, colour in enumerate(colours):
        third = picture[:, k * picture.shape[1] // 3 : (k + 1) * picture.shape[1] // 3]
        assert (np.abs(third.astype(int) - colour).max(2) <= 1).mean() > 0.6
    assert (picture[0] == 255).all() and picture.shape[0] > 2 * 12 / 16 * picture.shape[1] / 3
