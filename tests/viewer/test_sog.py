"""The order of the dial's columns in a packed splat, and packed pages; the latter need splat-transform."""

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
from clod_adapter.viewer.page import write_viewer_page
from clod_adapter.viewer.payload import Payload
from clod_adapter.viewer.sog import pack_sog
from shown import SIZE, Shown, assert_same


def dialled(degree: int) -> Gaussians:
    """1000 Gaussians that grow, some too transparent for the 8 bits of an opacity in SOG."""
    model = scenes.dialled(1000, degree, 4, scene_distance=1.0, reference_distance=3.0)
    logits, sigma_d = model.opacity_logits.clone(), model.sigma_d.clone()
    logits[::20] = -12.0
    sigma_d[:3] = torch.tensor([0.0, 1e9, -0.5])
    return model.replace(opacity_logits=logits, sigma_d=sigma_d, growth_d=torch.linspace(-0.5, 1, 1000))


class Reversing:
    """A stub of splat-transform that reverses the rows, and removes the last ``lost``."""

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


def test_the_dials_columns_follow_the_rows(tmp_path: Path) -> None:
    gaussians = dialled(0)
    packed = pack_sog(Payload("a.ply", gaussians), Reversing(), tmp_path)  # type: ignore[arg-type]
    assert packed.sog == b"packed" and list(tmp_path.iterdir()) == []
    assert list(packed.columns) == ["sigma_d", "growth_d"]
    for name, data in packed.columns.items():
        wanted = gaussians.tensors()[name].numpy()[::-1]
        assert (np.abs(np.frombuffer(gzip.decompress(data), "<f4") - wanted) <= 2.0**-12 * np.abs(wanted)).all()
    with pytest.raises(ClodError, match="has written 998 of 1000 Gaussians"):
        pack_sog(Payload("a.ply", gaussians), Reversing(2), tmp_path)  # type: ignore[arg-type]
    ungrown = gaussians.replace(growth_d=None)
    for model, names in ((ungrown, ["sigma_d"]), (ungrown.replace(sigma_d=None, attenuation=None), [])):
        packed = pack_sog(Payload("a.ply", model), Reversing(), tmp_path)  # type: ignore[arg-type]
        assert list(packed.columns) == names


@pytest.mark.parametrize("degree", [0, 1])
def test_a_packed_page_shows_its_contents(chromium: Any, tmp_path: Path, degree: int) -> None:
    """Against our rendering of the page's .sog as splat-transform reads it."""
    try:
        tool = SplatTransform.find()
    except ClodError as error:
        pytest.skip(str(error))
    gaussians, camera = dialled(degree), scenes.camera(320, 240)
    clod_adapter.save(tmp_path / "model.ply", gaussians)
    write_viewer_page(tmp_path / "page.html", clod_adapter.load(tmp_path / "model.ply"), tool=tool)
    packed = unpacked(tmp_path / "page.html", tool)
    assert len(packed) == 1000
    with chromium.new_context(viewport=SIZE, offline=True) as context:
        shown = Shown(context.new_page()).ready((tmp_path / "page.html").as_uri())
        shown.camera(camera)
        for s in (1.0, 3.0):
            shown.run("clod.setDial(given)", s)
            assert_same(shown, render(packed, camera, s), tmp_path / "shown.png")
            kept = int(render(gaussians, camera, s).kept.sum())
            assert abs(shown.counts()["kept"] - kept) <= 10  # opacities have 8 bits
        assert shown.errors == []


def unpacked(page: Path, tool: SplatTransform) -> Gaussians:
    """The Gaussians of a packed page."""

    def data(name: str) -> bytes:
        (text,) = re.findall(rf'id="{name}">([^<]*)<', page.read_text(encoding="utf-8"))
        return base64.b64decode(text, validate=True)

    sog, ply = page.with_name("packed.sog"), page.with_name("packed.ply")
    sog.write_bytes(data("clod-model"))
    tool.run(sog, ply, timeout=60)
    dial = {name: data(f"clod-model-{name}") for name in ("sigma_d", "growth_d")}
    columns = {name: torch.from_numpy(np.frombuffer(gzip.decompress(dial[name]), "<f4").copy()) for name in dial}
    found = clod_adapter.load(ply, activated="none").gaussians
    return found.replace(**columns, attenuation=dialled(0).attenuation)
