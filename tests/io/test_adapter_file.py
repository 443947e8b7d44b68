"""Adapters and the tensor files that they are written as."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from clod_adapter.adapter import Adapter
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.adapter_file import load_adapter, save_adapter
from clod_adapter.io.tensor_file import read_tensors, write_tensors

CONFIG = {"steps": 3, "lr": 0.1, "names": ["a", None], "nested": {"b": True}, "ü": "é"}


def adapter(n: int = 5, config: dict[str, object] | None = None, tau: float = 0.1 / 3) -> Adapter:
    generator = torch.Generator().manual_seed(n)
    updates = {
        "means": torch.randn(n, 3, generator=generator).half(),
        "opacity_logits": torch.randn(n, generator=generator),
        "shN": torch.zeros(n, 0, 3).half(),
    }
    attenuation = AttenuationConfig(tau=tau, reference_distance=np.float64(1) / 3, max_sv=7.0)
    return Adapter(torch.rand(n, generator=generator), attenuation, updates, "ab" * 32, config or {})


@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 20), st.floats(1e-9, 0.1, exclude_min=True), st.booleans())
def test_adapter_round_trips(tmp_path: Path, n: int, tau: float, growth: bool) -> None:
    saved = replace(adapter(n, CONFIG, tau), growth_d=torch.linspace(-1, 3, n) if growth else None)
    save_adapter(tmp_path / "a.safetensors", saved)
    loaded = load_adapter(str(tmp_path / "a.safetensors"))
    assert (loaded.attenuation, loaded.config, loaded.base_fingerprint) == (saved.attenuation, CONFIG, "ab" * 32)
    assert torch.equal(loaded.sigma_d, saved.sigma_d) and loaded.updates.keys() == saved.updates.keys()
    assert torch.equal(loaded.growth_d, saved.growth_d) if growth else loaded.growth_d is None
    for name, update in saved.updates.items():
        assert loaded.updates[name].dtype == update.dtype and torch.equal(loaded.updates[name], update)
    save_adapter(tmp_path / "b.safetensors", loaded)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_tensor_files_are_safetensors(tmp_path: Path) -> None:
    """Types in any order, a transposed and an empty tensor, a scalar, text that is not ASCII; for all to read."""
    tensors = {
        "mask": torch.tensor([True, False, True]), "bytes": torch.arange(5, dtype=torch.uint8),
        "half": torch.randn(3).half(), "means": torch.randn(3, 2).T, "none": torch.zeros(0, 3),
        "one": torch.tensor(2.5), "long": torch.arange(2), "double": torch.randn(2, dtype=torch.float64),
    }  # fmt: skip
    metadata = {"about": 'a "quoted" é'}
    write_tensors(tmp_path / "a", tensors, metadata)
    found, about = read_tensors(tmp_path / "a")
    assert about == metadata and found.keys() == tensors.keys()
    for name, tensor in load_file(tmp_path / "a").items():
        assert torch.equal(tensor, tensors[name]) and torch.equal(found[name], tensor)
    (tmp_path / "b").touch()
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


CHANGES: tuple[tuple[dict[str, Any], str], ...] = (  # of tensors, None for one that is absent, or of settings
    ({"extra": torch.ones(5)}, "updates has 'extra'"),
    ({"means": torch.ones(4, 3)}, "5 rows"),
    ({"means": torch.ones(5, 3, dtype=torch.int32)}, "float16 or float32"),
    ({"sigma_d": None}, "sigma_d"),
    ({"sigma_d": torch.full((5,), torch.nan)}, "not finite"),
    ({"sigma_d": torch.ones(5, 1)}, "float32"),
    ({"growth_d": torch.full((5,), torch.inf)}, "growth_d holds a value that is not finite"),
    ({"growth_d": torch.ones(4)}, r"growth_d is float32 \[4\], it must be float32 \[5\]"),
    ({"kept": torch.full((2,), 255, dtype=torch.uint8)}, r"Adapter.kept is bool \[9\], it must be bool with 5 set"),
    ({"format": "else"}, "is not an adapter but 'else'"),
    ({"base_sha256": 5}, "base_sha256 is 5"),
    ({"package_version": "1\n2"}, "printable"),
    ({"format_version": "x"}, "settings are damaged"),
    ({"config": [1]}, "config is .1., not a dict"),
    ({"trimmed": {"base_count": 9, "sh_degree": "3"}}, "sh_degree is '3', it must be one of 0, 1, 2, 3, 4"),
    *(({"trimmed": value}, "settings are damaged") for value in (
        [1], {"base_count": 17}, {"base_count": -1}, {"base_count": "9"}, {})),
)  # fmt: skip


def test_invalid_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a"
    save_adapter(path, replace(adapter(), kept=torch.arange(9) % 2 == 0, sh_degree=1))
    with safe_open(path, framework="pt") as file:
        about, tensors = json.loads(file.metadata()["clod_adapter"]), load_file(path)
    assert about["format"] == "clod-adapter" and about["format_version"] == 3 and "package_version" in about
    assert about["base_sha256"] == "ab" * 32 and about["attenuation"]["tau"] == 0.1 / 3
    texts = "[" * 100_000, '{"format": ' * 50_000, "1" * 10_000, "nul", '"\\ud800"'
    for change, message in (*CHANGES, *((text, "settings are damaged") for text in texts), (None, "not an adapter")):
        text, kept = json.dumps(about), tensors
        if isinstance(change, dict) and change.keys() <= about.keys():
            text = json.dumps(about | change)
        elif isinstance(change, dict):
            kept = {name: value for name, value in (tensors | change).items() if value is not None}
        else:
            text = change or ""
        save_file(kept, path, {"clod_adapter": text} if change else None)
        with pytest.raises(ClodError, match=message):
            load_adapter(path)


def test_config_must_be_json_and_version_is_kept(tmp_path: Path) -> None:
    for value in ({1, 2}, torch.ones(1), float("nan"), object()):
        with pytest.raises(ClodError, match="not plain JSON"):
            save_adapter(tmp_path / "a", adapter(config={"x": value}))
    assert list(tmp_path.iterdir()) == []
    save_adapter(tmp_path / "a", replace(adapter(), version="7.8.9"))
    assert load_adapter(tmp_path / "a").version == "7.8.9"
