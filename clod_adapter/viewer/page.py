"""The viewer's page, for the server or as one file that includes the splats, and the data that it
shows.

The page loads nothing from other hosts: its Content-Security-Policy allows one script and one
style, by their hashes, and connections to its own server only. Splats are PLY in one layout,
whatever the file, or SPZ.
"""

import base64
import hashlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.resources import files
from io import BytesIO
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from plyfile import PlyData, PlyElement
from torch import Tensor

from clod_adapter._support.arrays import float64_array
from clod_adapter._support.text import as_text, script_json
from clod_adapter.cameras import Camera, looking
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import OPAQUE, Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import Checkpoint, load
from clod_adapter.io.file_formats import write
from clod_adapter.io.ply_layout import inria_dtype, write_comments
from clod_adapter.io.settings import Metadata
from clod_adapter.io.values import dial_columns
from clod_adapter.origin import NOWHERE, Origin
from clod_adapter.quality_table import QualityTable
from clod_adapter.rasterizers.reference import rotations
from clod_adapter.render import render

BLOCK_ROWS = 1 << 14
STYLE = "viewer.css"
SCRIPT = "viewer.js"
ELEMENT = "clod-model"  # id of the elements with the splats
PART = 3 << 24  # bytes of a script element, a multiple of 3; browsers limit strings to about 5e8
POSTER_SIDE = 512  # pixels of the picture shown while the page loads
POSTER_QUALITY = 60  # of its JPEG
# What nerfstudio and Brush state as the vertical axis, in numbers or by name; as viewers/read.js.
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
VERTICAL = re.compile(
    rf"(?i)\s*vertical axis:[\s\[]*([xyz]|{NUMBER}(?:[\s,]+{NUMBER}){{2}})[\s\]]*"
)
NAMED = {"x": "1 0 0", "y": "0 -1 0", "z": "0 0 1"}  # Brush's y points down
# Settings of up_axis, as in web/src/model.js.
UPS = ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0))  # first guesses
FLAT = math.log(2)  # least logarithm of the ratio of a flat Gaussian's least two scales
BESIDE = math.cos(math.pi / 5)  # cosine within which a flat Gaussian faces the axis
SURE = 0.3  # least share of the flat Gaussians that do
UP_STEPS = 10
MAX_PITCH = 0.995  # cosine of a camera's axis and up, beyond which it is not levelled

Entry = Mapping[str, Any]


@dataclass(frozen=True)
class Payload:
    """A splat for the page, without SH degrees that are 0; means are relative to the origin."""

    name: str
    gaussians: Gaussians
    quality_table: QualityTable | None = None
    origin: Origin = NOWHERE
    about: tuple[str, ...] = ()  # comments on the vertical axis

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> "Payload":
        gaussians = checkpoint.gaussians.without_empty_bands()
        if gaussians.attenuation is not None and gaussians.attenuation.form == "paper":
            raise ClodError(
                f"{checkpoint.path}: its dial is of the paper's form, which viewers do not draw;"
                " adapt it without --form paper"
            )
        about = tuple(filter(VERTICAL.fullmatch, checkpoint.comments))
        name = as_text(checkpoint.path.name)
        return cls(name, gaussians, checkpoint.quality_table, checkpoint.origin, about)

    @cached_property
    def header(self) -> bytes:
        """The PLY's header, with attenuation settings and quality table as comments."""
        g = self.gaussians
        names = inria_dtype(g.sh_degree, dial=dial_columns(g.tensors())).names or ()
        columns = [(name, "<f4") for name in names if name not in ("nx", "ny", "nz")]
        row = np.zeros((), columns)
        settings = Metadata(g.attenuation, g.screen_filter, self.quality_table, about=self.about)
        comments = write_comments(settings)
        element = PlyElement.describe(np.broadcast_to(row, len(g)), "vertex", comments=comments)
        return f"{PlyData([element], byte_order='<').header}\n".encode("ascii")

    @property
    def size(self) -> int:
        """Bytes of the PLY."""
        columns = self.header.count(b"\nproperty ")
        return len(self.header) + 4 * columns * len(self.gaussians)

    def blocks(self) -> Iterator[bytes]:
        """The PLY in blocks of rows: little-endian float32, Inria's layout without normals, the
        dial last.

        A logit above 20 is written as 20, the same opacity in float32.
        """
        g = self.gaussians
        tensors = g.tensors()
        columns = [
            g.means,
            g.sh0,
            g.shN.transpose(1, 2),
            g.opacity_logits.clamp(max=OPAQUE)[:, None],
            g.log_scales,
            g.quats,
        ]
        columns += [tensors[name][:, None] for name in dial_columns(tensors)]
        yield self.header
        blocks = [column.split(BLOCK_ROWS) for column in columns]
        for columns_of_block in zip(*blocks, strict=True):
            rows = torch.cat([values.flatten(1) for values in columns_of_block], 1).detach()
            yield rows.float().cpu().numpy().astype("<f4", copy=False).tobytes()

    def content(self, file: str, exact: bool) -> tuple[bytes, Gaussians, tuple[str, ...]]:
        """The splat as PLY, if ``exact``, or as SPZ, with rows along a curve: where neighbours are
        next to one another, it takes a tenth less.

        ``file`` is a temporary name. Returns the bytes, the Gaussians in them, and a line for each
        loss.
        """
        if exact:
            return b"".join(self.blocks()), self.gaussians, ()
        rows = _along_curve(self.gaussians.means)
        try:
            metadata = Metadata(
                quality_table=self.quality_table, origin=self.origin, about=self.about
            )
            notes = write(file, self.gaussians.select(rows), metadata)
            gaussians = load(file, origin=self.origin).gaussians
            gaussians = gaussians.to(self.gaussians.means.device)
            return Path(file).read_bytes(), gaussians, notes
        finally:
            Path(file).unlink(missing_ok=True)


