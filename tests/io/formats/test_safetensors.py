from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from clod_adapter.adapter import extract
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.adapter_file import load_adapter, save_adapter
from clod_adapter.io.file_formats import write
from clod_adapter.io.formats.safetensors import load_safetensors, read_model_safetensors
from formats import ABOUT, ATTENUATION, CALIBRATION, ORIGIN, damaged, model
from scenes import gaussians


@pytest.mark.parametrize("degree", range(5))
def test_the_same_again(tmp_path: Path, degree: int) -> None:
    g = model(degree)
    assert write(tmp_path / "a.safetensors", g, ABOUT, origin=ORIGIN, calibration=CALIBRATION) == ()
    again, card, notes = load_safetensors(tmp_path / "a.safetensors")
    assert again.attenuation == g.attenuation and notes == ()
    assert (card.origin, card.about, card.calibration) == (ORIGIN, ABOUT, CALIBRATION)
    assert all(torch.equal(tensor, again.tensors()[name]) for name, tensor in g.tensors().items())
    assert set(load_file(tmp_path / "a.safetensors")) == set(g.tensors())
    write(tmp_path / "b.safetensors", again, ABOUT, origin=ORIGIN, calibration=CALIBRATION)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_without_a_dial(tmp_path: Path) -> None:
    write(tmp_path / "a.safetensors", gaussians(5, 1, 0))
    assert read_model_safetensors(tmp_path / "a.safetensors").sigma_d is None


def test_models_and_adapters_are_not_mixed_up(tmp_path: Path) -> None:
    base = gaussians(5, 1, 0)
    adapted = base.replace(sigma_d=torch.ones(5), attenuation=ATTENUATION)
    save_adapter(tmp_path / "adapter.safetensors", extract(base, adapted, fingerprint="0" * 64, config={}))
    with pytest.raises(ClodError, match="no model but 'clod-adapter'; clod-adapt apply makes"):
        load_safetensors(tmp_path / "adapter.safetensors")
    write(tmp_path / "model.safetensors", adapted)
    with pytest.raises(ClodError, match="is a whole model and no adapter"):
        load_adapter(tmp_path / "model.safetensors")
    save_file({"means": torch.ones(2, 3)}, tmp_path / "other.safetensors")
    with pytest.raises(ClodError, match="no model of clod-adapter"):
        load_safetensors(tmp_path / "other.safetensors")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": torch.ones(4, 3)}, "quats has shape"),
        ({"means": torch.ones(())}, "has shape|no Gaussians"),
        ({"shN": torch.ones(5, 2, 3)}, "shN has shape"),
        ({"quats": torch.ones(5, 4, dtype=torch.int32)}, "not of floating-point"),
        ({"quats": None}, "has no tensor 'quats'"),
    ],
)
def test_other_tensors(tmp_path: Path, change: dict[str, torch.Tensor | None], message: str) -> None:
    write(tmp_path / "a.safetensors", gaussians(5, 1, 0))
    about = {"format": "clod-model", "format_version": 1, "package_version": "0"}
    tensors = {**load_file(tmp_path / "a.safetensors"), **change}
    kept = {name: tensor for name, tensor in tensors.items() if tensor is not None}
    save_file(kept, tmp_path / "b.safetensors", {"clod_adapter": json.dumps(about)})
    with pytest.raises(ClodError, match=message):
        load_safetensors(tmp_path / "b.safetensors")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_is_never_another_exception(tmp_path: Path, data: st.DataObject) -> None:
    write(tmp_path / "a.safetensors", model(0, 5), calibration=CALIBRATION)
    path = tmp_path / "damaged.safetensors"
    path.write_bytes(damaged((tmp_path / "a.safetensors").read_bytes(), data))
    try:
        assert isinstance(read_model_safetensors(path), Gaussians)
    except ClodError as error:
        assert str(error).isprintable()
