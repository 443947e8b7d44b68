"""The calibration table: its checks, and exact round trips through adapter and PLY."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clod_adapter import AttenuationConfig, ClodError, extract, load, load_adapter, save, save_adapter, with_dial
from clod_adapter.calibration import Calibration, CalibrationRow, Viewpoint
from clod_adapter.equation.distances import viewpoint_of
from clod_adapter.evaluation.evaluate import Row
from scenes import gaussians, ring

number, positive = st.floats(-1e6, 1e6, allow_nan=False), st.floats(1e-9, 1e6)
rows = st.lists(st.tuples(st.floats(1, 300, exclude_min=True), number, number, number, positive), max_size=9)


@st.composite
def tables(draw: st.DrawFn) -> Calibration:
    found = {values[0]: values for values in [(1.0, *draw(st.tuples(number, number, number)), 2.5), *draw(rows)]}
    machine, against = draw(st.text(min_size=1, max_size=40)), draw(st.sampled_from(["photographs", "checkpoint"]))
    some = [Row(s, psnr, ssim, kept, 0.5, 1.0, ms) for s, kept, psnr, ssim, ms in found.values()]
    places = draw(st.lists(st.builds(Viewpoint, number, number, number, positive), max_size=3))
    about = {"total": 4, "views": 13, "size": (640, 480), "machine": machine, "against": against}
    return Calibration.of(some, **about, viewpoints=places)


@settings(deadline=None, max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(tables())
def test_round_trips(tmp_path: Path, calibration: Calibration) -> None:
    base = gaussians(4, 0, 0)
    dialled = with_dial(base, torch.ones(4))
    save(tmp_path / "a.ply", dialled, calibration=calibration)
    assert load(tmp_path / "a.ply").calibration == calibration and load(tmp_path / "a.ply").notes == ()
    adapter = replace(extract(base, dialled, fingerprint="", config={}), calibration=calibration)
    save_adapter(tmp_path / "a.safetensors", adapter)
    assert load_adapter(tmp_path / "a.safetensors").calibration == calibration
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0]
    assert header.isascii() and max(map(len, header.splitlines())) < 200


def test_rows_of_an_evaluation() -> None:
    some = [Row(s, 30 - s, 0.9, 100 / s, 1 / s, 50 / s, 10 / s) for s in (2.0, 1.0)]
    found = Calibration.of(some, total=100, views=3, size=(64, 48), machine=" AMD\tRyzen\u2122  9\n")
    assert found.rows == (CalibrationRow(1.0, 100.0, 29.0, 0.9, 10.0), CalibrationRow(2.0, 50.0, 28.0, 0.9, 5.0))
    assert (found.machine, found.width, found.height) == ("AMD Ryzen? 9", 64, 48)


ROW = CalibrationRow(1.0, 10.0, 30.0, 0.9, 5.0)
GOOD: dict[str, Any] = {"rows": (ROW,), "total": 4, "views": 1, "width": 8, "height": 8, "machine": "m"}
PLACE = Viewpoint(1.5, 2.5, 3.5, 4.5, look_z=1.0, up_y=-1.0, fov=0.8)


@pytest.mark.parametrize(
    ("good", "bad", "said"),
    [
        *((Calibration(**GOOD), {"rows": rows}, "ascend from 1") for rows in (
            (), (replace(ROW, virtual_scale=2.0),), (ROW, ROW))),
        (Calibration(**GOOD), {"rows": (replace(ROW, psnr=float("inf")),)}, "not finite"),
        (Calibration(**GOOD), {"rows": (replace(ROW, frame_ms=0.0),)}, "not positive"),
        (Calibration(**GOOD), {"total": 0}, "not positive"),
        (Calibration(**GOOD), {"against": "thin air"}, "'thin air', it must be one of photographs, checkpoint"),
        (Calibration(**GOOD), {"machine": "caf\u00e9"}, "machine"),
        (PLACE, {"x": float("nan")}, "the centre of a viewpoint is"),
        (PLACE, {"unit": 0.0}, "the unit of a viewpoint is"),
        *((PLACE, bad, "the direction of a viewpoint is") for bad in ({"up_x": 7.0}, {"fov": -1})),
    ],
)  # fmt: skip
def test_bad_values_are_refused(good: Any, bad: dict[str, Any], said: str) -> None:
    with pytest.raises(ClodError, match=said):
        replace(good, **bad)


def test_stored_viewpoints_are_cameras_again(tmp_path: Path) -> None:
    cameras, dialled = ring(3, 40, 30), with_dial(gaussians(4, 0, 0), torch.ones(4))
    viewpoints = tuple(viewpoint_of(camera, torch.randn(50, 3), AttenuationConfig()) for camera in cameras)
    for places in (viewpoints, (Viewpoint(1.5, 2.5, 3.5, 4.5),)):
        save(tmp_path / "a.ply", dialled, calibration=Calibration(**GOOD, viewpoints=places))
        stored = load(tmp_path / "a.ply")
        assert stored.viewpoints == places and len(stored.cameras) == len(places) - (len(places) == 1)
        for camera, found in zip(cameras, stored.cameras, strict=False):
            assert torch.allclose(found.viewmat, camera.viewmat, atol=1e-5)
            assert float(found.K[1, 1]) / found.height == pytest.approx(float(camera.K[1, 1]) / 30, rel=1e-5)
