"""The hook gives the opacities of a rendering in numpy and in torch."""

from __future__ import annotations

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
from clod_adapter.hook import Hold, Hook
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


def test_without_growth_d_factors_are_ones() -> None:
    model, view = adapted(), camera()
    hook = replace(hook_of(model), growth_d=None)
    growth = hook(model.means, model.opacities, view.viewmat)[2]
    assert torch.equal(growth, torch.ones(N))
    double = hook(model.means.double().numpy(), model.opacities.double().numpy(), view.viewmat)[2]
    assert double.dtype == np.float64 and (double == 1).all()


def test_shape_and_type_are_those_of_the_opacities() -> None:
    model, view = adapted(), camera()
    column, _, _ = hook_of(model)(model.means, model.opacities[:, None], view.viewmat)
    assert column.shape == (N, 1)
    double, keep, _ = hook_of(model)(model.means.double(), model.opacities.double(), view.viewmat.double())
    assert double.dtype == torch.float64 and keep.shape == (N,)
    half, _, _ = hook_of(model)(model.means, model.opacities.half(), view.viewmat)
    assert half.dtype == torch.float16
    torch.testing.assert_close(column[:, 0].double(), double, rtol=1e-4, atol=1e-6)


def test_float16_and_autocast_keep_distances() -> None:
    """Squares of the distances overflow float16, and autocast would round products to bfloat16."""
    model, view = adapted(scene_distance=300.0, normalizer="quantile"), camera()
    viewmat = view.viewmat.clone()
    viewmat[:3, 3] = torch.tensor([100.0, 200.0, 300.0])
    given = (viewmat, view.K, view.width, view.height)
    means = (300 * model.means).half()
    drawn, keep, _ = hook_of(model)(means.float(), model.opacities, *given)
    assert 0 < int(keep.sum()) < N
    half, same, _ = hook_of(model)(means, model.opacities, *given)
    assert torch.equal(half, drawn) and torch.equal(same, keep)
    with torch.autocast("cpu", torch.bfloat16):
        cast, same, _ = hook_of(model)(means.float(), model.opacities, *given)
    assert torch.equal(cast, drawn) and torch.equal(same, keep)


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


def test_hold_measures_the_block_and_the_work_on_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock counts CUDA's work at the end of the block, and not the work from before it."""
    clock = {"now": 0.0, "queued": 99.0}

    def synchronize() -> None:
        clock["now"] += clock.pop("queued", 0.0)

    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "synchronize", synchronize)
    monkeypatch.setattr("clod_adapter.hook.time.perf_counter", lambda: clock["now"])
    hold, times = hook_of(adapted(), 2.0).hold(10), []
    monkeypatch.setattr(Hold, "took", lambda self, milliseconds: times.append(milliseconds))
    with hold.frame() as hook:
        assert hook is hold.hook
        clock.update(now=clock["now"] + 0.002, queued=0.005)
    with pytest.raises(KeyError), hold.frame():
        raise KeyError  # a frame that was not finished has no time
    assert times == [pytest.approx(7.0)]


@pytest.mark.parametrize("milliseconds", [0, -1, float("nan"), float("inf")])
def test_hold_refuses_times_that_are_none(milliseconds: float) -> None:
    with pytest.raises(ClodError, match="milliseconds is .*, it must be above 0 and finite"):
        hook_of(adapted()).hold(milliseconds)
    if milliseconds:
        with pytest.raises(ClodError, match="the time of a frame is .*, it must be at least 0 ms and finite"):
            hook_of(adapted()).hold(10).took(milliseconds)


def test_a_hook_of_arrays() -> None:
    model = adapted()
    assert model.sigma_d is not None and model.growth_d is not None
    arrays = replace(hook_of(model), sigma_d=model.sigma_d.numpy(), growth_d=model.growth_d.numpy())
    given = model.means, model.opacities, camera().viewmat
    assert all(map(torch.equal, arrays(*given), hook_of(model)(*given)))
