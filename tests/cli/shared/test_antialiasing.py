"""``--antialiasing``: stored, detected or requested; used for training, measuring and export."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import clod_adapter
from clod_adapter.cli.adapt.listeners import fingerprint
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.view import make_page
from clod_adapter.config import CLASSIC, FILTERS
from clod_adapter.io.scene.load import load_scene

FAST = ("--iters", 3, "--max-sv", 4, "--out", "dial.ply", "--json")


@pytest.fixture(scope="session")
def trained(capture: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A checkpoint of small Gaussians without metadata on antialiasing, and antialiased photographs."""
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


def test_adapting_detects_and_stores_the_filter(clod: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
    ply, scene = trained
    done = clod(ply, "--images", scene, *FAST)
    assert done.code == 0 and "trained with antialiasing: " in done.err and "--antialiasing off overrides" in done.err
    report = json.loads(done.out)
    (note,) = [note for note in report["notes"] if "antialiasing" in note]
    assert note in done.err and report["screen_filter"] == {"variance": 0.3, "compensate": True}
    assert report["base_rows"][0]["psnr"] > 45  # the photographs are its renders, rounded to bytes
    found = clod_adapter.load(tmp_path / "dial.ply")
    assert found.gaussians.screen_filter == FILTERS["on"] and found.filter_known
    assert clod_adapter.load_adapter(tmp_path / "dial.safetensors").screen_filter == FILTERS["on"]
    assert clod("apply", ply, tmp_path / "dial.safetensors", "-o", tmp_path / "again.ply").code == 0
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()


def test_eval_and_render_use_the_detected_filter(clod: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
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


def test_option_overrides_the_file(clod: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
    """The result of adapting stores the filter of the option; a note names an override of it."""
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


def test_key_of_a_run_depends_on_the_filter(trained: tuple[Path, Path]) -> None:
    some = clod_adapter.load(trained[0]).gaussians
    assert len({fingerprint(some.replace(screen_filter=each)) for each in FILTERS.values()}) == len(FILTERS)


@pytest.mark.usefixtures("blank_figure")
def test_robustness_detects_the_filter(clod: Any, capture: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
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
def test_exports_store_the_filter_or_note_its_loss(clod: Any, trained: tuple[Path, Path], out: str) -> None:
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


def test_viewer_draws_the_base_with_the_filter_of_the_model(
    clod: Any, trained: tuple[Path, Path], tmp_path: Path
) -> None:
    """Without photographs, and without metadata in the file of the base."""
    assert clod(trained[0], "--images", trained[1], *FAST).code == 0
    words = ["dial.ply", "--base", str(trained[0])]
    for more, want in ((), FILTERS["on"]), (("--antialiasing", "off"), FILTERS["off"]):
        answers, _ = make_page(build_parser("view").parse_args([*words, *more]), Console(quiet=True))
        for name in ("model", "base"):
            (tmp_path / "served.ply").write_bytes(b"".join(answers[f"/files/{name}"].blocks()))
            assert clod_adapter.load(tmp_path / "served.ply").gaussians.screen_filter == want
