"""Checks of the formats besides PLY by their first bytes, without torch."""

from __future__ import annotations

import zipfile
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import check_readable, read_model
from clod_adapter.io.formats.converted import check_converted
from clod_adapter.io.formats.metadata import KEY
from clod_adapter.io.ply.columns import SIGMA
from clod_adapter.io.sniff import read_start, refuse, refuse_known
from clod_adapter.io.tensor_file import read_tensor_metadata

NEW_SPZ = b"NGSP"  # first bytes of version 4, which splat-transform reads; earlier versions are gzipped
_START: dict[str, tuple[bytes, ...]] = {".glb": (b"glTF",), ".spz": (b"\x1f\x8b", NEW_SPZ)}


def check_model(path: Path) -> None:
    """Refuses, without torch, a file whose first bytes are not of its suffix's format.

    Raises:
        ClodError: they are not, the file is an adapter, or it cannot be read.
    """
    suffix, start = path.suffix.lower(), read_start(path)
    refuse_known(path, start)
    if suffix in _START and not start.startswith(_START[suffix]):
        refuse(path, start, f"is not a {suffix} file by its first bytes; copy or export it again")
    if suffix == ".spz" and start.startswith(NEW_SPZ):
        check_converted(path, " of version 4")
    if suffix == ".splat" and path.stat().st_size % 32:
        raise ClodError(f"{path}: is not a .splat file, whose rows have 32 bytes; copy or export it again")
    if suffix == ".safetensors" and '"clod-adapter"' in read_tensor_metadata(path).get(KEY, ""):
        raise ClodError(f"{path}: is an adapter, not a model; clod-adapt apply BASE.ply {path.name} -o OUT.ply")


def model_has_dial(path: Path) -> bool:
    """Whether the file has a sigma_d; of a .pt by its pickle, else by reading the file."""
    check_readable(path)
    if path.suffix.lower() == ".pt":
        with zipfile.ZipFile(path) as archive:  # which check_pt has checked
            return any(SIGMA.encode() in archive.read(name) for name in archive.namelist() if name.endswith("data.pkl"))
    return not read_start(path).startswith(NEW_SPZ) and read_model(path).gaussians.sigma_d is not None
