"""LPIPS and FLIP: notes without their packages or weights, values with them, no network access."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.evaluation.perceptual import available_metrics
from scenes import gaussians, photograph, ring


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "create_connection", lambda *_, **__: pytest.fail("asked the network"))


def test_missing_packages_give_one_note(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("lpips", "flip_evaluator"):
        monkeypatch.setitem(sys.modules, name, None)
    found, notes = available_metrics()
    assert found == {} and notes == ["without LPIPS and FLIP (pip install lpips flip-evaluator)"]


def test_flip() -> None:
    """FLIP is 0 for equal images and about 1 for black against white; a row has the mean over views."""
    pytest.importorskip("flip_evaluator")
    flip = available_metrics()[0]["flip"]
    photo = torch.randint(0, 256, (40, 60, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    assert flip(photo / 255, photo) == 0
    assert flip(photo / 255 + 2, torch.full_like(photo, 255)) == 0  # clamped
    black = torch.zeros(40, 60, 3)
    assert 0.9 < flip(black, torch.full_like(photo, 255)) <= 1
    assert 0 < flip((photo / 255).clamp(0.1, 0.9), photo) < 0.5
    some = gaussians(50, 0, 0)
    views = photograph(gaussians(50, 0, 1), ring(2, 32, 24))
    rows = [evaluate(some, [view], [1.0], metrics={"flip": flip})[0] for view in views]
    (both,) = evaluate(some, views, [1.0], metrics={"flip": flip})
    assert both.flip == pytest.approx(sum(row.flip or 0 for row in rows) / 2) and both.lpips is None
    assert "flip" in both.as_dict() and "lpips" not in both.as_dict()


def test_an_incompatible_torchvision_gives_one_note(monkeypatch: pytest.MonkeyPatch) -> None:
    class Finder:
        def find_spec(self, name: str, *_: object) -> None:
            if name == "lpips":
                raise RuntimeError("operator torchvision::nms\n  does not exist\n")

    monkeypatch.delitem(sys.modules, "lpips", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Finder(), *sys.meta_path])
    found, (note,) = available_metrics()
    assert "lpips" not in found and "does not fit this torch: operator torchvision::nms does not exist)" in note


def test_lpips_is_left_out_without_weights(tmp_path: Path) -> None:
    """The weights are not downloaded; with weights (here random ones) LPIPS is measured."""
    pytest.importorskip("lpips", exc_type=(ImportError, RuntimeError))
    import torchvision

    before = torch.hub.get_dir()
    torch.hub.set_dir(str(tmp_path))
    try:
        found, notes = available_metrics()
        assert "lpips" not in found and "weights are not at" in notes[0] and "alexnet" in notes[0]
        (tmp_path / "checkpoints").mkdir()
        name = Path(torchvision.models.AlexNet_Weights.IMAGENET1K_V1.url).name
        torch.save(torchvision.models.alexnet().state_dict(), tmp_path / "checkpoints" / name)
        lpips = available_metrics()[0]["lpips"]
    finally:
        torch.hub.set_dir(before)
    photo = torch.randint(0, 256, (64, 80, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    assert lpips(photo / 255, photo) == 0 < lpips(1 - photo / 255, photo)


def test_only_evaluating_loads_the_networks(capture: Any, tmp_path: Path) -> None:
    """Adapting and rendering do not import installed packages of these names."""
    for name in ("lpips", "torchvision", "flip_evaluator"):
        (tmp_path / f"{name}.py").write_text("evaluate = lambda *_, **__: (None, 0.5)\n")
    code = (
        "import sys\n"
        "from clod_adapter.cli.main import main\n"
        "def run(*words): main([*words, '--images', sys.argv[2], '--quiet'])\n"
        "run(sys.argv[1], '--iters', '1', '--out', 'dial.ply')\n"
        "run('render', 'dial.ply', '--out', 'pictures')\n"
        "print([name for name in ('lpips', 'torchvision', 'flip_evaluator') if name in sys.modules], file=sys.stderr)\n"
        "run('eval', 'dial.ply', '--sv', '1')\n"
        "print([name for name in ('lpips', 'flip_evaluator') if name in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(capture.ply), str(capture.scene)], cwd=tmp_path, capture_output=True,
        text=True, env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
        check=False,
    )  # fmt: skip
    assert done.stderr.splitlines()[-2:] == ["[]", "['lpips', 'flip_evaluator']"], done.stderr
    assert (tmp_path / "dial.ply").exists() and list((tmp_path / "pictures").iterdir())
