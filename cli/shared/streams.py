"""stdout and stderr that may be closed, on a full device, or pipes whose reader has ended: the work goes on."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from clod_adapter.errors import ClodError


class Stream:
    """A text stream that raises no OSError: it keeps the first one as ``error`` and discards what follows."""

    def __init__(self, stream: TextIO | None) -> None:
        self.error: OSError | None = None
        if stream is None:  # Python's, where the shell closed it
            stream, self.error = open(os.devnull, "w"), OSError(errno.EBADF, "it is closed")  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # characters that its encoding lacks, as in names of files
        self._stream = stream

    def write(self, text: str) -> int:
        return self._try(lambda: self._stream.write(text)) or 0

    def flush(self) -> None:
        self._try(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _try(self, call: Callable[[], int | None]) -> int | None:
        try:
            return call()
        except OSError as error:
            self.error = error
            with open(os.devnull, "w") as nowhere:  # Python flushes what is left again when it exits
                os.dup2(nowhere.fileno(), self._stream.fileno())
            return None


@contextmanager
def unbreakable_streams() -> Iterator[None]:
    """Within the block sys.stdout and sys.stderr are Streams."""
    for number in range(3):  # a file that is opened later must not get the number of a closed stream
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    before = sys.stdout, sys.stderr
    out, err = streams = Stream(sys.stdout), Stream(sys.stderr)
    sys.stdout, sys.stderr = streams  # type: ignore[assignment]
    try:
        yield
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before


def check_printed() -> None:
    """Refuses a stdout that did not take all that was printed."""
    sys.stdout.flush()
    if error := getattr(sys.stdout, "error", None):  # not of a redirected one
        raise ClodError(f"stdout cannot be written ({error.strerror or error}), so the result is lost; open it")
