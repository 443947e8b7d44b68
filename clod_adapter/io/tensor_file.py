"""Safetensors files: tensors and metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Writes a file, the widest types first.

    safetensors' ``save`` holds all of it in memory; ``save_file`` takes names in UTF-8 only, and
    makes files that only their owner can read.
    """
    arrays = {}
    for name, tensor in tensors.items():
        arrays[name] = tensor.detach().cpu().contiguous().numpy()
    header: dict[str, Any] = {"__metadata__": dict(metadata)}
    at = 0
    names = sorted(arrays, key=lambda name: (-arrays[name].itemsize, name))
    for name in names:
        array = arrays[name]
        end = at + array.nbytes
        kind = "BOOL" if array.dtype == bool else f"{array.dtype.kind.upper()}{8 * array.itemsize}"
        header[name] = {"dtype": kind, "shape": list(array.shape), "data_offsets": [at, end]}
        at = end
    head = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    head += b" " * (-len(head) % 8)
    with open(path, "wb") as file:
        file.write(len(head).to_bytes(8, "little") + head)
        for name in names:
            file.write(arrays[name].data)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the metadata of a file; for ``rejected_if_damaged``."""
    from safetensors.torch import load

    data = path.read_bytes()  # not mapped: the file may change meanwhile
    head = data[8 : 8 + int.from_bytes(data[:8], "little")]
    return load(data), json.loads(head).get("__metadata__", {})
