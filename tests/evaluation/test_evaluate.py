"""Rows of an evaluation, by hand and of an unadapted file; frame times on a simulated clock;
budgets: solved dial values keep the counts asked for, and interpolate known curves.
"""

import math
import random
import re
from statistics import fmean

import pytest
import torch
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from refusals import refused

from clod_adapter import AttenuationConfig, Stopped, View, dial_for, evaluate, render
from clod_adapter.adapter import with_dial
from clod_adapter.config import FORMS
from clod_adapter.equation.attenuation import dial
from clod_adapter.evaluation import frame_times
from clod_adapter.evaluation.frame_times import PASSES, VIEWS, time_frames
from clod_adapter.losses import psnr_ssim
from clod_adapter.quality_table import QualityRow, QualityTable
from runs import counted
from scenes import camera, gaussians, in_front, photograph, ring, seeded


def row_of_four():
    """Four Gaussians at camera depths 1, 2, 4 and 8, the last far outside the image; each has a
    reach of 3.
    """
    means = in_front(camera(), torch.tensor([[0.0, 0, 1], [0, 0, 2], [0, 0, 4], [80, 0, 8]]))
    model = gaussians(4, 0, 0).replace(means=means, opacity_logits=torch.full((4,), 2.0))
    return with_dial(model, torch.full((4,), 3.0), AttenuationConfig())


def test_counts_follow_the_reach():
    view = View(camera(), torch.zeros(45, 61, 3, dtype=torch.uint8))
    rows = evaluate(row_of_four(), [view, view], [1.0, 1.6, 4.0])
    assert [row.kept for row in rows] == [2, 1, 0]
    assert [row.kept_share for row in rows] == [0.5, 0.25, 0]
    assert [row.in_view for row in rows] == [2, 1, 0]
    (row,) = evaluate(row_of_four().replace(sigma_d=torch.full((4,), 1e3)), [view], [1.0])
    assert (row.kept, row.in_view) == (4, 3)
    assert rows[2].psnr == math.inf  # a black photograph of nothing


def test_rows_are_means_over_renders():
    sigma_d = torch.full((200,), 0.8, requires_grad=True)
    model = with_dial(gaussians(200, 1, 0), sigma_d, AttenuationConfig(scene_distance=4.0))
    views = photograph(gaussians(200, 1, 0), ring(3, 32, 24))
    steps = []
    rows = evaluate(model, views, [1.0, 2.0], progress=counted(steps))
    assert steps == [(k, 6) for k in range(1, 7)]
    for row in rows:
        with torch.no_grad():
            renders = [render(model, view.camera, row.virtual_scale) for view in views]
        pairs = zip(renders, views, strict=True)
        psnr, ssim = zip(*(psnr_ssim(r.image, view.image) for r, view in pairs), strict=True)
        assert row.psnr == pytest.approx(fmean(psnr)) and row.ssim == pytest.approx(fmean(ssim))
        assert row.kept == pytest.approx(fmean(int(r.kept.sum()) for r in renders))
        assert 0 < row.kept_share == row.kept / 200 < 1 and row.in_view < row.kept


def test_bad_calls_are_named():
    views = [View(camera(20, 16), torch.zeros(16, 20, 3, dtype=torch.uint8))]
    for held_out, dials, message in (
        ([], [1.0], "no held-out views"),
        (views, [], "no dial values"),
        (views, [1.0, -0.5], "virtual_scale is -0.5"),
        (views, [1.0, math.nan], "virtual_scale is nan"),
    ):
        with refused(message):
            evaluate(row_of_four(), held_out, dials)


DIALS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0)


@pytest.fixture
def clock(monkeypatch):
    """Renders in no time; the clock advances by ``cost(frame, s)`` seconds. Returns the frames that
    are drawn.
    """

    def install(cost):
        drawn = []
        now = [0.0]

        def draw(model, camera, s):
            now[0] += cost(len(drawn), s)
            drawn.append((camera.name, s))

        monkeypatch.setattr(frame_times, "render", draw)
        monkeypatch.setattr(frame_times.time, "perf_counter", lambda: now[0])
        return drawn

    return install


