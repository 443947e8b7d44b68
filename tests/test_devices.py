"""Rendering, training and evaluation work on a device other than the CPU.

On a GPU, if there is one; otherwise on a simulated one (``fake_gpu``), with torch in place of gsplat's kernels.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

import gsplat_in_torch
from clod_adapter import Gaussians, attach, evaluate, from_gsplat, render, to_gsplat
from clod_adapter.adapter import detach
from clod_adapter.alignment.check import check_alignment
from clod_adapter.bake import bake, order_by_extinction
from clod_adapter.blocks.divide import divide, target_image
from clod_adapter.blocks.train import adapt_block, merge
from clod_adapter.cameras import Camera, Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.evaluation.baselines import matching_dial, mean_kept, rankings
from clod_adapter.evaluation.budget import dial_for, frame_times
from clod_adapter.evaluation.popping import dial_popping, path_popping
from clod_adapter.initialization.importance import for_training, initialize
from clod_adapter.losses import photometric_loss
from clod_adapter.metrics import psnr_ssim
from clod_adapter.rasterizers import BACKENDS, Rasterizer, cuda
from clod_adapter.training.camera_placement import place_cameras
from clod_adapter.training.loop import adapt
from clod_adapter.training.planner import make_plan
from clod_adapter.training.pseudo_views import PseudoView, render_pseudo_views
from clod_adapter.training.trainer import Trainer
from fake_gpu import fake_gpu, waits
from scenes import capture

CONFIG = AdaptConfig(iters=2, max_sv=4.0)


@dataclass(frozen=True)
class Setup:
    """The same Gaussians on both devices, and photographs, which are on the CPU."""

    device: torch.device
    own: Gaussians
    there: Gaussians
    scene: Scene

    @property
    def cameras(self) -> list[Camera]:
        return [view.camera for view in self.scene.train]


@pytest.fixture
def setup(monkeypatch: pytest.MonkeyPatch) -> Iterator[Setup]:
    pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    base, scene = capture(50, 4, 20, 14)
    own = initialize(base, scene.train, CONFIG)
    if torch.cuda.is_available():
        yield Setup(torch.device("cuda", 0), own, own.to("cuda"), scene)
        return
    gsplat_in_torch.install(monkeypatch)
    monkeypatch.setitem(BACKENDS, "gpu", lambda: Rasterizer(cuda.rasterize))
    with fake_gpu() as device:
        yield Setup(device, own, own.to(device), scene)


def on_both(setup: Setup, run: Callable[[Gaussians], Any]) -> tuple[Any, Any]:
    return run(setup.there), run(setup.own)


def test_the_fake_gpu_refuses_what_a_gpu_would(setup: Setup) -> None:
    there = setup.there.means
    for wrong in (lambda: there + setup.own.means, lambda: there.numpy(), lambda: setup.own.means[there[:, 0] > 0]):
        with pytest.raises((RuntimeError, TypeError)):
            wrong()
    assert torch.equal((there * torch.tensor(2.0)).cpu(), setup.own.means * 2) and there.device == setup.device


def test_render_and_its_gradients(setup: Setup) -> None:
    view, slopes, images = setup.scene.train[0], [], []
    for model in (setup.there, setup.own):
        leaves = {name: value.clone().requires_grad_() for name, value in model.tensors().items()}
        drawn = render(model.replace(**leaves), view.camera, 2.0)
        loss = photometric_loss(drawn.image, view.image)
        found = torch.autograd.grad(loss, list(leaves.values()))
        assert all(slope.device == model.means.device for slope in found)
        images.append(drawn.pixels.cpu().float())
        slopes.append(dict(zip(leaves, (slope.cpu() for slope in found), strict=True)))
    assert (images[0] - images[1]).abs().max() <= 1
    for name, mine in slopes[0].items():
        assert float((mine - slopes[1][name]).norm()) <= 2e-2 * float(slopes[1][name].norm()) + 1e-7, name


def test_measurements_match_the_cpu(setup: Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows, counts, dial values, popping, alignment and orders, to the difference of two rasterizers."""
    cameras, test = setup.cameras, setup.scene.test
    rows, want = on_both(setup, lambda model: evaluate(model, test, [1.0, 3.0]))
    for mine, own in zip(rows, want, strict=True):
        assert (mine.kept, mine.in_view) == (own.kept, own.in_view)
        assert mine.psnr == pytest.approx(own.psnr, abs=0.05) and mine.ssim == pytest.approx(own.ssim, abs=2e-3)
    shown = render(setup.there, test[0].camera).image
    assert psnr_ssim(shown, test[0].image)[0] == pytest.approx(evaluate(setup.own, test[:1], [1.0])[0].psnr, abs=0.05)
    for run in (
        lambda model: mean_kept(model, cameras, 2.0),
        lambda model: matching_dial(model, cameras, 20),
        lambda model: dial_for(model, keep=20, cameras=cameras).virtual_scale,
        lambda model: dial_popping(model, cameras[0], 3.0, steps=2).mean,
        lambda model: path_popping(model, cameras[:2], 2.0, steps=2).mean,
        lambda model: check_alignment(model, test).psnr,
        lambda model: float(bake(model, 2.0, cameras=cameras).opacities.sum()),
        lambda model: order_by_extinction(model, cameras).cpu().double() @ torch.arange(50).double(),
        lambda model: rankings(model, setup.scene.train[:1])["opacity"].cpu().double() @ torch.arange(50).double(),
    ):
        mine, own = on_both(setup, run)
        assert float(mine) == pytest.approx(float(own), rel=5e-3)
    monkeypatch.setattr(importlib.import_module("clod_adapter.evaluation.frame_times"), "PASSES", 2)
    assert all(taken > 0 for _, taken in frame_times(setup.there, cameras[:1])[0])


