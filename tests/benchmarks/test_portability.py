"""The conditions are those that the tests find, and their counts are right."""

from pathlib import Path

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


def test_conditions_and_their_counts(tmp_path: Path) -> None:
    """What else holds depends on where these tests themselves run."""
    (tmp_path / "test_made.py").write_text(TESTS)
    words = ["-p", "no:xdist", "-p", "no:cacheprovider"]
    found = portability.run("blocked_signals+folders+libm_0", [str(tmp_path / "test_made.py")], words)
    failed = {name.partition("::test_")[2] for name in found["failures"]}
    assert "error" in failed and failed <= {"error", "holds[ignored]", "holds[ascii]"}
    assert [found[key] for key in ("passed", "failed", "skipped")] == [6 - len(failed), len(failed), 1], found


def test_a_condition_that_cannot_be_had(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(portability.CONDITIONS, "plain", portability.Condition({}, ("env", "--no-such-option")))
    found = portability.run("plain", [str(tmp_path)], [])
    assert found["passed"] == 0 and found["failed"] == 1 and "env --help" in found["failures"][0]
