"""The data of the page: one PLY layout for Gaussians from any file."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from plyfile import PlyData

import clod_adapter
import scenes
from clod_adapter.calibration import Calibration, CalibrationRow
from clod_adapter.config import FILTERS, AttenuationConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.viewer.payload import BLOCK_ROWS, Payload, page_config


def dialled(n: int = 40, degree: int = 1) -> Gaussians:
    return scenes.dialled(n, degree, 3, scene_distance=1.0).replace(screen_filter=FILTERS["mip"])


def read_back(payload: Payload, folder: Path) -> Any:
    """The payload as our reader reads it."""
    path = folder / "payload.ply"
    path.write_bytes(b"".join(payload.blocks()))
    assert path.stat().st_size == payload.size
    return clod_adapter.load(path)


def assert_same(one: Gaussians, other: Gaussians) -> None:
    assert one.attenuation == other.attenuation and one.screen_filter == other.screen_filter
    assert one.tensors().keys() == other.tensors().keys()
    for name, value in one.tensors().items():
        assert torch.equal(value, other.tensors()[name]), name


@pytest.mark.parametrize(("degree", "growth"), [(0, False), (4, True)])
def test_bytes_are_a_plain_ply(degree: int, growth: bool, tmp_path: Path) -> None:
    gaussians = dialled(BLOCK_ROWS + 3, degree)  # more than one block
    gaussians = gaussians.replace(growth_d=torch.linspace(-1, 2, len(gaussians)) if growth else None)
    calibration = Calibration((CalibrationRow(1.0, 30.5, 29.25, 0.9, 4.0),), len(gaussians), 2, 8, 6, "a machine")
    read = read_back(Payload("a.ply", gaussians, calibration), tmp_path)
    assert_same(read.gaussians, gaussians)
    assert read.calibration == calibration
    names = PlyData.read(str(tmp_path / "payload.ply"))["vertex"].data.dtype
    assert names.names[:6] == ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2")
    assert names.names[names.names.index("rot_3") + 1 :] == (("sigma_d", "growth_d") if growth else ("sigma_d",))
    assert {names[name].str for name in names.names} == {"<f4"}
    rest = [name for name in names.names if name.startswith("f_rest_")]
    assert rest == [f"f_rest_{k}" for k in range(3 * (degree + 1) ** 2 - 3)]


def test_a_pt_and_its_opaque_gaussians(tmp_path: Path) -> None:
    plain = scenes.gaussians(20, 2, 3)
    logits = plain.opacity_logits.clone()
    logits[3] = torch.inf
    tensors = {"means": plain.means, "quats": plain.quats, "scales": plain.log_scales, "opacities": logits}
    torch.save({"splats": tensors | {"sh0": plain.sh0, "shN": plain.shN}}, tmp_path / "a.pt")
    read = read_back(Payload.of(clod_adapter.load(tmp_path / "a.pt")), tmp_path).gaussians
    assert_same(read, plain.replace(opacity_logits=logits.clamp(max=20)))
    assert float(read.opacities[3]) == 1.0


def test_empty_sh_degrees_and_dropped_rows_are_left_out(capture: Any, tmp_path: Path) -> None:
    gaussians = dialled(degree=3).replace(shN=torch.zeros(40, 15, 3))
    means = gaussians.means.clone()
    means[7, 1] = torch.nan
    capture.write(tmp_path / "a.ply", gaussians.replace(means=means, sigma_d=None, attenuation=None))
    checkpoint = dataclasses.replace(clod_adapter.load(tmp_path / "a.ply"), path=Path("b\udcff.ply"))
    payload = Payload.of(checkpoint)
    assert b"f_rest" not in payload.header and len(payload.gaussians) == payload.describe()["count"] == 39
    assert payload.name == "b\\xff.ply"


def test_description() -> None:
    """Numbers of a camera keep all digits of float32."""
    rows = (CalibrationRow(1.0, 30.5, 29.25, 0.9, 4.0), CalibrationRow(3.0, 9.0, 28.0, 0.8, 2.0))
    payload = Payload("a b.ply", dialled(), Calibration(rows, 40, 2, 8, 6, "a machine"))
    entry = payload.describe(href="/files/model")
    assert (entry["name"], entry["href"], entry["element"], entry["format"]) == ("a b.ply", "/files/model", None, "ply")
    assert (entry["count"], entry["max_sv"], entry["no_dial"], entry["columns"]) == (40, 5.0, None, {})
    assert entry["attenuation"] == dataclasses.asdict(AttenuationConfig(tau=0.02, cut="soft"))
    assert entry["calibration"][1] == {"virtual_scale": 3.0, "count": 9.0, "psnr": 28.0}
    plain = Payload("p.ply", scenes.gaussians(5, 0, 0)).describe()
    assert plain["attenuation"] is None and plain["max_sv"] == 1.0 and plain["calibration"] == []
    assert plain["screen_filter"] == {"variance": 0.3, "compensate": False}
    assert plain["no_dial"].startswith("p.ply has no sigma_d") and "clod-adapt p.ply" in plain["no_dial"]
    camera = scenes.ring(3, 20, 10)[1]
    config = json.loads(json.dumps(page_config(entry, None, [camera], 2.5)))
    shown = config["cameras"][0]
    assert (shown["name"], shown["width"], shown["height"], config["virtual_scale"]) == ("view_1.png", 20, 10, 2.5)
    assert torch.equal(torch.tensor(shown["viewmat"]), camera.viewmat)
    assert torch.equal(torch.tensor(shown["K"]), camera.K)
