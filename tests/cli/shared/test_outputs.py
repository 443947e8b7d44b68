"""No output takes the place of a file that is read, or of one that is somebody's, whatever the command and the name."""

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
    """The current folder, with a scene of both kinds, a checkpoint, a file with a dial and its adapter."""
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
    """Of each file what it holds, and where it is a link what it points to."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path): (path.read_bytes(), path.is_symlink() and os.readlink(path)) for path in files}


def refused(clod: Any, work: Path, said: str, *words: object) -> None:
    before = everything(work)
    done = clod(*words)
    assert done.code == 2 and said in done.err.splitlines()[-1], done
    assert everything(work) == before


INPUT = "is an input file"


@pytest.mark.parametrize(
    ("link", "taken"),
    [(os.link, "dial.ply"), (symbolic, "dial.safetensors"), (os.link, "dial.json"), (symbolic, "dial.html"),
     (os.link, "dial_adapting.png"), (symbolic, "dial.ply")],
)  # fmt: skip
def test_outputs_of_adapting(clod: Any, work: Path, link: Any, taken: str) -> None:
    """Each of them is refused where it is the checkpoint, a photograph, or a file of the model, by another name."""
    (work / "out").mkdir()
    for target in (work / "base.ply", work / "scene/images/004.png", work / "scene/sparse/0/images.bin"):
        (work / "out" / taken).unlink(missing_ok=True)
        link(target, work / "out" / taken)
        words = ("base.ply", "--images", "scene", *TINY, "--report", "-o", "out/dial.ply")
        refused(clod, work, f"out/{taken}: {INPUT} (", *words)


def test_a_transforms_file_beside_the_photographs(clod: Any, work: Path) -> None:
    refused(
        clod, work, f"nerf/transforms.json: {INPUT}, which", "base.ply", "--images", "nerf", *TINY,
        "-o", "nerf/transforms.ply",
    )  # fmt: skip


def test_a_state_or_block_that_is_an_input(clod: Any, work: Path) -> None:
    for name in ("x.resume.safetensors", "x.start.safetensors", "x.block1.pass1.safetensors"):
        assert clod("export", "dial.ply", "-o", name).code == 0
        refused(clod, work, f"{name}: {INPUT}", name, "--images", "scene", *TINY, "--memory", "8GB", "-o", "x.ply")
        (work / name).unlink()


def test_a_page_of_an_evaluation(clod: Any, work: Path) -> None:
    shutil.copy(work / "base.ply", work / "other.ply")
    page, figure = "page.html", "page_rendering.png"
    for read, taken in (
        ("dial.ply", page), ("base.ply", figure), ("other.ply", page), ("nerf/images/002.png", figure),
        ("nerf/masks/003.png", page),
    ):  # fmt: skip
        os.link(work / read, work / taken)
        words = ("--images", "nerf", "--base", "base.ply", "--against", "other.ply", "--report", page)
        refused(clod, work, f"{taken}: {INPUT} (", "eval", "dial.ply", *words)
        (work / taken).unlink()


def test_pictures(clod: Any, work: Path) -> None:
    (work / "out").mkdir()
    for target in (work / "scene/images/000.png", work / "dial.ply", work / "scene/sparse/0/cameras.bin"):
        (work / "out" / "008.png").unlink(missing_ok=True)
        (work / "out" / "008.png").symlink_to(target)
        refused(clod, work, f"out/008.png: {INPUT} (", "render", "dial.ply", "--images", "scene", "-o", "out")


def test_exports(clod: Any, work: Path) -> None:
    for name, words in {
        "x.glb": ["--images", "scene", "--order", "extinction"],
        "x_s2.ply": ["--levels", "1,2", "--images", "scene", "--order", "extinction"],
        "x.html": ["--images", "scene"],
    }.items():
        os.link(work / "scene/images/000.png", work / name)
        out = name.replace("_s2", "")
        refused(clod, work, f"{name}: {INPUT} (", "export", "dial.ply", "-o", out, *words)
    os.link(work / "dial.ply", work / "y.spz")
    refused(clod, work, f"y.spz: {INPUT} (", "export", "dial.ply", "-o", "y.spz")


def test_applying(clod: Any, work: Path) -> None:
    for read in ("base.ply", "dial.safetensors"):
        os.link(work / read, work / "x.ply")
        refused(clod, work, f"x.ply: {INPUT} (", "apply", "base.ply", "dial.safetensors", "-o", "x.ply")
        (work / "x.ply").unlink()


@pytest.mark.parametrize("taken", ["robustness.png", "robustness.json", "cells/base_base.json"])
def test_the_robustness_experiment(clod: Any, work: Path, taken: str) -> None:
    (work / "out" / "cells").mkdir(parents=True)
    os.link(work / "scene/images/004.png", work / "out" / taken)
    words = ("robustness", "base.ply", "--images", "scene", "--iters", 2, "--max-sv", 2, "-o", "out")
    refused(clod, work, f"out/{taken}: {INPUT} (", *words)


@pytest.mark.parametrize("name", ["out.json", "out.safetensors", "out.html", "out_rendering.png"])
def test_what_nobody_named_takes_no_strangers_place(clod: Any, work: Path, name: str) -> None:
    (work / name).write_bytes(b"somebody's")
    words = ("base.ply", "--images", "scene", *TINY, "--report", "-o", "out.ply")
    refused(clod, work, f"{name}: exists and was not written by clod-adapt; move it", *words)
    Image.new("RGB", (4, 4)).save(work / "000.png")
    refused(clod, work, "000.png: exists and was not", "render", "dial.ply", "--images", "scene", "-o", ".")


def test_earlier_outputs_are_replaced(clod: Any, work: Path) -> None:
    """All of every command's, and a file of any kind under the name that was given."""
    (work / "out.ply").write_bytes(b"somebody's, but named")
    for _ in range(2):
        for words in (
            ("base.ply", "--images", "scene", *TINY, "-o", "out.ply"),
            ("eval", "out.ply", "--images", "scene", "--sv", 1, "--report", "page.html"),
            ("render", "out.ply", "--images", "scene", "-o", "pictures"),
            ("export", "out.ply", "-o", "out.glb"),
        ):
            assert (done := clod(*words, "--quiet")).code == 0, done


def test_a_pipe_is_no_output(clod: Any, work: Path) -> None:
    os.mkfifo(work / "x.ply")
    refused(clod, work, "x.ply: is no regular file", "apply", "base.ply", "dial.safetensors", "-o", "x.ply")
    assert (work / "x.ply").is_fifo()
