"""One adapted file, whose Gaussians fade and grow, looks the same through every path that draws it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import clod_adapter
import gsplat_in_torch
import inria_forks
import scenes
from backends import fresh_copy
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.rasterizers import Rasterizer, cpu, reference
from clod_adapter.render import render
from shown import SIZE, Shown, assert_same, serve

DIAL = 3.0
VIEW = scenes.camera(48, 32, off_centre=(0.5, 0.5))  # Inria's settings have no principal point

Draw = Callable[[Checkpoint, pytest.MonkeyPatch], Tensor]


def through_cpu(checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    return render(checkpoint.gaussians, VIEW, DIAL, rasterizer=Rasterizer(cpu.rasterize)).image


def through_gsplat(checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    gsplat_in_torch.install(monkeypatch)
    from clod_adapter.integrations.gsplat import rasterization

    g = checkpoint.gaussians
    images, _, _ = rasterization(
        g.means, g.quats, g.scales, g.opacities, torch.cat([g.sh0, g.shN], 1), VIEW.viewmat[None], VIEW.K[None],
        VIEW.width, VIEW.height, sh_degree=1, sigma_d=g.sigma_d, growth_d=g.growth_d, attenuation=g.attenuation,
        virtual_scale=DIAL,
    )  # fmt: skip
    return images[0]


def through_inria(checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    g, fork = checkpoint.gaussians, inria_forks.module("inria 2023")
    ours = fresh_copy(monkeypatch, "inria", "diff_gaussian_rasterization", fork)
    settings = inria_forks.settings_of(ours.GaussianRasterizationSettings, VIEW, bg=torch.zeros(3))
    color, _ = ours.GaussianRasterizer(settings)(
        means3D=g.means, means2D=torch.zeros_like(g.means), opacities=g.opacities[:, None],
        shs=torch.cat([g.sh0, g.shN], 1), scales=g.scales, rotations=torch.nn.functional.normalize(g.quats),
        sigma_d=g.sigma_d, growth_d=g.growth_d, attenuation=g.attenuation, virtual_scale=DIAL,
    )  # fmt: skip
    return color.permute(1, 2, 0)


def through_hook(checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    """numpy, then a renderer that knows nothing of the dial."""
    g = checkpoint.gaussians
    arrays = (tensor.numpy() for tensor in (g.means, g.opacities, VIEW.viewmat))
    opacities, keep, growth = map(torch.from_numpy, checkpoint.hook(DIAL)(*arrays))
    assert torch.equal(opacities > 0, keep)
    scales = g.scales * growth[:, None]
    return reference.rasterize(g.means, g.quats, scales, opacities, g.sh0, g.shN, VIEW, torch.zeros(3))[0]


def through_baked_file(checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    baked, path = clod_adapter.bake(checkpoint.gaussians, DIAL, VIEW), checkpoint.path.with_name("baked.ply")
    clod_adapter.save(path, baked)
    plain = clod_adapter.load(path).gaussians
    assert plain.sigma_d is plain.growth_d is None and len(plain) < len(checkpoint.gaussians)
    return render(plain, VIEW).image


PATHS: tuple[Draw, ...] = (through_cpu, through_gsplat, through_inria, through_hook, through_baked_file)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Checkpoint:
    """An adapted file, read back."""
    clod_adapter.save(tmp_path / "adapted.ply", adapted())
    return clod_adapter.load(tmp_path / "adapted.ply")


def adapted() -> Gaussians:
    """60 Gaussians, of which a third is culled at the dial value, with growth of both signs."""
    some = scenes.dialled(60, 1, 3)
    values = torch.rand(60, generator=torch.Generator().manual_seed(5))
    return some.replace(means=some.means * torch.tensor([1, 1, 0.5]), growth_d=2 * values - 0.5)


def wanted(gaussians: Gaussians) -> Tensor:
    return render(gaussians, VIEW, DIAL, rasterizer=Rasterizer(reference.rasterize)).image


@pytest.mark.parametrize("draw", PATHS)
def test_paths_agree(draw: Draw, checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.testing.assert_close(draw(checkpoint, monkeypatch), wanted(adapted()), rtol=1e-3, atol=1e-3)


@pytest.mark.filterwarnings("ignore:virtual_scale")
def test_growth_and_fading_are_visible() -> None:
    """Without growth, and without the dial, the image is another: the comparison above measures both."""
    model = adapted()
    kept = render(model, VIEW, DIAL).kept
    assert 20 < int(kept.sum()) < 50
    for other in (model.replace(growth_d=None), model.replace(sigma_d=None, growth_d=None, attenuation=None)):
        assert (wanted(other) - wanted(model)).abs().max() > 0.1


def test_the_page_agrees(checkpoint: Checkpoint, chromium: Any, tmp_path: Path) -> None:
    camera = scenes.camera(320, 240)
    with serve(checkpoint.path, "--sv", DIAL) as url, closing(chromium.new_page()) as page:
        page.set_viewport_size(SIZE)
        shown = Shown(page).ready(url)
        shown.camera(camera)
        assert_same(shown, render(adapted(), camera, DIAL), tmp_path / "page.png")
        assert shown.errors == []
