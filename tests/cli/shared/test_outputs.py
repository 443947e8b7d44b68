"""Outputs never replace an input, nor a file that clod-adapt has not written; two runs never write the same file."""

from __future__ import annotations

import json
import os
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from clod_adapter.cli.main import ADAPT, COMMANDS, build_parser
from clod_adapter.cli.shared.outputs import Outputs, claimed

POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]


@pytest.fixture
def work(capture: Any, dialled: Path, tmp_path: Path) -> Path:
    """The current folder: a COLMAP scene, a transforms.json, a checkpoint, and the files of an adapted one."""
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
    for suffix in (".ply", ".safetensors", ".json"):
        shutil.copy(dialled.with_suffix(suffix), tmp_path / f"dial{suffix}")
    (tmp_path / "out" / "cells").mkdir(parents=True)
    return tmp_path


def give(work: Path, existing: str) -> None:
    """Makes a file of each word: ``NAME`` is foreign, ``NAME=FILE`` a copy, ``NAME>FILE`` and ``NAME~FILE`` links."""
    for word in existing.split():
        if "=" in word:
            shutil.copy(*(work / name for name in word.split("=")[::-1]))
        elif ">" in word:
            name, target = word.split(">")
            (work / name).symlink_to(work / target)
        elif "~" in word:
            name, target = word.split("~")
            os.link(work / target, work / name)
        elif word.endswith(".png"):
            Image.new("RGB", (4, 4)).save(work / word)
        else:
            (work / word).write_bytes(b"foreign")


