from __future__ import annotations

import dataclasses
import hashlib
import os
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from clod_adapter.adapter import detach, trim
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint, load, save, trimmed
from clod_adapter.io.file_formats import handle_name
from clod_adapter.io.file_formats import write as save_as
from clod_adapter.io.ply import column_map
from formats import model, write_elements, write_rows

RESTS = (0, 9, 24, 45, 72)
CONFIG = AttenuationConfig(tau=0.02, eps=1e-7, normalizer="quantile", quantile=1 / 3, max_sv=7.0)


def needed(degree: int) -> list[str]:
    groups = column_map(degree)
    rest = [f"f_rest_{i}" for i in range(RESTS[degree])]
    return [*groups["means"], *groups["sh0"], *rest, "opacity", *groups["log_scales"], *groups["quats"]]


def make(n: int, names: list[str], seed: int = 0, types: dict[str, str] | None = None) -> np.ndarray:
    rng = np.random.default_rng(seed)
    vertex = np.empty(n, [(name, (types or {}).get(name, "f4")) for name in names])
    for name in names:
        vertex[name] = rng.integers(0, 99, n) if vertex.dtype[name].kind in "iu" else rng.normal(size=n)
    return vertex


def rotated(vertex: np.ndarray, value: float) -> np.ndarray:
    """The rows with this value in every rotation."""
    for i in range(4):
        vertex[f"rot_{i}"] = value
    return vertex


