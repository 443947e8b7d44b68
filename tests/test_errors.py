from __future__ import annotations

from clod_adapter.errors import ClodError


def test_a_message_is_one_printable_line() -> None:
    message = str(ClodError("a.ply: property \x1b[2J\nx\r\x00 is odd (é)"))
    assert message == "a.ply: property  [2J x   is odd (é)" and message.isprintable()
