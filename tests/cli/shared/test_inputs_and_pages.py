"""Inputs in formats of other tools; devices; kernels, compiled before times are measured; the pages
of ``--report``.
"""

import json
import shutil
import sys
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from numba.core.event import install_recorder
from plyfile import PlyData
from refusals import refused

import clod_adapter
from clod_adapter.cli.shared import inputs, pages
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.inputs import pick_device, prepare_kernels
from formats import PACKED, splat_transform
from runs import data_in, names, rebuilt

TINY = "--images SCENE --iters 2 --max-sv 4 --out dial.ply"


def test_values_that_look_activated_need_the_option(clod, capture, tmp_path):
    """It is for the checkpoint, not for the adapted file. With the right option the renders
    match.
    """
    ply = PlyData.read(str(capture.ply), mmap=False)
    vertex = ply["vertex"].data
    vertex["opacity"] = 1 / (1 + np.exp(-vertex["opacity"].astype(np.float64)))
    for name in ("scale_0", "scale_1", "scale_2"):
        vertex[name] = np.exp(vertex[name])
    ply.write(str(tmp_path / "in.ply"))
    assert "--activated both" in clod("in.ply", TINY, code=2).err.splitlines()[-1]
    assert names(tmp_path) == ["in.ply"]
    assert "opacity taken as activated" in clod("in.ply", TINY, "--activated both").err
    assert rebuilt(clod, "in.ply", "--activated both")
    done = clod("apply in.ply dial.safetensors --out x.ply --activated both --json")
    assert done.note("opacity taken as activated")
    done = clod("eval dial.ply --images SCENE --sv 1 --base in.ply --activated both --json")
    assert done.report["base_row"]["psnr"] > 40


def test_a_compressed_file_is_adapted(clod, tmp_path):
    splat_transform("--version")
    shutil.copy(PACKED, tmp_path / "base.compressed.ply")
    assert "note: base.compressed.ply: quantised" in clod("base.compressed.ply", TINY).err
    assert rebuilt(clod, "base.compressed.ply")


def test_devices(monkeypatch, capsys):
    """Without a GPU nothing is printed; a GPU is named, or the reason that it is not used."""

    def cuda_is_refused(said):
        with refused(rf"--device cuda: {said}.*or use --device cpu"):
            pick_device("cuda", Console())

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert pick_device("auto", Console()) == pick_device("cpu", Console()) == torch.device("cpu")
    assert capsys.readouterr() == ("", "")
    for build, why in (
        (None, "torch .* is built without CUDA: install torch"),
        ("12.4", "torch finds no NVIDIA GPU"),
    ):
        monkeypatch.setattr(torch.version, "cuda", build)
        cuda_is_refused(why)
    for name, value in (
        ("is_available", True),
        ("current_device", 0),
        ("get_device_name", "NVIDIA Test 1"),
    ):
        monkeypatch.setattr(torch.cuda, name, lambda *_, value=value: value)
    # torch has no code for its compute capability: the first operation fails
    error = RuntimeError("CUDA error: no kernel image is available")
    monkeypatch.setattr(torch, "ones", Mock(side_effect=error))
    cuda_is_refused(r"torch cannot compute on it .*doctor")
    monkeypatch.setattr(torch, "ones", lambda *_, **__: torch.zeros(1))
    monkeypatch.setattr(inputs, "unusable", lambda: None)
    capsys.readouterr()
    for name in ("auto", "cuda"):
        assert pick_device(name, Console()) == torch.device("cuda", 0)
    assert capsys.readouterr().err.splitlines() == ["on NVIDIA Test 1"] * 2
    monkeypatch.setattr(inputs, "unusable", lambda: "gsplat is absent: pip install gsplat==1.5.3")
    assert pick_device("auto", Console()) == torch.device("cpu")
    why = "on the CPU, although there is a GPU: gsplat is absent: pip install"
    assert why in capsys.readouterr().err
    cuda_is_refused("gsplat is absent: pip install gsplat==1.5.3")


def test_adapting_compiles_nothing_more(capture, capsys):
    """For any SH degree; without compiling nothing is printed."""
    base = capture.gaussians
    scene = clod_adapter.load_scene(capture.scene)
    prepare_kernels(Console(quiet=True))
    with install_recorder("numba:compile") as compiled:
        prepare_kernels(Console())
        for bands in (0, 3):
            base = base.replace(shN=base.shN[:, :bands])
            result = clod_adapter.adapt(base, scene, clod_adapter.AdaptConfig(iters=2)).gaussians
            clod_adapter.evaluate(result, scene.test, [1.0, 3.0])
    assert capsys.readouterr().err == "" and compiled.buffer == []


ADAPT = "BASE --images SCENE --iters 16 --max-sv 4 --out dial.ply --report"


def page_of(path):
    """Its text, and the data in it."""
    text = path.read_text("utf-8")
    return text, json.loads(data_in(text, "data")[0])


def test_adapt(clod, tmp_path):
    pytest.importorskip("matplotlib")
    report = clod(ADAPT, "--json").report
    pictures = {name: f"dial_{name}.png" for name in ("rendering", "count", "adapting")}
    files = {"page": "dial.html"} | pictures
    assert report["outputs"].items() >= files.items()
    assert all((tmp_path / f).is_file() for f in files.values())
    text, page = page_of(tmp_path / "dial.html")
    assert all(page["report"][name] == report[name] for name in ("rows", "base_rows", "plan"))
    curves = page["training"]["curves"]
    assert [curve["label"] for curve in curves] == ["s = 1", "s = 3", "s = 4"]
    rows = {row["virtual_scale"]: row for row in report["rows"]}
    for curve, dial in zip(curves, (1, 3, 4), strict=True):
        seconds = [point["seconds"] for point in curve["points"]]
        psnr = [point["psnr"] for point in curve["points"]]
        assert seconds == sorted(seconds) and len(seconds) == 5  # steps 1, 2, 4, 8 and 16, the end
        assert len(set(psnr)) == 5 and psnr[-1] == rows[dial]["psnr"]  # each of its own time
    trained = report["seconds"]["start"] + report["seconds"]["train"]
    assert curves[0]["points"][-1]["seconds"] == pytest.approx(trained, abs=0.05)
    assert "take over in the distance" in text
    assert "base.ply, a trained splat of 300 Gaussians" in text
    assert text.count("<svg") == 3
    assert text.count('data-name=""') == pages.FRAMES and text.count('data-name="base"') == 1


def test_eval(clod, tmp_path, monkeypatch):
    """Without matplotlib the page is refused before any work."""
    pytest.importorskip("matplotlib")
    report = clod("eval DIAL --images SCENE --report look.html --json --base BASE").report
    pictures = {name: f"look_{name}.png" for name in ("rendering", "count")}
    assert report["outputs"] == {"page": "look.html"} | pictures
    text, page = page_of(tmp_path / "look.html")
    assert page["report"]["rows"] == report["rows"] and page["training"] is None
    assert 'data-name="base"' in text and "hold for base" in text
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "pip install matplotlib" in clod(ADAPT, code=2).err
