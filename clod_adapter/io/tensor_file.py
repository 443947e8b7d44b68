"""Safetensors files: tensors and metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import safe_open

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import file_sha256, handle_name, read_start, refuse_known

if TYPE_CHECKING:
    from torch import Tensor


TYPES = {
    "int64": "I64", "float64": "F64", "float32": "F32", "int32": "I32", "float16": "F16", "int16": "I16",
    "uint8": "U8", "bool": "BOOL",
}  # fmt: skip
"""Names of types in a file, by numpy's name, in the order in which a file has its tensors."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Writes the file that safetensors' own ``save`` makes, byte for byte, without copies of tensors on the CPU.

    ``save`` holds the whole file in memory, and ``save_file`` makes files that only their owner can read.

    Raises:
        OSError: it cannot be written.
    """
    arrays = {name: tensor.detach().cpu().contiguous().numpy() for name, tensor in tensors.items()}
    header, at, types = dict[str, Any](__metadata__=dict(metadata)), 0, list(TYPES)
    names = sorted(arrays, key=lambda name: (types.index(arrays[name].dtype.name), name))
    for name in names:
        array, end = arrays[name], at + arrays[name].nbytes
        header[name] = {"dtype": TYPES[array.dtype.name], "shape": list(array.shape), "data_offsets": [at, end]}
        at = end
    head = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    head += b" " * (-len(head) % 8)
    with open(path, "wb") as file:
        file.write(len(head).to_bytes(8, "little") + head)
        for name in names:
            file.write(arrays[name].data)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the metadata of a file; raises OSError, or for a damaged file any error of safetensors."""
    with open(path, "rb") as file:
        return _content(file)


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str], str]:
    """The tensors, the metadata and the SHA-256, hex, of an input file, which is opened once.

    Raises:
        ClodError: it cannot be read, is something else, or damaged.
    """
    with _one_line_errors(path), open(path, "rb") as file:
        return *_content(file), file_sha256(file)


def read_tensor_header(path: Path) -> tuple[list[str], dict[str, str]]:
    """The names of the tensors and the metadata, without torch.

    Raises:
        ClodError: as ``load_tensors``.
    """
    with _one_line_errors(path), open(path, "rb") as file, safe_open(handle_name(file), framework="np") as tensors:
        return list(tensors.keys()), tensors.metadata() or {}


def _content(file: BufferedReader) -> tuple[dict[str, Tensor], dict[str, str]]:
    with safe_open(handle_name(file), framework="pt") as tensors:
        # Copies, since the file may change under a memory map.
        return {name: tensors.get_tensor(name).clone() for name in tensors.keys()}, tensors.metadata() or {}  # noqa: SIM118


@contextmanager
def _one_line_errors(path: Path) -> Iterator[None]:
    refuse_known(path, read_start(path))
    try:
        yield
    except OSError as error:
        raise ClodError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except MemoryError:  # of a file that is whole
        raise
    except Exception as error:  # SafetensorError, and others for a crafted header
        raise ClodError(f"{path}: is not a safetensors file, or damaged ({error}); copy or export it again") from error
