"""Checkpoints that do not match the photographs; ``--antialiasing``: stored, detected or
requested.
"""

import pytest
import torch
from PIL import Image

import clod_adapter
from clod_adapter import load, load_scene, render
from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.view import make_page
from clod_adapter.config import FILTERS
from models import write_model
from runs import names, rebuilt
from scenes import seeded

FAST = "--iters 3 --max-sv 4 --out dial.ply --json"


def scene_of(capture, folder, shown, count=9):
    """The first of the capture's cameras with other photographs, which ``shown`` gives as
    pixels.
    """
    scene = load_scene(capture.scene)
    views = [*scene.test, *scene.train][:count]
    write_model(folder, [view.camera for view in views], [view.camera.name for view in views])
    (folder / "images").mkdir()
    for view in views:
        Image.fromarray(shown(view).numpy()).save(folder / "images" / view.camera.name)
    return folder


@pytest.fixture
def turned(capture, tmp_path):
    """The checkpoint with y and z negated: half a turn about x; without harmonics, which would turn
    too.
    """
    g = capture.gaussians
    quats = g.quats[:, [1, 0, 3, 2]] * torch.tensor([-1.0, 1, -1, 1])
    means = g.means * torch.tensor([1.0, -1, -1])
    return capture.write(
        tmp_path / "turned.ply", g.replace(means=means, quats=quats, shN=0 * g.shN)
    )


def test_cameras_are_moved_into_another_frame_in_every_command(clod, capture, turned):
    done = clod(turned, "--images SCENE", FAST)
    said = f"the cameras are moved into the frame of {turned} (axes x, -y, -z): renders have"
    report = done.report
    assert done.err.count(said) == 1 and any(said in note for note in report["notes"])
    found = report["alignment"]
    frame = report["alignment"]["frame"]
    assert frame["psnr"] > found["mean_colour_psnr"] + 6 > found["psnr"] + 6
    # The stored viewpoints are training cameras in the file's frame, x_cameras = scale R
    # x_file + offset.
    rotation = torch.tensor(frame["rotation"])
    offset = torch.tensor(frame["offset"])
    viewpoints = report["calibration"]["viewpoints"]
    centres = torch.tensor([(view["x"], view["y"], view["z"]) for view in viewpoints])
    back = frame["scale"] * centres @ rotation.T + offset
    poses = torch.stack(
        [torch.linalg.inv(view.camera.viewmat) for view in load_scene(capture.scene).train]
    )
    assert torch.cdist(back, poses[:, :3, 3]).min(1).values.max() < 1e-3
    again = clod("eval dial.ply --images SCENE --json")
    assert "(axes x, -y, -z)" in again.err
    assert again.report["rows"][0]["psnr"] == pytest.approx(report["rows"][0]["psnr"], abs=0.01)
    assert "(axes x, -y, -z)" in clod("export dial.ply --images SCENE --sv 2 -o baked.ply").err


def test_another_scene_is_refused_and_nothing_is_written(clod, capture, turned, tmp_path):
    random = seeded(2)
    scene = scene_of(capture, tmp_path / "scene", lambda view: view.image, 2)
    means, sh0 = (torch.randn(shape, generator=random) for shape in ((300, 3), (300, 1, 3)))
    lost = capture.write(
        tmp_path / "lost.ply", capture.gaussians.replace(means=means + 1e4, sh0=sh0)
    )
    before = names(tmp_path)
    done = clod(lost, "--images", scene, FAST, code=2)
    assert f"error: {lost}: does not match {scene}" in done.err and "are in view" in done.err
    assert "--misaligned-ok" in done.err.splitlines()[-1]
    done = clod("robustness BASE", turned, "--images SCENE", FAST, code=2)
    assert f"error: {turned}: in another frame than {capture.ply}" in done.err
    assert names(tmp_path) == before


def test_white_background_is_refused_unless_allowed(clod, capture, tmp_path):
    few = capture.gaussians.select(torch.arange(300) < 40)  # so that there is a background
    ply = capture.write(tmp_path / "few.ply", few)

    def over_white(view):
        return render(few, view.camera, background=torch.ones(3)).pixels

    words = (ply, "--images", scene_of(capture, tmp_path / "white", over_white), FAST)
    done = clod(*words, code=2)
    assert "over white the renders have" in done.err and "transparent background" in done.err
    done = clod(*words, "--misaligned-ok")
    assert f"warning: {ply}: does not match" in done.err and "to train anyway" not in done.err
    notes = done.report["notes"]
    alignment = done.report["alignment"]
    assert any(note.startswith("warning: ") for note in notes) and alignment["frame"] is None


