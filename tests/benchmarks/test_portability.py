"""The conditions are those that the tests find, and their counts are right."""

from pathlib import Path
from typing import Any

import portability
import pytest

TESTS = """
import locale, math, os, signal, tempfile
import pytest

IGNORED = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
BLOCKED = signal.pthread_sigmask(signal.SIG_BLOCK, []) == {signal.SIGINT, signal.SIGTERM}
SPACED = " " in tempfile.gettempdir() and os.path.isdir(tempfile.gettempdir())
ASCII = locale.getencoding() in ("ANSI_X3.4-1968", "US-ASCII", "646")
MOVED = hasattr(math.exp, "__wrapped__")

@pytest.mark.parametrize("name", ["ignored", "blocked", "spaced", "ascii", "moved"])
def test_holds(name):
    assert globals()[name.upper()]

def test_skipped():
    pytest.skip("always")

@pytest.fixture
def broken():
    raise ValueError

def test_error(broken):
    pass
"""
HOLD = {"ignored", "blocked", "spaced", "ascii", "moved"}


def run_made(folder: Path, condition: str) -> tuple[dict[str, Any], set[str]]:
    """The row of a run, and what fails in it."""
    (folder / "test_made.py").write_text(TESTS)
    found = portability.run(condition, [str(folder / "test_made.py")], ["-p", "no:xdist", "-p", "no:cacheprovider"])
    return found, {name.partition("::test_")[2].removeprefix("holds").strip("[]") for name in found["failures"]}


def test_conditions_and_their_counts(tmp_path: Path) -> None:
    """Beside what already holds where these tests themselves run, which may be under such conditions."""
    already = HOLD - run_made(tmp_path, "plain")[1]
    found, failed = run_made(tmp_path, "blocked_signals+folders+libm_0")
    holds = already | {"blocked", "spaced", "moved"}
    assert [found[key] for key in ("passed", "failed", "skipped")] == [len(holds), 6 - len(holds), 1], found
    assert failed == (HOLD | {"error"}) - holds


def test_a_condition_that_cannot_be_had(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(portability.CONDITIONS, "plain", portability.Condition({}, ("env", "--no-such-option")))
    found = portability.run("plain", [str(tmp_path)], [])
    assert found["passed"] == 0 and found["failed"] == 1 and "env --help" in found["failures"][0]
