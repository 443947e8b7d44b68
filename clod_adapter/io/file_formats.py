"""The file formats of Gaussians, by the suffix of the file: one table, and first checks of a file, without torch.

What reads, checks or refuses a file, here and in the readers, raises a ClodError of one line that names the file.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path
from clod_adapter.origin import NOWHERE, Origin

if TYPE_CHECKING:
    from clod_adapter.calibration import Calibration
    from clod_adapter.gaussians import Gaussians
    from clod_adapter.io.settings import Source


class Format(NamedTuple):
    """A format: functions by module and name under ``clod_adapter.io``, imported when they are called.

    Attributes:
        read: a path to a ``Source``.
        check: refuses, by the first bytes and without torch, a file that is not of the format.
        dial: whether a file that ``check`` passes has a sigma_d, by its header (an .spz is read); "" where none has.
        write: called with path, Gaussians in world units and a ``History``; gives a line for each loss; "" where the
            format is only read.
        carries_sigma: whether the dial is written: sigma_d, growth_d and their settings.
        about: of a format that is written, the precision of its values; lines of at most 54 letters.
        ordered: whether the rows keep their order.
    """

    read: str = ""
    check: str = ""
    dial: str = ""
    write: str = ""
    carries_sigma: bool = False
    about: tuple[str, ...] = ()
    ordered: bool = True


_CHECK = "file_formats.check_start"
_CONVERTED = Format("formats.splat_transform.load_converted", "formats.splat_transform.check_converted")
KEY = "clod_adapter"  # of the JSON document in formats other than PLY
PLY = Format(
    "ply.read_ply", "ply.check_ply", "ply.open_ply", "checkpoint.write_ply", True, ("exact; baked, in Inria's layout",)
)
FORMATS = {
    ".ply": PLY,
    ".glb": Format(
        "formats.glb.load_glb", _CHECK, "formats.glb.has_dial", "formats.glb.write_glb", True,
        ("float32, SH degree up to 3", "(KHR_gaussian_splatting, _SIGMA_D, _GROWTH_D)"),
    ),
    ".spz": Format(
        "formats.spz.load_spz", _CHECK, "formats.spz.has_dial", "formats.spz.write_spz", True,
        ("6 to 24 bits, SH degree up to 3, the dial 16-bit floats",),
    ),
    ".safetensors": Format(
        "tensor_file.load_safetensors", _CHECK, "tensor_file.has_dial", "tensor_file.write_safetensors", True,
        ("exact; for Python",),
    ),
    ".pt": Format(
        "formats.pt.load_pt", "formats.pt.check_pt", "formats.pt.has_dial", "formats.pt.write_pt", True,
        ("exact; layout of gsplat's trainer",),
    ),
    ".splat": Format(
        "formats.splat.load_splat", _CHECK, "", "formats.splat.write_splat", False, ("8 bits, SH degree 0",), False
    ),
    ".sog": _CONVERTED,
    ".ksplat": _CONVERTED,
}  # fmt: skip
WRITABLE = tuple(suffix for suffix, form in FORMATS.items() if form.write)


def format_of(path: Path) -> Format:
    """The format of a file, by its name alone, so that only a .pt is unpickled; any other name is a PLY's."""
    return FORMATS.get(path.suffix.lower(), PLY)


def check_readable(path: Path) -> None:
    """Refuses, without torch, a file whose first bytes are not of its format."""
    _call(format_of(path).check, path)


def file_has_dial(path: Path) -> bool:
    """Whether the file has a sigma_d: ``Format.dial``."""
    check_readable(path)
    dial = format_of(path).dial
    return bool(dial) and bool(_call(dial, path))


def check_suffix(path: Path) -> None:
    """Refuses a name whose suffix is none of WRITABLE."""
    if path.name.lower().endswith((".sog", ".compressed.ply")):
        raise ClodError(f"{path}: is written by clod-adapt export alone: save a .ply, then clod-adapt export it")
    if path.suffix.lower() not in WRITABLE:
        found = path.suffix or "no suffix"
        raise ClodError(f"{path}: {found} is no format to write; choose one of {', '.join(WRITABLE)}")


def check_written(path: Path) -> None:
    """Refuses a file just written, under its temporary name, that the reader of its format would refuse.

    Of a PLY header, settings and length are read; any other format is read whole.
    """
    try:
        (file_has_dial if format_of(path) is PLY else read_source)(path)
    except ClodError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise ClodError(f"{path}: is not written, because it could not be read again: {reason}") from error


