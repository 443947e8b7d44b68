"""Formats that splat-transform, PlayCanvas's converter, reads: through it, where it is installed."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import Model
from clod_adapter.io.formats.splat_transform import SplatTransform
from clod_adapter.io.sniff import read_start, refuse_known

LIMIT_S = 1800.0  # five million Gaussians take about a minute


def check_converted(path: Path, version: str = "") -> SplatTransform:
    """The converter; refuses a file that is something else, or that cannot be converted here.

    Args:
        version: of the format, where only one version is read in this way.

    Raises:
        ClodError: the file is something else, or splat-transform is missing or too old.
    """
    refuse_known(path, read_start(path))
    try:
        return SplatTransform.find()
    except ClodError as error:
        raise ClodError(
            f"{path}: {path.suffix}{version} is read through splat-transform ({error}); better still, adapt the PLY "
            "that it was made from"
        ) from error


def load_converted(path: Path, version: str = "") -> Model:
    """The Gaussians of the PLY that splat-transform converts the file to; ``version`` as in ``check_converted``.

    Raises:
        ClodError: splat-transform is missing, or cannot read the file.
    """
    # Here: check_converted needs no torch.
    from clod_adapter.io.formats.arrays import gaussians_of, read_whole, sha256_of
    from clod_adapter.io.ply.columns import column_map, in_shape, read_table
    from clod_adapter.io.ply.rows import read_ply
    from clod_adapter.io.settings import Metadata

    tool, sha256 = check_converted(path, version), sha256_of(read_whole(path))
    with TemporaryDirectory() as folder:
        converted = Path(folder) / "converted.ply"
        try:
            tool.run(path, converted, timeout=LIMIT_S)
        except ClodError as error:
            raise ClodError(f"{path}: cannot be read ({error}); copy or export it again") from error
        rows = read_ply(converted)
    values = {name: read_table(rows.vertex, group) for name, group in column_map(rows.sh_degree).items()}
    note = f"quantised: {path.suffix} stores positions, scales, rotations and colours in a few bits each"
    notes = (note, f"read through splat-transform {tool.version}")
    return Model(gaussians_of(path, in_shape(values), Metadata()), Metadata(), sha256, notes)
