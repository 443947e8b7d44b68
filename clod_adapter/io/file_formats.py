"""The file formats of Gaussians, by the suffix of the file: one table, and first checks of a file,
without torch.

What reads, checks or rejects a file, here and in the readers, raises a ClodError of one line that
names the file.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.ranks import check_ranks, joined, ranks_of
from clod_adapter.io.settings import Metadata, Source

if TYPE_CHECKING:
    from clod_adapter.gaussians import Gaussians

Writer = Callable[..., tuple[str, ...]]


class Format(NamedTuple):
    """A format. Its module has ``read``, of a path and the bytes of the file to a ``Source``
    without their hash, which may raise any error; if it is written also ``write``, of a path,
    Gaussians in world units and their ``Metadata``, to a line for each loss.
    """

    module: str = ""  # under ``clod_adapter.io``, imported when it is used
    check: str = ""  # rejects, without torch, a file of another format
    carries_sigma: bool = False  # whether the dial is written: sigma_d, growth_d and their settings
    # where it is written, the precision of its values; lines of at most 54 letters
    about: tuple[str, ...] = ()


PACKED = ".compressed.ply"
KEY = "clod_adapter"  # of the JSON document in formats other than PLY
_CONVERTED = Format("formats.splat_transform", "formats.splat_transform.check")
PLY = Format("ply", "ply.has_dial", carries_sigma=True, about=("exact; baked, in Inria's layout",))
FORMATS = {
    ".ply": PLY,
    ".spz": Format(
        "formats.spz",
        "file_formats.check_spz",
        carries_sigma=True,
        about=("6 to 24 bits, the dial 16-bit floats",),
    ),
    ".pt": Format(
        "formats.pt",
        "formats.pt.check",
        carries_sigma=True,
        about=("exact; layout of gsplat's trainer",),
    ),
    PACKED: _CONVERTED,
    ".sog": _CONVERTED,
    ".splat": _CONVERTED,
    ".ksplat": _CONVERTED,
}
WRITABLE = {suffix: form for suffix, form in FORMATS.items() if form.about}


def format_of(path: Path) -> Format:
    """The format of a file, by its name alone, so that only a .pt is unpickled; any other name is a
    PLY's.
    """
    if path.name.lower().endswith(PACKED):
        return FORMATS[PACKED]
    return FORMATS.get(path.suffix.lower(), PLY)


def check_readable(path: Path) -> None:
    """Rejects, without torch, a file whose first bytes are not of its format."""
    _reading(format_of(path).check, path)


def file_has_dial(path: Path) -> bool:
    """Whether the file has a sigma_d: of a PLY by its header, other formats are read."""
    form = format_of(path)
    if form is PLY:
        return bool(_reading("ply.has_dial", path))
    if form.carries_sigma:
        return _read(path).metadata.attenuation is not None
    check_readable(path)
    return False


def check_suffix(path: Path) -> None:
    """Rejects a name whose suffix is none of WRITABLE."""
    if path.name.lower().endswith((".glb", ".sog", PACKED)):
        raise ClodError(
            f"{path}: is written by clod-adapt export alone: save a .ply, then clod-adapt export it"
        )
    if path.suffix.lower() not in WRITABLE:
        raise ClodError(
            f"{path}: {path.suffix or 'no suffix'} is no format to write; choose one of"
            f" {', '.join(WRITABLE)}"
        )


def read_source(path: Path) -> Source:
    """The content of a file in any format, with the other ranks of a checkpoint of several GPUs
    (``ranks``).

    Every reader rejects, in one line, what is damaged or of another kind.
    """
    source = _read(path)
    ranks = {} if source.metadata.described else ranks_of(path)
    if not ranks:
        return source
    check_ranks(path, ranks)
    sources = [source if rank == path else _read(rank) for rank in ranks.values()]
    return joined(path, sources) if len(sources) > 1 else source


def _read(path: Path) -> Source:
    check_readable(path)
    data = read_bytes(path)  # once, and not mapped: another program may write the file meanwhile
    source: Source = _reading(f"{format_of(path).module}.read", path, data)
    return source._replace(sha256=hashlib.sha256(data).hexdigest())


def write(
    path: str | Path,
    gaussians: Gaussians,
    metadata: Metadata | None = None,
    *,
    writer: Writer | None = None,
) -> tuple[str, ...]:
    """Writes Gaussians in the format of the suffix, whole or not at all, sigma_d in world units; a
    line for each loss.

    ``metadata`` lacks their dial and screen-space filter; ``writer`` replaces the format's
    ``write``.
    """
    check_suffix(Path(path))
    form = format_of(Path(path))
    if len(gaussians) == 0:
        raise ClodError(
            f"{path}: there are no Gaussians to write, and no reader takes a file without any"
        )
    from clod_adapter.equation.units import in_world_units  # here: the table needs no torch

    g = in_world_units(gaussians)
    stored = replace(
        metadata or Metadata(), attenuation=g.attenuation, screen_filter=g.screen_filter
    )
    written = writer or import_module(f"clod_adapter.io.{form.module}").write
    with atomic_path(path) as temporary:
        notes: tuple[str, ...] = written(temporary, g, stored)
        try:
            file_has_dial(temporary)
        except ClodError as error:
            raise ClodError(
                f"{path}: is not written, because it could not be read again: {error}"
            ) from error
    return notes


START = 64  # bytes that tell the kind of a file
# first bytes of version 4, which splat-transform reads; earlier versions are gzipped
NEW_SPZ = b"NGSP"


def check_spz(path: Path) -> None:
    """Rejects a file whose first bytes are not of an SPZ file."""
    start = read_bytes(path, START)
    if not start.startswith((b"\x1f\x8b", NEW_SPZ)):
        reject(path, start, "is not a .spz file by its first bytes; copy or export it again")
    if start.startswith(NEW_SPZ):
        _reading("formats.splat_transform.check", path)


def _reading(function: str, path: Path, *args: Any) -> Any:
    """Calls a format's function; any error in it becomes one that names the file."""
    module, name = function.rsplit(".", 1)
    with rejected_if_damaged(path):
        return getattr(import_module(f"clod_adapter.io.{module}"), name)(path, *args)


