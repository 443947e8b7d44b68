"""The one exception type for bad input and bad use."""

from __future__ import annotations

from clod_adapter._support.text import as_text


class ClodError(Exception):
    """Something the user gave cannot be used.

    The message is one line that names the file or field, says what is wrong with it and what to do
    about it. The command line prints it and exits with code 2.
    """

    def __init__(self, message: str) -> None:
        # Parts of it may come from a file, and are not to begin a line or to steer the terminal.
        super().__init__("".join(c if c.isprintable() else " " for c in as_text(message)))
