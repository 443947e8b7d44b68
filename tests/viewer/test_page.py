"""The text of the page: its parts, sources, colours and security policy."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import clod_adapter
import scenes
from clod_adapter.render import render
from clod_adapter.viewer import page, payload
from clod_adapter.viewer.payload import Payload, page_config

PACKAGE = Path(clod_adapter.__file__).parent
NASTY = "a</script><!--<script>alert(1)</script>&amp;'\".ply"


def element(text: str, name: str) -> str:
    """The content of the script element with this id."""
    (found,) = re.findall(rf'<script type="[a-z/-]+" id="{name}">(.*?)</script>', text, re.DOTALL)
    return str(found)


def test_parts_are_in_their_places_and_built_from_these_sources() -> None:
    """After a change of the sources: npm ci && npm run build, in clod_adapter/viewer/web."""
    for place in page.PLACEHOLDERS:
        assert page._static_file(page.PAGE).count(place) == 1
    where = [page._static_file(page.PAGE).index(place) for place in page.PLACEHOLDERS]
    assert where == sorted(where)
    for name in (page.PAGE, page.STYLE, page.SCRIPT):
        assert not re.search(r"""(?:src|href)=["']?https?:|@import|url\(["']?https?:""", page._static_file(name)), name
    assert not re.search("</script|<!--", page._static_file(page.SCRIPT)) and "</style" not in page._static_file(
        page.STYLE
    )
    web = PACKAGE / "viewer" / "web"
    if not web.is_dir():
        pytest.skip("only a checkout contains the sources of the page")
    lines = (PACKAGE / "viewer" / "static" / "SOURCES.sha256").read_text(encoding="utf-8").splitlines()
    listed = {(web / name).resolve(): digest for digest, name in (line.split("  ") for line in lines)}
    assert {path for path in (web / "src").rglob("*.*") if path.is_file()} <= set(listed)
    for path, digest in listed.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == digest, f"{path} has changed since: build again"


def colours(path: Path) -> list[dict[str, str]]:
    """The colours by name of a style, minified or not: light and dark."""
    style = re.sub(r"#fff(?=[;}])", "#ffffff", re.sub(r"\s", "", path.read_text(encoding="utf-8")))
    blocks = re.findall(r":root\{(.*?)\}", style)
    assert len(blocks) == 2
    return [dict(re.findall(r"--([\w-]+):(#\w+)", block)) for block in blocks]


def test_colours_are_those_of_the_report() -> None:
    styles = (PACKAGE / "viewer" / "static" / "viewer.css", PACKAGE / "report" / "style.css")
    for ours, theirs in zip(*map(colours, styles), strict=True):
        assert {"paper", "card", "ink", "quiet", "line", "accent"} == set(ours)
        assert ours.items() <= theirs.items()


def test_a_name_cannot_end_its_element() -> None:
    text = page.served_page(page_config({"name": NASTY}, None, [], 1.0)).decode()
    assert json.loads(element(text, "clod-config"))["model"]["name"] == NASTY
    assert "<script>alert" not in text


@pytest.mark.parametrize("exact", [True, False])
def test_one_file_contains_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exact: bool) -> None:
    """Splats as PLY or SPZ, a picture of the first camera, and a policy that allows no connection."""
    monkeypatch.setattr(payload, "BLOCK_ROWS", 7)  # blocks that base64 would pad
    clod_adapter.save(tmp_path / "model.ply", clod_adapter.with_dial(scenes.gaussians(50, 1, 0)))
    saved, cameras = clod_adapter.load(tmp_path / "model.ply"), scenes.ring(2, 1000, 500)
    out = tmp_path / "out" / "page.html"
    out.parent.mkdir()
    shown, losses = page.write_viewer_page(out, saved, base=saved, cameras=cameras, virtual_scale=2.0, exact=exact)
    assert [each.name for each in out.parent.iterdir()] == ["page.html"] and bool(losses) != exact
    text = out.read_text(encoding="utf-8")
    config = json.loads(element(text, "clod-config"))
    for entry, name in ((config["model"], "clod-model"), (config["base"], "clod-base")):
        assert entry == {"name": "model.ply", "element": name}
        data = base64.b64decode(element(text, name), validate=True)
        if exact:
            assert data == b"".join(Payload.of(saved).blocks())
        else:
            (tmp_path / "held.spz").write_bytes(data)
            assert torch.equal(clod_adapter.load(tmp_path / "held.spz").gaussians.means, shown.means)
    assert len(config["cameras"]) == 2 and config["virtual_scale"] == 2.0
    policy = re.search('<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    assert policy and "default-src 'none'" in policy[1] and "'self'" not in policy[1] and "unsafe" not in policy[1]
    assert str(tmp_path) not in text
    (poster,) = re.findall('<img id="poster" alt="" src="data:image/jpeg;base64,([^"]*)">', text)
    assert len(poster) < 60_000
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(poster))), dtype=float)
    wanted = render(shown, replace(cameras[0], K=cameras[0].K * 0.512, width=512, height=256), 2.0).pixels.numpy()
    assert picture.shape == wanted.shape and np.abs(picture - wanted).mean() < 3
    page.write_viewer_page(tmp_path / "alone.html", saved, exact=exact)
    text = (tmp_path / "alone.html").read_text(encoding="utf-8")
    assert json.loads(element(text, "clod-config"))["base"] is None and "clod-base" not in text
    assert '<img id="poster"' not in text  # no viewpoint is stored