def read_source(path: Path) -> Source:
    """The content of a file in any format; every reader refuses, in one line, what is damaged or of another kind."""
    check_readable(path)
    found: Source = _call(format_of(path).read, path)
    return found


def write(
    path: str | Path,
    gaussians: Gaussians,
    about: Sequence[str] = (),
    *,
    origin: Origin = NOWHERE,
    calibration: Calibration | None = None,
) -> tuple[str, ...]:
    """Writes Gaussians in the format of the name's suffix, whole or not at all, sigma_d in world units.

    Args:
        gaussians: with or without a dial.
        about: lines on their history, printable ASCII, for formats that store text.
        origin: what their means are relative to (``Checkpoint.origin``), world units.
        calibration: of these Gaussians, for formats that store text.

    Returns:
        One line for each loss.

    Raises:
        ClodError: an unknown suffix, sigma_d for a format that does not carry it, no Gaussians, a value that is not
            finite (opacity = +inf aside), a missing package, or the file cannot be written or not be read again.
    """
    check_suffix(Path(path))
    suffix = Path(path).suffix.lower()
    if gaussians.sigma_d is not None and not FORMATS[suffix].carries_sigma:
        raise ClodError(f"{path}: {Path(path).suffix} has no room for a dial; choose a dial value to bake")
    from clod_adapter.equation.units import in_world_units  # here: the table needs no torch
    from clod_adapter.io.settings import History

    history = History(tuple(about), origin, calibration)
    with atomic_path(path) as temporary:
        notes: tuple[str, ...] = _call(FORMATS[suffix].write, temporary, in_world_units(gaussians), history)
        check_written(temporary)
    return notes


NEW_SPZ = b"NGSP"  # first bytes of version 4, which splat-transform reads; earlier versions are gzipped
_START: dict[str, tuple[bytes, ...]] = {".glb": (b"glTF",), ".spz": (b"\x1f\x8b", NEW_SPZ)}


def check_start(path: Path) -> None:
    """Refuses a file whose first bytes are not of its suffix's format."""
    suffix, start = path.suffix.lower(), read_start(path)
    refuse_known(path, start)
    if suffix in _START and not start.startswith(_START[suffix]):
        refuse(path, start, f"is not a {suffix} file by its first bytes; copy or export it again")
    if suffix == ".spz" and start.startswith(NEW_SPZ):
        _call("formats.splat_transform.check_converted", path, " of version 4")
    if suffix == ".splat" and (path.stat().st_size % 32 or start.startswith(b"ply")):  # else any bytes are one
        refuse(path, start, "is not a .splat file, whose rows have 32 bytes; copy or export it again")
    if suffix == ".safetensors" and '"clod-adapter"' in _call("tensor_file.read_tensor_header", path)[1].get(KEY, ""):
        raise ClodError(f"{path}: is an adapter, not a model; clod-adapt apply BASE.ply {path.name} -o OUT.ply")


def _call(function: str, *args: Any) -> Any:
    module, name = function.rsplit(".", 1)
    return getattr(import_module(f"clod_adapter.io.{module}"), name)(*args)


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
    """Refuses a number of a thousand digits, of which parsers make copies."""
    if re.search(rb"\d{1000}", text):
        raise ClodError(f"{path}: is damaged (a number of more than 1,000 digits); copy or export it again")


def read_start(path: Path, size: int = 64) -> bytes:
    """The first bytes of a file, at most ``size``; all with -1."""
    try:
        refuse_irregular(path)
        with open(path, "rb") as file:
            return file.read(size)
    except (OSError, ValueError) as error:  # ValueError: a name that holds a NUL
        raise ClodError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}); check the path") from error


def read_whole(path: Path) -> bytes:
    """A file's bytes; errors as ``read_start``."""
    return read_start(path, -1)


def refuse_known(path: Path, start: bytes) -> None:
    """Refuses a file whose first bytes are never those of a splat."""
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
    """
    refuse_known(path, start)
    found = SUFFIXES.get(path.suffix.lower()) or next(
        (kind for magic, *kind in ARCHIVES if start.startswith(magic)), None
    )
    if found:
        what, remedy = found
        raise ClodError(f"{path}: is {what}; {remedy.format(suffix=path.suffix)}")
    raise ClodError(f"{path}: {otherwise}")
