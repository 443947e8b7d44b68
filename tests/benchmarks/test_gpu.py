"""The GPU benchmark runs on the CPU at a small size."""

import json
import sys
from pathlib import Path

import gpu as script
import pytest


def test_plush_and_city_small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    out = tmp_path / "gpu.jsonl"
    words = "gpu.py --device cpu --small --only plush city --count 1000 --results"
    monkeypatch.setattr(sys, "argv", [*words.split(), str(out)])
    script.main()
    plush, adapted, *frames = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    assert (plush["benchmark"], plush["on"], plush["count"]) == ("gpu plush", "cpu", 1000)
    assert plush["train_seconds"] > 0 and adapted["peak_bytes"] > adapted["base_bytes"] > 0
    assert [(r["where"], r["virtual_scale"]) for r in frames] == [(w, s) for w in ("near", "far") for s in (1, 3, 7)]
    assert all(min(row["ms"].values()) > 0 for row in frames)
    assert frames[0]["kept"] > frames[1]["kept"] and frames[0]["psnr_full"] > frames[1]["psnr_full"]


def test_without_a_gpu_the_script_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script.torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    with pytest.raises(SystemExit, match="--device cpu --small"):
        script.main()
