from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import write
from scenes import gaussians


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": torch.ones(4, 3)}, "quats has shape"),
        ({"means": torch.ones(())}, "has shape|no Gaussians"),
        ({"shN": torch.ones(5, 2, 3)}, "shN has 2 coefficients"),
        ({"quats": torch.ones(5, 4, dtype=torch.int32)}, "not of floating-point"),
        ({"quats": None}, "has no tensor 'quats'"),
    ],
)
def test_invalid_tensors_are_refused(tmp_path: Path, change: dict[str, torch.Tensor | None], message: str) -> None:
    write(tmp_path / "a.safetensors", gaussians(5, 1, 0))
    about = {"format": "clod-model", "format_version": 1, "package_version": "0"}
    tensors = {**load_file(tmp_path / "a.safetensors"), **change}
    kept = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    save_file(kept, tmp_path / "b.safetensors", {"clod_adapter": json.dumps(about)})
    with pytest.raises(ClodError, match=message):
        load(tmp_path / "b.safetensors")
    save_file(kept, tmp_path / "b.safetensors")
    with pytest.raises(ClodError, match="not a model of clod-adapter"):
        load(tmp_path / "b.safetensors")