def of_one(**options):
    model = with_dial(gaussians(20, 0, 0), torch.ones(20), AttenuationConfig(max_sv=7.0))
    return time_frames([(model, DIALS)], ring(9, 48, 36), **options)


def test_drift_and_interruptions_show_in_the_range(clock):
    """Frames take 20/s ms; 3 times that at first, a half more at the end, and one in twelve is
    interrupted.
    """
    chance = random.Random(0)

    def cost(frame, s):
        slow = 3 if frame < 4 else 1 + frame / 500
        interruption = 0.02 / s * slow * chance.uniform(0.97, 1.03)
        return interruption + (0.05 if chance.random() < 1 / 12 else 0)

    clock(cost)
    found = of_one()
    times, ranges = found.milliseconds[0], found.ranges[0]
    for time, between, s in zip(times, ranges, DIALS, strict=True):
        assert 20 / s < time < 20 / s + 2 * between + 20
        assert between > 0.02 * time


def test_frames_are_interleaved_and_few_where_they_are_slow(clock):
    drawn = clock(lambda frame, s: 0.01)
    steps = []
    found = of_one(progress=counted(steps))
    assert found.milliseconds == ((pytest.approx(10),) * 9,)
    assert found.ranges == ((pytest.approx(0),) * 9,) and found.notes == []
    assert steps == [(k, PASSES) for k in range(1, PASSES + 1)]
    count = PASSES * 9 * 3  # nine cameras: every third is one of at most four
    assert len({name for name, _ in drawn}) == 3 <= VIEWS
    assert [s for _, s in drawn[-count:]] == [*DIALS] * (3 * PASSES)
    assert {s for _, s in drawn[:-count]} == {1.0}  # the warm-up, with the slowest
    drawn = clock(lambda frame, s: 1.0)
    of_one()
    assert len({name for name, _ in drawn[2:]}) == 1 and 3 * 9 <= len(drawn) <= 3 * 9 + 3


def test_a_listener_stops_the_timing():
    with pytest.raises(Stopped):
        of_one(progress=lambda now: False)


MAX_SV = 6.0


def adapted(n, seed, form="ours"):
    """Gaussians that are culled at dial values within, below and above the range."""
    generator = seeded(seed)
    sigma = (torch.randn(n, generator=generator) * 0.8 + 0.4).exp()
    attenuation = AttenuationConfig(form=form, max_sv=MAX_SV, scene_distance=5.0)
    return with_dial(gaussians(n, 0, seed), sigma, attenuation)


def kept(model, cameras, s):
    return sum(int(dial(model, camera, s).keep.sum()) for camera in cameras)


@settings(deadline=None, max_examples=30)
# one Gaussian is at distance 1 in three views
@example(n=2, seed=2, views=5, share=0.25, form="paper")
@given(
    n=st.integers(2, 3000),
    seed=st.integers(0, 10**6),
    views=st.integers(1, 5),
    share=st.floats(-1, 1),
    form=st.sampled_from(FORMS),
)
def test_counts_are_exact_up_to_ties(n, seed, views, share, form):
    model = adapted(n, seed, form)
    cameras = ring(views, 48, 36)
    most = kept(model, cameras, 1.0)
    fewest = kept(model, cameras, MAX_SV)
    wanted = fewest + round(share * (most - fewest if share > 0 else fewest))
    assume(wanted >= views)
    solved = dial_for(model, keep=wanted / views, cameras=cameras)
    s = solved.virtual_scale
    count = kept(model, cameras, s)
    assert s >= 1 and (s <= MAX_SV) == (solved.note == "") == (wanted >= fewest)
    # At most what was asked for; and where it is less, more would stay at the next smaller dial
    # value in float32.
    assert count <= wanted
    assert count == wanted or kept(model, cameras, s * (1 - 1e-6)) > wanted
    # The Gaussian whose distance is the unit is at distance 1, and ends at the same s in each view
    # where it is that.
    ties = 0 if form == "ours" else views - 1
    assert wanted - count <= max(1, 0.001 * wanted) + ties