_CONVERT = (
    "convert it: splat-transform IN{suffix} OUT.ply; better still, adapt the PLY that it was made"
    " from"
)
_DOWNLOAD = "download the file itself"
# First bytes (after white space) that are never those of a splat, what the file is, and the remedy.
CONTENTS = (
    (
        b"version https://git-lfs",
        "a Git LFS pointer, not the file it stands for",
        "fetch that: git lfs pull",
    ),
    (
        (b"<!doctype html", b"<html"),
        "a web page, of clod-adapt export or of a failed download",
        _DOWNLOAD,
    ),
    (b"<?xml", "an XML document, perhaps an error that a server sent", _DOWNLOAD),
)
# The same by suffix, or else by first bytes, of other formats.
OTHERS: dict[str | bytes, tuple[str, str]] = {
    ".lcc": ("an LCC file, compressed for delivery", _CONVERT),
    ".hier": (
        "a Hierarchical-3DGS tree",
        "use the chunk's point_cloud.ply that the tree was built from",
    ),
    ".ckpt": (
        "a checkpoint of Nerfstudio",
        "use ns-export gaussian-splat --load-config CONFIG.yml --output-dir OUT",
    ),
    ".pth": (
        "a trainer's checkpoint, such as Inria's",
        "use the point_cloud/iteration_N/point_cloud.ply beside it",
    ),
    ".safetensors": (
        "no model but perhaps an adapter",
        "clod-adapt apply BASE.ply ADAPTER.safetensors -o OUT.ply makes a model of it",
    ),
    ".json": ("a JSON document; of an unbundled SOG it is the table of contents", _CONVERT),
    b"\x1f\x8b": ("compressed with gzip", "unpack it first: gunzip"),
    b"PK\x03\x04": (
        "a zip archive",
        "unpack it first; a gsplat checkpoint must be called .pt to be read as one",
    ),
    b"glTF": ("a glTF model", "adapt the PLY that it was made from"),
    b"NGSP": ("an SPZ file", "call it .spz"),
    b"ply": ("a PLY file", "call it .ply"),
}


def reject_irregular(path: Path, remedy: str = "give the name of a file") -> None:
    """Rejects what exists and is not a regular file: reading a pipe would wait."""
    if path.exists() and not path.is_file():
        raise ClodError(f"{path}: cannot be read (it is not a regular file); {remedy}")


def reject_long_numbers(path: Path, text: bytes) -> None:
    """Rejects a number of a thousand digits, of which parsers make copies."""
    if re.search(rb"\d{1000}", text):
        raise ClodError(
            f"{path}: is damaged (a number of more than 1,000 digits); copy or export it again"
        )


def read_bytes(path: Path, most: int = -1) -> bytes:
    """The bytes of a file, or its first ones."""
    # ValueError: a name that holds a NUL
    with rejected_if_damaged(path, "cannot be read", "check the path"):
        reject_irregular(path)
        with open(path, "rb") as file:
            return file.read(most)


def reject_known(path: Path, start: bytes) -> None:
    """Rejects a file whose first bytes are never those of a splat."""
    if not start:
        raise ClodError(f"{path}: is empty; copy or export it again")
    text = start.lstrip()[:64].lower()
    for magic, content, remedy in CONTENTS:
        if text.startswith(magic):
            raise ClodError(f"{path}: is {content}; {remedy}")


def reject(path: Path, start: bytes, otherwise: str) -> NoReturn:
    """Rejects a file, with its kind by the tables, or else with the message ``otherwise``."""
    reject_known(path, start)
    for key, (content, remedy) in OTHERS.items():
        if key == path.suffix.lower() or (isinstance(key, bytes) and start.startswith(key)):
            raise ClodError(f"{path}: is {content}; {remedy.format(suffix=path.suffix)}")
    raise ClodError(f"{path}: {otherwise}")
