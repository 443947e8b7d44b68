"""The cameras that ``export`` bakes for, and the PSNR of the file that it writes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
from clod_adapter.cli.export import baking
from clod_adapter.cli.export.baking import largest_within
from clod_adapter.equation.distances import viewpoint_of
from clod_adapter.io.checkpoint import load


def exported(clod: Any, *words: object) -> Any:
    done = clod("export", *words, "--json")
    assert done.code == 0, done
    return json.loads(done.out)


def test_baking_for_the_training_cameras_of_the_scene(clod: Any, capture: Any, dialled: Path) -> None:
    model, train = load(dialled), clod_adapter.load_scene(capture.scene).train
    assert model.gaussians.attenuation is not None and len(model.viewpoints) == len(train) == 8
    for stored, view in zip(model.viewpoints, train, strict=True):
        assert stored == viewpoint_of(view.camera, model.gaussians.means, model.gaussians.attenuation)
    report = exported(clod, dialled, "--sv", 2, "--images", capture.scene, "-o", "x.ply")
    cameras = [view.camera for view in train]
    want = clod_adapter.bake(model.gaussians, 2.0, cameras=cameras)
    found = load("x.ply").gaussians
    assert report["cameras"] == 8 and torch.equal(found.means, want.means)
    torch.testing.assert_close(found.opacity_logits, want.opacity_logits)


def without_viewpoints(path: Path, out: Path) -> Path:
    head, end, body = path.read_bytes().partition(b"end_header\n")
    lines = [line for line in head.splitlines(keepends=True) if not line.startswith(b"comment clod_adapter viewpoint")]
    out.write_bytes(b"".join(lines) + end + body)
    return out


def test_baking_without_cameras_places_some(
    clod: Any, dialled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baking, "PLACED", 3)
    old = without_viewpoints(dialled, tmp_path / "old.ply")
    report = exported(clod, old, "--sv", 2, "-o", "x.ply")
    assert report["notes"] == [f"{old} stores no cameras: baked for 3 placed ones; --images gives a better result"]
    model = load(old)
    want = clod_adapter.bake(model.gaussians, 2.0, cameras=clod_adapter.place_cameras(model.gaussians, views=3))
    assert model.viewpoints == () and torch.equal(load("x.ply").gaussians.means, want.means)
    assert "baked at s = 2 by clod-adapter for 3 placed cameras" in load("x.ply").comments


def test_baking_an_invisible_model_without_cameras_is_refused(clod: Any, dialled: Path, tmp_path: Path) -> None:
    model = load(without_viewpoints(dialled, tmp_path / "old.ply"))
    faint = model.gaussians.replace(opacity_logits=model.gaussians.opacity_logits - 20)
    clod_adapter.save("faint.ply", faint)
    done = clod("export", "faint.ply", "--sv", 2, "-o", "x.ply")
    assert done.code == 2 and not Path("x.ply").exists()
    assert done.err.splitlines()[-1].startswith("clod-adapt: error: faint.ply: no cameras stored to bake for, and no ")
    assert done.err.splitlines()[-1].endswith("; give --images")


@pytest.mark.parametrize("suffix", [".ply", ".splat"])
def test_psnr_drop_is_that_of_the_file(clod: Any, capture: Any, dialled: Path, suffix: str) -> None:
    model, test = load(dialled), clod_adapter.load_scene(capture.scene).test
    reference = clod_adapter.evaluate(model.gaussians, test, [1])[0].psnr

    def lost(s: float) -> float:
        assert clod("export", dialled, "--sv", s, "--images", capture.scene, "-o", f"s{suffix}").code == 0
        return reference - clod_adapter.evaluate(load(f"s{suffix}").gaussians, test, [1])[0].psnr

    drop = (lost(1.0) + lost(4.0)) / 2
    report = exported(clod, dialled, "--psnr-drop", drop, "--images", capture.scene, "-o", f"x{suffix}")
    (output,) = report["outputs"]
    found = clod_adapter.evaluate(load(f"x{suffix}").gaussians, test, [1])[0].psnr
    assert output["psnr"] == pytest.approx(found, abs=1e-9) and output["views"] == len(test)
    assert output["reference_psnr"] == pytest.approx(reference, abs=1e-9)
    s = output["virtual_scale"]
    assert 1 < s < 4 and reference - found <= drop < lost(min(1.011 * s, 4.0))


def test_psnr_drop_out_of_reach(clod: Any, capture: Any, dialled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = baking.Photographs.drop_of
    monkeypatch.setattr(baking.Photographs, "drop_of", lambda *words: real(*words) + 1)
    done = clod("export", dialled, "--psnr-drop", 0.1, "--images", capture.scene, "-o", "x.ply")
    assert done.code == 2 and not Path("x.ply").exists()
    assert " out of reach: the file baked at s = 1 is " in done.err.splitlines()[-1]


def test_psnr_drop_without_photographs_is_that_of_the_dial(clod: Any, dialled: Path) -> None:
    report = exported(clod, dialled, "--psnr-drop", 1, "-o", "x.ply")
    assert "psnr" not in report["outputs"][0] and any("measured the dial" in note for note in report["notes"])


def test_largest_within() -> None:
    cases: list[tuple[Callable[[float], float], float, float, float]] = [
        (lambda s: s, 3.0, 8.0, 3.0), (lambda s: s, 9.0, 8.0, 8.0), (lambda s: s, 1.0, 8.0, 1.0),
        (lambda s: 0.0, 0.1, 1.0, 1.0), (lambda s: 1 / s if s < 2 else s, 5.0, 20.0, 5.0),
    ]  # fmt: skip
    for lost, drop, largest, want in cases:
        tried: list[float] = []
        found = largest_within(lambda s, lost=lost, tried=tried: tried.append(s) or lost(s), drop, largest)
        assert lost(found) <= drop and want / 1.01 <= found <= want
        assert len(tried) <= 2 + math.log2(math.log(20) / math.log(1.01))
