"""``--antialiasing``: believed, found out or told; tuned, measured, stored and passed on so."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import clod_adapter
from clod_adapter.cli.adapt.resume import _fingerprint
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.view import make_page
from clod_adapter.config import CLASSIC, FILTERS
from clod_adapter.io.scene.load import load_scene

FAST = ("--iters", 3, "--max-sv", 4, "--out", "dial.ply", "--json")


@pytest.fixture(scope="session")
def trained(capture: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A checkpoint of small Gaussians that does not say it was trained antialiased, and photographs that do."""
    folder = tmp_path_factory.mktemp("antialiased")
    small = capture.gaussians.replace(log_scales=capture.gaussians.log_scales - 1.2)
    scene, shown = folder / "scene", small.replace(screen_filter=FILTERS["on"])
    (scene / "images").mkdir(parents=True)
    (scene / "sparse").symlink_to(capture.scene / "sparse")
    seen = load_scene(capture.scene)
    for view in (*seen.train, *seen.test):
        Image.fromarray(clod_adapter.render(shown, view.camera).pixels.numpy()).save(
            scene / "images" / view.camera.name
        )
    return capture.write(folder / "base.ply", small), scene


def test_found_out_tuned_and_stored(clod: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
    ply, scene = trained
    done = clod(ply, "--images", scene, *FAST)
    assert done.code == 0 and "trained with antialiasing: " in done.err and "--antialiasing off overrides" in done.err
    report = json.loads(done.out)
    (note,) = [note for note in report["notes"] if "antialiasing" in note]
    assert note in done.err and report["screen_filter"] == {"variance": 0.3, "compensate": True}
    assert report["base_rows"][0]["psnr"] > 45  # but for the rounding to bytes it is what the photographs are of
    found = clod_adapter.load(tmp_path / "dial.ply")
    assert found.gaussians.screen_filter == FILTERS["on"] and found.filter_known
    assert clod_adapter.load_adapter(tmp_path / "dial.safetensors").screen_filter == FILTERS["on"]
    assert clod("apply", ply, tmp_path / "dial.safetensors", "-o", tmp_path / "again.ply").code == 0
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


def test_measured_and_rendered_with_what_is_found_out(clod: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
    ply, scene = trained
    for command in (("eval", ply, "--sv", 1), ("render", ply, "-o", tmp_path / "pictures")):
        own = json.loads(clod(*command, "--images", scene, "--json").out)
        off = json.loads(clod(*command, "--images", scene, "--json", "--antialiasing", "off").out)
        if command[0] == "eval":
            assert own["rows"][0]["psnr"] > 45 > 35 > off["rows"][0]["psnr"]
        else:
            assert own["pictures"][0]["psnr"][0] > 45 > 35 > off["pictures"][0]["psnr"][0]
        assert any("trained with antialiasing" in note for note in own["notes"])
        assert not any("ntialias" in note for note in off["notes"])
    done = clod("eval", ply, "--sv", 1, "--images", scene, "--json", "--against", ply, "--base", ply)
    report = json.loads(done.out)
    assert report["base_row"]["psnr"] > 45 and report["against"][0]["theirs"]["psnr"] > 45


def test_settings_of_the_option_and_of_the_file(clod: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
    """``--antialiasing`` decides how a file is adapted; its result stores that, and an override of it is noted."""
    ply, scene = trained
    done = clod(ply, "--images", scene, *FAST, "--antialiasing", "mip")
    assert done.code == 0 and "by the photographs" not in done.err, done
    assert clod_adapter.load(tmp_path / "dial.ply").gaussians.screen_filter == FILTERS["mip"]
    quiet = clod("eval", "dial.ply", "--images", scene, "--sv", 1, "--json")
    assert "0.1 px^2 of blur" in quiet.err and "by the photographs" not in quiet.err
    told = clod("eval", "dial.ply", "--images", scene, "--sv", 1, "--json", "--antialiasing", "off")
    (note,) = [note for note in json.loads(told.out)["notes"] if "(--antialiasing)" in note]
    assert "the file has 0.1 px^2 of blur, opacities compensated" in note and note in told.err
    done = clod("inspect", "dial.ply")
    assert "trained with antialiasing: 0.1 px^2 of blur, opacities compensated" in done.out + done.err
    assert json.loads(clod("inspect", "dial.ply", "--json").out)["splat"]["screen_filter"]["variance"] == 0.1


def test_what_a_run_is_resumed_by_depends_on_the_filter(trained: tuple[Path, Path]) -> None:
    some = clod_adapter.load(trained[0]).gaussians
    assert len({_fingerprint(some.replace(screen_filter=each)) for each in FILTERS.values()}) == len(FILTERS)


@pytest.mark.usefixtures("blank_figure")
def test_robustness_finds_out_for_each(clod: Any, capture: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
    ply, scene = trained
    words = ("robustness", ply, "--images", scene, "--max-sv", 1, "--iters", 2, "-o", tmp_path / "rob", "--json")
    done = clod(*words)
    report = json.loads(done.out)
    assert done.code == 0 and "trained with antialiasing" in done.err
    assert max(row["psnr"] for row in report["cells"][0]["rows"]) > 45
    again = clod(*words)
    assert "2 of 2 cells are done already" in again.err
    other = clod(*words, "--antialiasing", "off")
    assert "cells are done already" not in other.err
    assert max(row["psnr"] for row in json.loads(other.out)["cells"][0]["rows"]) < 35


@pytest.mark.usefixtures("without_splat_transform")
@pytest.mark.parametrize("out", ["a.ply", "a.spz", "a.html", "a.splat"])
def test_exports_carry_it_or_say_that_they_do_not(clod: Any, trained: tuple[Path, Path], out: str) -> None:
    done = clod("export", trained[0], "-o", out, "--antialiasing", "on", "--json")
    notes = [note for note in json.loads(done.out)["notes"] if "antialias" in note]
    assert len(notes) == (out in ("a.ply", "a.splat"))
    assert all("most readers need an option" in note and note in done.err for note in notes)
    if out in ("a.ply", "a.spz"):
        assert clod_adapter.load(out).gaussians.screen_filter == FILTERS["on"]
    done = clod("export", trained[0], "-o", out, "--json")
    assert not [note for note in json.loads(done.out)["notes"] if "antialias" in note]
    if out in ("a.ply", "a.spz"):
        assert clod_adapter.load(out).gaussians.screen_filter == CLASSIC


def test_the_base_beside_a_model_is_drawn_alike(clod: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
    """Without photographs, and although its own file does not say."""
    assert clod(trained[0], "--images", trained[1], *FAST).code == 0
    words = ["dial.ply", "--base", str(trained[0])]
    for more, want in ((), FILTERS["on"]), (("--antialiasing", "off"), FILTERS["off"]):
        answers, _ = make_page(build_parser("view").parse_args([*words, *more]), Console(quiet=True))
        page = b"".join(answers["/"].blocks()).decode()
        found = re.findall(r'"screen_filter": ?({[^}]*})', page)
        assert [json.loads(each) for each in found] == [asdict(want)] * 2
