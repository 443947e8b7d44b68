"""Every format that models are written to, read as the commands read it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from clod_adapter.adapter import extract
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.inspection.report import inspect
from clod_adapter.io.adapter_file import save_adapter
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import (
    LOADERS,
    MODEL,
    READERS,
    WRITERS,
    check_readable,
    file_has_dial,
    load_model,
    write,
)
from formats import ABOUT, CALIBRATION, ORIGIN, model

EXACT = (".safetensors", ".pt")
CARRIES = [suffix for suffix, writer in WRITERS.items() if writer.carries_sigma and suffix != ".ply"]


def test_the_tables_agree() -> None:
    assert {suffix for suffix, reader in READERS.items() if reader is MODEL} == set(LOADERS)


@pytest.mark.parametrize("suffix", CARRIES)
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), ORIGIN], ids=["near", "far"])
def test_a_dial_survives(tmp_path: Path, suffix: str, origin: tuple[float, float, float]) -> None:
    g = model(2)
    path = tmp_path / f"a{suffix}"
    write(path, g, ABOUT, origin=origin, calibration=CALIBRATION)
    check_readable(path)
    assert file_has_dial(path)
    found = load(path)
    assert len(found.gaussians) == len(g) and found.gaussians.attenuation == g.attenuation
    assert (found.origin, found.calibration) == (origin, CALIBRATION)
    assert found.gaussians.sigma_d is not None and g.sigma_d is not None
    most = g.sigma_d.clamp(max=65504) if suffix == ".spz" else g.sigma_d  # what its float16 holds
    torch.testing.assert_close(found.gaussians.sigma_d, most, rtol=1e-3, atol=1e-6)
    assert all(line in found.comments for line in ABOUT)
    if suffix in EXACT and not any(origin):
        for name, tensor in g.tensors().items():
            assert torch.equal(found.gaussians.tensors()[name], tensor), name
    save(tmp_path / "out.ply", found.gaussians, found, calibration=found.calibration)
    again = load(tmp_path / "out.ply")
    assert again.gaussians.attenuation == g.attenuation and any(again.origin) == any(origin)
    assert again.gaussians.sigma_d is not None
    assert torch.equal(again.gaussians.sigma_d, found.gaussians.sigma_d)
    seen = inspect(path)
    assert seen.splat is not None and seen.splat.dial is not None and seen.splat.dial.calibration == CALIBRATION


@pytest.mark.parametrize("suffix", LOADERS)
def test_a_plain_model(tmp_path: Path, suffix: str) -> None:
    g = model(1).replace(sigma_d=None, attenuation=None)
    path = tmp_path / f"a{suffix}"
    write(path, g)
    assert not file_has_dial(path)
    found = load(path)
    assert found.gaussians.sigma_d is None and len(found.gaussians) == len(g)
    assert any("quantised" in note for note in found.notes) == (suffix in (".spz", ".splat"))
    seen = inspect(path)
    assert seen.splat is not None and seen.splat.dial is None and seen.what.endswith(suffix)


def test_an_adapter_is_no_model(tmp_path: Path) -> None:
    g = model(0)
    plain = g.replace(sigma_d=None, attenuation=None)
    save_adapter(tmp_path / "a.safetensors", extract(plain, g, fingerprint="ab", config={}))
    for read in (check_readable, load):
        with pytest.raises(ClodError, match="a.safetensors: is an adapter, no model; clod-adapt apply BASE.ply"):
            read(tmp_path / "a.safetensors")


def test_lines_of_others_are_made_fit_for_a_header(tmp_path: Path) -> None:
    g = replace(model(0))
    write(tmp_path / "a.safetensors", g, ("caf\u00e9", "clod_adapter tau 0.5"))
    found = load(tmp_path / "a.safetensors")
    assert "caf?" in found.comments and found.gaussians.attenuation == g.attenuation
    save(tmp_path / "out.ply", found.gaussians, found)
    assert load(tmp_path / "out.ply").gaussians.attenuation == g.attenuation


def test_lines_that_no_header_has_room_for(tmp_path: Path) -> None:
    write(tmp_path / "a.safetensors", model(0), ("long",) * 20_000)
    with pytest.raises(ClodError, match="a.safetensors: its description has more than 65,536 letters"):
        load(tmp_path / "a.safetensors")


def test_settings_that_are_not_there_are_said_once(tmp_path: Path) -> None:
    write(tmp_path / "a.safetensors", model(0))
    path = tmp_path / "a.safetensors"
    with safe_open(path, framework="pt") as file:
        tensors, text = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()["clod_adapter"]  # noqa: SIM118
    card = json.loads(text)
    card.pop("attenuation")
    save_file(tensors, path, {"clod_adapter": json.dumps(card)})
    found = load(path)
    assert sum("defaults of earlier versions" in note for note in found.notes) == 1
    assert found.gaussians.attenuation == load_model(path).gaussians.attenuation
    assert found.gaussians.attenuation == AttenuationConfig(tau=1 / 255, cut="hard", reference_distance=1.0)


@pytest.mark.parametrize("suffix", LOADERS)
def test_the_check_does_without_torch(tmp_path: Path, suffix: str) -> None:
    write(tmp_path / f"a{suffix}", model(0).replace(sigma_d=None, attenuation=None))
    path = json.dumps(str(tmp_path / f"a{suffix}"))
    code = (
        "import sys, pathlib, clod_adapter.io.file_formats as r; "
        f"r.check_readable(pathlib.Path({path})); sys.exit('torch' in sys.modules)"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(root)}, check=False)
    assert done.returncode == 0
