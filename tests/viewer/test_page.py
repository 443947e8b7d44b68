"""The text of the page: its parts, sources, colours and security policy."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from pathlib import Path

import pytest

import clod_adapter
import scenes
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
    entry = Payload(NASTY, scenes.gaussians(3, 0, 0)).describe(href="/files/model")
    text = page.served_page(page_config(entry, None, [], 1.0)).decode()
    assert json.loads(element(text, "clod-config"))["model"]["name"] == NASTY
    assert "<script>alert" not in text


def test_one_file_contains_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(payload, "BLOCK_ROWS", 7)  # blocks that base64 would pad
    clod_adapter.save(tmp_path / "model.ply", clod_adapter.with_dial(scenes.gaussians(50, 1, 0)))
    saved, cameras = clod_adapter.load(tmp_path / "model.ply"), scenes.ring(2, 20, 10)
    page.write_viewer_page(tmp_path / "page.html", saved, base=saved, cameras=cameras, virtual_scale=2.0)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    config = json.loads(element(text, "clod-config"))
    for entry, name in ((config["model"], "clod-model"), (config["base"], "clod-base")):
        assert (entry["element"], entry["href"]) == (name, None)
        data = base64.b64decode(element(text, name), validate=True)
        assert data == b"".join(Payload.of(saved).blocks())
    assert len(config["cameras"]) == 2 and config["virtual_scale"] == 2.0
    policy = re.search('<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    assert policy and "default-src 'none'" in policy[1] and "'self'" not in policy[1]
    assert str(tmp_path) not in text
    page.write_viewer_page(tmp_path / "alone.html", saved)
    text = (tmp_path / "alone.html").read_text(encoding="utf-8")
    assert json.loads(element(text, "clod-config"))["base"] is None and "clod-base" not in text
