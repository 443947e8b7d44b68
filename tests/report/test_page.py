"""The page is self-contained and escapes its texts."""

from __future__ import annotations

import base64
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clod_adapter.report import page
from clod_adapter.report.page import Picture

NASTY = 'a <b> & "c" </script>'
VOID = {"meta", "img", "input", "link", "br"}


class Outline(HTMLParser):
    """The elements of a page with their attributes; fails where one is not closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def picture(level: float, title: str = NASTY) -> Picture:
    return Picture(np.full((6, 8, 3), level, np.float32), title, NASTY)


def test_page_is_self_contained_and_escaped(tmp_path: Path) -> None:
    body = [
        page.section(NASTY, page.paragraph(NASTY), page.tiles([(NASTY, "1", NASTY)]), page.facts({NASTY: NASTY})),
        page.dial_figure([picture(0.0), picture(0.5), picture(1.0)], {"photograph": picture(0.2)}),
        page.bullets([NASTY]),
        page.strip([picture(0.3)]), page.html_table(["x", NASTY], [(NASTY, [["1", NASTY]])]),
        page.chart("<svg></svg>", NASTY),
    ]  # fmt: skip
    data = {"rows": [{"note": NASTY, "psnr": None}]}
    page.write_page(tmp_path / "page.html", NASTY, NASTY, body, data)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    outline = Outline(text)
    assert "a <b>" not in text.partition('<script type="application/json"')[0]
    for tag, attributes in outline.found:  # nothing from elsewhere
        assert tag not in ("link", "iframe") and not (tag == "script" and "src" in attributes)
        assert all(value and value.startswith("data:") for name, value in attributes.items() if name in ("src", "href"))
    assert not re.search(r"https?://(?!www\.w3\.org)|@import|url\(", text)
    stored = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert stored and json.loads(stored[1]) == data and "<" not in stored[1]  # <!--<script> would hide the rest
    frames = [a for tag, a in outline.found if tag == "img" and "data-title" in a]
    assert [a["data-name"] for a in frames] == ["", "", "", "photograph"]
    (slider,) = [a for tag, a in outline.found if tag == "input"]
    assert (slider["min"], slider["max"]) == ("0", "2")
    (button,) = [a for tag, a in outline.found if tag == "button"]
    assert button["data-shows"] == "photograph"


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_images_are_embedded(kind: type) -> None:
    """Embedded images keep their pixels; wide ones are scaled down."""
    ramp = np.linspace(0, 255, 32 * 24 * 3).reshape(24, 32, 3)
    image = ramp.astype(np.uint8) if kind is np.uint8 else (ramp / 255).astype(np.float32)
    urls = [page.data_url(each) for each in (image, np.zeros((300, 2000, 3), kind))]
    assert all(url.startswith("data:image/webp;base64,") for url in urls)
    decoded, wide = (Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))) for url in urls)
    assert decoded.size == (32, 24) and wide.size == (1000, 150)
    assert np.abs(np.asarray(decoded.convert("RGB")).astype(float) - ramp).mean() < 4
