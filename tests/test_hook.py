"""The hook gives the opacities of a rendering in numpy and in torch."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import clod_adapter
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import dial
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.hook import Hook
from scenes import camera, gaussians

N = 200


def adapted(**settings: Any) -> Gaussians:
    plain = gaussians(N, 1, 0)
    sigma_d, growth_d = torch.rand(2, N, generator=torch.Generator().manual_seed(1)) * 1.5
    values = {"tau": 0.02, "scene_distance": 3.0, "max_sv": 5.0}
    return plain.replace(sigma_d=sigma_d, growth_d=growth_d - 0.5, attenuation=AttenuationConfig(**(values | settings)))


def hook_of(model: Gaussians, virtual_scale: float = 3.0) -> Hook:
    return Hook(model.sigma_d, model.attenuation, virtual_scale, model.growth_d)


@pytest.mark.parametrize(("normalizer", "cut"), [("scene", "hard"), ("quantile", "soft"), ("max", "soft")])
def test_numpy_and_torch_agree_with_a_rendering(tmp_path: Path, normalizer: str, cut: str) -> None:
    model, view = adapted(normalizer=normalizer, cut=cut), camera()
    clod_adapter.save(tmp_path / "model.ply", model)
    hook = clod_adapter.load(tmp_path / "model.ply").hook(virtual_scale=2)
    given, counts = (model.means, model.opacities, view.viewmat, view.K), []
    for s in (2.0, 3.0, 5.0):
        turned = replace(hook, virtual_scale=s)
        drawn, keep, growth = turned(*given, view.width, view.height)
        want = dial(model, view, s)
        assert torch.equal(keep, want.keep) and 0 < int(keep.sum()) < N
        torch.testing.assert_close(drawn, want.drawn)
        torch.testing.assert_close(growth, want.growth)
        assert growth.min() < 0.9 and growth.max() > 1.1
        arrays = tuple(tensor.numpy() for tensor in given)
        found = turned(*arrays, view.width, view.height)
        assert [(type(each).__name__, str(each.dtype)) for each in found] == [
            ("ndarray", dtype) for dtype in ("float32", "bool", "float32")
        ]
        for array, tensor in zip(found, (drawn, keep, growth), strict=True):
            assert (array == tensor.numpy()).all()
        counts.append(int(keep.sum()))
    assert counts[0] > counts[1] > counts[2]


def test_mixed_and_strided_arrays_are_accepted() -> None:
    """Mixed numpy and torch, integers, negative strides, the other byte order, and lists."""
    model, view = adapted(normalizer="max"), camera()
    means, a, viewmat = model.means.numpy(), model.opacities.numpy(), view.viewmat.numpy()
    hook, size = hook_of(model), (view.width, view.height)
    want = hook(means, a, viewmat, view.K.numpy(), *size)
    mixed = hook(model.means, model.opacities, viewmat, view.K.numpy(), *size)
    assert isinstance(mixed[0], torch.Tensor) and (mixed[0].numpy() == want[0]).all()
    for others in (
        (means, a, view.viewmat, view.K),
        (means[::-1][::-1], np.stack([a, a], 1)[:, 0], np.asfortranarray(viewmat), view.K.numpy()),
        (means.astype(">f4"), a.astype(">f4"), viewmat.astype(">f8"), view.K.numpy()),
        (means.tolist(), a, viewmat.tolist(), view.K.tolist()),
    ):
        drawn, keep, _ = hook(*others, *size)
        assert type(drawn) is type(keep) is np.ndarray and drawn.dtype.isnative
        assert (keep == want[1]).all() and np.allclose(drawn, want[0], rtol=1e-5)
    whole = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]])
    of_whole, of_floats = (hook(means, a, pose, view.K.numpy(), *size)[0] for pose in (whole, whole * 1.0))
    assert (of_whole == of_floats).all()


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
    assert torch.equal(hold.hook.sigma_d, start.sigma_d) and not hold.out_of_reach
    for _ in range(10):
        hold.took(30)
    assert hold.hook.virtual_scale == 5 and hold.out_of_reach
    for _ in range(4):
        hold.took(2)
    assert hold.hook.virtual_scale < 5 and not hold.out_of_reach
    assert replace(start, virtual_scale=9.0).hold(10).hook.virtual_scale == 5


def test_hold_measures_the_block() -> None:
    hold = hook_of(adapted(), 2.0).hold(milliseconds=1)
    for _ in range(4):
        with hold.frame() as hook:
            assert hook is hold.hook
            time.sleep(0.002)
    assert hold.hook.virtual_scale > 2
    before = hold.hook
    with pytest.raises(KeyError), hold.frame():
        raise KeyError  # a frame that was not finished has no time
    assert hold.hook is before
