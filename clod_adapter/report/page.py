"""A self-contained HTML page, from functions that return HTML.

Style, script, charts and images are in the file; nothing is loaded from a network.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from clod_adapter._support.text import as_text, script_json
from clod_adapter.io.atomic import atomic_path

WIDEST = 1000  # pixels; wider pictures are scaled down
QUALITY = 88  # of WebP


@dataclass(frozen=True)
class Picture:
    """An image with its caption.

    Attributes:
        image: ``[H, W, 3]`` uint8, or float in 0..1.
        title: one or two words; detail: its numbers.
    """

    image: np.ndarray
    title: str
    detail: str = ""


def write_page(path: str | Path, title: str, kicker: str, body: Iterable[str], data: Mapping[str, Any]) -> None:
    """Writes the page, including ``data`` as JSON under the id ``data``.

    Raises:
        ClodError: the file cannot be written.
    """
    source = files("clod_adapter.report")
    style, script = ((source / name).read_text(encoding="utf-8") for name in ("style.css", "dial.js"))
    page = f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{style}</style>
</head>
<body>
<header><p class="kicker">{escape(kicker)}</p><h1>{escape(title)}</h1></header>
<main>
{"".join(body)}
</main>
<script type="application/json" id="data">{script_json(data)}</script>
<script type="module">
{script}</script>
</body>
</html>
"""
    with atomic_path(path) as part:
        part.write_text(as_text(page), encoding="utf-8")


def section(title: str, *parts: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{''.join(parts)}</section>\n"


def paragraph(text: str, kind: str = "") -> str:
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def tiles(entries: Sequence[tuple[str, str, str]]) -> str:
    """Key figures: label, value and note."""
    cells = (
        f"<div><dt>{escape(what)}</dt><dd>{escape(value)}<small>{escape(note)}</small></dd></div>"
        for what, value, note in entries
    )
    return f'<dl class="tiles">{"".join(cells)}</dl>'


def facts(entries: Mapping[str, Any]) -> str:
    cells = (f"<div><dt>{escape(k)}</dt><dd>{escape(str(v))}</dd></div>" for k, v in entries.items())
    return f'<dl class="facts">{"".join(cells)}</dl>'


def bullets(lines: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"


def chart(svg: str, caption: str) -> str:
    return f'<figure><div class="chart">{svg}</div><figcaption>{escape(caption)}</figcaption></figure>'


def html_table(head: Sequence[str], groups: Iterable[tuple[str, Sequence[Sequence[str]]]]) -> str:
    """A table of groups, each with a heading and rows of cells."""
    lines = ["<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>"]
    for name, rows in groups:
        lines.append(f'<tr class="group"><td colspan="{len(head)}">{escape(name)}</td></tr>')
        lines += ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def strip(pictures: Sequence[Picture]) -> str:
    """Images side by side."""
    cells = (
        f'<figure><img src="{data_url(p.image)}" alt="{escape(p.title)}"><figcaption><b>{escape(p.title)}</b> '
        f"{escape(p.detail)}</figcaption></figure>"
        for p in pictures
    )
    return f'<div class="strip">{"".join(cells)}</div>'


def dial_figure(frames: Sequence[Picture], others: Mapping[str, Picture]) -> str:
    """A slider over the frames, in order of dial values; an image of ``others`` is shown while its button is held."""
    height, width = frames[0].image.shape[:2]
    images = [_frame(picture) for picture in frames] + [_frame(picture, name) for name, picture in others.items()]
    buttons = (f'<button type="button" data-shows="{escape(n)}">hold for {escape(n)}</button>' for n in others)
    return (
        f'<figure class="dial" hidden><div class="frames" style="aspect-ratio: {width} / {height}">{"".join(images)}'
        '</div><div class="readout"><b></b><span class="quiet"></span></div>'
        f'<input type="range" min="0" max="{len(frames) - 1}" value="0" step="1" aria-label="dial value">'
        f'<div class="ends"><span>{escape(frames[0].title)}, full quality</span><span>{escape(frames[-1].title)}</span>'
        f'</div><div class="buttons">{"".join(buttons)}</div></figure>'
        '<noscript><p class="quiet">The slider needs JavaScript; the images below show the same view.</p></noscript>'
    )


def _frame(picture: Picture, name: str = "") -> str:
    return (
        f'<img src="{data_url(picture.image)}" alt="{escape(picture.title)}" data-name="{escape(name)}" '
        f'data-title="{escape(picture.title)}" data-detail="{escape(picture.detail)}">'
    )


def data_url(image: np.ndarray) -> str:
    """The image as WebP in a data: URL, at most WIDEST pixels wide."""
    pixels = image if image.dtype == np.uint8 else (np.clip(image, 0, 1) * 255).round().astype(np.uint8)
    picture = Image.fromarray(pixels)
    if picture.width > WIDEST:
        picture = picture.resize((WIDEST, round(picture.height * WIDEST / picture.width)), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    picture.save(file, "WEBP", quality=QUALITY)
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode("ascii")
