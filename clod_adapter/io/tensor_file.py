"""Safetensors files, whole."""

from __future__ import annotations

from pathlib import Path

from safetensors import safe_open
from torch import Tensor


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the metadata of a file; raises OSError, or on damage whatever safetensors does."""
    with safe_open(path, framework="pt") as file:
        # Copies, since the file may change under a memory map.
        return {name: file.get_tensor(name).clone() for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