def read_back(path: Path) -> tuple[list[str], np.ndarray]:
    """The header's lines and the rows, by hand, as a strict reader sees them."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    types = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "short": "<i2"}
    dtype = np.dtype([(w[2], types[w[1]]) for w in map(str.split, lines) if w[0] == "property"])
    count = int(next(line for line in lines if line.startswith("element vertex")).split()[2])
    assert len(body) == count * dtype.itemsize
    return lines, np.frombuffer(body, dtype)


def same(a: Gaussians, b: Gaussians) -> bool:
    x, y = a.tensors(), b.tensors()
    return x.keys() == y.keys() and all(torch.equal(x[k].view(torch.int32), y[k].view(torch.int32)) for k in x)


@st.composite
def files(draw: st.DrawFn) -> tuple[np.ndarray, str, int]:
    degree = draw(st.integers(0, 4))
    names = needed(degree)
    names += ["nx", "ny", "nz"] if draw(st.booleans()) else []
    names += draw(st.lists(st.sampled_from(["label", "confidence", "time_7", "growth_d"]), unique=True))
    names = draw(st.permutations(names))
    doubles = draw(st.lists(st.sampled_from(names), max_size=5))
    types = {name: "f8" for name in doubles} | {"label": draw(st.sampled_from(["u1", "i4", "i2"]))}
    vertex = make(draw(st.integers(1, 5)), names, draw(st.integers(0, 1 << 16)), types)
    return vertex, draw(st.sampled_from(["<", ">", "ascii"])), degree


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(files(), st.integers(0, 1000))
def test_every_layout_round_trips(tmp_path: Path, file: tuple[np.ndarray, str, int], seed: int) -> None:
    """Every column is read and written bit for bit, but for the values that change; what training gives is saved.

    A growth_d without a sigma_d is a column like others, until there is a dial.
    """
    vertex, kind, degree = file
    source, out = write_rows(tmp_path / "in.ply", vertex, kind, ("made by hand",)), tmp_path / "out.ply"
    before = source.read_bytes()
    base = load(source)
    g = base.gaussians
    assert g.sh_degree == degree and g.sigma_d is g.growth_d is None and g.means.dtype == torch.float32
    assert base.notes == ()
    save(out, g, base)
    assert read_back(out)[1].dtype.names == vertex.dtype.names
    f32 = {name: vertex[name].astype(np.float32) for name in vertex.dtype.names}
    columns = {"y": g.means[:, 1], "rot_0": g.quats[:, 0], "scale_2": g.log_scales[:, 2], "f_dc_2": g.sh0[:, 0, 2]}
    bands = RESTS[degree] // 3
    columns |= {f"f_rest_{c * bands + k}": g.shN[:, k, c] for k in range(bands) for c in range(3)}
    for name, values in (columns | {"opacity": g.opacity_logits}).items():
        np.testing.assert_array_equal(values, f32[name])

    generator, changes = torch.Generator().manual_seed(seed), {}
    for name, old in g.tensors().items():
        touched = torch.rand(old.shape, generator=generator) < 0.3 * (seed % 2)
        changes[name] = torch.where(touched, torch.randn(old.shape, generator=generator), old)
    sigma_d = torch.linspace(0.1, 3, len(g))
    growth_d = torch.linspace(-1, 3, len(g)) if seed % 3 else None
    tuned = g.replace(**changes, sigma_d=sigma_d, growth_d=growth_d, attenuation=CONFIG)
    save(out, tuned.replace(means=changes["means"].requires_grad_(), sigma_d=sigma_d.double().requires_grad_()), base)
    _, rows = read_back(out)
    own = [name for name in vertex.dtype.names if name != "growth_d"]
    added = ["clod_eps", "clod_quantile", "sigma_d"]  # of CONFIG, what is not the default, but for max_sv
    added += ["growth_d"] if growth_d is not None else []
    assert list(rows.dtype.names) == own + added and {rows.dtype[name].str for name in added} == {"<f4"}
    for name in own:
        assert rows.dtype[name] == vertex.dtype[name]
        unchanged = rows[name].astype(np.float32) == f32[name] if seed % 2 else slice(None)
        assert rows[name][unchanged].tobytes() == vertex[name].astype(rows.dtype[name])[unchanged].tobytes(), name
    assert source.read_bytes() == before
    again = load(out)
    assert same(again.gaussians, tuned) and again.gaussians.attenuation == CONFIG and again.notes == ()
    save(tmp_path / "twice.ply", again.gaussians, again)
    assert (tmp_path / "twice.ply").read_bytes() == out.read_bytes()
    if kind == "ascii":
        source.write_bytes(before.replace(b"\n", b"\r\n"))
        assert same(load(source).gaussians, g)


def test_header_of_an_extended_file(tmp_path: Path) -> None:
    vertex = make(2, ["sigma_d", *needed(0)])
    comments = ("a photo", "clod_adapter tau 0.125", "clod_adapter odd 1")
    base = load(write_rows(tmp_path / "in.ply", vertex, comments=comments))
    assert base.gaussians.attenuation == AttenuationConfig(tau=0.125, cut="hard", reference_distance=1.0)
    config = dataclasses.replace(CONFIG, reference_distance=np.float64(1) / 3, max_sv=3, tau=np.float32(0.01))
    save(tmp_path / "out.ply", base.gaussians.replace(attenuation=config), base, version="7.8.9")
    assert load(tmp_path / "out.ply").gaussians.attenuation == config
    lines, rows = read_back(tmp_path / "out.ply")
    assert lines[:4] == ["ply", "format binary_little_endian 1.0", "element vertex 2", "comment a photo"]
    assert sum("clod_adapter tau" in line for line in lines) == 1 and not any("odd" in line for line in lines)
    for line in (f"tau {float(config.tau)!r}", "normalizer quantile", "version 7.8.9"):
        assert f"comment clod_adapter {line}" in lines
    assert lines[-1] == "property float sigma_d" and rows.dtype.names[-1] == "sigma_d"
    assert sum(name == "sigma_d" for name in rows.dtype.names) == 1


def test_mask_gaussian_layout(tmp_path: Path) -> None:
    names = needed(3)
    at = names.index("opacity") + 1
    vertex = make(5, [*names[:at], "masks_0", "masks_1", *names[at:]])
    vertex["masks_0"], vertex["masks_1"] = [-0.5, 2.0, 0.0, -20.0, 0.25], [0.0, 0.0, 0.0, 0.0, 0.25]  # 0 keeps the row
    checkpoint = load(write_rows(tmp_path / "in.ply", vertex))
    assert "2 of 5" in checkpoint.notes[0] and checkpoint.vertex.tobytes() == vertex[[1, 2, 4]].tobytes()
    np.testing.assert_array_equal(checkpoint.gaussians.means[:, 0], vertex["x"][[1, 2, 4]])
    save(tmp_path / "out.ply", checkpoint.gaussians, checkpoint)
    assert load(tmp_path / "out.ply").notes == ()


def test_unusable_rows_are_dropped_and_counted(tmp_path: Path) -> None:
    vertex = make(13, [*needed(1), "nx", "sigma_d", "growth_d"], types={"y": "f8", "opacity": "f8"})
    vertex["x"][0] = np.nan
    vertex["f_rest_8"][1] = np.inf
    vertex["opacity"][[2, 3, 4, 9]] = np.nan, -np.inf, np.inf, 1e300  # the last is +inf as a float32
    vertex["scale_1"][5] = -np.inf
    rotated(vertex[6:7], 0)
    rotated(vertex[12:], 1e-25)
    vertex["sigma_d"][7] = np.nan
    vertex["nx"][8] = np.nan  # not used, so no reason to drop
    vertex["y"][10] = 1e300
    vertex["growth_d"][11] = np.inf
    checkpoint = load(write_rows(tmp_path / "in.ply", vertex))
    np.testing.assert_array_equal(checkpoint.gaussians.means[:, 1], vertex["y"][[4, 8, 9]].astype("f4"))
    assert checkpoint.gaussians.opacities[0] == 1
    assert checkpoint.notes[:3] == (
        "8 of 13 Gaussians dropped: a value is not finite",
        "2 of 13 Gaussians dropped: rotation is zero or not of a usable length",
        "2 Gaussians have opacity = +inf and are taken as fully opaque",
    )
    save(tmp_path / "out.ply", checkpoint.gaussians, checkpoint)
    assert same(load(tmp_path / "out.ply").gaussians, checkpoint.gaussians)
    assert read_back(tmp_path / "out.ply")[1]["opacity"][2] == 1e300


def test_elements_that_are_not_written_are_noted(tmp_path: Path) -> None:
    vertex = PlyElement.describe(make(2, needed(0)), "vertex")
    camera = PlyElement.describe(np.zeros(1, [("fx", "f4")]), "intrinsic", comments=["of the camera"])
    PlyData([camera, vertex], byte_order="<", obj_info=["x"], comments=["first"]).write(str(tmp_path / "in.ply"))
    checkpoint = load(str(tmp_path / "in.ply"))
    assert checkpoint.path == tmp_path / "in.ply" and checkpoint.comments == ("first", "of the camera")
    assert checkpoint.notes == ("not carried over to outputs: element intrinsic, obj_info",)
    save(tmp_path / "out.ply", checkpoint.gaussians, checkpoint)
    assert not any(line.startswith("obj_info") for line in read_back(tmp_path / "out.ply")[0])


def without(*names: str, add: tuple[str, ...] = (), degree: int = 1) -> list[str]:
    return [name for name in needed(degree) if name not in names] + list(add)


@pytest.mark.parametrize(
    ("vertex", "message"),
    [
        (make(2, ["packed_position", "packed_rotation"]), "compressed PLY without its element chunk"),
        (make(2, without(add=("f_offset_0", "f_anchor_feat_0"))), "Scaffold-GS"),
        (make(2, without("scale_2")), "2DGS"),
        (make(2, ["x", "y", "z", "nx", "ny", "nz"]), "mesh or a point cloud"),
        (make(2, ["x", "y", "z", "red"]), "mesh or a point cloud"),
        *((make(2, without(name)), f"property {name} is missing") for name in ("rot_3", "y", "opacity", "f_dc_1")),
        (make(2, without("f_rest_4")), "8 f_rest"),
        (make(2, without("f_rest_4", add=("f_rest_9",))), "property f_rest_4 is missing"),
        (make(2, needed(0), types={"x": "i4"}), "property x is not float"),
        (make(0, needed(0)), "no usable Gaussian"),
        *((rotated(make(3, needed(0)), fill), "no usable Gaussian.*3 of 3") for fill in (np.nan, 0.0)),
    ],
)  # fmt: skip
def test_refused_layouts(tmp_path: Path, vertex: np.ndarray, message: str) -> None:
    path = write_rows(tmp_path / "in.ply", vertex)
    with pytest.raises(ClodError, match=message) as caught:
        load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_refused_elements(tmp_path: Path) -> None:
    path = tmp_path / "in.ply"
    with pytest.raises(ClodError, match="no vertex element.*point"):
        load(write_elements(path, [PlyElement.describe(make(2, needed(0)), "point")]))
    with pytest.raises(ClodError, match="no usable Gaussian|damaged"):
        load(write_rows(path, make(0, needed(0)), "ascii"))
    lists = np.ones(2, [(name, "f4") for name in needed(0)] + [("bones", "O")])
    lists["bones"] = [np.array([1], "i4"), np.array([2, 3], "i4")]
    with pytest.raises(ClodError, match="property bones is a list"):
        load(write_rows(path, lists))
    header = "element vertex 1\nproperty float x\nelement face 999999999\nproperty list uchar int vertex_indices\n"
    path.write_text(f"ply\nformat binary_little_endian 1.0\n{header}end_header\n")
    with pytest.raises(ClodError, match="mesh or a point cloud"):  # without reading its faces
        load(path)


def test_refused_saves(tmp_path: Path) -> None:
    base = load(write_rows(tmp_path / "in.ply", make(3, needed(1))))
    g, out = base.gaussians, tmp_path / "out.ply"
    refused = [
        (out, g.select(torch.tensor([0, 2])), "2 Gaussians of SH degree 1 do not fit"),
        (out, g.replace(shN=torch.zeros(3, 0, 3)), "degree 0"),
        (out, g.replace(opacity_logits=torch.full((3,), torch.inf)), "opacity_logits"),
        (tmp_path / "in.ply", g, "is the input file"), (tmp_path / "no" / "out.ply", g, "does not exist"),
    ]  # fmt: skip
    for bad in (torch.inf, torch.nan):
        sigma_d = g.replace(sigma_d=torch.tensor([1.0, bad, 1.0]), attenuation=CONFIG)
        refused.append((out, sigma_d, "sigma_d holds a value that is not finite; use a large number"))
        growth_d = g.replace(sigma_d=torch.ones(3), growth_d=torch.tensor([1.0, bad, 1.0]), attenuation=CONFIG)
        refused.append((out, growth_d, "growth_d holds a value that is not finite; use 0 for no growth"))
        refused.append((out, g.replace(means=torch.full((3, 3), bad)), "means holds a new value that is not finite"))
    for path, changed, message in refused:
        with pytest.raises(ClodError, match=message):
            save(path, changed, base)
    with pytest.raises(ClodError, match="out.ply: there are no Gaussians"):
        save(out, g.select(torch.zeros(3, dtype=torch.bool)))
    assert list(tmp_path.iterdir()) == [tmp_path / "in.ply"]


@pytest.mark.parametrize(("suffix", "module"), [(".safetensors", "tensor_file"), (".pt", "formats.pt")])
def test_fingerprint_and_rows_are_of_one_file(
    tmp_path: Path, suffix: str, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is replaced while it is open; for the PLY see ply/test_body."""
    path, other = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    save_as(path, detach(model(1)))
    save_as(other, detach(model(0)))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    monkeypatch.setattr("clod_adapter.io.file_formats.check_readable", lambda path: None)
    name = f"clod_adapter.io.{module}.handle_name"
    monkeypatch.setattr(name, lambda file: (os.replace(other, path), handle_name(file))[1])
    found = load(path)
    assert found.fingerprint == digest and found.gaussians.sh_degree == 1 and not other.exists()


