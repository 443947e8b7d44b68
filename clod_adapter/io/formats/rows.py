"""The formats besides PLY that hold a model, as rows: what ``models.load_model`` reads, with what it says of itself."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from clod_adapter.errors import ClodError
from clod_adapter.io.formats.converted import check_converted, read_converted
from clod_adapter.io.formats.metadata import KEY, Metadata
from clod_adapter.io.formats.pt import check_pt
from clod_adapter.io.ply.columns import SIGMA, rows_of
from clod_adapter.io.ply.header import PREFIX, write_comments
from clod_adapter.io.regular import read_start
from clod_adapter.io.rows import Rows
from clod_adapter.io.sniff import refuse, refuse_known
from clod_adapter.io.tensor_file import read_metadata
from clod_adapter.origin import AXES

_NEW_SPZ = b"NGSP"  # how version 4 begins, which splat-transform is asked to read; earlier ones are gzipped
_START: dict[str, tuple[bytes, ...]] = {".glb": (b"glTF",), ".spz": (b"\x1f\x8b", _NEW_SPZ)}
QUANTISED = {
    ".splat": "quantised: colours, opacities and rotations in 8 bits, no view-dependent colour",
    ".spz": "quantised: positions in 24 bits, scales, opacities and harmonics in 8, rotations in 10 or 8",
}


def check_model(path: Path) -> None:
    """Refuses, without torch, what by its first bytes is no file of its suffix's format.

    Raises:
        ClodError: it is none, an adapter, or cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix == ".pt":
        return check_pt(path)
    start = read_start(path)
    refuse_known(path, start)
    if suffix in _START and not start.startswith(_START[suffix]):
        refuse(path, start, f"is no {suffix} file by its first bytes; copy or export it again")
    if start.startswith(_NEW_SPZ):
        check_converted(path, " of version 4")
        return
    if suffix == ".splat" and path.stat().st_size % 32:
        raise ClodError(f"{path}: is no .splat file, whose rows have 32 bytes; copy or export it again")
    if suffix == ".safetensors" and '"clod-adapter"' in read_metadata(path).get(KEY, ""):
        raise ClodError(f"{path}: is an adapter, no model; clod-adapt apply BASE.ply {path.name} -o OUT.ply makes one")


def model_has_dial(path: Path) -> bool:
    """Whether the file has a sigma_d: by its header, and of an SPZ by reading it."""
    from clod_adapter.io.formats.models import load_model

    suffix = path.suffix.lower()
    check_model(path)
    if suffix == ".splat" or _is_new_spz(path):
        return False
    if suffix == ".pt":
        with zipfile.ZipFile(path) as archive:  # check_pt has looked at it
            return any(SIGMA.encode() in archive.read(name) for name in archive.namelist() if name.endswith("data.pkl"))
    return load_model(path).gaussians.sigma_d is not None


def read_model(path: Path) -> Rows:
    """The Gaussians of a file, with its settings, calibration and lines as the comments that a PLY of them has.

    Raises:
        ClodError: as ``models.load_model``.
    """
    from clod_adapter.io.formats.models import load_model

    check_model(path)
    if _is_new_spz(path):
        return read_converted(path)
    model = load_model(path)
    g = model.gaussians
    card = model.card
    arrays = {name: tensor.numpy() for name, tensor in g.tensors().items()}
    vertex = rows_of(arrays, g.sh_degree)
    kinds = [(name, np.dtype("f8") if name in AXES and any(card.origin) else kind) for name, kind in _fields(vertex)]
    kinds += [(SIGMA, np.dtype("f4"))] if SIGMA in arrays else []
    rows = np.empty(len(vertex), kinds)
    for name in vertex.dtype.names or ():
        rows[name] = vertex[name]
    if any(card.origin):
        for k, axis in enumerate(AXES):
            rows[axis] = arrays["means"][:, k].astype(np.float64) + card.origin[k]
    if SIGMA in arrays:
        rows[SIGMA] = arrays[SIGMA]
    suffix = path.suffix.lower()
    notes = (*model.notes, *([QUANTISED[suffix]] if suffix in QUANTISED else []))
    settled = suffix != ".pt" or bool(card.version)  # a .pt of another program may hold anything
    return Rows(rows, g.sh_degree, _comments(card), notes, settled, card.origin if any(card.origin) else None)


def _is_new_spz(path: Path) -> bool:
    with open(path, "rb") as file:
        return path.suffix.lower() == ".spz" and file.read(4) == _NEW_SPZ


def _fields(vertex: np.ndarray) -> list[tuple[str, np.dtype]]:
    return [(name, vertex.dtype[name]) for name in vertex.dtype.names or ()]


def _comments(card: Metadata) -> tuple[str, ...]:
    """The description as the header of a PLY has it: printable ASCII, and of ours only what a card says."""
    about = ["".join(c if c.isascii() and c.isprintable() else "?" for c in line) for line in card.about]
    if card.attenuation is None and not card.version:
        return tuple(line for line in about if not line.startswith(PREFIX))
    comments = write_comments(card.attenuation, about, card.version or None, card.calibration, card.screen_filter)
    return tuple(comment for comment in comments if card.version or not comment.startswith(f"{PREFIX}version "))
