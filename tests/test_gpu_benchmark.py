"""The GPU benchmark script runs on the CPU at a small size."""

from __future__ import annotations

import importlib
import json
import math
import sys
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("gpu")


def test_plush_and_city_small(script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    out = tmp_path / "gpu.jsonl"
    words = "gpu.py --device cpu --small --only plush city --count 1000 --results"
    monkeypatch.setattr(sys, "argv", [*words.split(), str(out)])
    script.main()
    rows = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    plush, adapted, *frames = rows
    assert (plush["benchmark"], plush["on"], plush["count"]) == ("gpu plush", "cpu", 1000)
    assert [row["virtual_scale"] for row in plush["rows"]] == [1.0, 3.0, 5.0] and plush["train_seconds"] > 0
    assert adapted["what"] == "adapt" and adapted["peak_bytes"] > adapted["base_bytes"] > 0
    assert [(r["where"], r["virtual_scale"]) for r in frames] == [(w, s) for w in ("near", "far") for s in (1, 3, 7)]
    for row in frames:
        assert set(row["ms"]) == {"ours", "plain", "dial", "compact"} and min(row["ms"].values()) > 0
        assert row["faster"]["plain"] == row["ms"]["plain"] / row["ms"]["ours"]
        assert row["one_pass_differs"] == {"drawn": 0.0, "kept_by_one": 0}
        assert math.isfinite(row["psnr_truth"])
    kept = [row["kept"] for row in frames[:3]]
    fidelity = [row["psnr_full"] for row in frames[:3]]
    assert 1000 >= kept[0] > kept[1] > kept[2] and fidelity[0] > fidelity[1] > fidelity[2]


def test_outcomes_of_tests_are_counted(script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    some = tmp_path / "test_some.py"
    some.write_text(
        "import pytest\n"
        "def test_good(): pass\n"
        "def test_bad(): assert False\n"
        "def test_not_here(): pytest.skip('no CUDA device')\n"
    )
    monkeypatch.setattr(script, "TESTS", (str(some),))
    row = script.run_tests(small=False)
    assert (row["cases"], row["failed"], row["skipped"]) == (3, 1, 1)
    assert [name.rpartition("::")[2] for name in row["failures"]] == ["test_bad"]


def test_a_missing_gpu_is_an_error(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script.torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    with pytest.raises(SystemExit, match="--device cpu --small"):
        script.main()
