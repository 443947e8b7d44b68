"""Ctrl-C within ``adapt``."""

import signal
from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import pytest

from clod_adapter import AdaptConfig, Gaussians, adapt
from clod_adapter.training import trainer
from clod_adapter.training.interrupts import GracefulStop
from runs import pressing
from scenes import assert_equal, capture

ITERS = 12
CONFIG = AdaptConfig(iters=ITERS, max_sv=3.0)
SCENE = capture(60, views=4, width=16, height=12)


@pytest.fixture(autouse=True)
def default_handler() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_within_the_update_completes_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """The step is completed, and its state resumes to the same bits."""
    after: dict[int, Gaussians] = {}
    adapt(*SCENE, CONFIG, lambda now: after.update({now.done: deepcopy(now.gaussians())}) if now.gaussians else None)
    states: list[Any] = []
    monkeypatch.setattr(trainer, "spoilt_rows", pressing(trainer.spoilt_rows, signal.SIGINT, at=5))
    found = adapt(*SCENE, CONFIG, lambda now: states.append(now.state) if now.state else None)
    assert found.interrupted and found.signalled and found.steps == 5
    assert_equal(found.gaussians, after[5])
    assert_equal(adapt(*SCENE, CONFIG, resume=states[-1]()).gaussians, after[ITERS])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_interrupt_is_raised_at_once() -> None:
    """Not one of the signals that are repeated."""
    before, deferred, stop = signal.signal(signal.SIGHUP, signal.default_int_handler), 0, GracefulStop()
    with pytest.raises(KeyboardInterrupt), stop.listening(in_place_of=signal.default_int_handler):
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGINT, signal.SIGHUP, signal.SIGINT):
            signal.raise_signal(number)
            assert stop.requests
            deferred += 1
    assert deferred == 4
    assert signal.getsignal(signal.SIGINT) is signal.signal(signal.SIGHUP, before) is signal.default_int_handler


def test_other_handlers_are_not_affected() -> None:
    heard, stop = list[int](), GracefulStop()
    signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    with stop.listening(in_place_of=signal.default_int_handler):
        signal.raise_signal(signal.SIGINT)
    assert heard == [signal.SIGINT] and not stop.requests
