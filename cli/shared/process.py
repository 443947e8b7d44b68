"""The process: its streams, signals and limits, and its place among those of torchrun."""

import errno
import io
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, redirect_stderr, redirect_stdout
from typing import Any, NamedTuple, TextIO

from clod_adapter import ClodError, Stopped
from clod_adapter.progress import ENDING, handled_by


class Stream:
    """A text stream that raises no OSError: it keeps the first one as ``error`` and discards what
    follows.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self.error: OSError | None = None
        if stream is None:  # Python's, where the shell closed it
            stream, self.error = open(os.devnull, "w"), OSError(errno.EBADF, "it is closed")  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            # characters that its encoding lacks, as in names of files
            stream.reconfigure(errors="backslashreplace")
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
            # Python flushes what is left again when it exits
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())
            return None


@contextmanager
def unbreakable_streams() -> Iterator[None]:
    """Within the block sys.stdout and sys.stderr are Streams."""
    # a file that is opened later must not get the number of a closed stream
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    out, err = Stream(sys.stdout), Stream(sys.stderr)
    with redirect_stdout(out), redirect_stderr(err):  # type: ignore[type-var]
        try:
            yield
        finally:
            out.flush()
            err.flush()


def check_printed() -> None:
    """Refuses a stdout that did not take all that was printed."""
    sys.stdout.flush()
    if error := getattr(sys.stdout, "error", None):  # not of a redirected one
        raise ClodError(
            f"stdout cannot be written ({error.strerror or error}), so the result is lost; open it"
        )


@contextmanager
def interrupt_as_stopped() -> Iterator[None]:
    """Within the block Ctrl-C raises Stopped. From the dispatcher of a compiled function it comes
    as a SystemError.
    """
    try:
        yield
    except (KeyboardInterrupt, SystemError) as error:
        if not isinstance(error, KeyboardInterrupt) and not isinstance(
            error.__cause__, KeyboardInterrupt
        ):
            raise
        raise Stopped("interrupted") from error


def signals_as_interrupt() -> AbstractContextManager[None]:
    """Within the block all raise KeyboardInterrupt. Enter it after importing pycolmap, which sets a
    handler.
    """
    return handled_by(signal.default_int_handler)


def ignore_signals() -> None:
    """Ignores all until the process ends, also after the blocks above."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


# In RuntimeErrors (torch's allocators, Python's threads) and ImportErrors (the loader's).
MESSAGES = (
    "can't allocate memory",
    "not enough memory",
    "out of memory",
    "std::bad_alloc",
    "can't start new thread",
    "failed to map segment",
    "cannot allocate memory",
)


def check_surroundings() -> None:
    """Refuses a deleted current folder; removes variables that numba and matplotlib would
    refuse.
    """
    for name in ("NUMBA_NUM_THREADS", "MPLBACKEND"):
        os.environ.pop(name, None)
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise ClodError("the current folder was deleted; change to another one") from error


def shortage(error: BaseException) -> str | None:
    """The shortage of memory or threads in one line; None for another error."""
    short = isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM
    if not short and not any(message in str(error).lower() for message in MESSAGES):
        return None
    text = (str(error) or "allocating").splitlines()[0]
    return (
        f"not enough memory ({text[:200]}); free some memory, or raise the limit on it (ulimit -v)"
    )


NEEDED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


class Launch(NamedTuple):
    """The index of this process, from 0, and their number: among all, and on this machine."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1


def launched() -> Launch:
    """Reads the environment variables of torchrun; a single process without them."""
    if not all(name in os.environ for name in NEEDED):
        return Launch()
    names = {"RANK": 0, "WORLD_SIZE": 1, "LOCAL_RANK": 0, "LOCAL_WORLD_SIZE": 1}
    try:
        launch = Launch(*(int(os.environ.get(name, default)) for name, default in names.items()))
    except ValueError:
        launch = Launch(-1)
    if not 0 <= launch.rank < launch.size or not 0 <= launch.local_rank < launch.local_size:
        raise ClodError(
            f"inconsistent environment variables {', '.join(names)}; start the processes with"
            " torchrun"
        )
    return launch


@contextmanager
def silence_but_first() -> Iterator[None]:
    """Within the block, only the first of several processes prints; an exception that leaves it is
    not silenced.
    """
    if os.environ.get("RANK", "0") == "0" or not all(name in os.environ for name in NEEDED):
        yield
        return
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield
