"""SOG and sigma_d row by row: with a stand-in for splat-transform, and with it where it is."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import clod_adapter
import scenes
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.splat_transform import SplatTransform
from clod_adapter.render import render
from clod_adapter.viewer.packed import pack
from clod_adapter.viewer.page import write_page
from clod_adapter.viewer.payload import Payload
from shown import SIZE, Shown


def dialled(degree: int) -> Gaussians:
    """Some of them too faint for the 8 bits that SOG has for an opacity."""
    plain = scenes.gaussians(1000, degree, 4)
    logits = plain.opacity_logits.clone()
    logits[::20] = -12.0
    sigma_d = torch.randn(1000, generator=torch.Generator().manual_seed(1)).exp()
    sigma_d[:3] = torch.tensor([0.0, 1e9, -0.5])
    attenuation = AttenuationConfig(tau=0.02, cut="soft", scene_distance=3.0)
    return plain.replace(opacity_logits=logits, sigma_d=sigma_d, attenuation=attenuation)


class Reversing:
    """Stands in for splat-transform: its Morton order is the rows from last to first."""

    version = "0"

    def __init__(self, lost: int = 0) -> None:
        self.lost = lost

    def run(self, source: Path, out: Path, *words: str, timeout: float, progress: Any) -> float:
        if out.suffix == ".sog":
            out.write_bytes(b"packed")
        else:
            found = clod_adapter.load(source).gaussians
            rows = torch.arange(len(found) - 1 - self.lost, -1, -1)
            clod_adapter.save(out, found.select(rows))
        return 0.0


def test_sigma_follows_the_rows() -> None:
    gaussians = dialled(0)
    packed = pack(Payload("a.ply", gaussians), Reversing())  # type: ignore[arg-type]
    sigma = np.frombuffer(gzip.decompress(packed.sigma or b""), "<f4")
    wanted = gaussians.sigma_d.numpy()[::-1]
    assert packed.sog == b"packed" and np.abs(sigma - wanted).max() <= 2.0**-12 * np.abs(wanted).max()
    assert (np.abs(sigma - wanted) <= 2.0**-12 * np.abs(wanted)).all()


def test_lost_rows_are_an_error() -> None:
    with pytest.raises(ClodError, match="has kept 998 of 1000 Gaussians"):
        pack(Payload("a.ply", dialled(0)), Reversing(2))  # type: ignore[arg-type]


def test_a_plain_file_has_no_sigma() -> None:
    plain = dialled(0).replace(sigma_d=None, attenuation=None)
    assert pack(Payload("a.ply", plain), Reversing()).sigma is None  # type: ignore[arg-type]


@pytest.mark.parametrize("degree", [0, 1])
def test_a_packed_page_shows_the_same(chromium: Any, tmp_path: Path, artefacts: Path, degree: int) -> None:
    try:
        tool = SplatTransform.find()
    except ClodError as error:
        pytest.skip(str(error))
    gaussians, camera = dialled(degree), scenes.camera(320, 240)
    clod_adapter.save(tmp_path / "model.ply", gaussians)
    model = clod_adapter.load(tmp_path / "model.ply")
    write_page(tmp_path / "ply.html", model)
    write_page(tmp_path / "sog.html", model, tool=tool)
    with chromium.new_context(viewport=SIZE, offline=True) as context:
        shown = Shown(context.new_page()).ready((tmp_path / "sog.html").as_uri())
        shown.camera(camera)
        for s in (1.0, 3.0):
            shown.run("clod.setDial(given)", s)
            wanted = render(gaussians, camera, s)
            error = float(((shown.picture().astype(np.float64) - wanted.pixels.numpy()) ** 2).mean())
            assert 10 * np.log10(255**2 / error) > 35  # 8 bits for opacities, scales and colours
            counts, kept = shown.counts(), int(wanted.kept.sum())
            assert counts["total"] == 1000 and abs(counts["kept"] - kept) <= 0.01 * 1000
        assert shown.errors == []
