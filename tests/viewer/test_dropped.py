"""Files dropped on the page: their layouts, settings and screen filters, and files that cannot be read."""

from __future__ import annotations

import gzip
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

import clod_adapter
import scenes
from clod_adapter.config import FILTERS, AttenuationConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.file_formats import write
from clod_adapter.render import render
from shown import Shown, assert_same, drop, message, take

CAMERA = scenes.camera(320, 240)


def drop_file(shown: Shown, path: Path, dial: float) -> None:
    """Drops a file, and waits until the page has drawn it."""
    drop(shown, path.name, path.read_bytes())
    shown.until(f"document.title === '{path.name}'")
    shown.camera(CAMERA)
    shown.run("clod.setDial(given)", dial)


def test_every_ply_layout_gives_the_same_picture(
    shown: Shown, save: Any, gaussians: Gaussians, artefacts: Path, tmp_path: Path
) -> None:
    path = save(gaussians, "usual.ply")
    drop_file(shown, path, 2.0)
    wanted = shown.picture()
    assert_same(shown, render(gaussians, CAMERA, 2.0), artefacts / "dropped.png")
    vertex = PlyData.read(str(path), mmap=False)["vertex"]
    doubles = vertex.data.astype([(name, "f8") for name in vertex.data.dtype.names])
    layouts: dict[str, dict[str, Any]] = {
        "ascii.ply": {"text": True},
        "big.ply": {"byte_order": ">"},
        "doubles.ply": {},
    }
    for name, options in layouts.items():
        rows = doubles if name == "doubles.ply" else vertex.data
        element = PlyElement.describe(rows, "vertex", comments=vertex.comments)
        PlyData([element], **options).write(str(tmp_path / name))
        drop_file(shown, tmp_path / name, 2.0)
        assert shown.page.is_enabled("#dial") and np.array_equal(shown.picture(), wanted), name


def test_settings_are_read_without_comments(
    shown: Shown, save: Any, gaussians: Gaussians, artefacts: Path, tmp_path: Path
) -> None:
    """Other tools remove comments and keep the columns of settings. A file of an earlier version has its defaults."""
    paper = {"tau": 1 / 255, "cut": "hard", "normalizer": "max"}
    cases: dict[str, tuple[dict[str, Any], list[str]]] = {
        "default.ply": ({}, []), "paper.ply": (paper, []), "old.ply": ({}, ["clod_adapter max_sv 4.0"]),
    }  # fmt: skip
    for name, (settings, comments) in cases.items():
        model = gaussians.replace(attenuation=AttenuationConfig(**settings))
        rows = PlyData.read(str(save(model)), mmap=False)["vertex"].data
        path = tmp_path / name
        PlyData([PlyElement.describe(rows, "vertex", comments=comments)], byte_order="<").write(str(path))
        drop_file(shown, path, 1.5)
        wanted = render(clod_adapter.load(path).gaussians if comments else model, CAMERA, 1.5)
        assert 0 < int(wanted.kept.sum()) < 400
        assert_same(shown, wanted, artefacts / f"bare_{name}.png")


def test_the_screen_filter_of_the_file_is_used(
    shown: Shown, save: Any, gaussians: Gaussians, plain: Gaussians, artefacts: Path, tmp_path: Path
) -> None:
    """From our comments, from columns without them, from an SPZ, and from another program's comment."""
    small = gaussians.log_scales - 2.0  # where filters differ most
    for form, suffix in (("comments", "ply"), ("columns", "ply"), ("spz", "spz"), ("tag", "ply")):
        name = "on" if form == "tag" else "mip"
        base = plain if form == "tag" else gaussians
        path = tmp_path / f"{form}.{suffix}"
        write(path, base.replace(log_scales=small, screen_filter=FILTERS[name]))
        if form in ("columns", "tag"):
            gone = rb"(?m)^comment .*\n" if form == "columns" else rb"(?m)^comment clod_adapter .*\n"
            path.write_bytes(re.sub(gone, b"", path.read_bytes()))
        found = clod_adapter.load(path).gaussians
        assert found.screen_filter == FILTERS[name]
        drop_file(shown, path, 1.0)
        assert_same(shown, render(found, CAMERA), artefacts / f"filter_{form}.png")


def test_growth_is_read_from_every_format(shown: Shown, gaussians: Gaussians, artefacts: Path, tmp_path: Path) -> None:
    """With its reference distance, also from columns alone; a row with a growth_d that is not finite is removed."""
    growth_d = torch.linspace(-1, 1, 400)
    settings = replace(gaussians.attenuation, reference_distance=1.5, max_sv=6.0)
    model = gaussians.replace(growth_d=growth_d, attenuation=settings)
    for form, suffix in (("comments", "ply"), ("columns", "ply"), ("row", "ply"), ("record", "spz")):
        path = tmp_path / f"{form}.{suffix}"
        write(path, model)
        if form == "columns":
            path.write_bytes(re.sub(rb"(?m)^comment .*\n", b"", path.read_bytes()))
        if form == "row":
            data = path.read_bytes()
            path.write_bytes(data.replace(growth_d[7].numpy().tobytes(), np.float32(np.nan).tobytes()))
        found = clod_adapter.load(path).gaussians
        assert len(found) == 400 - (form == "row")
        drop_file(shown, path, 4.0)
        assert_same(shown, render(found, CAMERA, 4.0), artefacts / f"growth_{form}.png")


def test_no_growth_and_exponents_of_0_are_the_same_picture(shown: Shown, gaussians: Gaussians, tmp_path: Path) -> None:
    pictures = []
    for growth_d in (None, torch.zeros(400)):
        write(tmp_path / "a.ply", gaussians.replace(growth_d=growth_d))
        drop_file(shown, tmp_path / "a.ply", 4.0)
        pictures.append(shown.picture())
    assert np.array_equal(*pictures)


