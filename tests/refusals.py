"""The check that bad input is refused."""

import pytest

from clod_adapter.errors import ClodError


def refused(message):
    """Expects a ClodError with a message that matches this pattern."""
    return pytest.raises(ClodError, match=message)
