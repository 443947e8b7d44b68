"""Errors during and after training: the state is saved, and the message names the step that --resume starts from."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from clod_adapter.cli.adapt import run as adapt_run
from clod_adapter.cli.shared import pages
from clod_adapter.errors import ClodError
from runs import OUTPUTS, STATE, change_step, fail, names
from scenes import stripped

ITERS = 12
BOTH = sorted([*OUTPUTS, STATE])


def full(*_: Any, **__: Any) -> None:
    raise ClodError("dial.ply: cannot be written")


def spoil(found: Any) -> Any:
    return replace(found, loss=math.nan)


Break = Callable[[pytest.MonkeyPatch], None]
ROWS: list[tuple[Break, int, int, list[str]]] = [  # what breaks, exit code, the step that is saved, files
    (lambda patch: change_step(patch, 6, fail), 1, 5, [STATE]),
    (lambda patch: change_step(patch, 6, spoil), 1, 5, BOTH),
    (lambda patch: patch.setattr(adapt_run, "save", full), 2, ITERS, [STATE]),
]


@pytest.mark.parametrize(("broken", "code", "step", "files"), ROWS, ids=["step", "loss", "full disk"])
def test_resuming_after_an_error(
    clod: Any, capture: Any, dialled: Path, tmp_path: Path, broken: Break, code: int, step: int, files: list[str]
) -> None:
    """The same command with --resume then writes the files of a run without an error."""
    words = [capture.ply, "--images", capture.scene, "--iters", ITERS, "--max-sv", 4, "--out", "dial.ply"]
    with pytest.MonkeyPatch.context() as patch:
        broken(patch)
        done = clod(*words, *(["--quiet"] if STATE in files[:1] else ["--json"]))
    assert done.code == code and names(tmp_path) == files, done
    assert f"--resume resumes from step {step}, which is in {STATE}\n" in done.err
    assert ("please report it" in done.err) == ("ZeroDivisionError: of ours" in done.err)
    if files == BOTH:
        report = json.loads(done.out)
        assert report["interrupted"] and report["steps"] == 5 and len(report["rows"]) > 2
        assert any("the result so far is written: the loss of step 6 is not finite" in n for n in report["notes"])
    done = clod(*words, "--resume")
    assert done.code == 0 and f"resuming {STATE} from step {step}" in done.err, done
    assert names(tmp_path) == OUTPUTS
    for suffix in (".ply", ".safetensors"):
        assert stripped((tmp_path / f"dial{suffix}").read_bytes()) == stripped(dialled.with_suffix(suffix).read_bytes())


def test_error_in_the_page(clod: Any, capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All other files are written, and no state remains; gradients that are not finite move nothing."""

    def without_a_gradient(found: Any) -> Any:
        found.gradients["quats"][5] = math.nan
        return found

    change_step(monkeypatch, 6, without_a_gradient)
    monkeypatch.setattr(pages.AdaptPage, "write", fail)
    done = clod(capture.ply, "--images", capture.scene, "--iters", ITERS, "--out", "dial.ply", "--report")
    assert done.code == 1 and names(tmp_path) == OUTPUTS and "--resume" not in done.err, done
    assert "1 Gaussians were not moved by some steps: their gradients" in done.err, done
