"""Frame times on a simulated clock: a machine that warms up, drifts, is interrupted, and one that is too busy."""

import random
from collections.abc import Callable
from typing import Any

import pytest
import torch

from clod_adapter import AttenuationConfig, Camera, Gaussians, Stopped, with_dial
from clod_adapter.evaluation import frame_times
from clod_adapter.evaluation.frame_times import PASSES, VIEWS, FrameTimes, time_frames
from scenes import gaussians, ring

DIALS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0)
Clock = Callable[[Callable[[int, float], float]], list[tuple[str, float]]]


def adapted() -> Gaussians:
    return with_dial(gaussians(20, 0, 0), torch.ones(20), AttenuationConfig(max_sv=7.0))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Renders in no time; the clock advances by ``cost(frame, s)`` seconds. Returns the frames that are drawn."""

    def install(cost: Callable[[int, float], float]) -> list[tuple[str, float]]:
        drawn, now = list[tuple[str, float]](), [0.0]

        def draw(some: Gaussians, camera: Camera, s: float) -> None:
            now[0] += cost(len(drawn), s)
            drawn.append((camera.name, s))

        monkeypatch.setattr(frame_times, "render", draw)
        monkeypatch.setattr(frame_times.time, "perf_counter", lambda: now[0])
        return drawn

    return install


def of_one(**options: Any) -> FrameTimes:
    return time_frames([(adapted(), DIALS)], ring(9, 48, 36), **options)


def test_drift_and_interruptions_do_not_zigzag(clock: Clock) -> None:
    """Frames take 20/s ms; 3 times that at first, a half more at the end, and one in twelve is interrupted."""
    chance = random.Random(0)

    def cost(frame: int, s: float) -> float:
        slow = 3 if frame < 4 else 1 + frame / 500
        return 0.02 / s * slow * chance.uniform(0.97, 1.03) + (0.05 if chance.random() < 1 / 12 else 0)

    clock(cost)
    found = of_one()
    (times,) = found.milliseconds
    assert all(a >= b for a, b in zip(times, times[1:], strict=False)), times
    scaled = [taken * s for taken, s in zip(times, DIALS, strict=True)]
    assert max(scaled) < 1.7 * min(scaled) and 20 < times[0] < 40


def test_frames_are_interleaved_and_few_where_they_are_slow(clock: Clock) -> None:
    drawn = clock(lambda frame, s: 0.01)
    seen = list[tuple[int, int]]()
    assert of_one(progress=lambda now: seen.append((now.done, now.total))).milliseconds == ((pytest.approx(10),) * 9,)
    assert seen == [(k, PASSES) for k in range(1, PASSES + 1)]
    timed = drawn[-PASSES * 9 * 3 :]  # nine cameras: every third is one of at most four
    assert len({name for name, _ in drawn}) == 3 <= VIEWS and [s for _, s in timed] == [*DIALS] * (3 * PASSES)
    assert {s for _, s in drawn[: -len(timed)]} == {1.0}  # the warm-up, with the slowest
    drawn = clock(lambda frame, s: 1.0)
    of_one()
    assert len({name for name, _ in drawn[2:]}) == 1 and 3 * 9 <= len(drawn) <= 3 * 9 + 3


def test_a_listener_stops_the_timing() -> None:
    with pytest.raises(Stopped):
        of_one(progress=lambda now: False)
