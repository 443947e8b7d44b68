"""The hook gives the opacities of a rendering in numpy and in torch."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import clod_adapter
from clod_adapter import AttenuationConfig, ClodError, Gaussians, Hook
from scenes import camera, gaussians

N = 200


def adapted(**settings: Any) -> Gaussians:
    plain = gaussians(N, 1, 0)
    sigma_d, growth_d = torch.rand(2, N, generator=torch.Generator().manual_seed(1)) * 1.5
    values = {"tau": 0.02, "scene_distance": 3.0, "max_sv": 5.0}
    return plain.replace(sigma_d=sigma_d, growth_d=growth_d - 0.5, attenuation=AttenuationConfig(**(values | settings)))


def hook_of(model: Gaussians, virtual_scale: float = 3.0) -> Hook:
    return Hook(model.sigma_d, model.attenuation, virtual_scale, model.growth_d)


def test_mixed_and_strided_arrays_are_accepted() -> None:
    """Mixed numpy and torch, integers, negative strides, the other byte order, and lists."""
    model, size = adapted(normalizer="max"), (64, 48)
    means, a, K = model.means.numpy(), model.opacities.numpy(), camera().K.numpy()
    pose = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]])
    hook = hook_of(model)
    want = hook(means, a, pose * 1.0, K, *size)
    assert isinstance(hook(model.means, model.opacities, pose, K, *size)[0], torch.Tensor)
    for others in (
        (means, a, pose, torch.from_numpy(K)),
        (means[::-1][::-1], np.stack([a, a], 1)[:, 0], np.asfortranarray(pose), K),
        (means.astype(">f4"), a.astype(">f4"), pose.astype(">f8"), K),
        (means.tolist(), a, pose.tolist(), K.tolist()),
    ):
        drawn, keep, _ = hook(*others, *size)
        assert type(drawn) is type(keep) is np.ndarray and drawn.dtype.isnative
        assert (keep == want[1]).all() and np.allclose(drawn, want[0], rtol=1e-5)


def test_gradients_reach_opacities_sigma_d_and_growth_d_only() -> None:
    model, view = adapted(), camera()
    given = (model.opacities, model.sigma_d, model.growth_d, model.means)
    keep = hook_of(model, 2.0)(model.means, model.opacities, view.viewmat)[1]
    a, sigma, growth, means = (tensor[keep].double().requires_grad_() for tensor in given)
    viewmat = view.viewmat.double().requires_grad_()

    def drawn(a: torch.Tensor, sigma: torch.Tensor, growth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return Hook(sigma, model.attenuation, 2.0, growth)(means, a, viewmat)[::2]

    assert torch.autograd.gradcheck(drawn, (a, sigma, growth), eps=1e-8)
    total = sum(each.sum() for each in drawn(a, sigma, growth))
    assert torch.autograd.grad(total, [means, viewmat], allow_unused=True) == (None, None)


def test_bad_arguments_are_refused(tmp_path: Path) -> None:
    model, view = adapted(normalizer="max"), camera()
    with pytest.raises(ClodError, match="normalizer max needs K, width and height"):
        hook_of(model)(model.means, model.opacities, view.viewmat)
    with pytest.raises(ClodError, match=r"for 200 Gaussians, but means is \(199, 3\)"):
        hook_of(model)(model.means[1:], model.opacities, view.viewmat, view.K, 64, 48)
    with pytest.raises(ClodError, match="virtual_scale is -0.5"):
        hook_of(model, -0.5)
    clod_adapter.save(tmp_path / "plain.ply", gaussians(5, 0, 0))
    with pytest.raises(ClodError, match="plain.ply: it has no sigma_d, so there is no dial"):
        clod_adapter.load(tmp_path / "plain.ply").hook(virtual_scale=3)


def test_hold_moves_the_dial_by_the_times_it_takes() -> None:
    start = hook_of(adapted(), 2.0)
    hold = start.hold(milliseconds=10)
    for _ in range(8):
        hold.took(30)
    assert hold.hook.virtual_scale == pytest.approx(2 * 1.1**6) and start.virtual_scale == 2  # from the third frame on
    assert hold.hook.sigma_d is start.sigma_d and not hold.out_of_reach
    for _ in range(10):
        hold.took(30)
    assert hold.hook.virtual_scale == 5 and hold.out_of_reach
    for _ in range(4):
        with hold.frame() as hook:
            assert hook is hold.hook
    assert hold.hook.virtual_scale < 5 and not hold.out_of_reach
    with pytest.raises(KeyError), hold.frame():
        hook = hold.hook
        raise KeyError  # a frame that was not finished has no time
    assert hold.hook is hook and replace(start, virtual_scale=9.0).hold(10).hook.virtual_scale == 5