def everything(folder: Path) -> dict[str, object]:
    """The content of each file, and the target of each link."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path): (path.read_bytes(), path.is_symlink() and os.readlink(path)) for path in files}


def refused(clod: Any, work: Path, said: str, line: str) -> None:
    before = everything(work)
    done = clod(*shlex.split(line))
    assert done.code == 2 and done.err.startswith(f"clod-adapt: error: {said}"), done
    assert done.err.count("\n") == 1 and everything(work) == before


TINY = "--images scene --iters 2 --max-sv 2"
ADAPTED = f"base.ply {TINY} --report -o out/dial.ply"
BLOCKS = f"{TINY} --memory 8GB -o x.ply"
EVAL = "eval dial.ply --images nerf --base base.ply --against base.ply --report page.html"
RENDER = "render dial.ply --images scene -o out"
EXPORT = "export dial.ply --images scene -o"
ROBUSTNESS = f"robustness base.ply {TINY} -o out"
INPUT, FOREIGN = (
    "is an input file",
    "exists and is not known to be written by clod-adapt; move it, or choose another output",
)
BESIDE = "is the adapter, state or report of"


@pytest.mark.parametrize(
    ("line", "existing", "said"),
    [
        # Inputs: checkpoints, adapters, photographs, masks, files of a COLMAP model; by hard and symbolic links.
        (ADAPTED, "out/dial.ply~base.ply", f"out/dial.ply: {INPUT} (base.ply), which is never overwritten"),
        (ADAPTED, "out/dial.safetensors>scene/images/004.png", f"out/dial.safetensors: {INPUT} (scene"),
        (ADAPTED, "out/dial.json~scene/sparse/0/images.bin", f"out/dial.json: {INPUT} (scene"),
        (ADAPTED, "out/dial_adapting.png~base.ply", f"out/dial_adapting.png: {INPUT} (base.ply)"),
        ("base.ply --images nerf --max-sv 2 -o nerf/transforms.ply", "", f"nerf/transforms.json: {INPUT}, which"),
        (f"dial.ply {BLOCKS}", "x.resume.safetensors~dial.ply", f"x.resume.safetensors: {INPUT} (dial.ply)"),
        (f"dial.ply {BLOCKS}", "x.block1.pass1.safetensors>dial.ply", f"x.block1.pass1.safetensors: {INPUT}"),
        (EVAL, "page.html~nerf/masks/003.png", f"page.html: {INPUT} (nerf"),
        (EVAL, "page_rendering.png~nerf/images/002.png", f"page_rendering.png: {INPUT} (nerf"),
        (RENDER, "out/008.png>scene/images/000.png", f"out/008.png: {INPUT} (scene"),
        (f"{EXPORT} x.glb --order extinction", "x.glb~scene/images/000.png", f"x.glb: {INPUT} (scene"),
        (f"{EXPORT} x.ply --levels 1,2", "x_s2.ply~scene/images/000.png", f"x_s2.ply: {INPUT} (scene"),
        ("export dial.ply -o y.spz", "y.spz~dial.ply", f"y.spz: {INPUT} (dial.ply)"),
        ("apply base.ply dial.safetensors -o x.ply", "x.ply~dial.safetensors", f"x.ply: {INPUT} (dial.safetensors)"),
        (ROBUSTNESS, "out/robustness.png~scene/images/000.png", f"out/robustness.png: {INPUT} (scene"),
        (ROBUSTNESS, "out/cells/base_base.json~base.ply", f"out/cells/base_base.json: {INPUT} (base.ply)"),
        # Files of adapting beside the input, which are named for something else.
        ("export dial.ply -o dial.safetensors", "", f"dial.safetensors: {BESIDE} dial.ply; choose another output"),
        ("export link.ply -o dial.safetensors", "link.ply>dial.ply", f"dial.safetensors: {BESIDE} link.ply"),
        ("export dial.ply -o dial.html", "dial.html=dial.json", f"dial.html: {BESIDE} dial.ply"),
        ("export dial.ply -o l.safetensors", "l.safetensors>dial.safetensors", f"l.safetensors: {BESIDE} dial.ply"),
        # Derived names.
        (f"base.ply {TINY} -o out.ply", "out.json", f"out.json: {FOREIGN}"),
        (f"base.ply {TINY} -o out.ply", "out.safetensors", f"out.safetensors: {FOREIGN}"),
        (f"base.ply {TINY} -o out.ply", "out.resume.safetensors", f"out.resume.safetensors: {FOREIGN}"),
        (f"base.ply {TINY} --report -o out.ply", "out.html", f"out.html: {FOREIGN}"),
        (f"base.ply {TINY} --report -o out.ply", "out_rendering.png", f"out_rendering.png: {FOREIGN}"),
        (f"base.ply {TINY}", "base_clod.ply", f"base_clod.ply: {FOREIGN}"),
        (f"base.ply {BLOCKS}", "x.block1.pass1.safetensors", f"x.block1.pass1.safetensors: {FOREIGN}"),
        (EVAL, "page_rendering.png", f"page_rendering.png: {FOREIGN}"),
        (RENDER, "out/000.png", f"out/000.png: {FOREIGN}"),
        (f"{EXPORT} x.ply --levels 1,2", "x_s2.ply", f"x_s2.ply: {FOREIGN}"),
        (f"{EXPORT} x.spz --levels 1,2", "x_s1.spz", f"x_s1.spz: {FOREIGN}"),
        (f"{EXPORT} x --levels 1,2 --3dtiles", "x", "x: is a file; with --3dtiles, --out must name a new folder"),
        (f"{EXPORT} out --levels 1,2 --3dtiles", "", "out: is a folder that is not empty"),
        (ROBUSTNESS, "out/robustness.csv", f"out/robustness.csv: {FOREIGN}"),
        (ROBUSTNESS, "out/cells/base_sv2.safetensors", f"out/cells/base_sv2.safetensors: {FOREIGN}"),
        (ROBUSTNESS.replace("out", "nerf"), "nerf/cells", "nerf/cells: nerf/cells is a file; choose another --out"),
        ("demo -o out", "out/gallery.ply", f"out/gallery.ply: {FOREIGN}"),
        ("demo -o out", "out/curve.png", f"out/curve.png: {FOREIGN}"),
        ("demo -o base.ply/here", "", "base.ply/here: base.ply is a file; choose another --out"),
    ],
)  # fmt: skip
def test_refused(clod: Any, work: Path, line: str, existing: str, said: str) -> None:
    give(work, existing)
    if line == RENDER:  # which reads the names of its images first
        before = everything(work)
        done = clod(*line.split())
        assert done.code == 2 and f"error: {said}" in done.err.splitlines()[-1] and everything(work) == before, done
    else:
        refused(clod, work, said, line)


def outputs_of(line: str) -> Outputs:
    words = line.split()
    name = words[0] if words[0] in COMMANDS else ""
    return COMMANDS.get(name, ADAPT).outputs(build_parser(name).parse_args(words[1:] if name else words))


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        (f"base.ply {TINY} -o two.ply", f"base.ply {TINY} -o two.PLY", "two.PLY"),
        (f"base.ply {TINY} -o two.ply", "export dial.ply -o two.safetensors", "two.safetensors"),
        (f"base.ply {TINY} -o two.ply", f"base.ply {BLOCKS.replace('x.ply', 'two.ply')} --block 1", "two.ply"),
        (f"base.ply {TINY} -o two.ply --report", "eval dial.ply --images scene --report two.html", "two.html"),
        ("export dial.ply -o x.ply --levels 1,2", "export dial.ply -o x_s2.ply", "x_s2.ply"),
        ("export dial.ply -o x --levels 1,2 --3dtiles", "export dial.ply -o x --levels 1,2 --3dtiles", "x"),
        ("apply base.ply dial.safetensors -o x.ply", "apply base.ply dial.safetensors -o x.ply", "x.ply"),
        (RENDER, RENDER, "out"), (ROBUSTNESS, ROBUSTNESS, "out"), ("demo -o out", "demo -o out", "out"),
        ("export dial.ply -o two.ply", "export dial.ply -o two.spz", None),
        (f"base.ply {BLOCKS} --block 1", f"base.ply {BLOCKS} --block 2", None),
    ],
)  # fmt: skip
def test_two_runs_at_once(clod: Any, work: Path, first: str, second: str, said: str | None) -> None:
    before = everything(work)
    with claimed(outputs_of(first)):
        if said is None:
            with claimed(outputs_of(second)):
                pass
        else:
            refused(clod, work, f"{said}: another run (process {os.getpid()}) is writing it; wait for that", second)
    assert everything(work) == before


def test_earlier_outputs_are_replaced(clod: Any, work: Path) -> None:
    """And a foreign file, if the command line names it."""
    (work / "out.ply").write_bytes(b"foreign, but named")
    for _ in range(2):
        for line in (
            f"base.ply {TINY} -o out.ply",
            "eval out.ply --images scene --sv 1 --report page.html",
            "render out.ply --images scene -o pictures",
            "export out.ply -o x.safetensors",
            "export out.ply -o x.spz --levels 1,2",
        ):
            assert (done := clod(*line.split(), "--quiet")).code == 0, done


def test_pipe_as_output_is_refused(clod: Any, work: Path) -> None:
    os.mkfifo(work / "x.ply")
    refused(clod, work, "x.ply: is no regular file", "apply base.ply dial.safetensors -o x.ply")
    assert (work / "x.ply").is_fifo()
