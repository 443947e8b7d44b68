"""The lines that commands print fit 80 columns: all of them on a terminal; in a pipe progress, plan and tables."""

from __future__ import annotations

import io
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from clod_adapter.cli.main import main
from clod_adapter.cli.shared.console import Meter
from clod_adapter.cli.shared.measure import popping_table, rows_table
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.evaluation.popping import Popping

ADAPT = "base.ply --images scene --iters 12 --max-sv 4 --out dial.ply --report --trim --without quats"
COMMANDS = (
    "inspect dial.ply", "inspect dial.safetensors", "inspect base.ply",
    "eval dial.ply --images scene --sv 1 3 --popping --base base.ply --against base.ply with_a_rather_long_name.ply",
    "render dial.ply --images scene --sv 1 3 --out pictures", "apply base.ply dial.safetensors -o again.ply",
    "export dial.ply --sv 2 -o baked.ply", "export dial.ply --keep 100 --images scene -o baked.glb",
    "robustness base.ply with_a_rather_long_name.ply --images scene --max-sv 1 2 --iters 2 --out ranges",
    "export dial.ply -o dial.splat", "eval missing.ply --images scene", "doctor",
)  # fmt: skip


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def folder(capture: Any, dialled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blank_figure: Any) -> Path:
    """Inputs of short names in the current folder, progress at every step, and a first measurement at once."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(capture.scene, "scene")
    shutil.copyfile(capture.ply, "base.ply")
    for suffix in (".ply", ".safetensors"):
        shutil.copyfile(dialled.with_suffix(suffix), f"dial{suffix}")
    shutil.copyfile(dialled, "with_a_rather_long_name.ply")
    monkeypatch.setattr("clod_adapter.cli.shared.console.LINE_EVERY", 0)
    monkeypatch.setattr("clod_adapter.cli.adapt.display.CHECK_EVERY", 0)
    monkeypatch.setattr("clod_adapter.cli.adapt.display.CHECK_COST", 1e9)
    return tmp_path


def run(words: str) -> None:
    main(words.split())


@pytest.mark.usefixtures("folder", "without_splat_transform")
def test_every_line_fits_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tqdm.std._screen_shape_wrapper", lambda: lambda file: (80, 24))
    made = Meter.__post_init__

    def eager(self: Meter) -> None:
        made(self)
        if self.bar is not None:
            self.bar.delay = self.bar.mininterval = 0

    monkeypatch.setattr(Meter, "__post_init__", eager)
    for words in (ADAPT, *COMMANDS):
        for name in ("stdout", "stderr"):
            monkeypatch.setattr(sys, name, Terminal())
        run(words)
        written = f"{sys.stdout.getvalue()}\n{sys.stderr.getvalue()}"
        lines = re.split(r"[\r\n]", re.sub(r"\x1b\[[A-Z]", "", written))
        assert len(lines) > 2, words
        assert not (wide := [line for line in lines if len(line) > 80]), f"{words}: {wide}"
        if words is ADAPT:
            bars = [line for line in lines if line.startswith("training") and "the base at s=1" in line]
            assert bars and all(re.search(r"%\|.{15,}\| .+ left, \d+\.\d\d dB (below|above) the", b) for b in bars)


@pytest.mark.usefixtures("folder", "without_splat_transform")
def test_progress_plan_and_tables_fit_in_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (ADAPT, *COMMANDS):
        if words.startswith("doctor"):
            continue  # its lines hold commands to copy
        run(words)
        out, err = capsys.readouterr()
        progress = [line for line in err.splitlines() if re.search(r" left(,|$)", line)]
        shown = progress if words.startswith("inspect") else [*progress, *out.splitlines()]
        shown += re.findall(r"^plan:.*|^  \S.*(?:kept|left out|frozen|trimmed).*|^  does not apply.*", err, re.M)
        notes = ("exact at", "baked for")
        wide = [line for line in shown if len(line) > 80 and not line.startswith(notes)]
        assert not wide, f"{words}: {wide}"
        if words is ADAPT:
            assert len(progress) > 12 and sum("dB" in line for line in progress) >= 6, err


def test_tables_fit_with_every_column() -> None:
    row = Row(28.5, 100.0, 0.98765, 12_345_678, 1.0, 1_234_567, 12345.6)
    table = rows_table([("s=28.5", row), ("base", row)])
    assert len({len(line) for line in table.splitlines()}) == 1 and len(table.splitlines()[0]) <= 80
    popping = Popping(200, 12.3456, 123.4567, 12.34, 123.4, 0.5, 123.4, 12.3, 0.5, ())
    shown = popping_table([("camera, a_photograph_of_a_long_name.png to another.png, s = 7", popping)])
    assert max(map(len, shown.splitlines())) <= 80
