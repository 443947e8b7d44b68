"""The exception for bad input and bad use."""

from clod_adapter._support.text import as_text


class ClodError(Exception):
    """Bad input or bad use.

    The message is one line: the file or field, what is wrong with it and what to do. The command line prints it and
    exits with code 2.
    """

    def __init__(self, message: str) -> None:
        # Parts may come from a file: no line breaks and no control characters for the terminal.
        super().__init__("".join(c if c.isprintable() else " " for c in as_text(message)))
