"""What a step is made of: views and dial values of the schedule, the target-count curve, and Adam
on some rows.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from clod_adapter import View
from clod_adapter.cameras import intrinsics
from clod_adapter.config import AdaptConfig
from clod_adapter.training.optimizer import RowAdam
from clod_adapter.training.schedule import OURS, PAPER, Schedule, ViewSampler
from clod_adapter.training.target_count import (
    SHARPNESS,
    count_gradient,
    count_slope,
    target_curve,
    target_share,
)
from scenes import capture, seeded

VIEWS = capture(n=20)[1].train


def assert_uniform(values):
    """In [0, 1], and more evenly than random numbers would be."""
    values = values.sort().values.double()
    assert (values - torch.linspace(0, 1, len(values))).abs().max() < 3 / len(values)


def test_dial_values_follow_the_schedule():
    """1, or 0, in a falling share of the steps, else (log-)uniform from 1 on; in every stretch."""

    def drawn(schedule, share_done=0.0):
        sampler = ViewSampler(VIEWS, AdaptConfig(max_sv=4.0), schedule)
        samples = [sampler.draw(k, share_done) for k in range(480)]
        names = [sample.view.camera.name for sample in samples]  # each view once a round
        count = len(VIEWS)
        assert all(len({*names[k : k + count]}) == count for k in range(0, 480, count))
        return torch.tensor([sample.dial for sample in samples], dtype=torch.float64)

    for stretch in drawn(Schedule(full=0.25)).split(120):
        assert abs(int((stretch <= 1).sum()) - 30) <= 1
        assert abs(int((stretch == 0).sum()) - 7.5) <= 1
        assert_uniform(stretch[stretch > 1].log() / math.log(OURS.rendered * 4.0))
    assert_uniform((drawn(PAPER) - 1) / 3)
    assert abs(int((drawn(Schedule(full=0.5, full_final=0.5), 0.5) <= 1).sum()) - 0.375 * 480) <= 1
    assert ViewSampler(VIEWS, AdaptConfig(max_sv=1.0)).draw(0, 0.0)[1:] == (1.0, None, False)


@pytest.mark.parametrize(
    "height, share_done, full, halved",
    [
        (258, 0.49, 0.0, True),
        (258, 0.5, 0.0, False),
        (255, 0.0, 0.0, False),
        (258, 0.0, 1.0, False),
    ],
)
def test_first_steps_have_photographs_of_half_the_size(height, share_done, full, halved):
    """Unless these would be small, or the step is at s = 1."""
    K = intrinsics(90.0, 90, 150, 129)
    camera = replace(VIEWS[0].camera, width=301, height=height, K=K)
    view = View(camera, torch.randint(256, (height, 301, 3), generator=seeded(0)).byte())
    schedule = Schedule(coarse=0.5, full=full)
    sample = ViewSampler((view,), AdaptConfig(), schedule).draw(0, share_done)
    assert sample.halved == halved and (sample.view is view) != halved


CONFIG = AdaptConfig(max_sv=6.0)
N = 2000


def reaches_and_distances():
    """log sigma_d and normalised distances."""
    log_sigma, d = torch.randn(2, N, generator=seeded(0))
    return 1 + 0.8 * log_sigma, (0.3 * d).exp()


def gradient(log_sigma, d, s, **changes):
    config = replace(CONFIG, **changes)
    return count_gradient(d, log_sigma.exp(), s, 0.1, config, target_share(s, N, config))


def test_count_gradient_penalises_excess_and_deficit():
    """The gradient is that of the squared excess; it is 0 for a single remaining Gaussian."""
    log_sigma, d = reaches_and_distances()
    for s in (1.5, 6.0):
        share = target_curve(s, CONFIG.start_share, CONFIG.exponent)
        excess = float((d * s < log_sigma.exp()).float().mean()) / share - 1
        want = 0.1 * 2 * CONFIG.reg_weight * excess / share * count_slope(d * s, log_sigma.exp())
        assert excess > 0.1
        assert_close(gradient(log_sigma, d, s), want, rtol=1e-4, atol=1e-9)
        few = gradient(log_sigma - 3, d, s)
        assert few.max() <= 0 and (few[d * s > (log_sigma - 3).exp()] < 0).all()
        assert (gradient(log_sigma, d, s, reg_weight=0.0) == 0).all()
    one = torch.ones(1)
    assert count_gradient(one, 6 * one, 5.0, 1.0, CONFIG, target_share(5.0, 1, CONFIG)).item() == 0
    # where none is near its reach: at the floor that training has, and at 0
    for gone in (-9.2, -100.0):
        assert (gradient(torch.full((N,), gone), d, 2.0) < 0).all()
    # half are kept, where the curve at s = 6 has 7 %
    mixed = torch.where(torch.arange(N) % 2 == 0, 5.0, -9.2)
    assert (gradient(mixed, d, 6.0) >= 0).all() and (gradient(mixed, d, 6.0)[1::2] < 1e-20).all()


def test_count_slope_is_that_of_a_soft_count():
    log_sigma, d = (x.double() for x in reaches_and_distances())
    soft = 1 / (1 + (2 * d / log_sigma.requires_grad_().exp()) ** SHARPNESS)
    (want,) = torch.autograd.grad(soft.mean(), log_sigma)
    assert (want > 0.1 * want.max()).sum() > 100
    assert_close(count_slope(2 * d, log_sigma.detach().exp()), want)
    assert (count_slope(d, 0 * d) == 0).all()


def test_shares_are_of_all_gaussians():
    """Where far ones alone are counted: as if the others, which are culled, were counted too."""
    log_sigma, d = reaches_and_distances()
    log_sigma[40:65] = -9.2

    def of_first(count, total=None):
        share = target_share(3.0, count, CONFIG, total)
        return count_gradient(d[:count], log_sigma[:count].exp(), 3.0, 0.3, CONFIG, share)[:40]

    assert of_first(65).abs().max() > 0
    assert torch.allclose(of_first(65), of_first(40, 65), rtol=1e-5, atol=0)


SHAPES = {
    "means": (3,),
    "quats": (4,),
    "opacity_logits": (),
    "sh0": (1, 3),
    "shN": (15, 3),
    "none": (0, 3),
}
TENTHS = dict.fromkeys(SHAPES, 0.1)


class PlainRowAdam(RowAdam):
    """RowAdam without the fused kernel."""

    def _step_fused(self, gradients, rows, rates):
        self._step_plain(gradients, rows, rates)


def parameters(n, seed=0):
    g = seeded(seed)
    return {name: torch.randn(n, *shape, generator=g) for name, shape in SHAPES.items()}


def gradients(n, seed):
    """Gradients over many orders of magnitude, with some zeros."""
    g = seeded(seed)
    out = {}
    for name, shape in SHAPES.items():
        size = 10 ** (8 * torch.rand(n, *[1] * len(shape), generator=g) - 6)
        values = torch.randn(n, *shape, generator=g) * size
        out[name] = values * (torch.rand(n, *shape, generator=g) > 0.1)
    return out


def part(values, rows):
    return {name: value[rows] for name, value in values.items()}


def everything(n):
    return torch.ones(n, dtype=torch.bool)


@pytest.mark.parametrize("kind", [RowAdam, PlainRowAdam])
@pytest.mark.parametrize(
    "steps, beta1, beta2, epsilon",
    [(12, 0.9, 0.999, 1e-15), (90, 0.5, 0.8, 1e-2)],
    ids=["defaults", "past the last bias correction that is stored, the 79th"],
)
def test_all_rows_match_torch_adam(kind, steps, beta1, beta2, epsilon, n=57):
    """In units: the rates of rows are multiplied by them."""
    ours = parameters(n)
    theirs = {name: p.requires_grad_() for name, p in parameters(n).items()}
    units = torch.linspace(0.1, 2, n)
    optimizer = kind(ours, beta1=beta1, beta2=beta2, epsilon=epsilon, units={"means": units})
    adam = torch.optim.Adam(theirs.values(), lr=0.02, betas=(beta1, beta2), eps=epsilon)
    for step in range(steps):
        optimizer.step(gradients(n, step), everything(n), dict.fromkeys(SHAPES, 0.02))
        for name, gradient in gradients(n, step).items():
            theirs[name].grad = gradient
        adam.step()
    close = {"rtol": 1e-5, "atol": 1e-5} if steps > 12 else {"rtol": 2e-6, "atol": 2e-6}
    for name, start in parameters(n).items():
        moved = (theirs[name] - start).detach() * (units[:, None] if name == "means" else 1)
        assert_close(ours[name], start + moved, **close)


@pytest.mark.parametrize("kind", [RowAdam, PlainRowAdam])
@pytest.mark.parametrize("more, filler", [(0, torch.inf), (11, torch.nan)])
def test_only_selected_rows_are_stepped(kind, more, filler, n=40):
    """Other rows keep every bit, and their gradients are ignored; so do rows behind a leading
    part.
    """
    chosen = torch.tensor([2, 17, 31])
    rows = torch.zeros(n, dtype=torch.bool)
    rows[chosen] = True
    larger = parameters(n + more)
    alone = part(larger, chosen)
    larger["means"][5] = torch.nan
    before = {name: value.clone().view(torch.int32) for name, value in larger.items()}
    optimizer = kind(part(larger, slice(n)))
    of_alone = kind(alone)
    for step in range(3):
        given = {name: gradient + 1 for name, gradient in gradients(n, step).items()}
        of_alone.step(part(given, chosen), everything(3), TENTHS)
        for value in given.values():
            value[~rows] = filler
        optimizer.step(given, rows, TENTHS)
        optimizer.step(given, torch.zeros_like(rows), TENTHS)  # of no rows
    others = torch.cat([~rows, everything(more)])
    for name, value in larger.items():
        bits = value.view(torch.int32)
        assert torch.equal(bits[others], before[name][others]), name  # in place
        assert (bits[chosen] != before[name][chosen]).all(), name
        assert torch.equal(value[chosen], alone[name]), name
