"""SOG and sigma_d row by row: with a stand-in for splat-transform, and with it where it is installed."""

from __future__ import annotations

import base64
import gzip
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import clod_adapter
import scenes
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.formats.splat_transform import SplatTransform
from clod_adapter.render import render
from clod_adapter.viewer.packed import pack
from clod_adapter.viewer.page import write_viewer_page
from clod_adapter.viewer.payload import Payload
from shown import SIZE, Shown, assert_same


def dialled(degree: int) -> Gaussians:
    """Some Gaussians are too transparent for the 8 bits that SOG has for an opacity."""
    model = scenes.dialled(1000, degree, 4, scene_distance=1.0, reference_distance=3.0)
    logits, sigma_d = model.opacity_logits.clone(), model.sigma_d.clone()
    logits[::20] = -12.0
    sigma_d[:3] = torch.tensor([0.0, 1e9, -0.5])
    return model.replace(opacity_logits=logits, sigma_d=sigma_d)


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


def test_sigma_d_follows_the_rows(tmp_path: Path) -> None:
    gaussians = dialled(0)
    packed = pack(Payload("a.ply", gaussians), Reversing(), tmp_path)  # type: ignore[arg-type]
    sigma = np.frombuffer(gzip.decompress(packed.sigma or b""), "<f4")
    wanted = gaussians.sigma_d.numpy()[::-1]
    assert packed.sog == b"packed" and list(tmp_path.iterdir()) == []
    assert (np.abs(sigma - wanted) <= 2.0**-12 * np.abs(wanted)).all()
    with pytest.raises(ClodError, match="has kept 998 of 1000 Gaussians"):
        pack(Payload("a.ply", gaussians), Reversing(2), tmp_path)  # type: ignore[arg-type]
    plain = gaussians.replace(sigma_d=None, attenuation=None)
    assert pack(Payload("a.ply", plain), Reversing(), tmp_path).sigma is None  # type: ignore[arg-type]


@pytest.mark.parametrize("degree", [0, 1])
def test_a_packed_page_shows_its_contents(chromium: Any, tmp_path: Path, degree: int) -> None:
    """Against our render of what splat-transform itself reads from the page's .sog."""
    try:
        tool = SplatTransform.find()
    except ClodError as error:
        pytest.skip(str(error))
    gaussians, camera = dialled(degree), scenes.camera(320, 240)
    clod_adapter.save(tmp_path / "model.ply", gaussians)
    write_viewer_page(tmp_path / "page.html", clod_adapter.load(tmp_path / "model.ply"), tool=tool)
    held = unpacked(tmp_path / "page.html", tool)
    assert len(held) == 1000
    with chromium.new_context(viewport=SIZE, offline=True) as context:
        shown = Shown(context.new_page()).ready((tmp_path / "page.html").as_uri())
        shown.camera(camera)
        for s in (1.0, 3.0):
            shown.run("clod.setDial(given)", s)
            assert_same(shown, render(held, camera, s), tmp_path / "shown.png")
            kept = int(render(gaussians, camera, s).kept.sum())
            assert abs(shown.counts()["kept"] - kept) <= 10  # opacities have 8 bits
        assert shown.errors == []


def unpacked(page: Path, tool: SplatTransform) -> Gaussians:
    """What a packed page holds."""

    def held(name: str) -> bytes:
        (text,) = re.findall(rf'id="{name}">([^<]*)<', page.read_text(encoding="utf-8"))
        return base64.b64decode(text, validate=True)

    sog, ply = page.with_name("held.sog"), page.with_name("held.ply")
    sog.write_bytes(held("clod-model"))
    tool.run(sog, ply, timeout=60)
    sigma_d = torch.from_numpy(np.frombuffer(gzip.decompress(held("clod-model-sigma")), "<f4").copy())
    found = clod_adapter.load(ply, activated="none").gaussians
    return found.replace(sigma_d=sigma_d, attenuation=dialled(0).attenuation)
