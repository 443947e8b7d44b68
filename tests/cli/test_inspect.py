"""The text and the JSON of ``clod-adapt inspect``."""

import json
from pathlib import Path
from typing import Any


def test_a_plain_file_fits_on_a_screen(clod: Any, capture: Any) -> None:
    done = clod("inspect BASE")
    lines = done.out.splitlines()
    assert len(lines) <= 24 and all(len(line) <= 120 for line in lines[1:]) and done.err == ""
    assert lines[0].startswith(f"{capture.ply} (") and lines[2].startswith("looks like   Inria's trainer")
    assert lines[3] == "Gaussians    300" and "dial         none: no sigma_d" in lines
    at = next(k for k, line in enumerate(lines) if line.split() == ["least", "1", "%", "median", "99", "%", "greatest"])
    assert [line.split()[0] for line in lines[at + 1 : at + 6]] == ["x", "y", "z", "scale", "opacity"]
    assert len({len(line) for line in lines[at : at + 6]}) == 1


def test_a_dial_and_its_calibration(clod: Any, dialled: Path) -> None:
    text, report = clod("inspect DIAL").out, clod("inspect DIAL --json").report
    lines = text.splitlines()
    assert "written by   clod-adapter" in text and "s = 1 to 4, soft culling" in text and len(lines) <= 32
    at = next(k for k, line in enumerate(lines) if "Gaussians" in line and "PSNR" in line)
    table = [line.split() for line in lines[at + 1 : at + 8]]
    assert [row[0] for row in (table[0], table[-1])] == ["1", "4"] and all(len(row) == 5 for row in table)
    splat = report["splat"]
    assert report["command"] == "inspect" and report["path"] == str(dialled)
    assert splat["count"] == splat["total"] == 300 and splat["columns"][-1] == ["growth_d", "float32"]
    assert {"least", "low", "median", "high", "greatest"} == set(splat["sigma"]) == set(splat["growth"])
    assert splat["dial"]["attenuation"]["max_sv"] == 4 and len(splat["position"]) == 3
    told = json.loads(dialled.with_suffix(".json").read_text())
    assert splat["dial"]["calibration"] == told["calibration"]
    clod("export DIAL --sv 2 -o baked.ply")
    says = "\nsays         baked at s = 2 by clod-adapter for 8 training cameras\n"
    assert says in clod("inspect baked.ply").out


def test_adapter(clod: Any) -> None:
    text, report = clod("inspect ADAPTER").out, clod("inspect ADAPTER --json").report
    assert "an adapter" in text and "with SHA-256 " in text and "max_sv 4" in text and "\ngrowth_d " in text
    assert "\ndial         sigma_d and growth_d, s = 1 to 4" in text and len(report["about"]["growth"]) == 5
    assert report["about"]["updates"]["means"] == "float16 [300, 3]"
    assert report["about"]["count"] == 300 and report["splat"] is None and report["about"]["config"]["iters"] == 12