@pytest.mark.parametrize(
    ("file", "count", "degree"),
    [
        ("ci_banana/pretrained.ply", 20_000, 3), ("splats/playbot_lod4_from_sog.ply", 8_406, 2),
        ("splats/lod_tiles/lod5_tile_0.ply", 111, 3), ("plush_half/pretrained_mask.ply", 58_438, 3),
    ],
)  # fmt: skip
def test_real_files(tmp_path: Path, shared_data: Callable[[str], Path], file: str, count: int, degree: int) -> None:
    path = shared_data(file)
    checkpoint = load(path)
    assert len(checkpoint.gaussians) == count and checkpoint.gaussians.sh_degree == degree
    save(tmp_path / "out.ply", checkpoint.gaussians, checkpoint)
    out, source = (p.read_bytes().split(b"end_header\n", 1) for p in (tmp_path / "out.ply", path))
    if "mask" not in file:
        assert out[1] == source[1]
    else:
        assert checkpoint.notes == ("61562 of 120000 Gaussians dropped: MaskGaussian existence probability below 0.5",)
    properties = [re.findall(rb"property \S+ \S+", part[0]) for part in (out, source)]
    assert properties[0] == properties[1]


@pytest.mark.parametrize(("rows", "degree"), [(None, 1), ([1, 4, 8], None), ([1, 4, 8], 0)])
def test_trimmed_checkpoint_keeps_its_other_columns(tmp_path: Path, rows: list[int] | None, degree: int | None) -> None:
    checkpoint = load(write_rows(tmp_path / "a.ply", make(9, ["label", *reversed(needed(2))], types={"label": "u1"})))
    kept = None if rows is None else torch.isin(torch.arange(9), torch.tensor(rows))
    less = trimmed(checkpoint, kept, degree)
    save(tmp_path / "less.ply", less.gaussians, less)
    found = load(tmp_path / "less.ply")
    assert same(found.gaussians, trim(checkpoint.gaussians, kept, degree))
    assert found.vertex["label"].tolist() == checkpoint.vertex["label"][rows or slice(None)].tolist()
    names = [name for name in checkpoint.vertex.dtype.names if name in found.vertex.dtype.names]
    assert list(found.vertex.dtype.names) == names  # in the order of the file
    assert less.fingerprint == checkpoint.fingerprint
    assert trimmed(checkpoint, None, None) is checkpoint


