"""The page as text: its parts in their places, and what it lets a browser do."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
import scenes
from clod_adapter.viewer import page
from clod_adapter.viewer.payload import Payload, page_config

NASTY = "a</script><!--<script>alert(1)</script>&amp;'\".ply"


def element(text: str, name: str) -> str:
    """What the script element of this id holds."""
    (found,) = re.findall(rf'<script type="[a-z/-]+" id="{name}">(.*?)</script>', text, re.DOTALL)
    return str(found)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Any:
    gaussians = clod_adapter.attach(scenes.gaussians(50, 1, 0))
    path = tmp_path_factory.mktemp("page") / "model.ply"
    clod_adapter.save(path, gaussians)
    return clod_adapter.load(path)


def test_the_parts_have_their_places() -> None:
    for place in page.PLACES:
        assert page._part(page.PAGE).count(place) == 1
    where = [page._part(page.PAGE).index(place) for place in page.PLACES]
    assert where == sorted(where)
    for name in (page.PAGE, page.STYLE, page.SCRIPT):
        assert not re.search(r"""(?:src|href)=["']?https?:|@import|url\(["']?https?:""", page._part(name)), name
    assert not re.search("</script|<!--", page._part(page.SCRIPT)) and "</style" not in page._part(page.STYLE)


def test_names_cannot_leave_their_element() -> None:
    entry = Payload(NASTY, scenes.gaussians(3, 0, 0)).describe(href="/files/model")
    text = page.served_page(page_config(entry, None, [], 1.0)).decode()
    assert json.loads(element(text, "clod-config"))["model"]["name"] == NASTY
    assert "<script>alert" not in text


def test_one_file_holds_everything(saved: Any, tmp_path: Path) -> None:
    cameras = scenes.ring(2, 20, 10)
    page.write_page(tmp_path / "page.html", saved, base=saved, cameras=cameras, virtual_scale=2.0)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    config = json.loads(element(text, "clod-config"))
    for entry, name in ((config["model"], "clod-model"), (config["base"], "clod-base")):
        assert (entry["element"], entry["href"]) == (name, None)
        held = base64.b64decode(element(text, name), validate=True)
        assert held == b"".join(Payload.of(saved).blocks())
    assert len(config["cameras"]) == 2 and config["virtual_scale"] == 2.0
    policy = re.search('<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    assert policy and "default-src 'none'" in policy[1] and "'self'" not in policy[1]
    assert str(tmp_path) not in text and str(saved.path.parent) not in text


def test_without_a_base_there_is_none(saved: Any, tmp_path: Path) -> None:
    page.write_page(tmp_path / "page.html", saved)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert json.loads(element(text, "clod-config"))["base"] is None and "clod-base" not in text


def test_base64_in_pieces() -> None:
    whole = bytes(range(256)) * 3
    for size in (1, 2, 3, 5, 100, 1000):
        pieces = [whole[k : k + size] for k in range(0, len(whole), size)]
        assert base64.b64decode(b"".join(page._base64(pieces)), validate=True) == whole
