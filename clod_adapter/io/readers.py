"""The formats that Gaussians are read from, by the suffix of the file. The table and its checks need no torch."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from clod_adapter.io.rows import Rows


class Reader(NamedTuple):
    """A format.

    Attributes:
        module: under ``clod_adapter.io``.
        read: its function that makes ``Rows`` of a file.
        check: its function that refuses, without torch, what by its first bytes is no such file.
        has_dial: its function that says whether a file has a sigma_d, without torch where that can be; none where
            none can have one.
    """

    module: str
    read: str
    check: str
    has_dial: str = ""


PLY = Reader("ply.rows", "read_ply", "check_ply", "ply_has_dial")
MODEL = Reader("formats.rows", "read_model", "check_model", "model_has_dial")
CONVERTED = Reader("formats.converted", "read_converted", "check_converted")
# Whatever is not listed is read as a PLY, and what is none is named by what it is.
READERS = {
    ".ply": PLY,
    ".pt": MODEL,
    ".glb": MODEL,
    ".spz": MODEL,
    ".splat": MODEL,
    ".safetensors": MODEL,
    ".sog": CONVERTED,
    ".ksplat": CONVERTED,
}


def reader_of(path: Path) -> Reader:
    """The format of a file, by its name alone: what is in it decides nothing, so that only a .pt is unpickled."""
    return READERS.get(path.suffix.lower(), PLY)


def read_rows(path: Path) -> Rows:
    """The Gaussians of a file, as rows.

    Raises:
        ClodError: it is damaged, of another kind, or its format takes a package or program that is not installed.
    """
    reader = reader_of(path)
    return _function(reader, reader.read)(path)


def check_readable(path: Path) -> None:
    """Refuses, without torch, what by its first bytes no reader takes.

    Raises:
        ClodError: it is.
    """
    reader = reader_of(path)
    _function(reader, reader.check)(path)


def file_has_dial(path: Path) -> bool:
    """Whether the file has a sigma_d.

    Raises:
        ClodError: as ``check_readable``.
    """
    reader = reader_of(path)
    return bool(reader.has_dial) and _function(reader, reader.has_dial)(path)


def _function(reader: Reader, name: str) -> Any:
    return getattr(import_module(f"clod_adapter.io.{reader.module}"), name)
