"""Tables, processes that are timed from outside, and the exponents of their times."""

import sys

import common
import pytest
import scaling


def test_a_table_is_markdown() -> None:
    lines = common.table(["scene", "dB"], [["plush", 29.0], ["banana", 25.8]], 1).splitlines()
    assert lines == ["| scene | dB |", "|---|---:|", "| plush | 29.0 |", "| banana | 25.8 |"]


def test_a_process_is_timed_by_its_messages() -> None:
    code = "import sys, time; print('half', file=sys.stderr, flush=True); time.sleep(1.5); print('done')"
    run = common.Process([sys.executable, "-c", code], {"half": "^half"})
    assert (run.out, run.lines) == ("done\n", ["half"])
    assert 0 < run.moments["half"] <= run.seconds - 0.3  # a busy machine reads the message up to a second late
    assert run.peak_bytes >= max(size for _, size, _ in run.memory) > 0
    with pytest.raises(SystemExit, match="exit code 3"):
        common.Process([sys.executable, "-c", "raise SystemExit(3)"])


def test_an_exponent_is_that_of_the_power() -> None:
    assert scaling.exponent([(n, 3 * n**0.5) for n in scaling.SIZES]) == pytest.approx(0.5)
