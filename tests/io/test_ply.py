import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from plyfile import PlyElement
from refusals import refused
from torch.testing import assert_close

from clod_adapter.config import SH_COUNTS, AttenuationConfig
from clod_adapter.io.checkpoint import Checkpoint, load, save
from clod_adapter.io.ply import UNPREFIXED
from formats import examples, model, needed, random_rows, resaved, write_elements, write_rows
from scenes import seeded

CONFIG = AttenuationConfig(form="paper", max_sv=7.0)


def read_back(path):
    """The header's lines and the rows, by hand, as a strict reader sees them."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    types = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "short": "<i2"}
    dtype = np.dtype([(w[2], types[w[1]]) for w in map(str.split, lines) if w[0] == "property"])
    count = int(next(line for line in lines if line.startswith("element vertex")).split()[2])
    assert len(body) == count * dtype.itemsize
    return lines, np.frombuffer(body, dtype)


@st.composite
def files(draw):
    degree = draw(st.integers(0, 3))
    names = needed(degree)
    names += ["nx", "ny", "nz"] if draw(st.booleans()) else []
    names += draw(
        st.lists(st.sampled_from(["label", "confidence", "time_7", "growth_d"]), unique=True)
    )
    names = draw(st.permutations(names))
    doubles = draw(st.lists(st.sampled_from(names), max_size=5))
    types = {name: "f8" for name in doubles} | {"label": draw(st.sampled_from(["u1", "i4", "i2"]))}
    vertex = random_rows(draw(st.integers(1, 5)), names, draw(st.integers(0, 1 << 16)), types)
    return vertex, draw(st.sampled_from(["<", ">", "ascii"])), degree


@examples(20)
@given(files(), st.integers(0, 1000))
def test_every_layout_round_trips(tmp_path, file, seed):
    """Bit for bit, but for values that change; growth_d without sigma_d is a column like others."""
    vertex, kind, degree = file
    source = write_rows(tmp_path / "in.ply", vertex, kind, ("made by hand",))
    out = tmp_path / "out.ply"
    before = source.read_bytes()
    base = load(source)
    g = base.gaussians
    assert g.sh_degree == degree
    assert g.sigma_d is g.growth_d is None
    assert g.means.dtype == torch.float32
    assert base.notes == ()
    save(out, g, base)
    assert read_back(out)[1].dtype.names == vertex.dtype.names
    f32 = {name: vertex[name].astype(np.float32) for name in vertex.dtype.names}
    columns = {
        "y": g.means[:, 1],
        "rot_0": g.quats[:, 0],
        "scale_2": g.log_scales[:, 2],
        "f_dc_2": g.sh0[:, 0, 2],
    }
    bands = SH_COUNTS[degree] - 1
    columns |= {f"f_rest_{k}": g.shN[:, k % bands, k // bands] for k in range(3 * bands)}
    for name, values in (columns | {"opacity": g.opacity_logits}).items():
        assert_array_equal(values, f32[name])

    generator, changes = seeded(seed), {}
    for name, old in g.tensors().items():
        touched = torch.rand(old.shape, generator=generator) < 0.3 * (seed % 2)
        changes[name] = torch.where(touched, torch.randn(old.shape, generator=generator), old)
    sigma_d = torch.linspace(0.1, 3, len(g))
    growth_d = torch.linspace(-1, 3, len(g)) if seed % 3 else None
    tuned = g.replace(**changes, sigma_d=sigma_d, growth_d=growth_d, attenuation=CONFIG)
    save(
        out,
        tuned.replace(
            means=changes["means"].requires_grad_(), sigma_d=sigma_d.double().requires_grad_()
        ),
        base,
    )
    _, rows = read_back(out)
    own = [name for name in vertex.dtype.names if name != "growth_d"]
    added = ["clod_paper", "sigma_d"]  # of CONFIG, what is not the default, but for max_sv
    added += ["growth_d"] if growth_d is not None else []
    assert list(rows.dtype.names) == own + added
    assert {rows.dtype[name].str for name in added} == {"<f4"}
    for name in own:
        assert rows.dtype[name] == vertex.dtype[name]
        unchanged = rows[name].astype(np.float32) == f32[name] if seed % 2 else slice(None)
        assert (
            rows[name][unchanged].tobytes()
            == vertex[name].astype(rows.dtype[name])[unchanged].tobytes()
        ), name
    assert source.read_bytes() == before
    again = load(out)
    assert again.gaussians == tuned and again.notes == ()
    save(tmp_path / "twice.ply", again.gaussians, again)
    assert (tmp_path / "twice.ply").read_bytes() == out.read_bytes()
    if kind == "ascii":
        for end in (b"\r\n", b"\r"):
            source.write_bytes(before.replace(b"\n", end))
            assert load(source).gaussians == g


def test_header_of_an_extended_file(tmp_path):
    vertex = random_rows(2, ["sigma_d", *needed(0)])
    comments = ("a photo", "clod_adapter max_sv 4.125", "clod_adapter odd 1")
    base = load(write_rows(tmp_path / "in.ply", vertex, comments=comments))
    assert base.gaussians.attenuation == AttenuationConfig(max_sv=4.125)
    config = dataclasses.replace(CONFIG, reference_distance=np.float32(0.01), max_sv=3)
    save(tmp_path / "out.ply", base.gaussians.replace(attenuation=config), base, version="7.8.9")
    assert load(tmp_path / "out.ply").gaussians.attenuation == config
    lines, _ = read_back(tmp_path / "out.ply")
    assert lines[3] == "comment a photo" and lines[-1] == "property float sigma_d"
    assert sum("clod_adapter max_sv" in line for line in lines) == 1
    assert not any("odd" in line for line in lines)
    assert "comment clod_adapter version 7.8.9" in lines


def test_unusable_rows_are_dropped_and_counted(tmp_path):
    names = ["masks_0", *needed(1), "nx", "sigma_d", "growth_d", "masks_1"]
    vertex = random_rows(15, names, types={"y": "f8", "opacity": "f8"})
    vertex["masks_0"], vertex["masks_1"] = 0, 0  # 0 keeps the row
    vertex["masks_0"][[8, 13, 14]] = 2, -0.5, -20  # MaskGaussian's
    vertex["x"][0] = np.nan
    vertex["f_rest_8"][1] = np.inf
    # the last is +inf as a float32
    vertex["opacity"][[2, 3, 4, 9]] = np.nan, -np.inf, np.inf, 1e300
    vertex["scale_1"][5] = -np.inf
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        vertex[name][[6, 12]] = 0, 1e-25
    vertex["sigma_d"][7] = np.nan
    vertex["nx"][8] = np.nan  # not used, so no reason to drop
    vertex["y"][10] = 1e300
    vertex["growth_d"][11] = np.inf
    checkpoint = load(write_rows(tmp_path / "in.ply", vertex))
    assert_array_equal(checkpoint.gaussians.means[:, 1], vertex["y"][[4, 8, 9]].astype("f4"))
    assert checkpoint.gaussians.opacities[0] == 1
    assert checkpoint.notes[:4] == (
        "2 of 15 Gaussians dropped: MaskGaussian existence probability below 0.5",
        "8 of 15 Gaussians dropped: a value is not finite",
        "2 of 15 Gaussians dropped: rotation is zero or not of a usable length",
        "2 Gaussians have opacity = +inf and are taken as fully opaque",
    )
    assert resaved(checkpoint).gaussians == checkpoint.gaussians
    assert read_back(tmp_path / "out.ply")[1]["opacity"][2] == 1e300


def test_refused_saves(tmp_path):
    base = load(write_rows(tmp_path / "in.ply", random_rows(3, needed(1))))
    g, out = base.gaussians, tmp_path / "out.ply"
    cases = [
        (out, g.select(torch.tensor([0, 2])), "Gaussians .2, SH degree 1, .* do not fit"),
        (out, g.replace(shN=torch.zeros(3, 0, 3)), "degree 0"),
        (out, g.replace(opacity_logits=torch.full((3,), torch.inf)), "opacity_logits"),
        (tmp_path / "in.ply", g, "is the input file"),
    ]
    dial = g.replace(sigma_d=torch.ones(3), attenuation=CONFIG)
    bad = torch.tensor([1.0, torch.inf, torch.nan])
    cases += [
        (
            out,
            dial.replace(sigma_d=bad),
            "sigma_d holds a new value that is not finite; use a large number",
        ),
        (
            out,
            dial.replace(growth_d=bad),
            "growth_d holds a new value that is not finite; use 0 for no growth",
        ),
        (out, g.replace(means=bad.expand(3, 3)), "means holds a new value that is not finite"),
    ]
    for path, changed, message in cases:
        with refused(message):
            save(path, changed, base)
    with refused("out.ply: there are no Gaussians"):
        save(out, g.select(torch.zeros(3, dtype=torch.bool)))
    assert list(tmp_path.iterdir()) == [tmp_path / "in.ply"]


def test_other_formats_keep_what_the_base_says(tmp_path):
    some = model(1, 9)
    with pytest.warns(UserWarning, match="out.spz: quantised|out.spz: .*rounded"):
        save(tmp_path / "out.spz", some)
    base = Checkpoint(some, None, ("from a trainer",), (), "", Path(), origin=(10.0, 20.0, 3.0))
    save(tmp_path / "out.pt", some, base)
    again = load(tmp_path / "out.pt", origin=(10.0, 20.0, 3.0))
    assert again.comments == ("from a trainer",)
    assert_close(again.gaussians.means, some.means)
    with refused("never overwritten"):
        save(tmp_path / "out.pt", again.gaussians, again)
    assert repr(again) == f"Checkpoint('{tmp_path}/out.pt', 9, SH degree 1, dial to 7 with growth)"


@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_rows_are_those_of_the_file_whatever_happens_to_it_later(tmp_path, order):
    """The fingerprint is of the whole file; elements around the rows, with lists too, do not
    matter.
    """
    camera = PlyElement.describe(
        np.zeros(3, [("fx", "f8"), ("n", "i2")]), "intrinsic", comments=["of the camera"]
    )
    face = PlyElement.describe(
        np.array([([0, 1],)], [("corners", "O")]), "face", val_types={"corners": "i4"}
    )
    vertex = random_rows(50, [*needed(), "label", "time"], types={"label": "u1", "time": "f8"})
    path = tmp_path / "in.ply"
    write_elements(path, [camera, PlyElement.describe(vertex, "vertex"), face], order)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    found = load(str(path), activated="none")
    path.write_bytes(bytes(path.stat().st_size))
    assert found.path == path
    assert found.fingerprint == digest
    assert found.comments == ("of the camera",)
    assert found.notes == ("not carried over to outputs: element intrinsic, element face",)
    assert found.vertex.dtype == vertex.dtype and found.vertex.dtype.isnative
    for name in vertex.dtype.names:
        assert_array_equal(found.vertex[name], vertex[name])


@pytest.mark.parametrize("order", ["<", "ascii"])
def test_comments_beyond_ascii(tmp_path, order):
    """CloudCompare writes a date in the user's language; outputs have question marks there."""
    path = write_rows(tmp_path / "in.ply", random_rows(5, needed()), order, ("made on @",))
    path.write_bytes(path.read_bytes().replace(b"@", "M\u00e4rz \x1b[2J".encode(), 1))
    found = load(path)
    assert found.comments == ("made on M??rz ?[2J",)
    assert resaved(found).gaussians == found.gaussians


@pytest.mark.parametrize("order", ["<", "ascii"])
@pytest.mark.parametrize("prefix", ["scalar_", "scal_"])
def test_columns_with_the_prefix_of_cloudcompare(tmp_path, order, prefix):
    """All but the position have it; outputs have none."""
    rows = random_rows(9, needed(1))
    plain = load(write_rows(tmp_path / "plain.ply", rows), activated="none")
    rows.dtype.names = tuple(
        name if name in "xyz" else f"{prefix}{name}" for name in rows.dtype.names
    )
    found = load(write_rows(tmp_path / "in.ply", rows, order), activated="none")
    assert found.gaussians == plain.gaussians
    assert found.vertex.dtype.names == plain.vertex.dtype.names
    assert found.notes == (UNPREFIXED,)
    assert resaved(found).vertex.dtype == plain.vertex.dtype
