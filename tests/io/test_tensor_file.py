"""Safetensors files that are written without a copy of their tensors."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import save

from clod_adapter.io.tensor_file import read_tensors, write_tensors


def test_files_are_those_of_safetensors(tmp_path: Path) -> None:
    """Byte for byte: types in any order, a transposed and an empty tensor, a scalar, text that is not ASCII."""
    generator = torch.Generator().manual_seed(0)
    tensors = {
        "mask": torch.tensor([True, False, True]), "bytes": torch.arange(5, dtype=torch.uint8),
        "block": torch.arange(3, dtype=torch.int16), "half": torch.randn(3, generator=generator).half(),
        "steps": torch.arange(4, dtype=torch.int32), "means": torch.randn(3, 2, generator=generator).T,
        "first.sh0": torch.randn(2, 1, 3, generator=generator), "none": torch.zeros(0, 3), "one": torch.tensor(2.5),
        "long": torch.arange(2), "double": torch.randn(2, generator=generator, dtype=torch.float64),
    }  # fmt: skip
    metadata = {"about": 'a "quoted" é'}
    write_tensors(tmp_path / "a", tensors, metadata)
    whole = {name: tensor.contiguous() for name, tensor in tensors.items()}
    assert (tmp_path / "a").read_bytes() == save(whole, metadata)
    found, about = read_tensors(tmp_path / "a")
    assert about == metadata and all(torch.equal(found[name], tensor) for name, tensor in tensors.items())