def test_placed_cameras_match_the_cpu(setup: Setup) -> None:
    placed = [place_cameras(model, views=1) for model in (setup.there, setup.own)]
    torch.testing.assert_close(placed[0][0].viewmat, placed[1][0].viewmat, rtol=1e-3, atol=1e-3)
    assert placed[0][0].viewmat.device.type == "cpu"
    small = replace(placed[0][0], K=placed[0][0].K / 31, width=16, height=12)
    pictures = render_pseudo_views(setup.there, [small]).train
    assert all(view.image.device.type == "cpu" for view in pictures)


def test_training_a_block(setup: Setup) -> None:
    views, config = setup.scene.train[:2], replace(CONFIG, iters=2)
    division = divide(initialize(detach(setup.there), views, config), views, config, 2)
    aimed = target_image(division.initial, 25, views[0])
    assert aimed.device.type == "cpu" and aimed.dtype == torch.uint8  # photographs of a whole block
    merged = merge(division, [adapt_block(division, views, config, block)[0] for block in range(2)])
    assert merged.means.device == setup.device and bool(merged.sigma_d.isfinite().all())


def test_plan_and_training(setup: Setup) -> None:
    """Parts that the plan leaves out are restored after training."""
    plain, scene = detach(setup.there), Scene(setup.scene.train[:2], ())
    config = AdaptConfig(iters=10, max_sv=4.0)
    plan = make_plan(plain, scene, config)
    want = make_plan(plain.to("cpu"), scene, config)
    assert [d.what for d in plan.decisions] == [d.what for d in want.decisions]
    for mine, own in zip(plan.decisions, want.decisions, strict=True):
        assert mine.number == pytest.approx(own.number, rel=0.02, abs=2e-3), mine.what
    plan = replace(plan, config=replace(plan.config, iters=2))
    adapted = plan.adapt(scene).gaussians
    whole = plan.whole(plain, adapted)
    assert len(whole) == len(plain) and all(x.device == setup.device for x in whole.tensors().values())
    assert not torch.equal(adapted.means.cpu(), plan.lean.means.cpu()) and bool(adapted.means.isfinite().all())


