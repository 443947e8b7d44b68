"""The exception for bad input and bad use."""

from collections.abc import Iterator
from contextlib import contextmanager
from errno import EINVAL
from pathlib import Path

from clod_adapter._support.text import as_text, first_line


class ClodError(Exception):
    """Bad input or bad use.

    The message is one line: the file or field, what is wrong with it and what to do. The command
    line prints it and exits with code 2.
    """

    def __init__(self, message: str) -> None:
        # Parts may come from a file: no line breaks and no control characters for the terminal.
        super().__init__("".join(c if c.isprintable() else " " for c in as_text(message)))


@contextmanager
def rejected_if_damaged(
    path: Path,
    what: str = "is damaged or truncated",
    fix: str = "copy or export it again",
) -> Iterator[None]:
    """Makes errors of reading a file, raised within, one line: the file, ``what`` it is, the
    reason, and the ``fix``.

    A ClodError that names the file already is unchanged, and a MemoryError, which is not of the
    file.
    """
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:  # of libraries, and whatever a crafted file provokes
        if isinstance(error, ClodError) and str(error).startswith(str(ClodError(f"{path}: "))):
            raise
        # Libraries raise an OSError without a number, or with that of a seek to nowhere, for what a
        # file contains.
        if isinstance(error, OSError) and error.errno not in (None, EINVAL):
            raise ClodError(
                f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
            ) from error
        reason = f"no {error}" if isinstance(error, KeyError) else first_line(error)
        raise ClodError(f"{path}: {what} ({reason:.200}); {fix}") from error
