"""Formats that splat-transform reads, PlayCanvas's converter: through it, where it is installed."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from clod_adapter.errors import ClodError
from clod_adapter.io.formats.splat_transform import SplatTransform
from clod_adapter.io.ply.body import read_element
from clod_adapter.io.ply.columns import sh_degree_of
from clod_adapter.io.ply.header import read_head
from clod_adapter.io.regular import read_start
from clod_adapter.io.rows import Rows
from clod_adapter.io.sniff import refuse_known

LIMIT_S = 1800.0  # five million Gaussians take about a minute


def check_converted(path: Path, version: str = "") -> SplatTransform:
    """What reads it; refuses no file, something else whatever its name, and what cannot be converted here.

    Args:
        version: of the format, where only one is read in this way.

    Raises:
        ClodError: it is, or splat-transform is not here, or too old.
    """
    refuse_known(path, read_start(path))
    try:
        return SplatTransform.find()
    except ClodError as error:
        raise ClodError(
            f"{path}: {path.suffix}{version} is read through splat-transform ({error}); better still, adapt the PLY "
            "that it was made from"
        ) from error


def read_converted(path: Path) -> Rows:
    """The Gaussians that splat-transform makes a PLY of.

    Raises:
        ClodError: it is not here, or cannot read the file.
    """
    tool = check_converted(path)
    with TemporaryDirectory() as folder:
        converted = Path(folder) / "converted.ply"
        try:
            tool.run(path, converted, timeout=LIMIT_S)
        except ClodError as error:
            raise ClodError(f"{path}: cannot be read ({error}); copy or export it again") from error
        head = read_head(converted)
        degree = sh_degree_of(converted, head.ply)
        vertex = read_element(converted, head)
    note = f"quantised: {path.suffix} stores positions, scales, rotations and colours in a few bits each"
    return Rows(vertex, degree, notes=(note, f"read through splat-transform {tool.version}"), settled=True)
