"""Ctrl-C at random times within ``adapt``."""

from __future__ import annotations

import copy
import random
import signal
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from clod_adapter import adapt
from clod_adapter.config import AdaptConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Phase, Progress
from clod_adapter.training import trainer
from clod_adapter.training.interrupts import DeferredInterrupt
from clod_adapter.training.loop import Adapted
from runs import pressing
from scenes import assert_equal, capture

Undisturbed = tuple[dict[int, Gaussians], float]
ITERS, ROUNDS = 40, 4
CONFIG = AdaptConfig(iters=ITERS, max_sv=3.0)
SCENE = capture(60, views=4, width=16, height=12)


@pytest.fixture(autouse=True)
def default_handler() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def undisturbed() -> Undisturbed:
    """The result after each step, and the seconds of training."""
    after: dict[int, Gaussians] = {}

    def keep(now: Progress) -> None:
        if now.gaussians:
            after[now.done] = copy.deepcopy(now.gaussians())

    return after, adapt(*SCENE, CONFIG, keep).seconds


def interrupted(step: int, seconds: float) -> tuple[Adapted, list[Progress]]:
    """``adapt`` with a SIGINT so many seconds after a step."""
    seen: list[Progress] = []
    timer = threading.Timer(seconds, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))

    def listen(now: Progress) -> None:
        if now.phase == Phase.TRAINING:
            seen.append(now)
            if now.done == step:
                timer.start()

    try:
        return adapt(*SCENE, CONFIG, listen), seen
    finally:
        timer.join()


def test_interrupted_results_are_of_a_whole_step(undisturbed: Undisturbed) -> None:
    after, seconds = undisturbed
    draw, early = random.Random(3), 0
    for _ in range(ROUNDS):
        adapted, seen = interrupted(draw.randint(1, ITERS // 2), draw.uniform(0, 2 * seconds / ITERS))
        assert adapted.interrupted and adapted.signalled and adapted.steps == len(seen)
        assert_equal(adapted.gaussians, after[adapted.steps])
        early += adapted.steps < ITERS
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert early > ROUNDS / 2


def test_an_interrupt_within_the_update_completes_the_step(
    undisturbed: Undisturbed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The step is completed, and its state resumes to the same bits."""
    states: list[Any] = []
    monkeypatch.setattr(trainer, "spoilt_rows", pressing(trainer.spoilt_rows, signal.SIGINT, at=5))
    found = adapt(*SCENE, CONFIG, lambda now: states.append(now.state) if now.state else None)
    assert found.interrupted and found.signalled
    assert_equal(found.gaussians, undisturbed[0][found.steps])
    assert_equal(adapt(*SCENE, CONFIG, resume=states[-1]()).gaussians, undisturbed[0][ITERS])


def test_an_interrupt_before_the_first_step_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def press(now: Progress) -> None:
        if now.phase == Phase.PRUNING_ORDER:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        adapt(*SCENE, CONFIG, press)


def test_a_second_interrupt_is_raised_at_once() -> None:
    """Not one of the signals that are repeated."""
    before, deferred = signal.signal(signal.SIGHUP, signal.default_int_handler), 0
    with pytest.raises(KeyboardInterrupt), DeferredInterrupt() as interrupt:
        interrupt.begin()
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGINT, signal.SIGHUP, signal.SIGINT):
            signal.raise_signal(number)
            assert interrupt.received
            deferred += 1
    assert deferred == 4
    assert signal.getsignal(signal.SIGINT) is signal.signal(signal.SIGHUP, before) is signal.default_int_handler


def test_other_handlers_and_threads_are_not_affected() -> None:
    heard: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    with DeferredInterrupt() as interrupt:
        interrupt.begin()
        signal.raise_signal(signal.SIGINT)
    assert heard == [signal.SIGINT] and not interrupt.received
    found: list[Adapted] = []
    thread = threading.Thread(target=lambda: found.append(adapt(*SCENE, AdaptConfig(iters=2))))
    thread.start()
    thread.join()
    assert found[0].steps == 2
