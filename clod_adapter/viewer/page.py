"""The viewer's page: assembled from its built parts, for the server or as one file that includes the splats.

The page loads nothing from other hosts: its Content-Security-Policy allows one script and one style, by their hashes,
and connections to its own server only.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from clod_adapter._support.text import script_json
from clod_adapter.cameras import Camera
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.formats.splat_transform import SplatTransform
from clod_adapter.viewer.payload import Payload, page_config
from clod_adapter.viewer.sog import PackedSplat, pack_sog

PAGE, STYLE, SCRIPT = "page.html", "viewer.css", "viewer.js"
MAX_CHARACTERS = 1 << 26  # per script element; browsers limit strings to about 5e8
PLACEHOLDERS = ("<!--CLOD-STYLE-->", "<!--CLOD-CONFIG-->", "<!--CLOD-DATA-->", "<!--CLOD-SCRIPT-->")  # in this order


def served_page(config: Mapping[str, Any]) -> bytes:
    """The page that fetches its splats from its server."""
    return b"".join(_document(config, (), ""))


def write_viewer_page(
    path: str | Path,
    model: Checkpoint,
    *,
    base: Checkpoint | None = None,
    cameras: Sequence[Camera] = (),
    virtual_scale: float | None = None,
    tool: SplatTransform | None = None,
    progress: Callable[[float], None] | None = None,
) -> PackedSplat | None:
    """Writes the page as one file that includes the splats, for opening without a server or network.

    The same arguments give the same bytes; what is installed has no influence.

    Args:
        model: with or without a dial.
        base: shown for comparison; relative to the same origin.
        cameras: selectable viewpoints, in the frame of the Gaussians (relative to the origin); by default the stored
            ones.
        virtual_scale: the initial dial value, >= 0; None for 1 with photographs, else 0 (everything), and then what
            the device holds.
        tool: packs the splats to a fifth of their size, with rounded values (``pack_sog``, which calls
            ``progress``); None stores them unpacked.

    Returns:
        The packed model; None without ``tool``.

    Raises:
        ClodError: the file cannot be written, or packing fails.
    """
    entries, data, packs = list[dict[str, Any]](), dict[str, Iterable[bytes]](), list[PackedSplat | None]()
    for element, checkpoint in (("clod-model", model), ("clod-base", base)):
        if checkpoint is not None:
            payload = Payload.of(checkpoint)
            packed = pack_sog(payload, tool, Path(path).absolute().parent, progress) if tool else None
            entry, added = _embed(element, payload, packed)
            entries.append(entry)
            packs.append(packed)
            data |= added
    shown, placed = cameras or model.cameras, model.placed and not cameras
    config = page_config(entries[0], entries[1] if base else None, shown, virtual_scale, placed=placed)
    meta = f'<meta http-equiv="Content-Security-Policy" content="{policy()}">\n'
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.writelines(_document(config, _elements(data), meta))
    return packs[0]


def _embed(
    element: str, payload: Payload, packed: PackedSplat | None
) -> tuple[dict[str, Any], dict[str, Iterable[bytes]]]:
    """A splat's entry in the configuration, and its bytes in the page by the id of their element."""
    if packed is None:
        return payload.describe(element=element), {element: payload.blocks()}
    columns = {name: {"element": f"{element}-{name}", "gzip": True} for name in packed.columns}
    entry = payload.describe(element=element, format="sog", columns=columns)
    return entry, {element: (packed.sog,), **{f"{element}-{name}": (data,) for name, data in packed.columns.items()}}


def policy(connect: str = "") -> str:
    """The page's Content-Security-Policy; ``connect`` is a further source that it may fetch from."""
    script, style = (f"'sha256-{_digest(_static_file(name))}'" for name in (SCRIPT, STYLE))
    return (
        f"default-src 'none'; script-src {script}; style-src {style}; img-src data: blob:; "
        f"connect-src {connect} data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'"
    )


def _document(config: Mapping[str, Any], data: Iterable[bytes], meta: str) -> Iterator[bytes]:
    """The page in pieces, because data may be large; ``meta`` is added to its head."""
    rest = _static_file(PAGE)
    content: dict[str, Iterable[bytes]] = {
        PLACEHOLDERS[0]: (f"{meta}<style>{_static_file(STYLE)}</style>".encode(),),
        PLACEHOLDERS[1]: (f'<script type="application/json" id="clod-config">{script_json(config)}</script>'.encode(),),
        PLACEHOLDERS[2]: data,
        PLACEHOLDERS[3]: (f'<script type="module">{_static_file(SCRIPT)}</script>'.encode(),),
    }
    for placeholder, pieces in content.items():
        before, _, rest = rest.partition(placeholder)
        yield before.encode()
        yield from pieces
    yield rest.encode()


def _elements(data: Mapping[str, Iterable[bytes]]) -> Iterator[bytes]:
    """Script elements with the bytes as base64, by id; large data are split into several with the same id."""
    for element, blocks in data.items():
        begin, end = f'<script type="application/octet-stream" id="{element}">'.encode(), b"</script>\n"
        yield begin
        length = 0
        for characters in _base64(blocks):
            if length > MAX_CHARACTERS:
                yield end + begin
                length = 0
            yield characters
            length += len(characters)
        yield end


def _base64(blocks: Iterable[bytes]) -> Iterator[bytes]:
    rest = b""
    for block in blocks:
        rest += block
        end = len(rest) - len(rest) % 3  # encodes without padding
        yield base64.b64encode(rest[:end])
        rest = rest[end:]
    yield base64.b64encode(rest)


@cache
def _static_file(name: str) -> str:
    return (files("clod_adapter.viewer") / "static" / name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
