"""Models as checkpoints of gsplat's trainer, read and written; ``pt`` checks the pickle and reads its tensors."""

from __future__ import annotations

import io
from pathlib import Path

import torch

from clod_adapter.gaussians import Gaussians
from clod_adapter.integrations.splats import NAMES
from clod_adapter.io.file_formats import History, Model
from clod_adapter.io.formats.arrays import arrays_of, gaussians_of
from clod_adapter.io.formats.metadata import KEY, metadata_text, parse_metadata, write_metadata
from clod_adapter.io.formats.pt import FRAME, read_splats
from clod_adapter.io.ply.columns import SIGMA, dial_columns


def write_pt(path: Path, gaussians: Gaussians, history: History) -> tuple[str, ...]:
    """Writes every value unchanged; arguments and errors as ``file_formats.write``."""
    arrays = arrays_of(path, gaussians)
    names = NAMES | {name: name for name in dial_columns(arrays)}
    splats = {name: torch.from_numpy(arrays[ours]) for name, ours in names.items()}
    text = metadata_text(write_metadata(gaussians, history))
    # By way of memory, as the entries of a file are named after it, and this one's name is temporary.
    buffer = io.BytesIO()
    torch.save({"step": 0, "splats": splats, KEY: text}, buffer)
    path.write_bytes(buffer.getbuffer())
    return ()


def open_pt(path: Path) -> bool:
    """Whether a checkpoint has sigma_d, without reading its values; errors as ``load_pt``."""
    values, text, _ = read_splats(path, digest=False)
    parse_metadata(path, text, dial=SIGMA in values)
    return SIGMA in values


def load_pt(path: Path) -> Model:
    """Reads a checkpoint of gsplat's trainer, or one written here.

    Raises:
        ClodError: as ``pt.read_splats``, or its settings are damaged.
    """
    values, text, sha256 = read_splats(path)
    metadata = parse_metadata(path, text, dial=SIGMA in values)
    arrays = {NAMES.get(name, name): value for name, value in values.items()}
    notes = () if metadata.described else (FRAME,)
    return Model(gaussians_of(path, arrays, metadata), metadata, sha256, notes, not metadata.described)
