"""``clod-adapt export -o page.html``."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.io.formats.splat_transform import VARIABLE


@pytest.mark.parametrize("sv", [None, 2, 9])
def test_page_holds_the_splat_and_its_dial(clod: Any, dialled: Path, tmp_path: Path, sv: int | None) -> None:
    done = clod("export", dialled, "-o", "page.html", *(["--sv", sv] if sv else []), "--json")
    assert done.code == 0 and "splat-transform" not in done.err, done
    report = json.loads(done.out)
    (output,) = report["outputs"]
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    (config,) = re.findall('id="clod-config">(.*?)</script>', text)
    model = json.loads(config)["model"]
    assert json.loads(config)["virtual_scale"] == (min(sv, 4) if sv else None)
    assert any("dial ends at s = 4" in note for note in report["notes"]) == (sv == 9)
    (tmp_path / "held.spz").write_bytes(base64.b64decode(re.findall('id="clod-model">(.*?)</script>', text)[0]))
    held = clod_adapter.load(tmp_path / "held.spz")
    assert len(held.gaussians) == output["count"] and model["name"] == dialled.name
    assert held.gaussians.sigma_d is not None and held.calibration is not None
    assert output["bytes"] == (tmp_path / "page.html").stat().st_size
    assert [path.name for path in tmp_path.glob(".tmp-*")] == []


def test_page_has_the_cameras_of_the_scene(clod: Any, dialled: Path, capture: Any, tmp_path: Path) -> None:
    done = clod("export", dialled, "-o", "page.html", "--images", capture.scene, "--sv", 2)
    assert done.code == 0 and "Gaussians, initial dial value s = 2" in done.out and " of " not in done.out
    (config,) = re.findall('id="clod-config">(.*?)</script>', (tmp_path / "page.html").read_text(encoding="utf-8"))
    names = [camera["name"] for camera in json.loads(config)["cameras"]]
    assert names == sorted(path.name for path in (capture.scene / "images").iterdir())


@pytest.mark.parametrize("exact", [False, True])
def test_pages_do_not_depend_on_installed_tools(
    clod: Any, dialled: Path, tmp_path: Path, monkeypatch: Any, exact: bool
) -> None:
    """The same bytes where no splat-transform can be found; of rounded values, the PSNR is printed."""
    options = ["--exact"] if exact else []
    done = clod("export", dialled, "-o", "with.html", *options, "--json")
    monkeypatch.setenv(VARIABLE, "there-is-none")
    assert clod("export", dialled, "-o", "without.html", *options).code == 0
    assert (tmp_path / "with.html").read_bytes() == (tmp_path / "without.html").read_bytes()
    found = re.findall(r"a PSNR of (\d+\.\d) dB against the exact file \(\d+ views, s = 1\); --exact", done.err)
    assert [40 < float(each) < 80 for each in found] == [True] * (not exact), done
    assert bool(found) == any("PSNR" in note for note in json.loads(done.out)["notes"])


def test_exact_is_for_pages(clod: Any, dialled: Path) -> None:
    done = clod("export", dialled, "-o", "x.ply", "--sv", 2, "--exact")
    assert done.code == 2 and "--exact is for .html pages" in done.err, done
