"""The formats that Gaussians are written to, by the suffix of the output. The table needs no torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from clod_adapter.errors import ClodError
from clod_adapter.origin import NOWHERE, Origin

if TYPE_CHECKING:
    from clod_adapter.calibration import Calibration
    from clod_adapter.gaussians import Gaussians


class Writer(NamedTuple):
    """A format.

    Attributes:
        module: under ``clod_adapter.io``; its function ``function`` writes a file and gives a line for each thing
            that did not fit into it.
        function: called as ``write`` is.
        carries_sigma: whether sigma_d and its settings go along; if not, a dial value has to be baked first.
    """

    module: str
    function: str
    carries_sigma: bool


WRITERS = {
    ".ply": Writer("formats.ply", "write_ply", True),
    ".glb": Writer("formats.glb", "write_glb", True),
    ".spz": Writer("formats.spz", "write_spz", True),
    ".safetensors": Writer("formats.safetensors", "write_safetensors", True),
    ".pt": Writer("formats.pt_model", "write_pt", True),
    ".splat": Writer("formats.splat", "write_splat", False),
}


def writer_of(path: str | Path) -> Writer:
    """The format that a name's suffix stands for, in capitals or not.

    Raises:
        ClodError: it stands for none.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise ClodError(f"{path}: {suffix or 'no suffix'} is no format to write; choose one of {', '.join(WRITERS)}")
    return WRITERS[suffix]


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
        gaussians: with or without sigma_d.
        about: lines on how they came about, printable ASCII, for formats that have room for them.
        origin: what their means are relative to (``Checkpoint.origin``), world units.
        calibration: of these Gaussians, for formats that have room for it.

    Returns:
        What did not fit into the format, one line each.

    Raises:
        ClodError: a suffix that stands for no format, sigma_d for a format that does not carry it, no Gaussians, a
            value that is not finite (opacity = +inf aside), a package that is missing, or the file cannot be written.
    """
    writer = writer_of(path)
    if gaussians.sigma_d is not None and not writer.carries_sigma:
        raise ClodError(f"{path}: {Path(path).suffix} has no room for sigma_d; choose a dial value to bake")
    function: Callable[..., tuple[str, ...]] = getattr(
        import_module(f"clod_adapter.io.{writer.module}"), writer.function
    )
    from clod_adapter.units import in_world_units  # here and not above, as the table needs no torch

    return function(path, in_world_units(gaussians), about, origin=origin, calibration=calibration)
