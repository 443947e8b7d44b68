"""The browser's picture equals ``clod_adapter.render`` at the same camera and dial value; files
that it reads itself as Python does, and those that it leaves to Python.
"""

import gzip
import re
import shutil
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
import torch
from plyfile import PlyData
from refusals import refused

import scenes
from clod_adapter import load
from clod_adapter.config import FILTERS, ScreenFilter
from clod_adapter.io.file_formats import write
from clod_adapter.render import render
from clod_adapter.viewer.page import Payload, write_viewer_page
from formats import PACKED, splat_transform, write_rows
from scenes import attenuated
from shown import TALL, assert_alike, assert_same, drop, message, take

VIEW = scenes.camera(320, 240)
WIDE = ScreenFilter(variance=2.0)


def finer(model, by, **changes):
    return model.replace(log_scales=model.log_scales - by, **changes)


def grown(count, degree, power, by, **settings):
    """With growth of both signs; some Gaussians have their centre outside the picture and grow into
    it.
    """
    model = attenuated(count, degree, 7, **settings)
    return finer(model, by, growth_d=torch.linspace(-1, power, count))


def small(size):
    """In another unit of length, with a nearer near plane."""
    model = attenuated(500, 0, 7, scene_distance=3 * size)
    viewmat = VIEW.viewmat.clone()
    viewmat[:3, 3] *= size
    model = finer(model, -float(np.log(size)), means=size * model.means)
    return model, (1.0,), replace(VIEW, viewmat=viewmat, near=0.01 * size)


