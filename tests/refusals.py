"""The check that bad input is refused, shared by the tests of files and scenes."""

import pytest

from clod_adapter.errors import ClodError


def refused(message: str) -> "pytest.RaisesExc[ClodError]":
    """Expects a ClodError with a message that matches this pattern."""
    return pytest.raises(ClodError, match=message)
