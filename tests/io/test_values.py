"""Values that are read as others than are stored: activated ones, Mip-Splatting's, coordinates far
from 0.
"""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData
from refusals import refused
from torch.testing import assert_close

import clod_adapter as clod
from clod_adapter.adapter import extract, with_dial
from clod_adapter.config import FILTERS, AttenuationConfig
from clod_adapter.io.checkpoint import load, save
from clod_adapter.origin import NOWHERE, origin_of
from formats import needed, random_rows, resaved, write_rows
from scenes import gaussians

SCALES = ("scale_0", "scale_1", "scale_2")


def inria(count, *extra):
    """Rows as a trainer writes them: logits on both sides of 0, small scales."""
    vertex = random_rows(count, [*needed(), *extra])
    vertex["opacity"] *= 3
    for name in SCALES:
        vertex[name] = vertex[name] * 0.7 - 3
    return vertex


def activate(vertex, *what):
    vertex = vertex.copy()
    if "opacity" in what:
        vertex["opacity"] = 1 / (1 + np.exp(-vertex["opacity"].astype(np.float64)))
    for name in SCALES if "scales" in what else ():
        vertex[name] = np.exp(vertex[name].astype(np.float64))
    return vertex


@pytest.mark.parametrize("what", [("opacity",), ("scales",), ("opacity", "scales")], ids="+".join)
def test_activated_values_need_the_option(tmp_path, what):
    vertex = inria(40)
    plain = load(write_rows(tmp_path / "plain.ply", vertex))
    assert plain.notes == ()
    path = write_rows(tmp_path / "in.ply", activate(vertex, *what))
    choice = "both" if len(what) == 2 else what[0]
    with refused(rf"in.ply: has {what[0]} from .* --activated {choice}, if not,") as caught:
        load(path)
    assert all(f"{name} from" in str(caught.value) for name in what)
    base = load(path, activated=choice)
    assert_close(
        base.gaussians.opacity_logits, plain.gaussians.opacity_logits, atol=1e-3, rtol=1e-4
    )
    assert_close(base.gaussians.log_scales, plain.gaussians.log_scales, atol=1e-5, rtol=1e-5)
    assert len(base.notes) == len(what) and base.comments == base.notes
    unchanged = load(path, activated="none")
    assert_array_equal(unchanged.gaussians.opacity_logits, activate(vertex, *what)["opacity"])
    assert unchanged.notes == () and base.fingerprint == f"{choice}:{unchanged.fingerprint}"


def test_usual_values_need_no_option(tmp_path):
    few = activate(inria(9), "opacity", "scales")
    same = inria(40)
    for name in ("opacity", *SCALES):
        same[name] = 0.5
    pruned = inria(200)
    for vertex in (few, same, pruned[pruned["opacity"] > 0]):
        loaded = load(write_rows(tmp_path / "in.ply", vertex))
        assert_array_equal(loaded.gaussians.opacity_logits, vertex["opacity"])
        assert loaded.notes == () and ":" not in loaded.fingerprint


def test_mip_splatting_is_fused(tmp_path):
    """The formula is its renderer's, here in float64; extreme values are finite."""
    vertex, names = inria(40, "filter_3D"), [*needed()[:6], *needed()[-4:]]
    vertex["filter_3D"] = np.exp(np.random.default_rng(1).normal(size=40) - 2.5)
    vertex["filter_3D"][:9] = 0, 1e30, 1e-30, 0.1, 0.1, 0.1, np.nan, np.inf, -0.1
    vertex["opacity"][3:6] = np.inf, 60, -90
    vertex["scale_0"][4], vertex["scale_1"][5] = -80, -200
    size = np.exp(np.stack([vertex[name].astype(np.float64) for name in SCALES], 1))
    wide = size**2 + vertex["filter_3D"].astype(np.float64)[:, None] ** 2
    opacities = np.sqrt((size**2).prod(1) / wide.prod(1)) / (
        1 + np.exp(-vertex["opacity"].astype(np.float64))
    )
    base = load(write_rows(tmp_path / "in.ply", vertex))
    g, kept = base.gaussians, np.isfinite(vertex["filter_3D"])
    assert len(g) == 38 and g.screen_filter == FILTERS["mip"]
    assert g.opacity_logits.isfinite().all() and g.log_scales.isfinite().all()
    assert g.opacity_logits[0] == vertex["opacity"][0]
    assert g.opacity_logits[2] == vertex["opacity"][2]
    usual = np.arange(40) != 1  # a filter of 1e30
    assert_allclose(g.scales[usual[kept]], np.sqrt(wide)[kept & usual], rtol=2e-6)
    assert_allclose(g.opacities[usual[kept]], opacities[kept & usual], rtol=2e-6, atol=1e-37)
    # In logs, where the opacity itself would be 0: a Gaussian thinner than float64 can square.
    log = -90 - sum(
        np.log(wide[5]) / 2 - np.array([vertex[name][5] for name in SCALES], np.float64)
    )
    assert_allclose(g.opacity_logits[5], log, rtol=1e-6)
    assert base.comments == base.notes[:1] and "filter_3D is fused" in base.comments[0]
    out = resaved(base, with_dial(g, torch.rand(38), AttenuationConfig()))
    assert "filter_3D" not in out.vertex.dtype.names
    assert out.notes == ()
    assert base.comments[0] in out.comments
    assert torch.equal(out.gaussians.log_scales, g.log_scales)
    assert torch.equal(out.gaussians.opacity_logits, g.opacity_logits)
    for name in names:
        assert_array_equal(out.vertex[name], vertex[name][kept])


