"""Files dropped on the page: what it reads as Python does, and what it leaves to Python or cannot read."""

import gzip
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plyfile import PlyData

import clod_adapter
import scenes
from clod_adapter.config import FILTERS
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.file_formats import write
from clod_adapter.render import render
from formats import write_rows
from shown import Shown, assert_same, drop, message, take

CAMERA = scenes.camera(320, 240)


def test_ply_and_spz_are_shown_as_python_reads_them(
    shown: Shown, gaussians: Gaussians, plain: Gaussians, tmp_path: Path
) -> None:
    """With and without our comments, which other tools remove; in other types."""
    settings = replace(gaussians.attenuation, reference_distance=1.5, max_sv=6.0)
    model = gaussians.replace(
        growth_d=torch.linspace(-1, 1, 400), attenuation=settings, log_scales=gaussians.log_scales - 2.0,
        screen_filter=FILTERS["mip"],
    )  # fmt: skip
    write(tmp_path / "usual.ply", model)
    write(tmp_path / "usual.spz", model)
    write(tmp_path / "plain.spz", plain)
    data, rows = (tmp_path / "usual.ply").read_bytes(), PlyData.read(tmp_path / "usual.ply", mmap=False)["vertex"]
    (tmp_path / "bare.ply").write_bytes(re.sub(rb"(?m)^comment .*\n", b"", data))
    doubles = rows.data.astype([(name, "f8") for name in rows.data.dtype.names])
    write_rows(tmp_path / "doubles.ply", doubles, ">", rows.comments)
    write(tmp_path / "tag.ply", plain.replace(log_scales=plain.log_scales - 2.0))
    tagged = re.sub(rb"(?m)^comment clod_adapter .*\n", b"", (tmp_path / "tag.ply").read_bytes())
    (tmp_path / "tag.ply").write_bytes(tagged.replace(b"format", b"comment SplatRenderMode: mip\nformat", 1))
    for path in sorted(tmp_path.glob("*.*")):
        found = clod_adapter.load(path).gaussians
        drop(shown, path.name, path.read_bytes())
        shown.until(f"document.title === '{path.name}'")
        shown.camera(CAMERA)
        s = 4.0 if found.attenuation else 1.0
        shown.run("clod.setDial(given)", s)
        assert shown.page.is_enabled("#dial") == bool(found.attenuation)
        assert_same(shown, render(found, CAMERA, s))


def test_other_files_are_errors_and_the_picture_stays(shown: Shown, model: Path, tmp_path: Path) -> None:
    data = model.read_bytes()
    write(tmp_path / "a.glb", clod_adapter.load(model).gaussians)
    header, _, _ = data.partition(b"end_header")
    python = "clod-adapt view {} opens every format"
    refused = (
        ("a.glb", (tmp_path / "a.glb").read_bytes(), python),
        ("a.sog", b"PK\3\4" + bytes(60), python),
        ("ascii.ply", header.replace(b"binary_little_endian", b"ascii") + b"end_header\n1 2\n", python),
        ("mip.ply", data.replace(b"property float x\n", b"property float filter_3D\nproperty float x\n"), python),
        ("mesh.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nend_header\n", "x is missing"),
        ("cut.ply", data[:-100], "truncated"),
        ("head.ply", data[:300], "truncated"),
        ("empty.ply", b"", "empty"),
        ("cut.spz", gzip.compress(bytes(100), mtime=0)[:-9], "damaged or too large"),
        ("zeros.spz", gzip.compress(bytes(100), mtime=0), "not .spz"),
        ("folder", b"", "cannot read it"),
    )
    before = shown.picture()
    for name, content, error in refused:
        drop(shown, name, content)
        assert error.format(name) in message(shown, name) and shown.text("#title") == "model.ply", name
    assert np.array_equal(shown.picture(), before)


def test_the_last_of_two_dropped_files_is_shown(show: Any, save: Any, model: Path, gaussians: Gaussians) -> None:
    """At the dial value of the command line, or the largest trained one of the file."""
    less = save(gaussians.replace(attenuation=replace(gaussians.attenuation, max_sv=2.0))[torch.arange(9)], "less.ply")
    shown = show(model, "--sv", 3)
    drop(shown, "slow.ply", model.read_bytes(), wait=300)
    drop(shown, "less.ply", less.read_bytes())
    shown.until("document.title === 'less.ply'")
    shown.page.wait_for_timeout(500)
    assert shown.text("#title") == "less.ply" and shown.counts()["total"] == 9
    assert shown.text("#dial-value") == "s = 2.00"
    take(shown, model)
    assert shown.text("#dial-value") == "s = 3.00"
