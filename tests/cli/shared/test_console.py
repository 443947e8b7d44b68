"""Progress and messages, with and without a terminal."""

import io
import sys
from types import SimpleNamespace

import pytest

from clod_adapter.cli.shared.console import Console, Meter, duration


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_bar_fits_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    monkeypatch.setattr("tqdm.std._screen_shape_wrapper", lambda: lambda file: (30, 24))
    with Console().meter("training") as meter:
        meter.bar.delay = meter.bar.mininterval = 0
        for step in range(1, 5):
            meter.update(step / 4, f"{step}/4, s=1 25.81 dB 100%, s=5 21.02 dB 9%")
    lines = terminal.getvalue().split("\r")
    assert any("50%" in line for line in lines) and max(map(len, lines)) <= 30
    assert "\n" not in terminal.getvalue() and not lines[-1].strip()  # cleared at the end


def test_progress_lines_without_a_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("clod_adapter.cli.shared.console.time", SimpleNamespace(perf_counter=lambda: now))
    meter = Meter(Console(), "training")
    for now in range(1, 21):
        meter.update(now / 90, f"step {now} of a checkpoint of a very long name")
    assert capsys.readouterr().err.splitlines() == [
        f"training  {share}%, {left} left, step {step} of a checkpoint of a very..."
        for share, left, step in ((11, "1:20", 10), (22, "1:10", 20))
    ]
    now = 10.0  # the time left does not count the work of an earlier run
    meter.begin("training", initial=0.5)
    meter.began = meter.printed = 0.0
    meter.update(0.6)
    assert capsys.readouterr().err == "training  60%, 40 s left\n"


def test_status_and_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """A status is shown on a terminal, until the block ends."""
    for quiet, stream in ((False, Terminal()), (True, Terminal()), (False, io.StringIO())):
        monkeypatch.setattr(sys, "stderr", stream)
        console = Console(quiet)
        with pytest.raises(KeyboardInterrupt), console.status("reading a file ..."):
            assert ("\rreading a file ..." in stream.getvalue()) == (stream.isatty() and not quiet)
            raise KeyboardInterrupt
        assert not stream.getvalue().split("\r")[-1].strip() and "\n" not in stream.getvalue()
        console.say("a line")
        assert stream.getvalue().endswith("a line\n") != quiet


def test_duration() -> None:
    for seconds, text in ((0.04, "0.0 s"), (9.96, "10 s"), (59.7, "1:00"), (125, "2:05"), (3725, "1:02:05")):
        assert duration(seconds) == text