def with_columns(path: Path, **columns: np.ndarray) -> Path:
    """The file with further columns, as another trainer writes it: without our comments."""
    rows = PlyData.read(str(path), mmap=False)["vertex"].data
    wider = np.empty(len(rows), rows.dtype.descr + [(name, "<f4") for name in columns])
    for name in wider.dtype.names or ():
        wider[name] = columns[name] if name in columns else rows[name]
    PlyData([PlyElement.describe(wider, "vertex")], byte_order="<").write(str(path))
    return path


def test_masks_and_filters_of_other_trainers(
    shown: Shown, save: Any, plain: Gaussians, artefacts: Path, tmp_path: Path
) -> None:
    """MaskGaussian's masks and Mip-Splatting's filter, as ``load`` reads them; each is named in a note.

    The Gaussians are smaller than a pixel, so that Mip-Splatting's screen-space filter differs from the classic one.
    """
    small = plain.replace(log_scales=plain.log_scales - 3.0)
    filters = np.linspace(0, 0.005, 400, dtype=np.float32)
    filters[7] = np.nan
    masks = {"masks_0": np.linspace(-1, 1, 400, dtype=np.float32), "masks_1": np.zeros(400, np.float32)}
    masks["masks_0"][300] = np.inf
    for name, columns, kept, note in (
        ("filter.ply", {"filter_3D": filters}, 399, "filter_3D is fused"),
        ("masks.ply", masks, 199, "200 of 400 Gaussians are masked out"),
    ):
        path = with_columns(save(small, name), **columns)
        found = clod_adapter.load(path).gaussians
        assert len(found) == kept
        drop_file(shown, path, 1.0)
        assert_same(shown, render(found, CAMERA), artefacts / f"{name}.png")
        with pytest.raises(AssertionError):
            assert_same(shown, render(small, CAMERA), artefacts / "not_read.png")
        shown.page.reload()
        shown.run("clod.ready")
        drop(shown, path.name, path.read_bytes())
        shown.until(f"document.title === '{name}'")
        assert note in str(shown.page.text_content("#target-note"))


@pytest.mark.parametrize("kind", ["dial", "growth, mip", "plain"])
def test_glb(shown: Shown, gaussians: Gaussians, plain: Gaussians, artefacts: Path, tmp_path: Path, kind: str) -> None:
    """With the dial, its settings and the screen-space filter; a plain one has no dial."""
    pytest.importorskip("pygltflib")
    model = {"dial": gaussians, "plain": plain}.get(kind, gaussians)
    if kind == "growth, mip":
        settings = replace(gaussians.attenuation, reference_distance=1.5, max_sv=6.0)
        growth_d, small = torch.linspace(-1, 1, 400), gaussians.log_scales - 2.0
        model = model.replace(growth_d=growth_d, attenuation=settings, log_scales=small, screen_filter=FILTERS["mip"])
    path = tmp_path / "model.glb"
    write(path, model)
    drop_file(shown, path, 1.0 if kind == "plain" else 4.0)
    assert shown.page.is_enabled("#dial") == (kind != "plain")
    assert_same(shown, render(model, CAMERA, 1.0 if kind == "plain" else 4.0), artefacts / f"glb_{kind[:4]}.png")
    drop(shown, "cut.glb", path.read_bytes()[:-100])
    assert "truncated" in message(shown, "cut.glb")
    drop(shown, "mesh.glb", path.read_bytes().replace(b"KHR_gaussian_splatting", b"KHR_gaussian_splatters"))
    assert "mesh" in message(shown, "mesh.glb")


def test_a_damaged_file_is_an_error_and_the_picture_stays(shown: Shown, model: Path) -> None:
    data = model.read_bytes()
    damaged = (
        ("cut.ply", data[:-100], "truncated"),
        ("head.ply", data[:300], "truncated"),
        ("words.ply", b"good morning", "not a splat"),
        ("empty.ply", b"", "empty"),
        ("mesh.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "mesh"),
        ("cut.spz", gzip.compress(bytes(100), mtime=0)[:-9], "it is damaged or too large"),
        ("end.sog", b"PK\3\4" + bytes(60) + b"PK\5\6" + b"\xff" * 20, "it is damaged or too large"),
        ("folder", b"", "cannot read it"),
    )
    before = shown.picture()
    for name, content, error in damaged:
        drop(shown, name, content, fails=name == "folder")
        assert error in message(shown, name) and shown.text("#title") == "model.ply"
    assert np.array_equal(shown.picture(), before)


def test_the_dial_value_of_the_command_line_is_that_of_dropped_files(
    show: Any, save: Any, model: Path, gaussians: Gaussians
) -> None:
    """Or the largest trained value of the file."""
    assert gaussians.attenuation is not None
    less = gaussians.replace(attenuation=replace(gaussians.attenuation, max_sv=2.0))
    shown = show(model, "--sv", 3)
    for path, dial in ((save(less, "less.ply"), "s = 2.00"), (model, "s = 3.00")):
        take(shown, path)
        assert shown.text("#dial-value") == dial


def test_the_last_of_two_dropped_files_is_shown(shown: Shown, save: Any, model: Path) -> None:
    one = save(scenes.gaussians(9, 0, 1), "nine.ply")
    drop(shown, "slow.ply", model.read_bytes(), wait=200)
    drop(shown, "nine.ply", one.read_bytes())
    shown.until("document.title === 'nine.ply'")
    shown.page.wait_for_timeout(400)
    assert shown.text("#title") == "nine.ply" and shown.counts()["total"] == 9
