"""Data of a checkpoint for the viewer's page: Gaussians as PLY in one layout, and metadata as JSON.

The layout does not depend on the file (ascii, big-endian, doubles, masks, .pt).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from clod_adapter._support.text import as_text
from clod_adapter.calibration import Calibration
from clod_adapter.cameras import Camera
from clod_adapter.gaussians import OPAQUE, Gaussians
from clod_adapter.io.checkpoint import Checkpoint, load
from clod_adapter.io.file_formats import write
from clod_adapter.io.ply import inria_dtype
from clod_adapter.io.ply_settings import write_comments
from clod_adapter.io.settings import Metadata
from clod_adapter.io.values import dial_columns
from clod_adapter.origin import NOWHERE, Origin

BLOCK_ROWS = 1 << 14


@dataclass(frozen=True)
class Payload:
    """A splat for the page, without SH degrees that are 0; means are relative to the origin."""

    name: str
    gaussians: Gaussians
    calibration: Calibration | None = None
    origin: Origin = NOWHERE

    @classmethod
    def of(cls, checkpoint: Checkpoint) -> Payload:
        gaussians = checkpoint.gaussians.without_empty_bands()
        return cls(as_text(checkpoint.path.name), gaussians, checkpoint.calibration, checkpoint.origin)

    @cached_property
    def header(self) -> bytes:
        """The PLY's header, with attenuation settings and calibration as comments."""
        g = self.gaussians
        layout = inria_dtype(g.sh_degree, dial=dial_of(g))
        row = np.zeros((), [(name, "<f4") for name in layout.names or () if name not in ("nx", "ny", "nz")])
        comments = write_comments(Metadata(g.attenuation, g.screen_filter, self.calibration))
        element = PlyElement.describe(np.broadcast_to(row, len(self.gaussians)), "vertex", comments=comments)
        return f"{PlyData([element], byte_order='<').header}\n".encode("ascii")

    @property
    def size(self) -> int:
        """Bytes of the PLY."""
        return len(self.header) + 4 * self.header.count(b"\nproperty ") * len(self.gaussians)

    def blocks(self) -> Iterator[bytes]:
        """The PLY in blocks of rows: little-endian float32, Inria's layout without normals, the dial last.

        A logit above 20 is written as 20, the same opacity in float32.
        """
        yield self.header
        for start in range(0, len(self.gaussians), BLOCK_ROWS):
            yield _values(self.gaussians, slice(start, start + BLOCK_ROWS)).astype("<f4", copy=False).tobytes()

    def packed(self, file: str | Path, exact: bool = False) -> tuple[bytes, Gaussians, tuple[str, ...]]:
        """The splat as SPZ, of which rows that are near one another take a tenth less, or ``exact`` as PLY.

        ``file`` is a temporary name. Returns the bytes, the Gaussians in them, and a line for each loss.
        """
        if exact:
            return b"".join(self.blocks()), self.gaussians, ()
        rows = _along_curve(self.gaussians.means)
        try:
            notes = write(file, self.gaussians.select(rows), origin=self.origin, calibration=self.calibration)
            found = load(file, origin=self.origin).gaussians.to(self.gaussians.means.device)
            return Path(file).read_bytes(), found, notes
        finally:
            Path(file).unlink(missing_ok=True)


def page_config(
    model: Mapping[str, Any],
    base: Mapping[str, Any] | None,
    cameras: Sequence[Camera],
    virtual_scale: float | None,
    others: Sequence[Mapping[str, Any]] = (),
    placed: bool = False,
) -> dict[str, Any]:
    """The page's configuration. ``model`` and ``base`` have a ``name``, and ``href`` or ``element`` for their data.

    ``virtual_scale`` is the first dial value; None for 1 with photographs, else 0 (everything), and then what suits the
    device. ``placed``: the cameras are not photographs'; the page levels them.
    """
    return {
        "title": model["name"], "model": model, "base": base, "others": list(others),
        "cameras": [_camera(camera) | {"placed": placed} for camera in cameras], "virtual_scale": virtual_scale,
    }  # fmt: skip


def dial_of(gaussians: Gaussians) -> dict[str, Tensor]:
    """``[N]`` values of the dial's columns, by name; none without a dial."""
    tensors = gaussians.tensors()
    return {name: tensors[name] for name in dial_columns(tensors)}


def _values(g: Gaussians, rows: slice) -> np.ndarray:
    """``[n, P]`` float32 values of these rows in the order of the header."""
    count = len(g.means[rows])
    parts = [
        g.means[rows], g.sh0[rows].reshape(count, 3), g.shN[rows].transpose(1, 2).reshape(count, -1),
        g.opacity_logits[rows].clamp(max=OPAQUE)[:, None], g.log_scales[rows], g.quats[rows],
    ]  # fmt: skip
    parts += [column[rows][:, None] for column in dial_of(g).values()]
    return torch.cat(parts, 1).detach().float().cpu().numpy()


def _along_curve(means: Tensor) -> Tensor:
    """The rows in Morton order, of cells that divide all but the outermost 1 % on each side by 1024."""
    points = means.detach().double().cpu().numpy()
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    cells = (1023 * (points - low) / np.maximum(high - low, 1e-300)).clip(0, 1023).astype(np.int64)
    code = sum(((cells[:, k] >> bit) & 1) << (3 * bit + k) for bit in range(10) for k in range(3))
    return torch.from_numpy(np.argsort(code, kind="stable")).to(means.device)


def _camera(camera: Camera) -> dict[str, Any]:
    def digits(matrix: torch.Tensor) -> list[list[float]]:
        return [[float(f"{value:.9g}") for value in row] for row in matrix.tolist()]  # full float32 precision

    return {
        "name": camera.name, "viewmat": digits(camera.viewmat), "K": digits(camera.K), "width": camera.width,
        "height": camera.height, "near": camera.near,
    }  # fmt: skip
