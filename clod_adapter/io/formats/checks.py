"""Checks of the formats besides PLY by their first bytes, without torch."""

from __future__ import annotations

from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.formats.converted import check_converted
from clod_adapter.io.formats.metadata import KEY
from clod_adapter.io.sniff import read_start, refuse, refuse_known
from clod_adapter.io.tensor_file import read_tensor_header

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
    if suffix == ".splat" and (path.stat().st_size % 32 or start.startswith(b"ply")):  # else any bytes are one
        refuse(path, start, "is not a .splat file, whose rows have 32 bytes; copy or export it again")
    if suffix == ".safetensors" and '"clod-adapter"' in read_tensor_header(path)[1].get(KEY, ""):
        raise ClodError(f"{path}: is an adapter, not a model; clod-adapt apply BASE.ply {path.name} -o OUT.ply")
