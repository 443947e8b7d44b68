"""One adapted file looks the same through every path that draws it, and so do the files of viewers/kit."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

import clod_adapter as clod
import gsplat_in_torch
import inria_forks
import scenes
from backends import fresh_copy
from clod_adapter.config import FILTERS
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.rasterizers import Rasterizer, reference
from clod_adapter.render import render

DIAL = 3.0
VIEW = scenes.camera(48, 32, off_centre=(0.5, 0.5))  # Inria's settings have no principal point
KIT = Path(__file__).parents[2] / "viewers" / "kit"


def through_gsplat(checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    gsplat_in_torch.install(monkeypatch)
    from clod_adapter.integrations.gsplat import rasterization

    g = checkpoint.gaussians
    images, _, _ = rasterization(
        g.means, g.quats, g.scales, g.opacities, torch.cat([g.sh0, g.shN], 1), VIEW.viewmat[None], VIEW.K[None],
        VIEW.width, VIEW.height, sh_degree=1, sigma_d=g.sigma_d, growth_d=g.growth_d, attenuation=g.attenuation,
        virtual_scale=DIAL, eps2d=g.screen_filter.variance,
        rasterize_mode="antialiased" if g.screen_filter.compensate else "classic",
    )  # fmt: skip
    return images[0]


def through_inria(checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    g = checkpoint.gaussians
    name, settings = ("mip-splatting", {"kernel_size": 0.1}) if g.screen_filter == FILTERS["mip"] else (
        "inria 2024", {"antialiasing": g.screen_filter.compensate}
    )  # fmt: skip
    ours = fresh_copy(monkeypatch, "inria", "diff_gaussian_rasterization", inria_forks.module(name))
    color, *_ = ours.GaussianRasterizer(inria_forks.settings_of(ours.GaussianRasterizationSettings, VIEW, **settings))(
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
    plain = g.replace(
        sigma_d=None, growth_d=None, attenuation=None, log_scales=g.log_scales + growth.log()[:, None],
        opacity_logits=opacities.logit(),
    )  # fmt: skip
    return render(plain[keep], VIEW, rasterizer=Rasterizer(reference.rasterize)).image


def adapted() -> Gaussians:
    """60 Gaussians, of which a third is culled at the dial value, with growth of both signs."""
    some = scenes.dialled(60, 1, 3)
    values = torch.rand(60, generator=torch.Generator().manual_seed(5))
    return some.replace(means=some.means * torch.tensor([1, 1, 0.5]), growth_d=2 * values - 0.5)


def wanted(gaussians: Gaussians) -> Tensor:
    return render(gaussians, VIEW, DIAL, rasterizer=Rasterizer(reference.rasterize)).image


@pytest.mark.filterwarnings("ignore:virtual_scale")
@pytest.mark.parametrize("screen_filter", FILTERS)
def test_paths_agree(screen_filter: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With each screen filter. Without growth, the dial or the filter, the image is another."""
    model = adapted().replace(screen_filter=FILTERS[screen_filter])
    clod.save(tmp_path / "adapted.ply", model)
    checkpoint = clod.load(tmp_path / "adapted.ply")
    for draw in (through_gsplat, through_inria, through_hook):
        image = draw(checkpoint, monkeypatch)
        torch.testing.assert_close(image, wanted(model), rtol=1e-3, atol=1e-3)
    assert 20 < int(render(model, VIEW, DIAL).kept.sum()) < 50
    for other in (model.replace(growth_d=None), model.replace(sigma_d=None, growth_d=None, attenuation=None)):
        assert (wanted(other) - wanted(model)).abs().max() > 0.1
    for name, other in FILTERS.items():
        assert name == screen_filter or (wanted(model.replace(screen_filter=other)) - wanted(model)).abs().max() > 0.01


@pytest.mark.parametrize(("suffix", "levels"), [("ply", 1), ("glb", 1), ("spz", 12)])
def test_the_kit_is_what_the_library_draws_and_writes(suffix: str, levels: int) -> None:
    """The files that authors of renderers test with."""
    gaussians = clod.load(KIT / f"kit.{suffix}").gaussians
    for about in json.loads((KIT / "cameras.json").read_text(encoding="utf-8"))["cameras"]:
        width, height, focal = about["width"], about["height"], about["focal"]
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        camera = clod.Camera(torch.tensor(about["world_to_camera"]), K, width, height)
        for frame in about["frames"]:
            shown = clod.render(gaussians, camera, frame["s"])
            assert int(shown.kept.sum()) == pytest.approx(frame["kept"], rel=0.005 if suffix == "spz" else 0)
            stored = np.asarray(Image.open(KIT / frame["picture"], formats=["PNG"]), np.float64)
            assert np.abs(shown.image.clamp(0, 1).numpy() * 255 - stored).max() < levels
