"""Files that jobs on one scene exchange, as safetensors: the division, and the trained rows of each block.

One JSON document under the metadata key ``clod_adapter_block`` identifies the run of a file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.file_formats import refuse_irregular
from clod_adapter.io.tensor_file import read_tensors, write_tensors

KEY = "clod_adapter_block"


def save_block(path: Path, tensors: dict[str, Tensor], about: dict[str, Any], belongs: dict[str, Any]) -> None:
    """Writes tensors with a description; loading gives the same bits.

    Args:
        about: plain JSON, describes this file; an ``AttenuationConfig`` in it is written as its fields.
        belongs: plain JSON, identifies the run.

    Raises:
        ClodError: the file cannot be written.
    """
    plain = {name: asdict(value) if isinstance(value, AttenuationConfig) else value for name, value in about.items()}
    metadata = {KEY: json.dumps({"about": plain, "belongs": belongs}, sort_keys=True)}
    with atomic_path(path) as temporary:
        write_tensors(temporary, tensors, metadata)


def load_block(path: Path, belongs: dict[str, Any]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and their description.

    Raises:
        ClodError: the file cannot be read, is damaged, or is of another run than ``belongs``.
    """
    refuse_irregular(path, "remove it")
    with refused_if_damaged(path):
        tensors, metadata = read_tensors(path)
        found = json.loads(metadata[KEY])
        about, theirs = dict(found["about"]), dict(found["belongs"])
    different = [name for name in belongs if theirs.get(name) != belongs[name]]
    if different:
        raise ClodError(f"{path}: is of a run with another {different[0]}; remove it, or give --out another name")
    possible = {name: tensor.isfinite() for name, tensor in tensors.items()}
    if (logits := tensors.get("opacity_logits")) is not None:  # files in the wild have +inf: fully opaque
        possible["opacity_logits"] |= logits == math.inf
    if not all(bool(each.all()) for each in possible.values()):
        raise ClodError(f"{path}: holds a value that is not finite; remove it to have it made anew")
    return tensors, about


@contextmanager
def refused_if_damaged(path: Path) -> Iterator[None]:
    """Turns errors of reading a file, raised within, into a ClodError that names it."""
    try:
        yield
    except OSError as error:
        raise ClodError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except MemoryError:  # of a file that is whole
        raise
    except Exception as error:  # SafetensorError, and anything that a crafted file provokes
        raise ClodError(f"{path}: is no block or damaged ({error!r}); remove it to have it made anew") from error


def checked(path: Path, tensors: dict[str, Tensor], shapes: dict[str, tuple[torch.dtype, tuple[int, ...]]]) -> None:
    """Refuses a file whose tensors are not those of ``shapes``; raises ClodError."""
    found = {name: (tensor.dtype, tuple(tensor.shape)) for name, tensor in tensors.items()}
    wrong = [name for name in {**found, **shapes} if found.get(name) != shapes.get(name)]
    if wrong:
        raise ClodError(f"{path}: its {wrong[0]} is not that of this scene; remove it to have it made anew")
