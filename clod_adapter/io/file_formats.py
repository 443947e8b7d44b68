"""The file formats of Gaussians, by the suffix of the file: one table, which needs no torch."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path
from clod_adapter.origin import NOWHERE, Origin

if TYPE_CHECKING:
    from clod_adapter.calibration import Calibration
    from clod_adapter.gaussians import Gaussians
    from clod_adapter.io.settings import Metadata


class Model(NamedTuple):
    """The content of a file.

    Attributes:
        gaussians: every row of the file, also rows with values that are not finite.
        metadata: its settings.
        sha256: of the file that was parsed, hex.
        notes: what the reader noticed, one line each, besides the notes of the metadata.
        activation_unknown: whether opacities and scales may be activated already, as the format does not tell.
    """

    gaussians: Gaussians
    metadata: Metadata
    sha256: str
    notes: tuple[str, ...] = ()
    activation_unknown: bool = False


class History(NamedTuple):
    """Of Gaussians that are written: lines on it, what their means are relative to, and their calibration."""

    about: tuple[str, ...] = ()
    origin: Origin = NOWHERE
    calibration: Calibration | None = None


class Format(NamedTuple):
    """A format: functions by module and name under ``clod_adapter.io``, imported when they are called.

    Attributes:
        read: a path to a ``Model``; of the PLY, to ``PlyRows``.
        check: refuses, by the first bytes and without torch, a file that is not of the format.
        open: whether a file has a sigma_d; refuses what ``read`` would by header, settings and sizes, without reading
            the values (but of an .spz). "" where no file has one, and ``check`` is all.
        write: called with path, Gaussians in world units and a ``History``; gives a line for each loss; "" where the
            format is only read.
        carries_sigma: whether the dial is written: sigma_d, growth_d and their settings.
    """

    read: str
    check: str
    open: str = ""
    write: str = ""
    carries_sigma: bool = False


_CHECK = "formats.checks.check_model"
_CONVERTED = Format("formats.converted.load_converted", "formats.converted.check_converted")
PLY = Format("ply.rows.read_ply", "ply.rows.check_ply", "ply.rows.open_ply", "formats.ply.write_ply", True)
FORMATS = {
    ".ply": PLY,
    ".glb": Format(
        "formats.glb_reader.load_glb", _CHECK, "formats.glb_reader.open_glb", "formats.glb.write_glb", True
    ),
    ".spz": Format(
        "formats.spz_reader.load_spz", _CHECK, "formats.spz_reader.open_spz", "formats.spz.write_spz", True
    ),
    ".safetensors": Format(
        "formats.safetensors.load_safetensors", _CHECK, "formats.safetensors.open_safetensors",
        "formats.safetensors.write_safetensors", True,
    ),
    ".pt": Format(
        "formats.pt_model.load_pt", "formats.pt.check_pt", "formats.pt_model.open_pt", "formats.pt_model.write_pt", True
    ),
    ".splat": Format("formats.splat.load_splat", _CHECK, "", "formats.splat.write_splat"),
    ".sog": _CONVERTED,
    ".ksplat": _CONVERTED,
}  # fmt: skip
WRITABLE = tuple(suffix for suffix, form in FORMATS.items() if form.write)


def format_of(path: Path) -> Format:
    """The format of a file, by its name alone, so that only a .pt is unpickled; any other name is a PLY's."""
    return FORMATS.get(path.suffix.lower(), PLY)


def check_readable(path: Path) -> None:
    """Refuses, without torch, a file whose first bytes are not of its format.

    Raises:
        ClodError: they are not, or the file cannot be read.
    """
    _call(format_of(path).check, path)


def file_has_dial(path: Path) -> bool:
    """Whether the file has a sigma_d.

    Raises:
        ClodError: as ``check_readable``, or its header, settings or sizes are damaged.
    """
    check_readable(path)
    opened = format_of(path).open
    return bool(opened) and _call(opened, path)


def check_suffix(path: Path) -> None:
    """Refuses a name whose suffix is none of WRITABLE.

    Raises:
        ClodError: it is not.
    """
    if path.name.lower().endswith((".sog", ".compressed.ply")):
        raise ClodError(f"{path}: is written by clod-adapt export alone: save a .ply, then clod-adapt export it")
    if path.suffix.lower() not in WRITABLE:
        found = path.suffix or "no suffix"
        raise ClodError(f"{path}: {found} is no format to write; choose one of {', '.join(WRITABLE)}")


def check_written(path: Path) -> None:
    """Refuses a file just written, under its temporary name, that the reader of its format would refuse: ``open``.

    Raises:
        ClodError: it would.
    """
    try:
        file_has_dial(path)
    except ClodError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise ClodError(f"{path}: is not written, because it could not be read again: {reason}") from error


def read_model(path: str | Path) -> Model:
    """The content of a file in any format but the PLY, which ``checkpoint.load`` reads.

    Raises:
        ClodError: the file is damaged, of another kind, or a package or program that its format needs is missing.
    """
    path = Path(path)
    if format_of(path) is PLY:
        raise ClodError(f"{path}: is read by clod_adapter.load")
    check_readable(path)
    return _call(format_of(path).read, path)


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

    history = History(tuple(about), origin, calibration)
    with atomic_path(path) as temporary:
        notes: tuple[str, ...] = _call(FORMATS[suffix].write, temporary, in_world_units(gaussians), history)
        check_written(temporary)
    return notes


def _call(function: str, *args: Any) -> Any:
    module, name = function.rsplit(".", 1)
    return getattr(import_module(f"clod_adapter.io.{module}"), name)(*args)
