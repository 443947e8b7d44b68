"""``.splat``: the 32-byte rows of antimatter15's web viewer, which many others read.

A row is the position and the standard deviations, three float32 each, then four bytes of RGBA and
four of the rotation (wxyz, ``128 q + 128``). Colours are those of SH degree 0; higher degrees and
the dial are not stored. The largest and most opaque come first (by volume times opacity), as
viewers draw what has arrived.
"""

from pathlib import Path

import numpy as np

from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io import values
from clod_adapter.io.settings import Metadata, Source

QUANTISED = "quantised: colours, opacities and rotations in 8 bits, no view-dependent colour"
_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def write(path: Path, gaussians: Gaussians, metadata: Metadata) -> tuple[str, ...]:
    """Writes Gaussians without a dial, and no text."""
    arrays = values.arrays_of(path, gaussians)
    opacities = values.sigmoid(arrays["opacity_logits"])
    # As logarithms, in which no volume is too small.
    log_volumes = arrays["log_scales"].astype(np.float64).sum(1)
    with np.errstate(divide="ignore"):
        order = np.argsort(-(log_volumes + np.log(opacities)), kind="stable")
    rows = np.empty(len(gaussians), _ROW)
    rows["means"] = arrays["means"]
    rows["scales"] = values.scales_of(path, arrays["log_scales"])
    rows["rgba"] = values.colours_of(arrays["sh0"], opacities)
    rows["quats"] = values.bytes_of(128 * values.normalized(arrays["quats"]) + 128)
    path.write_bytes(rows[order].tobytes())
    notes = [
        "colours, opacities and rotations are rounded to 8 bits, and the rows are in another order"
    ]
    if arrays["shN"].any():
        notes.append("view-dependent colour is dropped")
    if any(metadata.origin):
        notes.append("the origin is dropped: coordinates are relative to it")
    return tuple(notes)


def read(path: Path, data: bytes) -> Source:
    """Reads rows as ``write`` writes them; SH degree 0."""
    if not data or len(data) % _ROW.itemsize:
        raise ClodError(
            f"{path}: {len(data)} bytes are not a .splat file, whose rows have 32; copy or export"
            " it again"
        )
    rows = np.frombuffer(data, _ROW)
    arrays = {
        "means": rows["means"].copy(),
        "log_scales": values.logs_of(rows["scales"]),
        "quats": (rows["quats"].astype(np.float32) - 128) / 128,
        "opacity_logits": values.logits_of_bytes(rows["rgba"][:, 3]),
        "shN": np.zeros((len(rows), 0, 3)),
        "sh0": values.sh0_of(rows["rgba"][:, None, :3]),
    }
    return Source(arrays, Metadata(), (QUANTISED,))
