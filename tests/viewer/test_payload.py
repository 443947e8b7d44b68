"""The data of the page: one PLY layout for Gaussians from any file, or SPZ."""

import dataclasses
from pathlib import Path
from typing import Any

import torch
from plyfile import PlyData

import clod_adapter
import scenes
from clod_adapter.calibration import Calibration, CalibrationRow
from clod_adapter.config import FILTERS
from clod_adapter.gaussians import Gaussians
from clod_adapter.viewer.page import Payload


def dialled(n: int = 40, degree: int = 1) -> Gaussians:
    return scenes.dialled(n, degree, 3, scene_distance=1.0).replace(screen_filter=FILTERS["mip"])


def test_bytes_are_a_plain_ply(tmp_path: Path) -> None:
    """In blocks; an opaque Gaussian, whose logit is infinite, has a finite one of the same opacity."""
    gaussians = dialled(20_000, 2)
    calibration = Calibration((CalibrationRow(1.0, 30.5, 29.25, 0.9, 4.0),), 20_000, 2, 8, 6, "a machine")
    gaussians = gaussians.replace(growth_d=torch.linspace(-1, 2, len(gaussians)))
    gaussians.opacity_logits[3] = torch.inf
    payload, file = Payload("a.ply", gaussians, calibration), tmp_path / "payload.ply"
    file.write_bytes(b"".join(payload.blocks()))
    read = clod_adapter.load(file)
    assert file.stat().st_size == payload.size and read.calibration == calibration
    scenes.assert_equal(read.gaussians, gaussians.replace(opacity_logits=gaussians.opacity_logits.clamp(max=20)))
    assert read.gaussians.screen_filter == FILTERS["mip"] and float(read.gaussians.opacities[3]) == 1.0
    layout = PlyData.read(str(file))["vertex"].data.dtype
    assert layout.names[:6] == ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2")
    assert layout.names[-2:] == ("sigma_d", "growth_d")
    assert {layout[name].str for name in layout.names} == {"<f4"}
    rest = [name for name in layout.names if name.startswith("f_rest_")]
    assert rest == [f"f_rest_{k}" for k in range(24)]


def test_empty_sh_degrees_and_dropped_rows_are_left_out(capture: Any, tmp_path: Path) -> None:
    gaussians = dialled(degree=3).replace(shN=torch.zeros(40, 15, 3))
    gaussians.means[7, 1] = torch.nan
    capture.write(tmp_path / "a.ply", gaussians)
    checkpoint = dataclasses.replace(clod_adapter.load(tmp_path / "a.ply"), path=Path("b\udcff.ply"))
    payload = Payload.of(checkpoint)
    assert b"f_rest" not in payload.header and len(payload.gaussians) == 39
    assert payload.name == "b\\xff.ply"
