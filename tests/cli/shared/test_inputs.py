"""What commands read, in formats of other tools; their device; kernels, compiled before times are measured."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numba.core.event import Event, Listener, install_listener
from plyfile import PlyData

import clod_adapter
from clod_adapter.cli.shared import inputs
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.inputs import pick_device, prepare_kernels
from clod_adapter.errors import ClodError
from formats import PACKED

TINY = ("--iters", 2, "--max-sv", 4, "--out", "dial.ply")


def activated(source: Path, path: Path) -> Path:
    """The same splat with activated opacities and scales."""
    ply = PlyData.read(str(source), mmap=False)
    vertex = ply["vertex"].data
    vertex["opacity"] = 1 / (1 + np.exp(-vertex["opacity"].astype(np.float64)))
    for name in ("scale_0", "scale_1", "scale_2"):
        vertex[name] = np.exp(vertex[name])
    ply.write(str(path))
    return path


def test_values_that_look_activated_need_the_option(clod: Any, capture: Any, tmp_path: Path) -> None:
    """It is for the checkpoint, not for the adapted file. With the right option the renders match."""
    path, images = activated(capture.ply, tmp_path / "in.ply"), ("--images", capture.scene)
    done = clod(path, *images, *TINY)
    assert done.code == 2 and "--activated both" in done.err.splitlines()[-1], done
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.ply"]
    done = clod(path, *images, *TINY, "--activated", "both")
    assert done.code == 0 and "opacity taken as activated" in done.err, done
    done = clod("apply", path, "dial.safetensors", "--out", "again.ply", "--activated", "both", "--json")
    assert done.code == 0 and "opacity taken as activated" in json.loads(done.out)["notes"][0], done
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    done = clod("eval", "dial.ply", *images, "--sv", 1, "--base", path, "--activated", "both", "--json")
    assert done.code == 0 and json.loads(done.out)["base_row"]["psnr"] > 40, done


def test_a_compressed_file_is_adapted(clod: Any, capture: Any, tmp_path: Path) -> None:
    shutil.copy(PACKED, tmp_path / "base.compressed.ply")
    done = clod("base.compressed.ply", "--images", capture.scene, *TINY)
    assert done.code == 0 and "note: base.compressed.ply: quantised" in done.err, done
    assert clod("apply", "base.compressed.ply", "dial.safetensors", "--out", "again.ply").code == 0
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


def test_devices(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a GPU nothing is printed; a GPU is named, or the reason that it is not used."""

    def refused(said: str) -> None:
        with pytest.raises(ClodError, match=rf"--device cuda: {said}.*or use --device cpu"):
            pick_device("cuda", Console())

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert pick_device("auto", Console()) == pick_device("cpu", Console()) == torch.device("cpu")
    assert capsys.readouterr() == ("", "")
    for build, why in ((None, "torch .* is built without CUDA: install torch"), ("12.4", "torch finds no NVIDIA GPU")):
        monkeypatch.setattr(torch.version, "cuda", build)
        refused(why)
    for name, value in (("is_available", True), ("current_device", 0), ("get_device_name", "NVIDIA Test 1")):
        monkeypatch.setattr(torch.cuda, name, lambda *_, value=value: value)
    with monkeypatch.context() as patch:  # torch has no code for its compute capability: the first operation fails
        patch.setattr(torch, "ones", fail)
        refused(r"torch cannot compute on it .*doctor")
    monkeypatch.setattr(torch, "ones", lambda *_, **__: torch.zeros(1))
    monkeypatch.setattr(inputs, "unusable", lambda: None)
    capsys.readouterr()
    assert pick_device("auto", Console()) == pick_device("cuda", Console()) == torch.device("cuda", 0)
    assert capsys.readouterr().err.splitlines() == ["on NVIDIA Test 1"] * 2
    monkeypatch.setattr(inputs, "unusable", lambda: "gsplat is absent: pip install gsplat==1.5.3")
    assert pick_device("auto", Console()) == torch.device("cpu")
    assert "on the CPU, although there is a GPU: gsplat is absent: pip install" in capsys.readouterr().err
    refused("gsplat is absent: pip install gsplat==1.5.3")


def fail(*_: Any, **__: Any) -> None:
    raise RuntimeError("CUDA error: no kernel image is available for execution on the device")


class Compiled(Listener):
    def __init__(self) -> None:
        self.names = list[str]()

    def on_start(self, event: Event) -> None:
        self.names.append(str(event.data["dispatcher"]))

    def on_end(self, event: Event) -> None:
        pass


def test_adapting_compiles_nothing_more(capture: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """For any SH degree; without compiling nothing is printed."""
    base, scene = capture.gaussians, clod_adapter.load_scene(capture.scene)
    prepare_kernels(Console(quiet=True))
    with install_listener("numba:compile", compiled := Compiled()):
        prepare_kernels(Console())
        for bands in (0, 3):
            base = base.replace(shN=base.shN[:, :bands])
            result = clod_adapter.adapt(base, scene, clod_adapter.AdaptConfig(iters=2)).gaussians
            clod_adapter.evaluate(result, scene.test, [1.0, 3.0])
    assert capsys.readouterr().err == "" and compiled.names == []
