"""The text and the JSON of ``clod-adapt inspect``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def test_text_of_a_plain_file_fits_on_a_screen(clod: Any, capture: Any) -> None:
    done = clod("inspect", capture.ply)
    lines = done.out.splitlines()
    assert done.code == 0 and done.err == "" and len(lines) <= 24 and all(len(line) <= 120 for line in lines[1:])
    assert lines[0].startswith(f"{capture.ply} (") and lines[2].startswith("looks like   Inria's trainer")
    assert lines[3] == "Gaussians    300" and "dial         none: no sigma_d" in lines
    at = next(k for k, line in enumerate(lines) if line.split() == ["least", "1", "%", "median", "99", "%", "greatest"])
    assert [line.split()[0] for line in lines[at + 1 : at + 6]] == ["x", "y", "z", "scale", "opacity"]
    assert len({len(line) for line in lines[at : at + 6]}) == 1


def test_text_of_a_dial_and_its_calibration(clod: Any, dialled: Path) -> None:
    done = clod("inspect", dialled)
    assert done.code == 0 and "written by   clod-adapter" in done.out and "s = 1 to 4, soft culling" in done.out
    lines = done.out.splitlines()
    at = next(k for k, line in enumerate(lines) if "Gaussians" in line and "PSNR" in line)
    table = [line.split() for line in lines[at + 1 : at + 8]]
    assert [row[0] for row in (table[0], table[-1])] == ["1", "4"] and len(lines) <= 32
    assert all(len(row) == 5 for row in table)


def test_text_of_file_metadata(clod: Any, dialled: Path, tmp_path: Path) -> None:
    assert clod("export", dialled, "--sv", 2, "-o", tmp_path / "baked.ply").code == 0
    out = clod("inspect", tmp_path / "baked.ply").out
    assert "\nsays         baked at s = 2 by clod-adapter for 8 training cameras\n" in out
    text = (tmp_path / "baked.ply").read_bytes().replace(b"comment baked", b"comment " + 400 * b"long " + b"baked", 1)
    (tmp_path / "baked.ply").write_bytes(text)
    _, *lines = clod("inspect", tmp_path / "baked.ply").out.splitlines()  # the first has the path
    assert max(map(len, lines)) < 120


def test_json_of_a_dial(clod: Any, dialled: Path) -> None:
    done = clod("inspect", dialled, "--json")
    report = json.loads(done.out)
    assert done.code == 0 and done.err == "" and report["command"] == "inspect" and report["path"] == str(dialled)
    splat = report["splat"]
    assert splat["count"] == splat["total"] == 300 and splat["columns"][-1] == ["growth_d", "float32"]
    assert splat["dial"]["attenuation"]["max_sv"] == 4 and splat["dial"]["calibration"]["rows"][0]["virtual_scale"] == 1
    assert len(splat["position"]) == 3
    assert {"least", "low", "median", "high", "greatest"} == set(splat["sigma"]) == set(splat["growth"])
    told = json.loads(dialled.with_suffix(".json").read_text())
    assert splat["dial"]["calibration"] == told["calibration"]


def test_adapter(clod: Any, dialled: Path) -> None:
    done = clod("inspect", dialled.with_suffix(".safetensors"))
    assert done.code == 0 and "an adapter" in done.out and "with SHA-256 " in done.out and "max_sv 4" in done.out
    report = json.loads(clod("inspect", dialled.with_suffix(".safetensors"), "--json").out)
    assert len(report["about"]["growth"]) == 5 and "\ngrowth_d " in done.out
    assert "\ndial         sigma_d and growth_d, s = 1 to 4" in done.out
    assert report["about"]["count"] == 300 and report["splat"] is None and report["about"]["config"]["iters"] == 12
