"""Checkpoints in formats of other tools."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData

from clod_adapter.cli.main import COMMANDS, build_parser
from clod_adapter.io.file_formats import write
from packing import write_packed

TINY = ("--iters", 4, "--max-sv", 4, "--out", "dial.ply")


def activated(source: Path, path: Path) -> Path:
    """The same splat with activated opacities and scales."""
    ply = PlyData.read(str(source), mmap=False)
    vertex = ply["vertex"].data
    vertex["opacity"] = 1 / (1 + np.exp(-vertex["opacity"].astype(np.float64)))
    for name in ("scale_0", "scale_1", "scale_2"):
        vertex[name] = np.exp(vertex[name].astype(np.float64))
    ply.write(str(path))
    return path


def test_gsplat_checkpoint_is_adapted(clod: Any, capture: Any, tmp_path: Path) -> None:
    g = capture.gaussians
    values = {
        "means": g.means, "quats": g.quats, "scales": g.log_scales, "opacities": g.opacity_logits, "sh0": g.sh0,
        "shN": g.shN,
    }  # fmt: skip
    torch.save({"step": 6999, "splats": values}, tmp_path / "ckpt.pt")
    done = clod("ckpt.pt", "--images", capture.scene, *TINY)
    assert done.code == 0 and "note: gsplat's trainer may have normalised" in done.err, done
    assert clod("apply", "ckpt.pt", "dial.safetensors", "--out", "again.ply").code == 0
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    done = clod("export", "ckpt.pt", "--sv", 2, "--out", "b.ply")
    assert done.code == 2 and "has no sigma_d" in done.err


def test_values_that_look_activated_need_the_option(clod: Any, capture: Any, tmp_path: Path) -> None:
    path = activated(capture.ply, tmp_path / "in.ply")
    images = ("--images", capture.scene)
    for words in ((path, *images, *TINY), ("eval", path, *images), ("robustness", path, *images)):
        done = clod(*words)
        assert done.code == 2 and "--activated both" in done.err.splitlines()[-1], done
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.ply"]
    done = clod(path, *images, *TINY, "--activated", "both")
    assert done.code == 0 and "opacity taken as activated" in done.err, done
    done = clod("apply", path, "dial.safetensors", "--out", "again.ply", "--activated", "both", "--json")
    assert "opacity taken as activated" in json.loads(done.out)["notes"][0], done
    assert done.code == 0 and (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes(), done
    done = clod("apply", path, "dial.safetensors", "--out", "again.ply", "--activated", "none")
    assert done.code == 2 and "a different base was given" in done.err
    # The option is for the checkpoint, not for the adapted file.
    done = clod("eval", "dial.ply", *images, "--sv", 1, "--base", path, "--activated", "both", "--json")
    assert done.code == 0, done
    # With the right option the renders match.
    errors = [
        json.loads(clod("eval", *words, *images, "--sv", 1, "--json").out)["rows"][0]["psnr"]
        for words in ((capture.ply,), (path, "--activated", "both"), (path, "--activated", "none"))
    ]
    assert errors[0] > 40 and abs(errors[1] - errors[0]) < 0.5 and errors[2] < 20


def test_commands_that_read_a_checkpoint_have_the_option() -> None:
    for name in ("", *COMMANDS):
        options = {option for action in build_parser(name)._actions for option in action.option_strings}
        assert ("--activated" in options) == (name not in ("demo", "inspect", "doctor")), name


@pytest.mark.parametrize("name", ["base.compressed.ply", "base.spz", "base.splat", "base.glb", "base.safetensors"])
def test_other_formats_are_adapted(clod: Any, capture: Any, tmp_path: Path, name: str) -> None:
    (write_packed if name.endswith(".ply") else write)(tmp_path / name, capture.gaussians)
    done = clod(name, "--images", capture.scene, *TINY)
    quantised = Path(name).suffix in (".ply", ".spz", ".splat")
    assert done.code == 0 and ("note: quantised" in done.err) == quantised, done
    assert clod("apply", name, "dial.safetensors", "--out", "again.ply").code == 0
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    assert clod("eval", name, "--images", capture.scene, "--keep", 10).code == 2
