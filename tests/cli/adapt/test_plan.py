"""The plan as ``clod-adapt`` prints, stores, overrides and applies it."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
from clod_adapter.cli import adapt
from clod_adapter.gaussians import Gaussians
from clod_adapter.training.plan import NAMES

TINY = ("--iters", 24, "--max-sv", 4, "--out", "dial.ply")


@pytest.fixture
def wasteful(capture: Any, tmp_path: Path) -> Path:
    """The capture's checkpoint with a degree that does nothing, and 50 Gaussians that no camera sees among the rest."""
    base: Gaussians = capture.gaussians
    far = base.select(torch.arange(50)).replace(means=base.means[:50] + torch.tensor([0.0, 90.0, 0.0]))
    values = {name: torch.cat([far.tensors()[name], value]) for name, value in base.tensors().items()}
    values["shN"] = torch.cat([values["shN"], 1e-5 * torch.ones(350, 5, 3)], 1)
    (tmp_path / "in").mkdir()
    return Path(capture.write(tmp_path / "in" / "wasteful.ply", base.replace(**values)))


def decisions(folder: Path) -> dict[str, dict[str, Any]]:
    return {d["what"]: d for d in json.loads((folder / "dial.json").read_text())["plan"]["decisions"]}


def test_apply_rebuilds_trimmed_files(clod: Any, capture: Any, wasteful: Path, tmp_path: Path) -> None:
    """The plan is printed and stored; what is left out is in the file unchanged, or with --trim not at all."""
    done = clod(wasteful, "--images", capture.scene, *TINY)
    lines = done.err.splitlines()
    (first,) = (k for k, line in enumerate(lines) if line.startswith("plan: "))
    assert max(map(len, lines[first:])) <= 80
    assert re.search(r"^trained 24 steps", "\n".join(lines[first:]), re.M)
    table = {line[2:].split("  ")[0]: line for line in lines[first + 1 :] if line.startswith("  ")}
    assert re.search(r"left out +0\.0\d\d dB +--with bands$", table["SH degree 2"])
    assert re.search(r"kept +\d+\.\d+ dB +--without bands$", table["SH degree 1 to 2"])
    assert re.search(r"left out +\d+ +--with unseen$", table["unseen Gaussians"])
    assert table.pop("does not apply: undistortion, scaling")  # one line for both
    assert not {"exposure", "alpha", "masks"} & set(table), done  # of which the scene has none
    assert not {"means", "quats", "scales", "opacities", "sh0"} & set(table), done  # listed only if frozen
    report, stored = json.loads((tmp_path / "dial.json").read_text()), decisions(tmp_path)
    assert list(stored) == [*table, "undistortion", "scaling"] and stored["unseen Gaussians"]["number"] >= 50
    assert set(report["plan"]["seconds"]) == {"bands", "unseen", "share", "start"} and report["seconds"]["plan"] > 0
    base, whole = (clod_adapter.load(path).gaussians for path in (wasteful, tmp_path / "dial.ply"))
    assert len(whole) == 350 and torch.equal(whole.shN, base.shN)  # with the part that was left out
    assert torch.equal(whole.means[:50], base.means[:50]) and not torch.equal(whole.means[50:], base.means[50:])

    large = (tmp_path / "dial.ply").stat().st_size
    done = clod(wasteful, "--images", capture.scene, *TINY, "--trim", "--quiet")
    assert done.code == 0 and "plan:" not in done.err, done
    report, stored = json.loads((tmp_path / "dial.json").read_text()), decisions(tmp_path)
    trimmed = clod_adapter.load(tmp_path / "dial.ply").gaussians
    gone = int(stored["unseen Gaussians"]["number"])
    assert (len(trimmed), trimmed.sh_degree, report["base_count"]) == (350 - gone, 1, 350)
    assert report["rows"][0]["kept"] <= len(trimmed) and (tmp_path / "dial.ply").stat().st_size < 0.7 * large
    assert "held out" in stored["what is left out"]["why"] and stored["what is left out"]["number"] < 0.02
    adapter = clod_adapter.load_adapter(tmp_path / "dial.safetensors")
    assert adapter.kept is not None and int((~adapter.kept).sum()) == gone and not adapter.kept[:50].any()
    # The same training, except for rounding.
    for name, value in trimmed.tensors().items():
        assert torch.allclose(value, whole.tensors()[name][adapter.kept][:, :3] if name == "shN"
                              else whole.tensors()[name][adapter.kept], rtol=2e-3, atol=1e-5), name  # fmt: skip
    done = clod("apply", wasteful, "dial.safetensors", "-o", "again.ply", "--json")
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    assert json.loads(done.out)["base_count"] == 350


def test_overrides(clod: Any, capture: Any, wasteful: Path, tmp_path: Path) -> None:
    options = ("--with", "bands", "unseen", "--without", "quats", "--with", "sh0", "--without", "means", "--trim")
    done = clod(wasteful, "--images", capture.scene, *TINY, *options)
    assert done.code == 0, done
    stored = decisions(tmp_path)
    assert {d["verdict"] for d in (stored["SH degrees"], stored["unseen Gaussians"])} == {"kept"}
    assert {name: d["verdict"] for name, d in stored.items() if d["name"] not in ("bands", "unseen", "")} == {
        "means": "frozen", "quats": "frozen",
    }  # fmt: skip
    assert re.search(r"^  quats +frozen +- +--with quats$", done.err, re.M), done
    adapter = clod_adapter.load_adapter(tmp_path / "dial.safetensors")
    assert set(adapter.updates) == {"log_scales", "opacity_logits", "sh0"}
    assert adapter.kept is None and adapter.sh_degree is None  # nothing to trim: earlier versions read the file


def test_options_name_the_items_of_the_plan() -> None:
    assert adapt.NAMES == NAMES