def test_activated_opacities_extreme_values(tmp_path):
    vertex = activate(inria(40), "opacity")
    vertex["opacity"][:5] = 0, 1, 1.5, -0.05, np.nan  # Taming-3DGS activates by the absolute value
    base = load(write_rows(tmp_path / "in.ply", vertex), activated="opacity")
    assert len(base.gaussians) == 39 and base.gaussians.opacity_logits.isfinite().all()
    assert_close(base.gaussians.opacities[:4], torch.tensor([0, 1, 1, 0.05]), atol=1e-7, rtol=1e-5)
    assert "1 above 1 taken as 1" in base.notes[0]
    with refused("activated is 'yes'.*none, opacity, scales, both"):
        load(tmp_path / "in.ply", activated="yes")
    vertex["opacity"] = 1
    with refused("opacity from 1 to 1"):
        load(write_rows(tmp_path / "in.ply", vertex))


def test_own_outputs_need_no_option(tmp_path):
    """An opaque result, as every logit may be above 0 after tuning; its adapter knows how its base
    was read.
    """
    path = write_rows(tmp_path / "in.ply", activate(inria(40), "opacity", "scales"))
    base = load(path, activated="both")
    g = base.gaussians
    tuned = with_dial(
        g.replace(opacity_logits=g.opacity_logits.abs()), torch.rand(40), AttenuationConfig()
    )
    adapter = extract(g, tuned, fingerprint=base.fingerprint, config={})
    save(tmp_path / "out.ply", adapter.apply(g, load(path, activated="both").fingerprint), base)
    out = load(tmp_path / "out.ply")
    assert_close(out.gaussians.opacity_logits, g.opacity_logits.abs(), atol=2e-2, rtol=1e-3)
    assert out.comments[:2] == base.notes
    with refused("different base.*the adapter both:"):
        adapter.apply(g, load(path, activated="none").fingerprint)


UTM = np.array([437_123.25, -4_481_010.5, 1_000.0])


def moved(path, out, kind):
    """The file's coordinates UTM away, as columns of ``kind``."""
    old = PlyData.read(str(path))["vertex"].data
    new = old.astype(
        [(name, kind if name in "xyz" else old.dtype[name]) for name in old.dtype.names]
    )
    for axis, by in zip("xyz", UTM, strict=True):
        new[axis] = old[axis].astype("f8") + by
    return write_rows(out, new)


def test_only_distant_scenes_have_an_origin():
    near = np.random.default_rng(0).normal(size=(500, 3))
    floater = np.concatenate([near, [[1e9, 0, 0]]])
    none = (near, near + 40, floater, near[:1] + UTM, np.zeros((0, 3)), np.full((3, 3), np.nan))
    assert {origin_of(each) for each in none} == {NOWHERE}
    assert np.abs(np.array(origin_of(floater + UTM)) - UTM).max() < 5
    for length in (1e-320, 1e-9):
        assert origin_of(np.linspace([1, 0, 0], [1, 0, length], 100))[0] == 1.0
    origin = origin_of(near * [1, 1, 1e-3] + [1e6, -0.1, -1e-4])
    assert origin[0] > 9e5 and [str(value) for value in origin[1:]] == ["0.0", "0.0"]  # not -0.0


@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_round_trip_of_distant_scenes_is_exact(tmp_path, kind):
    base = gaussians(200, 1, 0)
    clod.save(tmp_path / "near.ply", base)
    far = clod.load(moved(tmp_path / "near.ply", tmp_path / "far.ply", kind))
    stored = np.stack([far.vertex[axis].astype("f8") for axis in "xyz"], 1)
    assert_allclose(far.gaussians.means.double().numpy() + far.origin, stored, rtol=0, atol=3e-7)
    if kind == "f8":  # the picture is that of the scene near 0
        apart = (far.gaussians.means - base.means).double().numpy() + far.origin - UTM
        assert np.abs(apart).max() < 1e-6
    else:
        assert (far.gaussians.means.double().numpy() + far.origin == stored).all()
    assert "far from 0" in far.notes[-1]
    tuned = far.gaussians.means.clone()
    tuned[:50] += 1e-4
    clod.save(tmp_path / "out.ply", clod.with_dial(far.gaussians.replace(means=tuned)), far)
    out = PlyData.read(str(tmp_path / "out.ply"))["vertex"].data
    written = np.stack([out[axis] for axis in "xyz"], 1)
    assert written.dtype == np.float64 and (written[50:] == stored[50:]).all()
    assert_allclose(written[:50], tuned[:50].double().numpy() + far.origin, rtol=0, atol=1e-9)
    again = clod.load(tmp_path / "out.ply", origin=far.origin)
    assert again.gaussians.means.equal(tuned) and again.origin == far.origin
    adapter = clod.extract(
        far.gaussians, clod.with_dial(far.gaussians), fingerprint="", config={}, origin=far.origin
    )
    clod.save_adapter(tmp_path / "far.safetensors", adapter)
    assert clod.load_adapter(tmp_path / "far.safetensors").origin == far.origin
