"""The importance estimate against brute force, the counts kept with the resulting sigma_d, and the
pruning order.
"""

import dataclasses

import pytest
import torch
from refusals import refused

from clod_adapter import AdaptConfig, View
from clod_adapter.equation.attenuation import dial
from clod_adapter.equation.distances import typical_distance
from clod_adapter.gaussians import SH_C0
from clod_adapter.initialization import pruning_order as pruning
from clod_adapter.initialization.importance import initialize, removal_error, usable_views
from clod_adapter.initialization.pruning_order import (
    APART,
    COLOUR_FLOOR,
    NEIGHBOURS,
    REMOVED,
)
from clod_adapter.render import splat
from runs import counted
from scenes import gaussians, photograph, ring, seeded

REVERSED = torch.diag(torch.tensor([-1.0, 1, -1, 1]))  # looks the other way


def changes(model, view):
    """``[N, pixels]`` of removing each Gaussian alone; an image is linear in each opacity where
    nothing is clamped.
    """
    whole, _ = splat(model, model.opacities, view.camera)
    without = model.opacities.repeat(len(model), 1).fill_diagonal_(0)
    return torch.stack(
        [(splat(model, each, view.camera)[0] - whole).flatten() for each in without]
    ).double()


def test_removal_error_is_unbiased(draws=100):
    """To 5 standard deviations: with random signs z, ``(sum z v)^2`` has mean |v|^2, variance 2
    (|v|^4 - sum v^4).
    """
    model = gaussians(15, 1, 0, size=0.4)
    model = model.replace(opacity_logits=(0.02 + 0.3 * model.opacities).logit())
    views = photograph(model, ring(3, 16, 12))
    v = [changes(model, view) for view in views]
    cameras = [view.camera for view in views]
    exact = sum(x.square().sum(1) for x in v) / 3
    variance = sum(2 * (x.square().sum(1).square() - x.pow(4).sum(1)) for x in v) / 9
    found = torch.stack([removal_error(model, cameras, seed=k) for k in range(draws)]).double()
    error = (found.mean(0) - exact).abs()
    spread = (variance / draws).sqrt()
    assert (exact > 0).sum() > 10
    assert (error <= 5 * spread + 1e-5 * exact.max()).all(), (
        f"{(error / spread).max():.1f} deviations"
    )
    # so the test could tell a factor of 2, or a missing view
    assert (spread < 0.15 * exact + 1e-9).all()


def test_removal_error_depends_on_the_seed_alone():
    model = gaussians(100, 1, 0)
    # outside of every view
    model = model.replace(means=torch.cat([model.means[:75], model.means[75:] + 1e3]))
    (view,) = photograph(model, ring(1, 20, 16))
    twice = [view.camera, view.camera]
    both = removal_error(model, twice, seed=3)
    assert torch.equal(both, removal_error(model, twice, seed=3))
    assert not torch.equal(both, removal_error(model, twice, seed=4))
    assert (both[75:] == 0).all() and (both[:75] > 0).any()
    blind = View(
        dataclasses.replace(view.camera, viewmat=REVERSED @ view.camera.viewmat), view.image
    )
    assert usable_views(model.select(torch.arange(75)), [view, blind, view]) == (view, view)
    with refused("in front of any of the 1 training cameras"):
        usable_views(gaussians(20, 0, 0), [blind])


def attenuated(n, **settings):
    """An initialized dial, and the views that it is from."""
    views = photograph(gaussians(n, 0, 0), ring(3, 20, 16))
    return initialize(gaussians(n, 0, 0), views, AdaptConfig(**settings)), views


def distances_of(model, views):

    return typical_distance(model.means, [view.camera for view in views], model.attenuation)


