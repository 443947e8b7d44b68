from pathlib import Path

import numpy as np
import pytest
import torch

from clod_adapter.adapter import extract, with_dial
from clod_adapter.config import FILTERS, AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load, save
from formats import needed, random_rows, write_rows

SCALES = ("scale_0", "scale_1", "scale_2")


def inria(count: int, *extra: str) -> np.ndarray:
    """Rows as a trainer writes them: logits on both sides of 0, small scales."""
    vertex = random_rows(count, [*needed(), *extra])
    vertex["opacity"] *= 3
    for name in SCALES:
        vertex[name] = vertex[name] * 0.7 - 3
    return vertex


def activate(vertex: np.ndarray, *what: str) -> np.ndarray:
    vertex = vertex.copy()
    if "opacity" in what:
        vertex["opacity"] = 1 / (1 + np.exp(-vertex["opacity"].astype(np.float64)))
    for name in SCALES if "scales" in what else ():
        vertex[name] = np.exp(vertex[name].astype(np.float64))
    return vertex


@pytest.mark.parametrize("what", [("opacity",), ("scales",), ("opacity", "scales")], ids="+".join)
def test_activated_values_need_the_option(tmp_path: Path, what: tuple[str, ...]) -> None:
    vertex = inria(40)
    plain = load(write_rows(tmp_path / "plain.ply", vertex))
    assert plain.notes == ()
    path = write_rows(tmp_path / "in.ply", activate(vertex, *what))
    choice = "both" if len(what) == 2 else what[0]
    with pytest.raises(ClodError, match=rf"in.ply: has {what[0]} from .* --activated {choice}, if not,") as caught:
        load(path)
    assert all(f"{name} from" in str(caught.value) for name in what)
    base = load(path, activated=choice)
    torch.testing.assert_close(base.gaussians.opacity_logits, plain.gaussians.opacity_logits, atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(base.gaussians.log_scales, plain.gaussians.log_scales, atol=1e-5, rtol=1e-5)
    assert len(base.notes) == len(what) and base.comments == base.notes
    unchanged = load(path, activated="none")
    np.testing.assert_array_equal(unchanged.gaussians.opacity_logits, activate(vertex, *what)["opacity"])
    assert unchanged.notes == () and base.fingerprint == f"{choice}:{unchanged.fingerprint}"


def test_usual_values_need_no_option(tmp_path: Path) -> None:
    few, same = activate(inria(9), "opacity", "scales"), inria(40)
    same["opacity"], same["scale_0"], same["scale_1"], same["scale_2"] = 0.5, 0.5, 0.5, 0.5
    pruned = inria(200)
    for vertex in (few, same, pruned[pruned["opacity"] > 0]):
        loaded = load(write_rows(tmp_path / "in.ply", vertex))
        np.testing.assert_array_equal(loaded.gaussians.opacity_logits, vertex["opacity"])
        assert loaded.notes == () and ":" not in loaded.fingerprint


def test_mip_splatting_is_fused(tmp_path: Path) -> None:
    """By the formula of its renderer, here in float64; extreme values are finite."""
    vertex, names = inria(40, "filter_3D"), [*needed()[:6], *needed()[-4:]]
    vertex["filter_3D"] = np.exp(np.random.default_rng(1).normal(size=40) - 2.5)
    vertex["filter_3D"][:9] = 0, 1e30, 1e-30, 0.1, 0.1, 0.1, np.nan, np.inf, -0.1
    vertex["opacity"][3:6] = np.inf, 60, -90
    vertex["scale_0"][4], vertex["scale_1"][5] = -80, -200
    size = np.exp(np.stack([vertex[name].astype(np.float64) for name in SCALES], 1))
    wide = size**2 + vertex["filter_3D"].astype(np.float64)[:, None] ** 2
    opacities = np.sqrt((size**2).prod(1) / wide.prod(1)) / (1 + np.exp(-vertex["opacity"].astype(np.float64)))
    base = load(write_rows(tmp_path / "in.ply", vertex))
    g, kept = base.gaussians, np.isfinite(vertex["filter_3D"])
    assert len(g) == 38 and g.screen_filter == FILTERS["mip"]
    assert g.opacity_logits.isfinite().all() and g.log_scales.isfinite().all()
    assert g.opacity_logits[0] == vertex["opacity"][0] and g.opacity_logits[2] == vertex["opacity"][2]
    usual = np.arange(40) != 1  # a filter of 1e30
    np.testing.assert_allclose(g.scales[usual[kept]], np.sqrt(wide)[kept & usual], rtol=2e-6)
    np.testing.assert_allclose(g.opacities[usual[kept]], opacities[kept & usual], rtol=2e-6, atol=1e-37)
    # In logs, where the opacity itself would be 0: a Gaussian thinner than float64 can square.
    log = -90 - sum(np.log(wide[5]) / 2 - np.array([vertex[name][5] for name in SCALES], np.float64))
    np.testing.assert_allclose(g.opacity_logits[5], log, rtol=1e-6)
    assert base.comments == base.notes[:1] and "filter_3D is fused" in base.comments[0]
    save(tmp_path / "out.ply", with_dial(g, torch.rand(38), AttenuationConfig()), base)
    out = load(tmp_path / "out.ply")
    assert "filter_3D" not in out.vertex.dtype.names and out.notes == () and base.comments[0] in out.comments
    assert torch.equal(out.gaussians.log_scales, g.log_scales)
    assert torch.equal(out.gaussians.opacity_logits, g.opacity_logits)
    for name in names:
        np.testing.assert_array_equal(out.vertex[name], vertex[name][kept])


def test_activated_opacities_extreme_values(tmp_path: Path) -> None:
    vertex = activate(inria(40), "opacity")
    vertex["opacity"][:5] = 0, 1, 1.5, -0.05, np.nan  # Taming-3DGS activates by the absolute value
    base = load(write_rows(tmp_path / "in.ply", vertex), activated="opacity")
    assert len(base.gaussians) == 39 and base.gaussians.opacity_logits.isfinite().all()
    torch.testing.assert_close(base.gaussians.opacities[:4], torch.tensor([0, 1, 1, 0.05]), atol=1e-7, rtol=1e-5)
    assert "1 above 1 taken as 1" in base.notes[0]
    with pytest.raises(ClodError, match="activated is 'yes'.*none, opacity, scales, both"):
        load(tmp_path / "in.ply", activated="yes")  # type: ignore[arg-type]
    vertex["opacity"] = 1
    with pytest.raises(ClodError, match="opacity from 1 to 1"):
        load(write_rows(tmp_path / "in.ply", vertex))


def test_own_outputs_need_no_option(tmp_path: Path) -> None:
    """An opaque result, as every logit may be above 0 after tuning; its adapter knows how its base was read."""
    path = write_rows(tmp_path / "in.ply", activate(inria(40), "opacity", "scales"))
    base = load(path, activated="both")
    g = base.gaussians
    tuned = with_dial(g.replace(opacity_logits=g.opacity_logits.abs()), torch.rand(40), AttenuationConfig())
    adapter = extract(g, tuned, fingerprint=base.fingerprint, config={})
    save(tmp_path / "out.ply", adapter.apply(g, load(path, activated="both").fingerprint), base)
    out = load(tmp_path / "out.ply")
    torch.testing.assert_close(out.gaussians.opacity_logits, g.opacity_logits.abs(), atol=2e-2, rtol=1e-3)
    assert out.comments[:2] == base.notes
    with pytest.raises(ClodError, match="different base.*trained on both:"):
        adapter.apply(g, load(path, activated="none").fingerprint)
