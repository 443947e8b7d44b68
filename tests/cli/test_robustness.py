"""``clod-adapt robustness``: outputs, resuming, interrupts, progress."""

from __future__ import annotations

import csv
import json
import re
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import clod_adapter
from clod_adapter.cli import robustness as command
from clod_adapter.evaluation.robustness import BASELINE_SHARES
from runs import pressing

pytest.importorskip("matplotlib")
OUTPUTS = ["robustness.csv", "robustness.json", "robustness.png"]


@pytest.fixture
def run(clod: Any, capture: Any, tmp_path: Path) -> Callable[..., Any]:
    """Runs the command on two checkpoints, the second without the faintest Gaussians."""
    few = capture.gaussians.select(capture.gaussians.opacities > 0.5)
    paths = (capture.write(tmp_path / "plain.ply", capture.gaussians), capture.write(tmp_path / "masked.ply", few))

    def start(*words: object) -> Any:
        return clod("robustness", *paths, "--images", capture.scene, "--max-sv", 3, 1, "--iters", 6, *words)

    return start


def stamps(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in (folder / "cells").iterdir()}


def at(cell: dict[str, Any], virtual_scale: float) -> dict[str, Any]:
    """The cell's row at a dial value."""
    (row,) = [row for row in cell["rows"] if row["virtual_scale"] == virtual_scale]
    return row  # type: ignore[no-any-return]


def test_outputs_of_all_cells(run: Any, clod: Any, tmp_path: Path) -> None:
    done = run("--json")
    assert done.code == 0, done
    folder = tmp_path / "robustness"
    assert sorted(p.name for p in folder.iterdir()) == ["cells", *OUTPUTS]
    report = json.loads(done.out)
    assert report == json.loads((folder / "robustness.json").read_text())
    cells = [(cell["checkpoint"], cell["max_sv"]) for cell in report["cells"]]
    assert cells == [(name, max_sv) for name in ("plain", "masked") for max_sv in (None, 1, 3)]
    assert report["missing"] == [] and not report["interrupted"]
    for cell in report["cells"]:
        dials = [row["virtual_scale"] for row in cell["rows"]]
        assert dials == ([1.0] * len(BASELINE_SHARES) if cell["max_sv"] is None else [1, 1.5, 2, 3])
        assert ("log10_sigma_d" in cell["distribution"]) == (cell["max_sv"] is not None)
    with open(folder / "robustness.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * (len(BASELINE_SHARES) + 8)
    (row,) = [r for r in rows if (r["checkpoint"], r["max_sv"], r["virtual_scale"]) == ("masked", "1.0", "2.0")]
    assert float(row["psnr"]) == at(report["cells"][4], 2)["psnr"] and row["within_range"] == "False"
    assert Image.open(folder / "robustness.png").size[0] > 2000
    # The adapter of a cell gives the measured model.
    assert clod("apply", "plain.ply", "robustness/cells/plain_sv3.safetensors", "-o", "x.ply").code == 0
    scene = clod_adapter.load_scene(report["scene"])
    (again,) = clod_adapter.evaluate(clod_adapter.load("x.ply").gaussians, scene.test, [3.0])
    assert again.psnr == at(report["cells"][2], 3)["psnr"]


@pytest.mark.usefixtures("blank_figure")
def test_unfinished_and_changed_cells_are_run_again(run: Any, tmp_path: Path) -> None:
    first = run()
    assert first.code == 0 and "done already" not in first.err, first
    folder = tmp_path / "robustness"
    before = stamps(folder)
    assert len(before) == 10
    (folder / "cells" / "masked_sv1.safetensors").unlink()
    (folder / "robustness.png").unlink()
    again = run()
    assert again.code == 0 and "5 of 6 cells are done already" in again.err
    changed = {name for name, stamp in stamps(folder).items() if stamp != before.get(name)}
    assert changed == {"masked_sv1.safetensors", "masked_sv1.json"} and (folder / "robustness.png").exists()
    other = run("--seed", 1)  # baselines do not depend on the seed
    assert "2 of 6 cells are done already: plain_base, masked_base" in other.err
    before = stamps(folder)
    Path("masked.ply").write_bytes(Path("plain.ply").read_bytes())
    assert "3 of 6 cells are done already: plain_base, plain_sv1, plain_sv3" in run("--seed", 1).err
    assert {name for name, stamp in stamps(folder).items() if stamp != before[name]} == {
        f"masked_{what}" for what in ("base.json", "sv1.json", "sv1.safetensors", "sv3.json", "sv3.safetensors")
    }


@pytest.mark.usefixtures("blank_figure")
def test_interrupt_keeps_finished_cells(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, real = [], pressing(command.adapt_at_range, signal.SIGINT, at=2)
    monkeypatch.setattr(command, "adapt_at_range", lambda *a, **options: calls.append(a) or real(*a, **options))
    done = run("--json")
    report, folder = json.loads(done.out), tmp_path / "robustness"
    assert done.code == 0 and report["interrupted"] and "plain_sv3 was not finished" in done.err
    assert [cell["max_sv"] for cell in report["cells"]] == [None, 1]
    assert report["missing"] == ["plain_sv3", "masked_base", "masked_sv1", "masked_sv3"]
    assert all((folder / name).exists() for name in OUTPUTS)
    finished = json.loads(run("--json").out)
    assert finished["missing"] == [] and finished["cells"][:2] == report["cells"] and len(calls) == 5


def test_interrupt_of_the_first_cell_writes_nothing(run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, real = [], command.scene_fingerprint
    monkeypatch.setattr(command, "scene_fingerprint", lambda scene: calls.append(scene) or real(scene))
    monkeypatch.setattr(command, "baseline", pressing(command.baseline, signal.SIGINT))
    assert run().code == 130 and len(calls) == 1
    assert not (tmp_path / "robustness").exists()


@pytest.mark.usefixtures("blank_figure")
def test_progress_is_over_all_cells(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clod_adapter.cli.shared.console.LINE_EVERY", 0)
    done = run()
    lines = re.findall(r"^robustness +(\d+)%, .* left, (\w+) \((\d)/6\)", done.err, re.M)
    shares = [int(share) for share, *_ in lines]
    assert shares == sorted(shares) and shares[-1] == 100 and len(set(shares)) > 20
    assert list(dict.fromkeys(k for *_, k in lines)) == list("123456")
    assert run("--quiet", "--out", "other").err == ""


def test_unreadable_inputs_or_missing_matplotlib_make_no_folder(
    clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(capture.scene, scene)
    (scene / "images" / "003.png").write_text("no picture")
    done = clod("robustness", capture.ply, "--images", scene, "--iters", 1)
    assert done.code == 2 and "003.png" in done.err, done
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    done = clod("robustness", capture.ply, "--images", capture.scene)
    assert done.code == 2 and "pip install matplotlib" in done.err
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
