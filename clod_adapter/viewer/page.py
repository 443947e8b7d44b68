"""The viewer's page: assembled from its built parts, for the server or as one file that includes the splats.

The page loads nothing from other hosts: its Content-Security-Policy allows one script and one style, by their hashes,
and connections to its own server only.
"""

import base64
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from clod_adapter._support.text import script_json
from clod_adapter.cameras import Camera
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.render import render
from clod_adapter.viewer.payload import Payload, page_config

PAGE, STYLE, SCRIPT = "page.html", "viewer.css", "viewer.js"
ELEMENT = "clod-model"  # id of the elements with the splats
PART = 3 << 24  # bytes of a script element, a multiple of 3; browsers limit strings to about 5e8
POSTER_SIDE, POSTER_QUALITY = 512, 60  # of the picture shown while the page loads: pixels, and of JPEG


def served_page(config: Mapping[str, Any]) -> bytes:
    """The page that fetches its splats from its server."""
    return b"".join(_document(config, (), "", ""))


def write_viewer_page(
    path: str | Path,
    model: Checkpoint,
    *,
    cameras: Sequence[Camera] = (),
    virtual_scale: float | None = None,
    exact: bool = False,
) -> tuple[Gaussians, tuple[str, ...]]:
    """Writes the page as one file with the splats in it; the same arguments give the same bytes.

    ``virtual_scale`` is as in ``page_config``; ``exact`` includes float32, not SPZ. Returns the Gaussians as the page
    shows them, and a line for each loss.
    """
    shown, placed = cameras or model.cameras, model.placed and not cameras
    with atomic_path(path) as temporary:
        payload = Payload.of(model)
        data, found, notes = payload.packed(f"{temporary}.spz", exact)
        config = page_config({"name": payload.name, "element": ELEMENT}, None, shown, virtual_scale, placed=placed)
        opening = virtual_scale if virtual_scale is not None else 0.0 if placed else 1.0
        poster = _poster(found, shown[0], opening) if shown else ""
        meta = f'<meta http-equiv="Content-Security-Policy" content="{policy()}">\n'
        with open(temporary, "wb") as file:
            file.writelines(_document(config, _elements(data), meta, poster))
    return found, notes


def _poster(gaussians: Gaussians, camera: Camera, virtual_scale: float) -> str:
    """An element with the view of a camera as a JPEG, for the time until the page has drawn its own."""
    scale = min(POSTER_SIDE / max(camera.width, camera.height), 1.0)
    width, height = (max(round(scale * side), 1) for side in (camera.width, camera.height))
    K = camera.K * torch.tensor([[width / camera.width], [height / camera.height], [1.0]])
    small = replace(camera, K=K, width=width, height=height)
    dial = 1.0 if gaussians.sigma_d is None else virtual_scale
    image = Image.fromarray(render(gaussians, small, dial).pixels.cpu().numpy())
    buffer = BytesIO()
    image.save(buffer, "JPEG", quality=POSTER_QUALITY)
    text = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f'<img id="poster" alt="" src="data:image/jpeg;base64,{text}">'


def policy(connect: str = "") -> str:
    """The page's Content-Security-Policy; ``connect`` is a further source that it may fetch from."""
    script, style = (f"'sha256-{_digest(_static_file(name))}'" for name in (SCRIPT, STYLE))
    return (
        f"default-src 'none'; script-src {script}; style-src {style}; img-src data: blob:; "
        f"connect-src {connect} data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'"
    )


def _document(config: Mapping[str, Any], data: Iterable[bytes], meta: str, poster: str) -> Iterator[bytes]:
    """The page in pieces, because data may be large; ``meta`` is added to its head, ``poster`` above its canvas."""
    content = {
        "STYLE": f"{meta}<style>{_static_file(STYLE)}</style>",
        "POSTER": poster,
        "CONFIG": f'<script type="application/json" id="clod-config">{script_json(config)}</script>',
        "SCRIPT": f'<script type="module">{_static_file(SCRIPT)}</script>',
    }
    for number, part in enumerate(re.split("<!--CLOD-([A-Z]+)-->", _static_file(PAGE))):
        if part == "DATA":
            yield from data
        else:
            yield (content[part] if number % 2 else part).encode()


def _elements(data: bytes) -> Iterator[bytes]:
    """Script elements with the bytes as base64; large data are divided among several with the same id."""
    for start in range(0, len(data), PART):
        part = base64.b64encode(data[start : start + PART])
        yield b'<script type="application/octet-stream" id="%s">%s</script>\n' % (ELEMENT.encode(), part)


@cache
def _static_file(name: str) -> str:
    return (files("clod_adapter.viewer") / "static" / name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