@pytest.mark.parametrize(
    "said, share", [("another exposure", 0.2), ("have a single colour each", 0)]
)
def test_other_photographs_have_a_warning(clod, capture, tmp_path, said, share):
    scene_of(capture, tmp_path / "scene", lambda view: (share * view.image).byte())
    done = clod("BASE --images scene", FAST)
    assert said in done.err and said in done.report["notes"][0]


@pytest.fixture(scope="module")
def trained(capture, tmp_path_factory):
    """A checkpoint of small Gaussians without metadata on antialiasing, and antialiased
    photographs.
    """
    folder = tmp_path_factory.mktemp("antialiased")
    small = capture.gaussians.replace(log_scales=capture.gaussians.log_scales - 0.8)
    shown = small.replace(screen_filter=FILTERS["on"])
    scene = scene_of(capture, folder / "scene", lambda view: render(shown, view.camera).pixels, 10)
    return capture.write(folder / "base.ply", small), scene


def test_adapting_detects_and_stores_the_filter(clod, trained, tmp_path):
    """The viewer draws the base with the filter of the model, without photographs and metadata in
    the base's file.
    """
    ply, scene = trained
    report = (done := clod(ply, "--images", scene, FAST)).report
    assert "trained with antialiasing: " in done.err and "--antialiasing off overrides" in done.err
    (note,) = [note for note in report["notes"] if "antialiasing" in note]
    assert note in done.err and report["screen_filter"] == {"variance": 0.3, "compensate": True}
    assert report["base_rows"][0]["psnr"] > 45  # the photographs are its renders, rounded to bytes
    found = load("dial.ply")
    assert found.gaussians.screen_filter == FILTERS["on"] and found.filter_known
    assert clod_adapter.load_adapter("dial.safetensors").screen_filter == FILTERS["on"]
    assert rebuilt(clod, ply)
    for more, want in ((), FILTERS["on"]), (("--antialiasing", "off"), FILTERS["off"]):
        words = ["dial.ply", "--base", str(ply), *more]
        answers, _ = make_page(build_parser("view").parse_args(words), Console(quiet=True))
        for name in ("model", "base"):
            (tmp_path / "served.ply").write_bytes(b"".join(answers[f"/files/{name}"].blocks()))
            assert load(tmp_path / "served.ply").gaussians.screen_filter == want


def test_eval_and_render_use_the_detected_filter(clod, trained):
    ply, scene = trained
    for more in ("", "--antialiasing off"):
        words = (ply, "--images", scene, "--json", more)
        report = clod("eval", *words, "--sv 1 --against", ply, "--base", ply).report
        drawn = clod("render", *words, "-o pictures").report
        for psnr in (
            report["rows"][0]["psnr"],
            report["base_row"]["psnr"],
            report["against"][0]["theirs"]["psnr"],
            drawn["pictures"][0]["psnr"][0],
        ):
            assert psnr < 35 if more else psnr > 45
        for notes in (report["notes"], drawn["notes"]):
            assert ("was trained with antialiasing" in str(notes)) == (more == "")


def test_option_overrides_the_file(clod, trained):
    """The result of adapting stores the filter of the option; a note names an override of it."""
    ply, scene = trained
    assert "by the photographs" not in clod(ply, "--images", scene, FAST, "--antialiasing mip").err
    told = clod("eval dial.ply --images", scene, "--sv 1 --json --antialiasing off")
    (note,) = [note for note in told.report["notes"] if "(--antialiasing)" in note]
    assert "the file has 0.1 px^2 of blur, opacities compensated" in note and note in told.err


def test_exports_store_the_filter(clod, trained):
    """A PLY with a note, as most readers need an option."""
    for out, notes in (("a.ply", 1), ("a.spz", 0)):
        done = clod("export", trained[0], "--antialiasing on --json -o", out)
        assert str(done.report["notes"]).count("trained antialiased") == notes
        assert done.err.count("trained antialiased") == notes
        assert load(out).gaussians.screen_filter == FILTERS["on"]
