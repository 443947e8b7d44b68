"""Files that are not what they are called: what they are, by first bytes and name, and what to do about them."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from clod_adapter.errors import ClodError

_CONVERT = "convert it: splat-transform IN{suffix} OUT.ply; better still, adapt the PLY that it was made from"

_PAGE = "which clod-adapt export wrote to be opened in a browser, or a download went wrong"

# What a file begins with (white space aside), what it then is whatever its name, and what to do.
CONTENTS = (
    (b"version https://git-lfs", "a Git LFS pointer, not the file it stands for", "fetch that: git lfs pull"),
    (b"<!doctype html", f"a web page, {_PAGE}", "download the file itself"),
    (b"<html", f"a web page, {_PAGE}", "download the file itself"),
    (b"<?xml", "an XML document, perhaps an error that a server sent", "download the file itself"),
)
# The same by suffix, for formats that no first bytes tell apart.
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
# The same by first bytes, where neither of the two above knows better.
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


def refuse_known(path: Path, start: bytes) -> None:
    """Raises the ClodError of a file that, whatever its name, is no splat, by what it begins with."""
    if not start:
        raise ClodError(f"{path}: is empty; copy or export it again")
    text = start.lstrip()[:64].lower()
    for magic, what, remedy in CONTENTS:
        if text.startswith(magic):
            raise ClodError(f"{path}: is {what}; {remedy}")


def refuse(
    path: Path, start: bytes, otherwise: str = "is not a PLY file; convert it to a .ply in Inria's 3DGS layout first"
) -> NoReturn:
    """Raises the ClodError of a file that begins with ``start`` and so is not what its name says: by default a PLY."""
    refuse_known(path, start)
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        what, remedy = SUFFIXES[suffix]
        raise ClodError(f"{path}: is {what}; {remedy.format(suffix=path.suffix)}")
    for magic, what, remedy in ARCHIVES:
        if start.startswith(magic):
            raise ClodError(f"{path}: is {what}; {remedy}")
    raise ClodError(f"{path}: {otherwise}")