@pytest.mark.parametrize("share, exponent", [(0.51, 1.5), (0.8, 2.5), (1.0, 1.5)])
def test_kept_shares_follow_the_target_curve(share, exponent, n=1000):
    """At the distances of the initialization, ``1 / (s^p + (1/share - 1) s^-p)``, to one
    Gaussian.
    """
    model, views = attenuated(n, start_share=share, exponent=exponent)
    for s in (1.0, 1.2, 1.7, 2.0, 3.0, 5.0, 7.0, 15.0):
        kept = dial(model, distances_of(model, views), s).keep
        want = 1 / (s**exponent + (1 / share - 1) * s**-exponent)
        assert abs(kept.sum().item() - n * want) <= 1, f"s {s}"


def test_initialization_culls_in_the_pruning_order():
    """In which one that a neighbour replaces goes earlier than by its removal error alone."""
    model, views = attenuated(200)

    error = removal_error(model, [view.camera for view in views], seed=0)
    found = (model.sigma_d / distances_of(model, views)).argsort()
    order = pruning.pruning_order(model, error.sqrt() * model.opacities)
    assert torch.equal(found[100:180], order.argsort()[100:180])
    assert not torch.equal(order.argsort()[100:180], error.argsort(stable=True)[100:180])


def plainly(model, worth):
    """The order computed round by round and pair by pair."""
    worths = worth.double().tolist()
    left = list(range(len(model)))
    order = []
    centres = model.means.double()
    colours = 0.5 + SH_C0 * model.sh0[:, 0].double()
    sizes = model.log_scales.double().exp().amax(1)

    def unlike(i, j):
        apart = (centres[i] - centres[j]).square().sum()
        reach = (sizes[i] + sizes[j]).square()
        return float(
            (colours[i] - colours[j]).square().sum()
            + COLOUR_FLOOR**2
            + APART * apart / (apart + reach)
        )

    while len(left) > 1:
        heirs = {}
        for i in left:
            near = sorted(
                (j for j in left if j != i),
                key=lambda j: float((centres[i] - centres[j]).square().sum()),
            )
            heirs[i] = min(near[:NEIGHBOURS], key=lambda j: unlike(i, j))
        ranked = sorted(left, key=lambda i: worths[i] * unlike(i, heirs[i]))
        first = ranked[: max(int(REMOVED * len(left)), 1)]
        leaving = [i for i in first if ranked.index(heirs[i]) > ranked.index(i)]
        inheriting = {heirs[i] for i in leaving}
        leaving = [i for i in leaving if i not in inheriting]
        for i in leaving:
            worths[heirs[i]] += worths[i]
        order += leaving
        left = [i for i in left if i not in leaving]
    return order + left


@pytest.mark.parametrize("n, seed", [(0, 0), (1, 0), (2, 0), (60, 1)])
def test_order_matches_the_plain_implementation(n, seed):
    model = gaussians(n, 1, seed)
    steps = []
    worth = torch.rand(n, generator=seeded(seed))
    order = pruning.pruning_order(model, worth, counted(steps))
    assert order.argsort().tolist() == plainly(model, worth)
    assert n < 60 or (steps == sorted(steps) and 0 < steps[0][0] < 30 and steps[-1] == (60, 60))


def test_coincident_gaussians_are_moved_apart():
    """A k-d tree cannot separate coincident points and would compare all pairs."""
    model = gaussians(2000, 0, 0)
    alike = model.replace(means=torch.zeros(2000, 3), sh0=torch.zeros(2000, 1, 3))
    # Of no worth and no size at all: ties, and nothing to divide by.
    for one in (alike, alike.replace(log_scales=torch.full((2000, 3), -400.0))):
        steps = []
        order = pruning.pruning_order(one, torch.zeros(2000), counted(steps))
        assert order.sort().values.equal(torch.arange(2000)) and len(steps) < 300


def test_a_dial_of_another_form_is_refused():
    """Its numbers mean something else."""
    adapted, views = attenuated(20, iters=1)
    with refused("has the form ours; adapt with the same"):
        initialize(adapted, views, AdaptConfig.paper())