def _along_curve(means: Tensor) -> Tensor:
    """The rows in Morton order, of cells that divide all but the outermost 1 % on each side by
    1024.
    """
    points = float64_array(means)
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    places = 1023 * (points - low) / np.maximum(high - low, 1e-300)
    cells = places.clip(0, 1023).astype(np.int64)
    code = np.zeros(len(cells), np.int64)
    for bit, axis in product(range(10), range(3)):
        code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return torch.from_numpy(np.argsort(code, kind="stable")).to(means.device)


def camera_entry(camera: Camera, placed: bool = False) -> Entry:
    """A camera of the page's configuration. ``placed``: it is not a photograph's; the page levels
    it.
    """
    return {
        "name": camera.name,
        "viewmat": camera.viewmat.tolist(),
        "K": camera.K.tolist(),
        "width": camera.width,
        "height": camera.height,
        "near": camera.near,
        "placed": placed,
    }


def page_config(
    models: Sequence[Entry],
    base: Entry | None,
    cameras: Sequence[Entry],
    virtual_scale: float | None,
    converter: Entry | None = None,
) -> Entry:
    """The page's configuration. Models and ``base`` have a ``name``, and ``href`` or ``element``
    for their data; ``converter`` has the ``href`` of the server's, and the ``limit`` of its bytes.

    ``virtual_scale`` is the first dial value; None for 1 with photographs, else 0 (everything), and
    then what suits the device.
    """
    return {
        "title": models[0]["name"],
        "model": models[0],
        "base": base,
        "others": models[1:],
        "cameras": cameras,
        "virtual_scale": virtual_scale,
        "converter": converter,
    }


def distinct_names(models: Sequence[Checkpoint]) -> list[str]:
    """The names of the models' files, with their folders where two are alike."""
    names = [as_text(model.path.name) for model in models]
    if len({*names}) < len(names):
        names = [as_text("/".join(model.path.absolute().parts[-2:])) for model in models]
    return names


def write_viewer_page(
    path: str | Path,
    model: Checkpoint,
    *,
    others: Sequence[Checkpoint] = (),
    cameras: Sequence[Camera] = (),
    virtual_scale: float | None = None,
    exact: bool = False,
) -> tuple[Gaussians, tuple[str, ...]]:
    """Writes the page as one file with the splats in it; the same arguments give the same bytes.

    ``others`` are models to switch to, with the origin of ``model``. ``virtual_scale`` is as in
    ``page_config``; ``exact`` includes float32, not SPZ. Returns the Gaussians of ``model`` as the
    page shows them, and a line for each loss.
    """
    models = [model, *others]
    payloads = [Payload.of(each) for each in models]
    placed = model.placed and not cameras
    cameras = cameras or model.cameras
    entries = [camera_entry(camera, placed) for camera in cameras]
    elements = [ELEMENT, *(f"{ELEMENT}-{k}" for k in range(1, len(models)))]
    names = distinct_names(models)
    files = [
        {"name": name, "element": element} for name, element in zip(names, elements, strict=True)
    ]
    config = page_config(files, None, entries, virtual_scale)
    with atomic_path(path) as temporary:
        contents = [payload.content(f"{temporary}.spz", exact) for payload in payloads]
        data, shown, losses = zip(*contents, strict=True)
        gaussians = shown[0]
        opening = virtual_scale if virtual_scale is not None else 0.0 if placed else 1.0
        first = cameras[0] if cameras else None
        if first and placed:
            first = levelled(first, up_axis(gaussians, payloads[0].about))
        poster = _poster(gaussians, first, opening) if first else ""
        meta = f'<meta http-equiv="Content-Security-Policy" content="{policy()}">\n'
        with open(temporary, "wb") as file:
            file.writelines(document(config, _elements(elements, data), meta, poster))
    return gaussians, tuple(dict.fromkeys(chain(*losses)))


