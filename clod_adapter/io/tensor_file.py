"""Safetensors files: tensors and metadata."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import safe_open

from clod_adapter.errors import rejected_if_damaged
from clod_adapter.io.file_formats import START, read_bytes, reject_known

if TYPE_CHECKING:
    from torch import Tensor

_DAMAGED = "is not a safetensors file, or damaged", "copy or export it again"


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
        kind = (
            "BOOL" if array.dtype.kind == "b" else f"{array.dtype.kind.upper()}{8 * array.itemsize}"
        )
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
    with open(path, "rb") as file, safe_open(_name_of(file), framework="pt") as tensors:
        # Copies, since the file may change under a memory map.
        names = tensors.keys()
        copies = {name: tensors.get_tensor(name).clone() for name in names}
        return copies, tensors.metadata() or {}


def parse_tensors(path: Path, data: bytes) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the metadata of an input file with these bytes."""
    from safetensors.torch import load  # here: a header is read without torch

    reject_known(path, data[:START])
    with rejected_if_damaged(path, *_DAMAGED):
        tensors = load(data)
        head = data[8 : 8 + int.from_bytes(data[:8], "little")]
        return tensors, json.loads(head).get("__metadata__", {})


def read_tensor_header(path: Path) -> tuple[list[str], dict[str, str]]:
    """The names of the tensors and the metadata, without torch."""
    reject_known(path, read_bytes(path, START))
    with (
        rejected_if_damaged(path, *_DAMAGED),
        open(path, "rb") as file,
        safe_open(_name_of(file), framework="np") as tensors,
    ):
        return list(tensors.keys()), tensors.metadata() or {}


def _name_of(file: BufferedReader) -> str:
    """A name of an open file, in UTF-8 as safetensors takes it."""
    return str(file.name) if sys.platform == "win32" else f"/dev/fd/{file.fileno()}"