@pytest.mark.parametrize("suffix", [".glb", ".pt", ".safetensors", ".spz", ".PLY"])
def test_the_suffix_decides_the_format(tmp_path: Path, suffix: str) -> None:
    some = model(1, 9)
    some = some.replace(opacity_logits=some.opacity_logits.clamp(max=20))
    with warnings.catch_warnings(record=True) as losses:
        save(tmp_path / f"out{suffix}", some)
    again = load(tmp_path / f"out{suffix}")
    start = (tmp_path / f"out{suffix}").read_bytes()[:4]
    assert (start == b"ply\n") == (suffix == ".PLY") and bool(losses) == (suffix == ".spz")
    torch.testing.assert_close(again.gaussians.means, some.means, rtol=1e-3, atol=1e-3)
    assert again.gaussians.attenuation == some.attenuation and again.gaussians.sigma_d is not None


def test_other_formats_keep_what_the_base_says(tmp_path: Path) -> None:
    """Its origin and its comments; the input is not overwritten."""
    some = model(1, 9)
    base = Checkpoint(some, None, ("from a trainer",), (), "", Path(), origin=(10.0, 20.0, 3.0))
    save(tmp_path / "out.pt", some, base)
    again = load(tmp_path / "out.pt", origin=(10.0, 20.0, 3.0))
    assert again.comments == ("from a trainer",)
    torch.testing.assert_close(again.gaussians.means, some.means)
    with pytest.raises(ClodError, match="never overwritten"):
        save(tmp_path / "out.pt", again.gaussians, again)
    with pytest.raises(ClodError, match="no room for a dial"):
        save(tmp_path / "out.splat", some)
    assert repr(again) == f"Checkpoint('{tmp_path}/out.pt', 9, SH degree 1, dial to 7 with growth)"
