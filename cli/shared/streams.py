"""Text for stdout and stderr that cannot be written, or not as it is."""

from __future__ import annotations

import errno
import io
import os
import sys
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


def print_anywhere() -> None:
    """Makes stdout and stderr escape characters that their encoding lacks, as in names of files.

    A terminal that is closed meanwhile drops the text, so that the work continues.
    """
    sys.stdout, sys.stderr = _lasting(sys.stdout), _lasting(sys.stderr)


def forget_stdout() -> None:
    """After the reader of a pipe has ended; without this Python reports it again when it flushes at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _lasting(stream: TextIO) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper):
        return stream
    stream.reconfigure(errors="backslashreplace")
    raw = getattr(stream.buffer, "raw", stream.buffer)  # the second one below python -u
    if type(raw) is not io.FileIO or not raw.isatty():  # Windows has another class for its console
        return stream
    terminal = io.BufferedWriter(_Terminal(os.dup(raw.fileno()), "w"))
    return io.TextIOWrapper(terminal, stream.encoding, stream.errors, line_buffering=True)


class _Terminal(io.FileIO):
    def write(self, data: ReadableBuffer, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return memoryview(data).nbytes
