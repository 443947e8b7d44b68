"""The hook's opacities in numpy and torch, and the law of a held frame rate on simulated
renderers.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
import pytest
import torch
from refusals import refused

import clod_adapter
from clod_adapter import AttenuationConfig, Hook
from clod_adapter.frame_rate import next_dial
from scenes import camera, gaussians, seeded

N = 200


def adapted(**settings):
    plain = gaussians(N, 1, 0)
    sigma_d, growth_d = torch.rand(2, N, generator=seeded(1)) * 1.5
    attenuation = AttenuationConfig(scene_distance=3.0, **settings)
    return plain.replace(sigma_d=sigma_d, growth_d=growth_d - 0.5, attenuation=attenuation)


def hook_of(model, virtual_scale=3.0):
    return Hook(model.sigma_d, model.attenuation, virtual_scale, model.growth_d)


def test_mixed_and_strided_arrays_are_accepted():
    """Mixed numpy and torch, integers, negative strides, the other byte order, and lists."""
    model = adapted(form="paper")
    size = (64, 48)
    means = model.means.numpy()
    a = model.opacities.numpy()
    K = camera().K.numpy()
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


def test_gradients_reach_opacities_sigma_d_and_growth_d_only():
    model = adapted()
    view = camera()
    keep = hook_of(model, 2.0)(model.means, model.opacities, view.viewmat)[1]

    def leaf(values):
        return values[keep].double().requires_grad_()

    means = leaf(model.means)
    viewmat = view.viewmat.double().requires_grad_()

    def drawn(a, sigma, growth):
        return Hook(sigma, model.attenuation, 2.0, growth)(means, a, viewmat)[::2]

    leaves = tuple(map(leaf, (model.opacities, model.sigma_d, model.growth_d)))
    assert torch.autograd.gradcheck(drawn, leaves, eps=1e-8)
    total = sum(values.sum() for values in drawn(*leaves))
    assert torch.autograd.grad(total, [means, viewmat], allow_unused=True) == (None, None)


def test_bad_arguments_are_refused(tmp_path):
    model = adapted(form="paper")
    view = camera()
    with refused("the paper's form needs K, width and height"):
        hook_of(model)(model.means, model.opacities, view.viewmat)
    with refused(r"for 200 Gaussians, but means is \(199, 3\)"):
        hook_of(model)(model.means[1:], model.opacities, view.viewmat, view.K, 64, 48)
    with refused("virtual_scale is -0.5"):
        hook_of(model, -0.5)
    clod_adapter.save(tmp_path / "plain.ply", gaussians(5, 0, 0))
    with refused("plain.ply: it has no sigma_d, so there is no dial"):
        clod_adapter.load(tmp_path / "plain.ply").hook(virtual_scale=3)


def test_hold_moves_the_dial_by_the_times_it_takes():
    start = hook_of(adapted(), 2.0)
    hold = start.hold(milliseconds=10)
    for _ in range(8):
        hold.took(30)
    # from the third frame on
    assert hold.hook.virtual_scale == pytest.approx(2 * 1.1**6) and start.virtual_scale == 2
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


BUDGET = 10.0  # ms
MAX_SV = 7.0
EXPONENTS = (0.2, 0.75, 1.5)
FIXED = (0.0, 0.5)  # of the time at the start
BEFORE, AFTER = 25, 100  # frames before and after a change of the load


@dataclass(frozen=True)
class Renderer:
    """``ms(s) = load BUDGET (fixed + (1 - fixed) (s / start)^-exponent)``, which is the budget at
    ``start``.
    """

    exponent: float
    fixed: float
    start: float

    def ms(self, dial, load=1.0):
        return (
            load * BUDGET * (self.fixed + (1 - self.fixed) * (dial / self.start) ** -self.exponent)
        )

    def best(self, load):
        """The dial value in [1, MAX_SV] whose time is the budget, or the nearest to it."""
        rest = (1 / load - self.fixed) / (1 - self.fixed)
        wanted = self.start * rest ** (-1 / self.exponent) if rest > 0 else math.inf
        return min(max(wanted, 1.0), MAX_SV)

    def off(self, dial, load):
        """Distance of the noiseless log time from the best in range."""
        return abs(math.log(self.ms(dial, load) / self.ms(self.best(load), load)))

    def follow(self, loads, noise):
        """Dial values of frames with these loads, whose times are multiplied by ``noise``."""
        frames = []
        dial = self.start
        for load, factor in zip(loads, noise, strict=True):
            frames.append((dial, self.ms(dial, load) * factor))
            dial = next_dial(frames, BUDGET, MAX_SV)
        dials = [dial for dial, _ in frames]
        assert all(max(a, b) <= 1.1 * min(a, b) * (1 + 1e-9) for a, b in pairwise(dials))
        assert all(1 <= dial <= MAX_SV for dial in dials)
        return dials


@pytest.mark.parametrize("load", [2.0, 4.0, 1 / 3])
@pytest.mark.parametrize("outliers", [False, True])
def test_the_time_is_within_10_percent_after_a_change(load, outliers):
    """After at most 22 frames: 4, and 18 steps of 10 % from end to end; without outliers, it never
    turns back.
    """
    loads = [1.0] * BEFORE + [load] * AFTER
    noise = np.ones(len(loads))
    if outliers:
        noise[7::20] = 5.0
    for exponent, fixed in product(EXPONENTS, FIXED):
        renderer = Renderer(exponent, fixed, start=2.0 if load > 1 else 5.0)
        settled = renderer.follow(loads, noise)[BEFORE + 22 :]
        assert all(renderer.off(dial, load) <= 0.1 for dial in settled), (exponent, fixed)
        assert outliers or sorted(settled) in (settled, settled[::-1]), (exponent, fixed)


def test_it_does_not_oscillate_under_noise_of_20_percent():
    """Over 400 frames of one load: the dial's changes are small, and the time stays near the
    budget.
    """
    for exponent, fixed, seed in product(EXPONENTS, FIXED, range(2)):
        renderer = Renderer(exponent, fixed, start=3.0)
        noise = np.random.default_rng(seed).lognormal(0.0, 0.2, 400)
        dials = np.array(renderer.follow([1.0] * 400, noise))
        times = np.log([renderer.ms(dial) / BUDGET for dial in dials])
        changes = np.abs(np.diff(np.log(dials)))
        assert changes.mean() <= 0.015 and np.median(changes) <= 0.005, (exponent, fixed, seed)
        assert np.log(dials).std() <= 0.2 and times.std() <= 0.1, (exponent, fixed, seed)


def test_the_first_frames_and_single_outliers_do_not_move_it():
    """A first frame includes compilation; a frame of 0 ms is below a timer's resolution."""
    calm = [(2.0, BUDGET)] * 5
    slow = (2.0, 900.0)
    fast = (2.0, 0.0)
    for frames in ([slow], [slow] * 2, [*calm, slow], [*calm, fast]):
        assert next_dial(frames, BUDGET, MAX_SV) == 2.0
    assert next_dial([*calm, *[fast] * 3], BUDGET, MAX_SV) == pytest.approx(2.0 / 1.1)
