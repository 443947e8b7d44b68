"""Tuning of plain Gaussians: pictures improve, the finest of several levels stays, errors name the
remedy.
"""

import pytest
import torch

from clod_adapter import ClodError, Phase, Stopped, evaluate, tune, tune_levels
from clod_adapter.bake import Level
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


def test_levels_are_tuned_where_they_are_drawn(faded):
    start, views = faded
    distances = torch.cat([(start.means - v.camera.position).norm(dim=1) for v in views])
    away = float(distances.max()) * 2
    levels = [Level(0.0, start), Level(float(distances.min()) / 2, start), Level(away, start)]
    finest, drawn, beyond = tune_levels(levels, views, 90)
    assert_equal(finest.gaussians, start)
    assert quality(drawn.gaussians, views) > quality(start, views) + 1
    assert [level.begins for level in (finest, drawn, beyond)] == [each.begins for each in levels]


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