def _poster(gaussians: Gaussians, camera: Camera, virtual_scale: float) -> str:
    """An element with the view of a camera as a JPEG, for the time until the page has drawn its
    own.
    """
    scale = min(POSTER_SIDE / max(camera.width, camera.height), 1.0)
    width = max(round(scale * camera.width), 1)
    height = max(round(scale * camera.height), 1)
    small = camera.resized(width, height)
    dial = 1.0 if gaussians.sigma_d is None else virtual_scale
    image = Image.fromarray(render(gaussians, small, dial).pixels.cpu().numpy())
    buffer = BytesIO()
    image.save(buffer, "JPEG", quality=POSTER_QUALITY)
    text = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f'<img id="poster" alt="" src="data:image/jpeg;base64,{text}">'


def levelled(camera: Camera, axis: np.ndarray) -> Camera:
    """The camera rolled until ``axis`` is up, as web/src/camera.js does with placed ones; unchanged
    if it looks along it.
    """
    ahead = camera.viewmat[2, :3]
    up = ahead.new_tensor(axis)
    if abs(float(ahead @ up)) >= MAX_PITCH:
        return camera
    return replace(camera, viewmat=looking(camera.position, ahead, -up))


def up_axis(gaussians: Gaussians, comments: Sequence[str] = ()) -> np.ndarray:
    """The axis that the last comment states, else the direction that flat Gaussians face, a ground
    or a table, as in web/src/model.js.
    """
    for match in filter(None, map(VERTICAL.fullmatch, reversed(comments))):
        text = match[1].lower()
        up = np.array(re.findall(NUMBER, NAMED.get(text, text)), np.float64)
        length = np.linalg.norm(up)
        if 0 < length < math.inf:
            return up / length
    g = gaussians.to("cpu")
    scales = np.sort(g.log_scales.numpy(), axis=1)
    flat = scales[:, 0] + FLAT < scales[:, 1]
    axes = rotations(g.quats[torch.from_numpy(flat)].double()).numpy()
    thin = g.log_scales.numpy()[flat].argmin(axis=1)
    normals = axes[np.arange(len(axes)), :, thin]
    weights = float64_array(g.opacities)[flat]
    for up in np.array(UPS):
        for _ in range(UP_STEPS):
            cosines = normals @ up
            near = np.abs(cosines) > BESIDE
            if near.any():
                total = (weights * np.sign(cosines))[near] @ normals[near]
                up = total / np.linalg.norm(total)
        if weights[near].sum() > SURE * weights.sum():
            return up
    return np.array(UPS[0])


def _source_of(name: str) -> str:
    """A source of the policy: the hash of a static file."""
    digest = hashlib.sha256(_static_file(name).encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def policy(connect: str = "") -> str:
    """The page's Content-Security-Policy; ``connect`` is a further source that it may fetch
    from.
    """
    script = _source_of(SCRIPT)
    style = _source_of(STYLE)
    return (
        f"default-src 'none'; script-src {script}; style-src {style}; img-src data: blob:; "
        f"connect-src {connect} data: blob:; worker-src blob:; base-uri 'none'; form-action 'none'"
    )


def document(
    config: Mapping[str, Any],
    data: Iterable[bytes] = (),
    meta: str = "",
    poster: str = "",
) -> Iterator[bytes]:
    """The page in pieces, because data may be large; ``meta`` is added to its head, ``poster``
    above its canvas.
    """
    content = {
        "STYLE": f"{meta}<style>{_static_file(STYLE)}</style>",
        "POSTER": poster,
        "CONFIG": (
            f'<script type="application/json" id="clod-config">{script_json(config)}</script>'
        ),
        "SCRIPT": f'<script type="module">{_static_file(SCRIPT)}</script>',
    }
    pieces = re.split("<!--CLOD-([A-Z]+)-->", _static_file("page.html"))
    for number, piece in enumerate(pieces):
        if piece == "DATA":
            yield from data
        else:
            yield (content[piece] if number % 2 else piece).encode()


def _elements(elements: Sequence[str], data: Sequence[bytes]) -> Iterator[bytes]:
    """Script elements with the bytes as base64; large data are divided among several with the same
    id.
    """
    for element, content in zip(elements, data, strict=True):
        for start in range(0, len(content), PART):
            encoded = base64.b64encode(content[start : start + PART])
            yield b'<script type="application/octet-stream" id="%s">%s</script>\n' % (
                element.encode(),
                encoded,
            )


@cache
def _static_file(name: str) -> str:
    return (files("clod_adapter.viewer") / "static" / name).read_text(encoding="utf-8")
