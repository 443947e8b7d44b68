"""First checks of a file: whether it can be read, and its kind where the suffix is wrong."""

from __future__ import annotations

import hashlib
import re
import sys
from io import BufferedReader
from pathlib import Path
from typing import NoReturn

from clod_adapter.errors import ClodError

_CONVERT = "convert it: splat-transform IN{suffix} OUT.ply; better still, adapt the PLY that it was made from"

_PAGE = "which clod-adapt export wrote to be opened in a browser, or a download went wrong"

# First bytes (after white space) that determine the kind of a file, its name, and the remedy.
CONTENTS = (
    (b"version https://git-lfs", "a Git LFS pointer, not the file it stands for", "fetch that: git lfs pull"),
    (b"<!doctype html", f"a web page, {_PAGE}", "download the file itself"),
    (b"<html", f"a web page, {_PAGE}", "download the file itself"),
    (b"<?xml", "an XML document, perhaps an error that a server sent", "download the file itself"),
)
# The same by suffix, for formats without characteristic first bytes.
SUFFIXES = {
    ".lcc": ("an LCC file, compressed for delivery", _CONVERT),
    ".hier": (
        "a Hierarchical-3DGS tree, whose levels of detail are its own",
        "use the chunk's point_cloud.ply that the tree was built from",
    ),
    ".ckpt": (
        "a training checkpoint, as Nerfstudio writes it",
        "export a PLY: ns-export gaussian-splat --load-config CONFIG.yml --output-dir OUT",
    ),
    ".pth": (
        "a trainer's own checkpoint, as Inria's code writes it to resume from",
        "use the point_cloud/iteration_N/point_cloud.ply beside it",
    ),
    ".json": ("a JSON document; of an unbundled SOG it is the table of contents", _CONVERT),
}
# The same by first bytes, where neither table above matches.
ARCHIVES = (
    (b"\x1f\x8b", "compressed with gzip", "unpack it first: gunzip"),
    (b"PK\x03\x04", "a zip archive", "unpack it first; a gsplat checkpoint must be called .pt to be read as one"),
    (b"\xfd7zXZ\x00", "compressed with xz", "unpack it first: unxz"),
    (b"BZh", "compressed with bzip2", "unpack it first: bunzip2"),
    (b"\x28\xb5\x2f\xfd", "compressed with Zstandard", "unpack it first: unzstd"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive", "unpack it first"),
    (b"glTF", "a glTF model", "call it .glb"),
    (b"NGSP", "an SPZ file", "call it .spz"),
    (b"ply\n", "a PLY file", "call it .ply"),
    (b"ply\r", "a PLY file", "call it .ply"),
)


def refuse_irregular(path: Path, remedy: str = "give the name of a file") -> None:
    """Refuses what exists and is not a regular file: reading a pipe would wait.

    Raises:
        ClodError: the path is not a regular file.
    """
    if path.exists() and not path.is_file():
        raise ClodError(f"{path}: cannot be read (it is not a regular file); {remedy}")


def refuse_long_numbers(path: Path, text: bytes) -> None:
    """Refuses a number of a thousand digits, of which parsers make copies.

    Raises:
        ClodError: ``text``, of ``path``, has one.
    """
    if re.search(rb"\d{1000}", text):
        raise ClodError(f"{path}: is damaged (a number of more than 1,000 digits); copy or export it again")


def read_start(path: Path, size: int = 64) -> bytes:
    """The first bytes of a file, at most ``size``.

    Raises:
        ClodError: the file cannot be read, or is not a regular file.
    """
    try:
        refuse_irregular(path)
        with open(path, "rb") as file:
            return file.read(size)
    except (OSError, ValueError) as error:  # ValueError: a name that holds a NUL
        raise ClodError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}); check the path") from error


def handle_name(file: BufferedReader) -> str:
    """A name of an open file, for libraries that open a file themselves and take names in UTF-8 only.

    It names the same file after another one has replaced it; on Windows nothing replaces an open file.
    """
    return str(file.name) if sys.platform == "win32" else f"/dev/fd/{file.fileno()}"


def file_sha256(file: BufferedReader) -> str:
    """SHA-256 of an open file, hex."""
    file.seek(0)
    digest = hashlib.sha256()
    while block := file.read(1 << 20):
        digest.update(block)
    return digest.hexdigest()


def refuse_known(path: Path, start: bytes) -> None:
    """Refuses a file whose first bytes are never those of a splat.

    Raises:
        ClodError: it is empty, or is one of ``CONTENTS``.
    """
    if not start:
        raise ClodError(f"{path}: is empty; copy or export it again")
    text = start.lstrip()[:64].lower()
    for magic, what, remedy in CONTENTS:
        if text.startswith(magic):
            raise ClodError(f"{path}: is {what}; {remedy}")


def refuse(
    path: Path, start: bytes, otherwise: str = "is not a PLY file; convert it to a .ply in Inria's 3DGS layout first"
) -> NoReturn:
    """Refuses a file, with its kind by its first bytes.

    Args:
        otherwise: the message for a file in none of the tables.

    Raises:
        ClodError: always.
    """
    refuse_known(path, start)
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        what, remedy = SUFFIXES[suffix]
        raise ClodError(f"{path}: is {what}; {remedy.format(suffix=path.suffix)}")
    for magic, what, remedy in ARCHIVES:
        if start.startswith(magic):
            raise ClodError(f"{path}: is {what}; {remedy}")
    raise ClodError(f"{path}: {otherwise}")
