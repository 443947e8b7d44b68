"""Near and far Gaussians: the equation, merging, training, and files, of which plain viewers show
the checkpoint.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData
from torch.nn.functional import pad

import clod_adapter as clod
from clod_adapter import adapt, detach, make_plan, render
from clod_adapter.adapter import ATTRIBUTES
from clod_adapter.bake import bake
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.evaluation.budget import dial_for
from clod_adapter.initialization.merging import merge
from clod_adapter.io.file_formats import write
from clod_adapter.io.settings import Metadata
from clod_adapter.rasterizers import cpu, reference
from clod_adapter.rasterizers.protocol import Rasterizer
from runs import config_of
from scenes import assert_equal, capture, gaussians, ring

PLAIN = Rasterizer(reference.rasterize)


@pytest.fixture(scope="module")
def both():
    return capture()


def test_far_ones_have_harmonics_where_higher_degrees_are_empty(both):
    base, scene = both
    empty = pad(base.shN, (0, 0, 0, 5))
    found = adapt(base.replace(shN=empty), scene, config_of(iters=0)).gaussians
    assert torch.equal(found.shN[:, :3], adapt(base, scene, config_of(iters=0)).gaussians.shN)
    assert found.shN[~found.near, :3].any() and not found.shN[:, 3:].any()


@pytest.fixture(scope="module")
def adapted(both):
    return adapt(*both, config_of(iters=40)).gaussians


def test_far_ones_take_over_from_near_ones():
    """Continuously, at near_distance; opacities of both sum to the near one's where the far one
    does not fade yet.
    """
    config = AttenuationConfig(near_distance=2.0)
    d = torch.linspace(0, 4, 4001, dtype=torch.float64)
    s = 1.5
    near, far = (
        attenuate(torch.full_like(d, 0.8), torch.full_like(d, sigma), d, s, config, activated=True)
        for sigma in (0.0, 1e6)
    )
    assert torch.allclose(near.drawn + far.drawn, torch.tensor(0.8, dtype=torch.float64), atol=1e-9)
    assert torch.equal(near.keep, d * s < 2)
    assert torch.equal(far.keep, (d * s / 2).square() * 12 - 11 > 0)
    slopes = torch.stack([near.drawn, far.drawn]).diff(dim=1).abs() / d.clamp(min=1e-9).log().diff()
    assert float(slopes[:, 1:].max()) <= 24 * 0.8 + 1e-6


def test_few_photographs_merge_nothing_away(both):
    """Beside few photographs there are as many far Gaussians as near ones, else fewer."""
    base, scene = both
    few = clod.add_pseudo_views(base, replace(scene, train=scene.train[:4]))
    assert len(few.train) > 4
    start = make_plan(base, few, config_of()).start
    assert len(start) == 2 * len(base)
    assert len(make_plan(base, scene, config_of()).start) < len(start)


def test_rasterizers_agree(adapted):
    for camera in ring(3, 48, 32):
        for s in (0.0, 1.0, 2.0, 4.0):
            given = (adapted, camera, s)
            change = cpu.RASTERIZER.draw(*given)[0] - PLAIN.draw(*given)[0]
            assert float(change.abs().max()) < 2e-3
            assert torch.equal(cpu.RASTERIZER.kept(*given), PLAIN.kept(*given))


def test_merging_keeps_mass_and_centre():
    model = gaussians(400, 1, 3)
    few = merge(model, 100)
    assert len(few) == 100 and few.sh_degree == 1
    assert all(x.isfinite().all() for x in few.tensors().values())
    assert torch.allclose(few.means.mean(0), model.means.mean(0), atol=0.3)
    assert_equal(merge(model, 400), merge(model, 500))
    twins = model.select(torch.arange(50).repeat(2))
    one = merge(twins, 50, torch.ones(100))
    places = [{*map(tuple, g.means.round(decimals=4).tolist())} for g in (one, model[:50])]
    assert places[0] == places[1]
    faint = model.replace(sh0=model.sh0 * 1e-25)
    with np.errstate(all="raise"):
        assert len(merge(faint, 100, torch.ones(400))) == 100


def test_near_ones_are_the_checkpoint(adapted, both):
    base, scene = both
    assert adapted.whole == len(base) < len(adapted) and adapted.near is not None
    assert_equal(detach(adapted), base)
    camera = scene.test[0].camera
    assert torch.equal(render(adapted, camera, 0.0).image, render(base, camera).image)


@pytest.mark.parametrize("suffix", [".ply", ".pt", ".spz"])
def test_files(adapted, tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write(path, adapted, Metadata())
    found = clod.load(path).gaussians
    assert found.whole == adapted.whole and found.attenuation == adapted.attenuation
    within = {"atol": 0.5, "rtol": 0.1} if suffix == ".spz" else {"atol": 0, "rtol": 0}
    assert torch.allclose(found.opacity_logits, adapted.opacity_logits, **within)
    if suffix == ".ply":
        assert_equal(found, adapted)
        opacity = PlyData.read(str(path))["vertex"]["opacity"]
        assert np.array_equal(opacity <= -20, ~adapted.near.numpy())


def test_the_adapter_has_the_far_ones(adapted, both, tmp_path):
    adapter = clod.extract(both[0], adapted, fingerprint="0" * 64, config={})
    assert not adapter.updates
    assert {*adapter.added} == {*ATTRIBUTES}
    assert adapter.base_count == len(both[0])
    clod.save_adapter(tmp_path / "a.safetensors", adapter)
    assert_equal(clod.load_adapter(tmp_path / "a.safetensors").apply(both[0]), adapted)


def test_counts_and_baking(adapted, both):
    cameras = [view.camera for view in both[1].train]
    s = dial_for(adapted, keep=80, cameras=cameras, baked=True).virtual_scale
    assert 60 < len(bake(adapted, s, cameras=cameras)) <= 80
    camera = cameras[0]
    baked = render(bake(adapted, 1.7, camera), camera).image
    assert torch.allclose(baked, render(adapted, camera, 1.7).image, atol=1e-3)


def test_a_second_run_continues_with_the_far_ones(adapted, both):
    again = adapt(adapted, both[1], config_of(iters=5)).gaussians
    assert len(again) == len(adapted) and not torch.equal(again.means, adapted.means)
    assert_equal(detach(again), both[0])
