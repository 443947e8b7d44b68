"""Writing PLY files: an extended file of a base's rows, or Inria's layout."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from plyfile import PlyData, PlyElement

from clod_adapter.errors import ClodError
from clod_adapter.io.ply import column_map, inria_dtype
from clod_adapter.io.ply_settings import COLUMN, constants_of, write_comments
from clod_adapter.io.settings import Metadata
from clod_adapter.io.values import FILTER, GROWTH, ROWS, SIGMA, arrays_of, dial_columns

if TYPE_CHECKING:
    from clod_adapter.gaussians import Gaussians

_INSTEAD = {SIGMA: "use a large number for no decay", GROWTH: "use 0 for no growth"}


def write(path: Path, gaussians: Gaussians, metadata: Metadata) -> tuple[str, ...]:
    """Writes Gaussians without a base, every value unchanged but opacity = +inf, which some viewers do not take."""
    from clod_adapter.gaussians import OPAQUE  # here: a header is checked without torch

    arrays_of(path, gaussians)  # refuses rows that load would drop
    opaque = gaussians.opacity_logits.isposinf()
    gaussians = gaussians.replace(opacity_logits=gaussians.opacity_logits.masked_fill(opaque, OPAQUE))
    write_rows(path, gaussians, metadata)
    return (f"{int(opaque.sum())} opacities of +inf are written as {OPAQUE:g}, which is 1 too",) if opaque.any() else ()


def write_rows(path: Path, gaussians: Gaussians, metadata: Metadata, base: np.ndarray | None = None) -> tuple[str, ...]:
    """Writes a binary little-endian PLY, in blocks: a large file is never held twice.

    A column of the base is overwritten where the new value is not the one that was read.

    Args:
        base: ``[N]`` rows of the file that ``gaussians`` come from; None for Inria's layout.
    """
    tensors, origin = {name: tensor.detach() for name, tensor in gaussians.tensors().items()}, metadata.origin
    constants, dial = constants_of(metadata, growth=gaussians.growth_d is not None), dial_columns(tensors)
    layout = inria_dtype(gaussians.sh_degree) if base is None else base.dtype
    gone = {FILTER, *((SIGMA, GROWTH) if dial else dial_columns(layout.names or ()))}  # growth_d alone is foreign
    own = [name for name in layout.names or () if name not in gone and not name.startswith(COLUMN)]
    kinds = [(name, np.dtype("f8") if any(origin) and name in ("x", "y", "z") else layout[name]) for name in own]
    kind = np.dtype(kinds + [(name, np.dtype("f4")) for name in (*constants, *dial)])
    one = np.broadcast_to(np.zeros((), kind), len(gaussians))  # of which plyfile makes a header without the rows
    element = PlyElement.describe(one, "vertex", comments=write_comments(metadata))
    with open(path, "wb") as file, np.errstate(over="ignore", invalid="ignore"):
        file.write(f"{PlyData([element], byte_order='<').header}\n".encode("ascii"))
        for start in range(0, len(gaussians), ROWS):
            part = slice(start, start + ROWS)
            block = np.zeros(len(gaussians.means[part]), kind)
            for name in own if base is not None else ():
                block[name] = base[part][name]  # type: ignore[index]
            for name, value in constants.items():
                block[name] = value
            for attribute, group in (column_map(gaussians.sh_degree) | dial).items():
                values = tensors[attribute][part].float().cpu().numpy().reshape(len(block), -1)
                for k, name in enumerate(group):
                    shift = origin[k] if attribute == "means" else 0.0
                    new, changed = values[:, k], np.ones(len(block), bool)
                    if base is not None and name not in dial:
                        old = (block[name] - shift if shift else block[name]).astype(np.float32)
                        changed = new.view(np.uint32) != old.view(np.uint32)
                    new = new[changed]
                    opaque = new == np.inf if attribute == "opacity_logits" and base is None else False
                    if not (np.isfinite(new) | opaque).all():
                        fix = _INSTEAD.get(attribute, "the tuning has diverged")
                        raise ClodError(f"{path}: {attribute} holds a new value that is not finite; {fix}")
                    block[name][changed] = new.astype(np.float64) + shift if shift else new
            file.write(block.astype(kind.newbyteorder("<"), copy=False).data)
    return ()
