"""The examples run as they stand, and the scripts of benchmarks at a small size; what these measure
with is right.
"""

import json
import re
import runpy
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from unittest.mock import MagicMock

import city
import common
import gpu
import hostile
import numpy as np
import pytest
import scaling
import torch
from PIL import Image

import clod_adapter
import gsplat_in_torch
from clod_adapter import load, load_scene, render
from clod_adapter.losses import psnr

FOLDER = Path(__file__).resolve().parents[1] / "examples"
EXAMPLES = {int(path.name[:2]): path for path in sorted(FOLDER.glob("[0-9]*.py"))}


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs an example by its number in the test's folder, with 5 steps of training; returns what it
    printed.
    """
    monkeypatch.chdir(tmp_path)
    adapt = clod_adapter.adapt
    monkeypatch.setattr(
        clod_adapter, "adapt", lambda base, scene, config: adapt(base, scene, type(config)(iters=5))
    )

    def start(number, *words):
        monkeypatch.setattr(sys, "argv", [EXAMPLES[number].name, *map(str, words)])
        runpy.run_path(str(EXAMPLES[number]), run_name="__main__")
        return capsys.readouterr().out

    return start


def test_training_and_rendering(run, capture, monkeypatch):
    """Pictures by the library, by gsplat, with torch in place of its kernels, and by a renderer of
    one's own.
    """
    gsplat_in_torch.install(monkeypatch)
    printed = run(1, capture.ply, capture.scene, "dial.ply")
    assert "dial 5:" in printed and clod_adapter.load("dial.ply").gaussians.sigma_d is not None

    def by_gsplat():
        runpy.run_path(str(EXAMPLES[3]))["main"]("dial.ply", str(capture.scene), "cpu")
        return "of 300 Gaussians"

    for draw, stem, size in (
        (lambda: run(2, "dial.ply"), "dial_sv", (320, 240)),
        (lambda: run(2, "dial.ply", capture.scene), "dial_sv", (64, 48)),
        (by_gsplat, "dial_gsplat_sv", (64, 48)),
        (lambda: run(4, "dial.ply"), "dial_dots_sv", (320, 240)),
    ):
        assert "of 300 Gaussians" in draw()
        pictures = [Image.open(f"{stem}{dial}.png") for dial in (1, 2, 3, 5)]
        assert {picture.size for picture in pictures} == {size}
        assert len({picture.tobytes() for picture in pictures}) == 4
    for dial in (1, 2, 3, 5):
        own = np.asarray(Image.open(f"dial_sv{dial}.png"), float)
        theirs = np.asarray(Image.open(f"dial_gsplat_sv{dial}.png"), float)
        assert np.abs(own - theirs).mean() < 0.1
    scene = replace(load_scene(capture.scene), test=())
    monkeypatch.setattr(clod_adapter, "load_scene", lambda folder, origin: scene)
    assert "of 300 Gaussians" in run(2, "dial.ply", capture.scene)  # without held-out views


def test_budgets(run, attenuated, capture):
    printed = run(5, attenuated, capture.scene).splitlines()
    names = "50% of,25% of,10% of,0.1 dB,0.5 dB,1 dB,10 frames,30 frames,60 frames"
    for line, name in zip(printed, names.split(","), strict=True):
        assert line.startswith(name)
    half, *drops = (
        float(line.partition("s = ")[2].split()[0]) for line in (printed[0], *printed[3:6])
    )
    assert 1 < half < 4 and [1, *drops, 4] == sorted([1, *drops, 4])
    # a tenth is less than the far end keeps, and that is said
    assert "(beyond s = 4, " in printed[2]


def test_adapter_is_applied_and_removed(run, attenuated, capture, tmp_path):
    printed = run(6, capture.ply, attenuated.with_suffix(".safetensors"), "again.ply")
    assert "changed: sigma_d, far Gaussians" in printed and f"{capture.ply}, bit for bit" in printed
    assert (tmp_path / "again.ply").read_bytes() == attenuated.read_bytes()
    brighter = capture.gaussians.replace(sh0=capture.gaussians.sh0 + 1)
    other = capture.write(tmp_path / "other.ply", brighter)
    with pytest.raises(SystemExit, match="a different base was given"):
        run(6, other, attenuated.with_suffix(".safetensors"), "other_again.ply")
    assert not (tmp_path / "other_again.ply").exists()


def test_a_loop_of_gsplat_trains_a_dial(capture, tmp_path, monkeypatch, capsys):
    """With torch in place of its kernels; in at most 20 lines more than the loop has without a
    dial.
    """
    gsplat_in_torch.install(monkeypatch)
    torch.manual_seed(0)  # the order of the views
    source = EXAMPLES[7].read_text("utf-8")
    assert 0 < len(re.findall(r"# dial\b", source)) <= 20
    runpy.run_path(str(EXAMPLES[7]))["main"](
        str(capture.ply), str(capture.scene), str(tmp_path / "d.ply"), "cpu", 24
    )
    rows = re.findall(
        r"dial \S+: (.+) dB before, (.+) dB after, (\d+)% .*target (\d+)%", capsys.readouterr().out
    )
    for before, after, kept, target in (map(float, row) for row in rows):
        assert after > before + 1 and abs(kept - target) < 15
    model = clod_adapter.load(tmp_path / "d.ply").gaussians
    assert len(rows) == 2 and model.growth_d.abs().max() > 0.05 and len(model) == 300


def test_the_slider_turns_the_dial_while_it_trains(run, capture, monkeypatch):
    """With mocks in place of viser; it is interrupted in the third step."""
    viser = MagicMock()
    monkeypatch.setitem(sys.modules, "viser", viser)
    monkeypatch.setitem(sys.modules, "viser.transforms", viser.transforms)
    moved = viser.transforms.SE3.from_rotation_and_translation.return_value.inverse.return_value
    moved.as_matrix.return_value = (
        clod_adapter.load_scene(capture.scene).train[0].camera.viewmat.numpy()
    )
    server = viser.ViserServer.return_value
    client = MagicMock(**{"camera.aspect": 4 / 3, "camera.fov": 0.9})
    server.get_clients.side_effect = [{0: client}, {0: client}, KeyboardInterrupt]
    server.gui.add_slider.return_value.value = 5.0
    run(8, capture.ply, capture.scene)
    (picture,) = client.scene.set_background_image.call_args.args
    assert picture.shape == (360, 480, 3) and picture.any()
    assert re.fullmatch(r"\d\d of 300, step 2", server.gui.add_text.return_value.value)
    written = clod_adapter.load("slider.ply").gaussians
    assert written.attenuation.max_sv == 5
    assert not torch.equal(written.means, capture.gaussians.means)


def test_bad_arguments_are_refused(run):
    for number in (1, 2, 5, 6):
        with pytest.raises(SystemExit, match=f"python examples/{EXAMPLES[number].name}"):
            run(number)
        with pytest.raises(SystemExit, match="error: (missing.ply|nowhere): .*check the path"):
            run(number, "missing.ply", "nowhere")


def test_the_readme_lists_every_example():
    listed = re.findall(r"\]\((.+?)\)", (FOLDER / "README.md").read_text("utf-8"))
    assert listed == [path.name for path in EXAMPLES.values()]
    assert list(EXAMPLES) == list(range(1, len(EXAMPLES) + 1))


def test_a_written_town_can_be_loaded_and_trained(tmp_path):
    city.write_city(tmp_path / "city", 4000, 9, 64, 40)
    base = load(tmp_path / "city" / "city.ply")
    scene = load_scene(tmp_path / "city")
    assert (len(base.gaussians), len(scene.train), len(scene.test), base.notes) == (4000, 7, 2, ())
    view = scene.train[0]
    with torch.no_grad():
        truth, quality = (
            psnr(render(gaussians, view.camera).image, view.image)
            for gaussians in (city.city(4000), base.gaussians)
        )
    assert truth > 45 > 35 > quality > 15


def test_a_table_is_markdown():
    table = common.Table(["scene", "dB"], [["plush", 29.0], ["banana", 25.8]], [], 1)
    lines = table.markdown().splitlines()
    assert lines == ["| scene | dB |", "|---|---:|", "| plush | 29.0 |", "| banana | 25.8 |"]


def test_a_process_is_timed():
    code = "import time; print('half', flush=True); x = bytes(10**8); time.sleep(0.5); print(1)"
    run = common.Process([sys.executable, "-c", code], until="half")
    assert run.line == run.out == "half\n"
    run.finish()
    assert run.seconds > 0.5 and run.cpu_seconds > 0 and run.peak_bytes > 10**8
    with pytest.raises(SystemExit, match="exit code 1: .*\nfailed"):
        common.Process([sys.executable, "-c", "raise SystemExit('failed')"])


def test_an_exponent_is_that_of_the_power():
    assert scaling.exponent([(n, 3 * n**0.5) for n in scaling.SIZES]) == pytest.approx(0.5)


def test_plush_and_city_small(monkeypatch, tmp_path):
    out = tmp_path / "gpu.jsonl"
    words = ["gpu.py", "--device", "cpu", "--small", "--only", "plush", "city", "--results"]
    monkeypatch.setattr(sys, "argv", [*words, str(out)])
    gpu.main()
    plush, adapted, *frames = map(json.loads, out.read_text("utf-8").splitlines())
    assert (plush["benchmark"], plush["on"], plush["count"]) == ("gpu plush", "cpu", 1000)
    assert plush["train_seconds"] > 0 and adapted["peak_bytes"] > adapted["base_bytes"] > 0
    places = [(frame["where"], frame["virtual_scale"]) for frame in frames]
    assert places == [*product(("near", "far"), (1, 3, 7))]
    assert all(min(frame["ms"].values()) > 0 for frame in frames)
    assert frames[0]["kept"] > frames[1]["kept"] and frames[0]["psnr_full"] > frames[1]["psnr_full"]


def test_hostile_surroundings(capture):
    every = (*hostile.streams(), *hostile.folders(), *hostile.options(), *hostile.environments())
    cases = [case for case in every if "--json >&-" in case.line or "cd gone" in case.line]
    found = {case.line: hostile.failures(case, inputs=Path(capture.ply).parent) for case in cases}
    assert len(found) >= 2 and not any(found.values()), found
