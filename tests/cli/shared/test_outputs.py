"""Outputs never replace an input, nor a file that clod-adapt has not written."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

TINY = ("--iters", 2, "--max-sv", 2)


def symbolic(target: Path, name: Path) -> None:
    name.symlink_to(target)


@pytest.fixture
def work(capture: Any, dialled: Path, tmp_path: Path) -> Path:
    """The current folder, with a COLMAP scene, a transforms.json, a checkpoint, a file with a dial and its adapter."""
    scene = tmp_path / "scene"
    shutil.copytree(capture.scene, scene)
    frames = [{"file_path": f"images/{k:03}", "mask_path": f"masks/{k:03}.png"} for k in range(10)]
    (tmp_path / "nerf").mkdir()
    shutil.copytree(capture.scene / "images", tmp_path / "nerf" / "images")
    content = {"fl_x": 60, "w": 64, "h": 48, "frames": [frame | {"transform_matrix": POSE} for frame in frames]}
    (tmp_path / "nerf" / "transforms.json").write_text(json.dumps(content))
    (tmp_path / "nerf" / "masks").mkdir()
    (tmp_path / "nerf" / "masks" / "003.png").write_bytes(b"a mask")
    shutil.copy(capture.ply, tmp_path / "base.ply")
    for suffix in (".ply", ".safetensors"):
        shutil.copy(dialled.with_suffix(suffix), tmp_path / f"dial{suffix}")
    return tmp_path


POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]


def everything(folder: Path) -> dict[str, object]:
    """The content of each file, and the target of each link."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path): (path.read_bytes(), path.is_symlink() and os.readlink(path)) for path in files}


def refused(clod: Any, work: Path, said: str, *words: object) -> None:
    before = everything(work)
    done = clod(*words)
    assert done.code == 2 and said in done.err.splitlines()[-1], done
    assert everything(work) == before


INPUT = "is an input file"


ADAPT = "base.ply --images scene --iters 2 --max-sv 2 --report -o out/dial.ply"
ADAPTED = "base.ply scene/images/004.png scene/sparse/0/images.bin"
EVAL = "eval dial.ply --images nerf --base base.ply --against other.ply --report page.html"
RENDER = "render dial.ply --images scene -o out"
EXPORT = "export dial.ply --images scene -o"
ROBUSTNESS = "robustness base.ply --images scene --iters 2 --max-sv 2 -o out"
IMAGE = "scene/images/000.png"


@pytest.mark.parametrize(
    ("line", "link", "taken", "targets"),
    [
        (ADAPT, os.link, "out/dial.ply", ADAPTED), (ADAPT, symbolic, "out/dial.ply", ADAPTED),
        (ADAPT, symbolic, "out/dial.safetensors", ADAPTED), (ADAPT, os.link, "out/dial.json", ADAPTED),
        (ADAPT, symbolic, "out/dial.html", ADAPTED), (ADAPT, os.link, "out/dial_adapting.png", ADAPTED),
        (EVAL, os.link, "page.html", "dial.ply other.ply nerf/masks/003.png"),
        (EVAL, os.link, "page_rendering.png", "base.ply nerf/images/002.png"),
        (RENDER, symbolic, "out/008.png", f"dial.ply {IMAGE} scene/sparse/0/cameras.bin"),
        (f"{EXPORT} x.glb --order extinction", os.link, "x.glb", IMAGE),
        (f"{EXPORT} x.html", os.link, "x.html", IMAGE),
        (f"{EXPORT} x.ply --levels 1,2 --order extinction", os.link, "x_s2.ply", IMAGE),
        ("export dial.ply -o y.spz", os.link, "y.spz", "dial.ply"),
        ("apply base.ply dial.safetensors -o x.ply", os.link, "x.ply", "base.ply dial.safetensors"),
        (ROBUSTNESS, os.link, "out/robustness.png", IMAGE), (ROBUSTNESS, os.link, "out/robustness.json", IMAGE),
        (ROBUSTNESS, os.link, "out/cells/base_base.json", IMAGE),
    ],
)  # fmt: skip
def test_outputs_that_are_links_to_inputs_are_refused(
    clod: Any, work: Path, line: str, link: Any, taken: str, targets: str
) -> None:
    """Checkpoints, adapters, photographs, masks and files of a COLMAP model, by hard and symbolic links."""
    shutil.copy(work / "base.ply", work / "other.ply")
    (work / "out" / "cells").mkdir(parents=True)
    for target in targets.split():
        link(work / target, work / taken)
        refused(clod, work, f"{taken}: {INPUT} (", *line.split())
        (work / taken).unlink()


def test_transforms_file_is_an_input(clod: Any, work: Path) -> None:
    refused(
        clod, work, f"nerf/transforms.json: {INPUT}, which", "base.ply", "--images", "nerf", *TINY,
        "-o", "nerf/transforms.ply",
    )  # fmt: skip


def test_state_or_block_that_is_an_input(clod: Any, work: Path) -> None:
    for name in ("x.resume.safetensors", "x.start.safetensors", "x.block1.pass1.safetensors"):
        assert clod("export", "dial.ply", "-o", name).code == 0
        refused(clod, work, f"{name}: {INPUT}", name, "--images", "scene", *TINY, "--memory", "8GB", "-o", "x.ply")
        (work / name).unlink()


@pytest.mark.parametrize("name", ["out.json", "out.safetensors", "out.html", "out_rendering.png"])
def test_derived_names_replace_no_foreign_file(clod: Any, work: Path, name: str) -> None:
    (work / name).write_bytes(b"foreign")
    words = ("base.ply", "--images", "scene", *TINY, "--report", "-o", "out.ply")
    refused(clod, work, f"{name}: exists and was not written by clod-adapt; move it", *words)
    Image.new("RGB", (4, 4)).save(work / "000.png")
    refused(clod, work, "000.png: exists and was not", "render", "dial.ply", "--images", "scene", "-o", ".")


def test_earlier_outputs_are_replaced(clod: Any, work: Path) -> None:
    """And a foreign file, if the command line names it."""
    (work / "out.ply").write_bytes(b"foreign, but named")
    for _ in range(2):
        for words in (
            ("base.ply", "--images", "scene", *TINY, "-o", "out.ply"),
            ("eval", "out.ply", "--images", "scene", "--sv", 1, "--report", "page.html"),
            ("render", "out.ply", "--images", "scene", "-o", "pictures"),
            ("export", "out.ply", "-o", "out.glb"),
        ):
            assert (done := clod(*words, "--quiet")).code == 0, done


def test_pipe_as_output_is_refused(clod: Any, work: Path) -> None:
    os.mkfifo(work / "x.ply")
    refused(clod, work, "x.ply: is no regular file", "apply", "base.ply", "dial.safetensors", "-o", "x.ply")
    assert (work / "x.ply").is_fifo()