def test_training_matches_the_cpu(setup: Setup) -> None:
    scene, config = Scene(setup.scene.train[:2], ()), replace(CONFIG, batch=2, iters=1)
    mine, own = on_both(setup, lambda model: adapt(model, scene, config).gaussians)
    for name, value in own.tensors().items():
        # Adam's first steps are as long as their rate whichever way: where a slope is rounding, they may differ.
        assert float((mine.tensors()[name].cpu() - value).abs().median()) <= 1e-4, name


def test_frozen_tensors_get_no_gradient(setup: Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    """No memory is allocated for one; harmonics are the largest part of a Gaussian."""
    if setup.there.means.is_cuda:
        monkeypatch.setattr(cuda, "unusable", lambda: None)
    made: list[torch.Size] = []
    zeros = Tensor.new_zeros
    monkeypatch.setattr(Tensor, "new_zeros", lambda x, *size, **more: made.append(size[0]) or zeros(x, *size, **more))
    sh0 = setup.there.sh0.clone().requires_grad_()
    render(setup.there.replace(sh0=sh0), setup.cameras[0]).image.sum().backward()
    assert sh0.grad is not None and setup.there.sh0.shape in made and setup.there.shN.shape not in made


def test_a_step_waits_for_the_device_once(setup: Setup) -> None:
    """At its end, for the loss; the rasterizer aside: gsplat itself asks how many rows and tiles there are."""
    if setup.device.type == "cuda":
        pytest.skip("the simulated device tells where the host waits")
    views = setup.scene.train[:2]
    moving = [PseudoView(view.camera, setup.there, 1.0) for view in views]
    config = replace(CONFIG, batch=4)
    start = for_training(setup.there, views, config)
    trainer = Trainer(start, (*views, *moving), config)
    trainer.step(0.0)  # moves Adam's table to the device
    for share_done in (0.1, 0.9):
        with waits() as found:
            trainer.step(share_done)
        ours = [place for place in found if not place.startswith("rasterizers/")]
        assert ours == ["training/trainer.py:step"]
    with waits() as found:
        assert float(setup.there.means.sum()) and not bool(setup.there.means[setup.there.means > 1e9].any())
        setup.there.means.cpu(), setup.own.means.to(setup.device), setup.own.means.to(setup.device, non_blocking=True)
    assert len(found) == 5


def test_a_dial_of_ones_own_loop(setup: Setup) -> None:
    """Its parameters are where the splats are; loss and gradients match the CPU's."""
    grown = []
    for model in (setup.there, setup.own):
        splats = torch.nn.ParameterDict({n: torch.nn.Parameter(x.clone()) for n, x in to_gsplat(model).items()})
        dialled = attach(from_gsplat(splats), setup.cameras, CONFIG)
        groups = dialled.param_groups(splats=True)
        assert len(groups) == 8 and all(each["params"][0].device == model.means.device for each in groups)
        view, s = setup.scene.train[0], dialled.sample()
        shown = render(dialled.gaussians(), view.camera, 2.0).image
        loss = dialled.loss(2.0, photometric_loss(shown, view.image.to(model.means.device)))
        loss.backward()
        found = [each["params"][0].grad.cpu() for each in groups if each["name"] in ("log_sigma", "opacity_logits")]
        grown.append((s, loss.detach().cpu(), found))
        assert dialled(view.camera, 2.0).drawn.device == dialled.gaussians().sigma_d.device == model.means.device
    (s, loss, found), (want_s, want, slopes) = grown
    assert s == want_s and float(loss) == pytest.approx(float(want), rel=1e-2) and len(found) == 2
    for mine, own in zip(found, slopes, strict=True):
        assert float((mine - own).norm()) <= 2e-2 * float(own.norm())
