"""``--antialiasing``: stored, detected or requested; used for training, measuring and export."""

from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import clod_adapter
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.view import make_page
from clod_adapter.config import FILTERS
from clod_adapter.io.scene.load import load_scene
from runs import rebuilt

FAST = "--iters 3 --max-sv 4 --out dial.ply --json"


@pytest.fixture(scope="module")
def trained(capture: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A checkpoint of small Gaussians without metadata on antialiasing, and antialiased photographs."""
    folder = tmp_path_factory.mktemp("antialiased")
    small = capture.gaussians.replace(log_scales=capture.gaussians.log_scales - 0.8)
    scene, shown = folder / "scene", small.replace(screen_filter=FILTERS["on"])
    (scene / "images").mkdir(parents=True)
    (scene / "sparse").symlink_to(capture.scene / "sparse")
    seen = load_scene(capture.scene)
    for view in (*seen.train, *seen.test):
        pixels = clod_adapter.render(shown, view.camera).pixels.numpy()
        Image.fromarray(pixels).save(scene / "images" / view.camera.name)
    return capture.write(folder / "base.ply", small), scene


def test_adapting_detects_and_stores_the_filter(clod: Any, trained: tuple[Path, Path], tmp_path: Path) -> None:
    """The viewer draws the base with the filter of the model, without photographs and metadata in the base's file."""
    ply, scene = trained
    report = (done := clod(ply, "--images", scene, FAST)).report
    assert "trained with antialiasing: " in done.err and "--antialiasing off overrides" in done.err
    (note,) = [note for note in report["notes"] if "antialiasing" in note]
    assert note in done.err and report["screen_filter"] == {"variance": 0.3, "compensate": True}
    assert report["base_rows"][0]["psnr"] > 45  # the photographs are its renders, rounded to bytes
    found = clod_adapter.load("dial.ply")
    assert found.gaussians.screen_filter == FILTERS["on"] and found.filter_known
    assert clod_adapter.load_adapter("dial.safetensors").screen_filter == FILTERS["on"] and rebuilt(clod, ply)
    for more, want in ((), FILTERS["on"]), (("--antialiasing", "off"), FILTERS["off"]):
        words = ["dial.ply", "--base", str(ply), *more]
        answers, _ = make_page(build_parser("view").parse_args(words), Console(quiet=True))
        for name in ("model", "base"):
            (tmp_path / "served.ply").write_bytes(b"".join(answers[f"/files/{name}"].blocks()))
            assert clod_adapter.load(tmp_path / "served.ply").gaussians.screen_filter == want


def test_eval_and_render_use_the_detected_filter(clod: Any, trained: tuple[Path, Path]) -> None:
    ply, scene = trained
    found = {}
    for more in ("", "--antialiasing off"):
        words = (ply, "--images", scene, "--json", more)
        report = clod("eval", *words, "--sv 1 --against", ply, "--base", ply).report
        drawn = clod("render", *words, "-o pictures").report
        psnr = [report["rows"][0]["psnr"], report["base_row"]["psnr"], report["against"][0]["theirs"]["psnr"]]
        found[more] = [*psnr, drawn["pictures"][0]["psnr"][0]]
        for each in (report, drawn):
            assert any("was trained with antialiasing" in note for note in each["notes"]) == (more == ""), each["notes"]
    assert min(found[""]) > 45 > 35 > max(found["--antialiasing off"]), found


def test_option_overrides_the_file(clod: Any, trained: tuple[Path, Path]) -> None:
    """The result of adapting stores the filter of the option; a note names an override of it."""
    ply, scene = trained
    assert "by the photographs" not in clod(ply, "--images", scene, FAST, "--antialiasing mip").err
    told = clod("eval dial.ply --images", scene, "--sv 1 --json --antialiasing off")
    (note,) = [note for note in told.report["notes"] if "(--antialiasing)" in note]
    assert "the file has 0.1 px^2 of blur, opacities compensated" in note and note in told.err


def test_exports_store_the_filter_or_note_its_loss(clod: Any, trained: tuple[Path, Path]) -> None:
    for out, stores, notes in (("a.ply", True, True), ("a.spz", True, False), ("a.splat", False, True)):
        done = clod("export", trained[0], "--antialiasing on --json -o", out)
        found = [note for note in done.report["notes"] if "trained antialiased" in note]
        assert bool(found) == notes and all(note in done.err for note in found), done
        assert not stores or clod_adapter.load(out).gaussians.screen_filter == FILTERS["on"]
