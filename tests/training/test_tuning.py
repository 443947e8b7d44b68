"""Tuning of plain Gaussians: pictures improve, and errors name the remedy."""

import pytest

from clod_adapter import ClodError, Phase, Stopped, evaluate, tune
from scenes import assert_equal, attenuated, capture


@pytest.fixture(scope="module")
def faded():
    """Photographs, and their Gaussians in colours that have lost contrast."""
    truth, scene = capture()
    return truth.replace(sh0=0.5 * truth.sh0), scene.train


def quality(gaussians, views):
    (row,) = evaluate(gaussians, views, [1.0])
    return row.psnr


def test_pictures_improve(faded):
    start, views = faded
    before = start.replace(sh0=start.sh0.clone())
    tuned = tune(start, views, 60)
    assert quality(tuned, views) > quality(start, views) + 3
    assert_equal(start, before)
    assert_equal(tuned, tune(start, views, 60))


def test_a_listener_stops_it(faded):
    seen = []

    def stop(now):
        seen.append((now.phase, now.done, now.total))
        return now.done < 2

    with pytest.raises(Stopped):
        tune(*faded, 5, progress=stop)
    assert seen == [(Phase.TUNING, 1, 5), (Phase.TUNING, 2, 5)]


def test_a_dial_is_baked_first(faded):
    with pytest.raises(ClodError, match="bake"):
        tune(attenuated(20, 1, 0), faded[1])
