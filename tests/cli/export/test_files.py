"""``clod-adapt export -o page.html``."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli.export import packing
from clod_adapter.errors import ClodError
from clod_adapter.io.formats.splat_transform import VARIABLE, SplatTransform


@pytest.mark.parametrize("sv", [None, 2, 9])
def test_page_holds_the_splat_and_its_dial(clod: Any, dialled: Path, tmp_path: Path, sv: int | None) -> None:
    done = clod("export", dialled, "-o", "page.html", *(["--sv", sv] if sv else []), "--json")
    assert done.code == 0 and "splat-transform" not in done.err and "exact" not in done.err, done
    report = json.loads(done.out)
    (output,) = report["outputs"]
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    (config,) = re.findall('id="clod-config">(.*?)</script>', text)
    model = json.loads(config)["model"]
    assert json.loads(config)["virtual_scale"] == (min(sv, 4) if sv else None)
    assert any("dial ends at s = 4" in note for note in report["notes"]) == (sv == 9)
    (tmp_path / "held.ply").write_bytes(base64.b64decode(re.findall('id="clod-model">(.*?)</script>', text)[0]))
    held = clod_adapter.load(tmp_path / "held.ply")
    assert len(held.gaussians) == model["count"] == output["count"] and model["name"] == dialled.name
    assert held.gaussians.sigma_d is not None and model["attenuation"] and model["calibration"]
    assert [path.name for path in tmp_path.glob(".tmp-*")] == []


def test_page_has_the_cameras_of_the_scene(clod: Any, dialled: Path, capture: Any, tmp_path: Path) -> None:
    done = clod("export", dialled, "-o", "page.html", "--images", capture.scene, "--sv", 2)
    assert done.code == 0 and "Gaussians, initial dial value s = 2" in done.out and " of " not in done.out
    (config,) = re.findall('id="clod-config">(.*?)</script>', (tmp_path / "page.html").read_text(encoding="utf-8"))
    names = [camera["name"] for camera in json.loads(config)["cameras"]]
    assert names == sorted(path.name for path in (capture.scene / "images").iterdir())


def test_pages_do_not_depend_on_installed_tools(clod: Any, dialled: Path, tmp_path: Path, monkeypatch: Any) -> None:
    """The same bytes with splat-transform on the PATH and without, which is not even started."""
    monkeypatch.setattr(SplatTransform, "find", lambda: pytest.fail("asked for"))
    assert clod("export", dialled, "-o", "with.html").code == 0
    monkeypatch.setenv(VARIABLE, "there-is-none")
    assert clod("export", dialled, "-o", "without.html").code == 0
    assert (tmp_path / "with.html").read_bytes() == (tmp_path / "without.html").read_bytes()


def test_pack_needs_the_tool_and_a_page(clod: Any, dialled: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv(VARIABLE, "there-is-none")
    done = clod("export", dialled, "-o", "page.html", "--pack")
    assert done.code == 2 and "there-is-none" in done.err and "npm install" in done.err, done
    done = clod("export", dialled, "-o", "x.ply", "--sv", 2, "--pack")
    assert done.code == 2 and "--pack is for .html pages" in done.err, done


def test_the_loss_of_packing_is_measured(clod: Any, dialled: Path, monkeypatch: Any) -> None:
    """A stub of splat-transform keeps the rows, and rounds the positions to a hundredth."""

    def run(*words: Any, timeout: float, progress: Any = None) -> float:
        source, out = (word for word in words if isinstance(word, Path))
        for seconds in (0.0, 0.5, 1.0):
            if progress:
                progress(seconds)
        found = clod_adapter.load(source)
        rounded = found.gaussians.replace(means=(found.gaussians.means * 100).round() / 100)
        clod_adapter.save(out if out.suffix == ".ply" else kept, rounded if out.suffix == ".sog" else found.gaussians)
        if out.suffix == ".sog":
            out.write_bytes(b"packed")
        return 1.0

    kept = Path("kept.ply").absolute()
    tool = SimpleNamespace(run=run, version="0", gpu=False)
    monkeypatch.setattr(SplatTransform, "find", lambda: tool)
    monkeypatch.setattr(packing, "load", lambda path: clod_adapter.load(kept))
    monkeypatch.setattr("clod_adapter.cli.shared.console.LINE_EVERY", 0)
    done = clod("export", dialled, "-o", "page.html", "--pack", "--json")
    assert done.code == 0, done
    (loss,) = re.findall(r"is packed: its renders have a PSNR of (\d+\.\d) dB against the exact", done.err)
    assert 20 < float(loss) < 60 and f"{loss} dB" in json.loads(done.out)["notes"][-1]
    assert re.search(r"^splat-transform +\d+%, .* left, \d+ Gaussians, estimated$", done.err, re.M), done


def test_a_page_packed_by_the_real_tool(clod: Any, dialled: Path, tmp_path: Path) -> None:
    try:
        SplatTransform.find()
    except ClodError as error:
        pytest.skip(str(error))
    for name, options in (("exact.html", []), ("packed.html", ["--pack"])):
        done = clod("export", dialled, "-o", name, *options)
        assert done.code == 0, done
    (loss,) = re.findall(r"a PSNR of (\d+\.\d) dB", done.err)
    assert 25 < float(loss) < 60
