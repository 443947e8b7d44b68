"""The device of a command, and the message for a GPU that cannot be used."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from clod_adapter.cli.main import main
from clod_adapter.cli.shared import inputs as devices
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.inputs import pick_device
from clod_adapter.errors import ClodError


def test_auto_and_named_devices(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a GPU nothing is printed; a GPU is named, or the reason that it is not used."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert pick_device("auto", Console()) == pick_device("cpu", Console()) == torch.device("cpu")
    assert capsys.readouterr() == ("", "")
    for name, value in (("is_available", True), ("current_device", 0), ("get_device_name", "NVIDIA Test 1")):
        monkeypatch.setattr(torch.cuda, name, lambda *_, value=value: value)
    monkeypatch.setattr(devices, "_fails", lambda: None)
    monkeypatch.setattr(devices, "unusable", lambda: None)
    assert pick_device("auto", Console()) == pick_device("cuda", Console()) == torch.device("cuda", 0)
    assert capsys.readouterr().err.splitlines() == ["on NVIDIA Test 1"] * 2
    assert pick_device("cpu", Console()) == torch.device("cpu")
    monkeypatch.setattr(devices, "unusable", lambda: "gsplat is absent: pip install gsplat==1.5.3")
    assert pick_device("auto", Console()) == torch.device("cpu")
    said = "on the CPU, although there is a GPU: gsplat is absent: pip install gsplat==1.5.3"
    assert capsys.readouterr().err.splitlines() == [said]
    with pytest.raises(ClodError, match=r"--device cuda: gsplat is absent: pip install gsplat==1.5.3; or use"):
        pick_device("cuda", Console())


@pytest.mark.skipif(torch.cuda.is_available(), reason="torch computes on the GPU that is here")
def test_gpu_that_torch_cannot_compute_on_is_not_used(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """For example, torch has no code for its compute capability: torch finds it, and the first operation fails."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(devices, "unusable", lambda: pytest.fail("gsplat would be compiled for nothing"))
    assert pick_device("auto", Console()) == torch.device("cpu")
    assert "although there is a GPU: torch cannot compute on it (" in capsys.readouterr().err
    with pytest.raises(ClodError, match=r"--device cuda: torch cannot compute on it .*doctor.*or use --device cpu"):
        pick_device("cuda", Console())


def test_cuda_without_a_gpu_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], capture: Any
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for build, why in ((None, "is built without CUDA: install torch from"), ("12.4", "torch finds no NVIDIA GPU")):
        monkeypatch.setattr(torch.version, "cuda", build)
        words = ["eval", str(capture.ply), "--images", str(capture.scene), "--device", "cuda"]
        assert main(words) == 2
        last = capsys.readouterr().err.strip().splitlines()[-1]
        assert why in last and last.endswith("or use --device cpu")
