"""``clod-adapt export -o page.html``."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import pytest

import clod_adapter


@pytest.mark.usefixtures("without_splat_transform")
@pytest.mark.parametrize("sv", [None, 2, 9])
def test_page_holds_the_splat_and_its_dial(clod: Any, dialled: Path, tmp_path: Path, sv: int | None) -> None:
    done = clod("export", dialled, "-o", "page.html", *(["--sv", sv] if sv else []), "--json")
    assert done.code == 0 and "there-is-none" in done.err and "exact" not in done.err, done
    report = json.loads(done.out)
    (output,) = report["outputs"]
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    (config,) = re.findall('id="clod-config">(.*?)</script>', text)
    model = json.loads(config)["model"]
    assert json.loads(config)["virtual_scale"] == min(sv or 1, 4)
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