# Model, dial values and camera; each differs from the others in what is named.
CASES = {
    "degree 3": (attenuated(500, 3, 7), (1.0, 3.0), VIEW),
    "compensated": (finer(attenuated(500, 1, 7), 2, screen_filter=FILTERS["on"]), (2.0,), VIEW),
    "another unit, wide blur": (
        finer(attenuated(500, 1, 7, scene_distance=2.0), 2, screen_filter=WIDE),
        (2.0,),
        VIEW,
    ),
    "growth": (
        grown(1500, 0, 1.5, 1, max_sv=10.0, reference_distance=4.5),
        (1.0, 8.0),
        scenes.camera(320, 240, fov=40),
    ),
    # By factors up to 1e8: quads of that size would be drawn inexactly; they end at the picture's
    # farthest corner.
    "far beyond the picture": (
        grown(300, 0, 5, 0, max_sv=40.0, reference_distance=2.0),
        (20.0,),
        VIEW,
    ),
    "millimetres": small(1e-3),
    "off centre": (
        attenuated(500, 0, 7),
        (1.0,),
        scenes.camera(180, 240, fov=100, off_centre=(0.1, 0.9)),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_picture_and_the_count(shown, save, name):
    model, dials, camera = CASES[name]
    take(shown, save(model))
    shown.camera(camera)
    for s in dials:
        shown.run("clod.setDial(given)", s)
        assert_same(shown, render(model, camera, s))
        # the measure tells them from models without it
        if name in ("growth", "another unit, wide blur"):
            other = model.replace(growth_d=None, screen_filter=FILTERS["off"])
            with pytest.raises(AssertionError):
                assert_alike(shown.picture(), render(other, camera, s).pixels.numpy())
    shown.run("clod.setEquation(false)")
    bare = model.replace(sigma_d=None, growth_d=None, attenuation=None)
    assert_same(shown, render(bare, camera))


def test_wipe_shows_both_sides(show, save):
    """The base, or the same file without its dial, which is then on at the left; by a switch, and
    by C.
    """
    gaussians = attenuated(600, 0, 7)
    base = gaussians.replace(sigma_d=None, attenuation=None, sh0=-gaussians.sh0)
    shown = show(save(gaussians), "--base", save(base, "base.ply"), "--sv", 3, viewport=TALL)
    left = render(gaussians, VIEW, 3.0).pixels.numpy()
    for right in (base, base.replace(sh0=gaussians.sh0)):
        shown.camera(VIEW)
        shown.page.check("#compare")
        shown.run("clod.setWipe(0.4)")
        both = np.concatenate([left[:, :128], render(right, VIEW).pixels.numpy()[:, 128:]], axis=1)
        assert_alike(shown.picture(), both)
        shown.press("c")
        assert_same(shown, render(gaussians, VIEW, 3.0))
        take(shown, save(gaussians))
        shown.run("clod.setEquation(false)")
    shown.press("c")
    assert shown.page.is_checked("#equation") and "dial off" in shown.text("#wipe-right")
    shown.page.focus("#wipe")
    shown.press("Home")
    assert shown.page.input_value("#wipe") == "0"


def test_ply_and_spz_are_shown_as_python_reads_them(shown, gaussians, plain, tmp_path):
    """With and without our comments, which other tools remove; in other types."""
    settings = replace(gaussians.attenuation, reference_distance=1.5, max_sv=6.0)
    model = finer(gaussians, 2.0, growth_d=torch.linspace(-1, 1, 400), attenuation=settings)
    for name, saved in (("usual.ply", model), ("usual.spz", model), ("plain.spz", plain)):
        write(tmp_path / name, saved.replace(screen_filter=FILTERS["mip"]))
    write(tmp_path / "tag.ply", finer(plain, 2.0))
    data = (tmp_path / "usual.ply").read_bytes()
    rows = PlyData.read(tmp_path / "usual.ply", mmap=False)["vertex"]
    (tmp_path / "bare.ply").write_bytes(re.sub(rb"(?m)^comment .*\n", b"", data))
    doubles = rows.data.astype([(name, "f8") for name in rows.data.dtype.names])
    write_rows(tmp_path / "doubles.ply", doubles, ">", rows.comments)
    tagged = re.sub(rb"(?m)^comment clod_adapter .*\n", b"", (tmp_path / "tag.ply").read_bytes())
    (tmp_path / "tag.ply").write_bytes(
        tagged.replace(b"format", b"comment SplatRenderMode: mip\nformat", 1)
    )
    for path in sorted(tmp_path.glob("*.*")):
        found = load(path).gaussians
        take(shown, path)
        shown.camera(VIEW)
        s = 4.0 if found.attenuation else 1.0
        shown.run("clod.setDial(given)", s)
        assert shown.page.is_enabled("#dial") == bool(found.attenuation)
        assert_same(shown, render(found, VIEW, s))


def ascii_ply(data):
    """An ascii PLY with a header like this one's, without its rows."""
    header, _, _ = data.partition(b"end_header")
    return header.replace(b"binary_little_endian", b"ascii") + b"end_header\n1 2\n"


MESH = b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nend_header\n"


def test_the_server_reads_files_of_other_formats(show, model, gaussians, plain, tmp_path):
    """They are shown as ``clod-adapt view`` shows them; none remains; errors are one line."""
    for name, saved in (
        ("a b&.pt", gaussians),
        ("b.spz", plain),
    ):
        write(tmp_path / name, finer(saved, 2.0))
    rows = PlyData.read(model, mmap=False)
    rows.text = True
    rows.write(tmp_path / "ascii.ply")
    splat_transform("--version")
    for path in (PACKED, PACKED.with_name("capture.sog")):
        shutil.copy(path, tmp_path)
    folder = tmp_path / "temporary"
    folder.mkdir()
    with patch("tempfile.tempdir", str(folder)):
        shown = show(model)
        for path in sorted(path for path in tmp_path.glob("*.*") if path != model):
            drop(shown, path.name, path.read_bytes())
            shown.until(f"document.title === '{path.name}'")
            opened = load(path).gaussians
            assert shown.counts()["total"] == len(opened)
            assert shown.page.is_disabled("#dial") == (opened.sigma_d is None)
            shown.camera(VIEW)
            assert_same(shown, render(opened, VIEW, 1.0))
        before = shown.picture()
        refused = (
            ("cut.pt", (tmp_path / "a b&.pt").read_bytes()[:200], "cut.pt: is damaged"),
            ("a.glb", b"glTF" + bytes(60), "a.glb: is a glTF model; adapt the PLY"),
            ("page.sog", b"<!doctype html>", "page.sog: is a web page"),
            ("ö b.lcc", b"something", "ö b.lcc: is an LCC file"),
            ("a.txt", b"something", "a.txt: "),
            ("mesh.ply", MESH, "mesh.ply: "),
        )
        for name, content, error in refused:
            drop(shown, name, content)
            said = message(shown, name)
            assert error in said.splitlines()[0] and str(folder) not in said, said
        assert np.array_equal(shown.picture(), before)
        assert list(folder.iterdir()) == []
    assert all("422" in error for error in shown.errors) and len(shown.errors) == len(refused)
    shown.errors.clear()


def test_other_files_are_errors_and_the_picture_stays(show, model, tmp_path):
    """Of a page without a server."""
    write_viewer_page(tmp_path / "page.html", load(model), exact=True, virtual_scale=1.0)
    shown = show(url=(tmp_path / "page.html").as_uri())
    data = model.read_bytes()
    python = "clod-adapt view {} opens every format"
    refused = (
        ("a.sog", b"PK\3\4" + bytes(60), python),
        ("ascii.ply", ascii_ply(data), python),
        (
            "mip.ply",
            data.replace(b"property float x\n", b"property float filter_3D\nproperty float x\n"),
            python,
        ),
        ("mesh.ply", MESH, "x is missing"),
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
        assert error.format(name) in message(shown, name), name
        assert shown.text("#title") == "model.ply", name
    assert np.array_equal(shown.picture(), before)


def test_other_forms_of_the_dial_are_refused_with_a_remedy(shown, model, tmp_path):
    """The paper's, and that of files from before every Gaussian had a reach; by comments, columns
    and documents.
    """
    loaded = load(model)
    attenuation = replace(loaded.gaussians.attenuation, form="paper")
    paper = loaded.gaussians.replace(attenuation=attenuation)
    write(tmp_path / "paper.spz", paper)
    ours = b"comment clod_adapter form ours\n"
    column = b"property float nx\n"
    data = model.read_bytes()
    assert ours in data and column in data
    of_paper = "without --form paper"
    earlier = "its dial is of an earlier form; adapt its checkpoint again"
    with_column = data.replace(ours, b"").replace(column, b"property float clod_tau\n")
    for name, content, error in (
        ("paper.spz", (tmp_path / "paper.spz").read_bytes(), of_paper),
        ("paper.ply", data.replace(ours, b"comment clod_adapter form paper\n"), of_paper),
        ("column.ply", with_column, earlier),
        ("comment.ply", data.replace(ours, b"comment clod_adapter cut soft\n"), earlier),
    ):
        drop(shown, name, content)
        said = message(shown, name)
        assert error in said and "opens every format" not in said, name
    with refused("the paper's form, which viewers do not draw; adapt it without --form paper"):
        Payload.of(replace(loaded, gaussians=paper))


def test_the_last_of_two_dropped_files_is_shown(show, save, model, gaussians):
    """At the dial value of the command line, or the largest trained one of the file."""
    less = save(
        gaussians.replace(attenuation=replace(gaussians.attenuation, max_sv=2.0))[torch.arange(9)],
        "less.ply",
    )
    shown = show(model, "--sv", 3)
    drop(shown, "slow.ply", model.read_bytes(), wait=300)
    drop(shown, "less.ply", less.read_bytes())
    shown.until("document.title === 'less.ply'")
    shown.page.wait_for_timeout(500)
    assert shown.text("#title") == "less.ply" and shown.counts()["total"] == 9
    assert shown.dial == "s = 2.00"
    take(shown, model)
    assert shown.dial == "s = 3.00"