def table(psnr, times=()):
    dials = [2.0**k for k in range(len(psnr))]
    times = times or [10.0 / s for s in dials]
    rows = tuple(
        QualityRow(s, 100 / s, p, 0.9, t) for s, p, t in zip(dials, psnr, times, strict=True)
    )
    return QualityTable(rows, 100, 2, 64, 48, "a machine")


@pytest.mark.parametrize(
    "psnr, drop, wanted",
    [
        ([30, 29, 28], 1, 2),
        ([30, 29, 28], 1.25, 2 * 2**0.25),
        ([30, 30.5, 29.5], 0.25, 2 * 2**0.75),
        ([30, 28, 29.5, 27], 1, math.sqrt(2)),
        ([30, 29, 28.25], 3, 4),
    ],
)
def test_a_psnr_drop_is_linear_in_log_s(psnr, drop, wanted):
    """From s = 1, not from the best; where it is first spent; a larger one than any is the largest
    dial value.
    """
    solved = dial_for(adapted(3, 0), psnr_drop=drop, quality_table=table(psnr))
    assert solved.virtual_scale == pytest.approx(wanted, rel=1e-12)
    assert drop < 3 or solved.note.startswith("only 1.75 dB are lost at s = 4")


def test_a_frame_rate_is_reached_for_good():
    for times, fps, wanted in (
        ([20, 10, 5], 1000 / 15, math.sqrt(2)),
        ([20, 10, 12, 5], 1000 / 11, 4 * 2 ** (1 / 7)),  # not in passing
        ([20, 10, 5], 200, 4),
        ([20, 10, 5], 30, 1),  # s = 1 is fast enough
    ):
        quality_table = table([30] * len(times), times)
        solved = dial_for(adapted(3, 0), fps=fps, quality_table=quality_table)
        assert solved.virtual_scale == pytest.approx(wanted, rel=1e-12)
        assert solved.note == ("s = 1 draws 50 frames a second already" if fps == 30 else "")
        with refused("at s = [48], .* takes 5.0 ms, 200 a second"):
            dial_for(adapted(3, 0), fps=201, quality_table=quality_table)


def test_bad_arguments_are_refused():
    model = adapted(5, 0)
    cameras = ring(1, 48, 36)
    (camera,) = cameras
    lists = "cameras must be a list of cameras or viewpoints"
    view = View(camera, torch.zeros(36, 48, 3, dtype=torch.uint8))
    for arguments, message in (
        ({}, "exactly one of keep, psnr_drop and fps"),
        ({"keep": 3, "fps": 3}, "exactly one of keep, psnr_drop and fps"),
        ({"keep": 0}, "keep is 0, it must be a positive, finite number"),
        ({"fps": math.nan}, "fps is nan"),
        ({"psnr_drop": math.inf}, "psnr_drop is inf"),
        ({"psnr_drop": 1}, "needs the quality table"),
        *(
            ({"keep": wrong}, re.escape(f"keep is {wrong}, it must be a positive, finite number"))
            for wrong in ("5", [1.0], torch.ones(2), 10**400)
        ),
        *(({"keep": 3, "cameras": wrong}, lists) for wrong in (camera, [view], "abc", 5)),
        ({"keep": 1, "cameras": ()}, "no camera"),
        ({"fps": 1, "cameras": ()}, "a quality table or cam"),
    ):
        with refused(message):
            dial_for(model, **{"cameras": cameras} | arguments)
    with refused("no sigma_d"):
        dial_for(gaussians(3, 0, 0), keep=1, cameras=cameras)
