"""Outputs appear whole or not at all: write under a temporary name, then rename; and one run at a
time writes them.
"""

import os
import shutil
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from clod_adapter.errors import ClodError


@contextmanager
def atomic_path(final: str | Path) -> Iterator[Path]:
    """Gives a temporary name beside ``final``; on success the file written there replaces it.

    The body writes a file, or makes a folder, there. It is flushed to disk before it is renamed, so
    a crash leaves the old ``final`` or the new one; on any exception (KeyboardInterrupt too) the
    temporary is removed.
    """
    with atomic_paths(final) as (temporary,):
        yield temporary


@contextmanager
def atomic_paths(*finals: str | Path) -> Iterator[tuple[Path, ...]]:
    """``atomic_path`` for several, of which all are replaced or none. Errors name the final
    paths.
    """
    targets = [Path(final) for final in finals]
    for target in targets:
        check_target(target)
    temporaries = tuple(_temporary(target) for target in targets)
    try:
        yield temporaries
        for temporary in temporaries:
            for path in [*temporary.rglob("*"), temporary]:
                _flush(path)
        _replace(targets, temporaries)
        with suppress(OSError):  # the files are in place; some file systems cannot flush a folder
            for folder in {target.parent for target in targets}:
                _flush(folder)
    except OSError as error:
        names = ", ".join(map(str, targets))
        raise ClodError(f"{names}: cannot be written: {error.strerror or error}") from error
    except ClodError as error:
        message = str(error)
        for temporary, target in zip(temporaries, targets, strict=True):
            message = message.replace(str(temporary), str(target))
        raise ClodError(message) from error
    finally:
        for temporary in temporaries:
            _remove(temporary)


def remove_leftovers(final: Path) -> None:
    """Removes temporaries of ``final`` that killed processes left, where permissions allow."""
    for path in final.parent.glob(f"{_mark(final)}*"):
        if not path.name.endswith("-lock"):  # of ``output_lock``
            with suppress(OSError):
                _remove(path)


@contextmanager
def output_lock(final: Path, *, of: Path | None = None) -> Iterator[None]:
    """Holds, in the body, the lock of ``final``, by a hidden file beside it; errors name ``of``.

    A second run would remove the temporaries of the first. The lock ends with the
    process, however that ends. On a file system without locks nothing is locked.
    """
    from filelock import FileLock, Timeout  # here: --help needs no lock

    # some file systems ignore case
    path = final.parent / f"{_mark(final.with_name(final.name.casefold()))}lock"
    lock = FileLock(path, timeout=0)
    name = of or final
    try:
        lock.acquire()
    except (OSError, NotImplementedError) as error:
        # the latter: a run of another user
        if isinstance(error, Timeout | PermissionError) and os.path.exists(path):
            raise ClodError(
                f"{name}: another run is writing it; wait for that, or choose another name"
            ) from error
        if isinstance(error, Timeout):  # raised too where no file can be made
            raise ClodError(f"{name}: cannot be written; check the path") from error
        with suppress(OSError):  # no locks here
            path.unlink()
    try:
        yield
    finally:
        if lock.is_locked:
            with suppress(OSError):  # Windows removes no open file; there releasing does
                path.unlink()
            lock.release()


def check_target(final: Path) -> None:
    """Rejects, before anything is written, what ``atomic_path`` could not write."""
    folder = final.parent
    if not folder.is_dir():
        raise ClodError(f"{final}: folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ClodError(
            f"{final}: folder {folder} is not writable; choose another or change its permissions"
        )
    if os.path.ismount(final):
        raise ClodError(
            f"{final}: is a mount point, which cannot be replaced; mount its folder instead"
        )
    if final.is_dir() and any(final.iterdir()):
        raise ClodError(f"{final}: is a folder that is not empty; choose another name")
    if final.is_file() and not (final.stat().st_mode & 0o222 and os.access(final, os.W_OK)):
        # A rename would replace it, and root has access to everything.
        raise ClodError(
            f"{final}: is write-protected; choose another output, or chmod u+w if it is to be"
            " replaced"
        )


def _mark(final: Path) -> str:
    """The prefix of its temporaries' names: short, whatever the length of its own."""
    return f".tmp-{zlib.crc32(os.fsencode(final.name)):08x}-"


def _temporary(final: Path) -> Path:
    # A temporary of a temporary has the mark of the final file. Some writers choose their format by
    # the suffix.
    mark = final.name[:14] if final.name.startswith(".tmp-") else _mark(final)
    return final.parent / f"{mark}{os.urandom(8).hex()}{final.suffix}"


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _replace(targets: Sequence[Path], temporaries: Sequence[Path]) -> None:
    """Renames all; where one cannot be, those before it are again what they were."""
    earlier = {target: _temporary(target) for target in targets[:-1] if target.exists()}
    try:
        for target, backup in earlier.items():
            try:
                os.link(target, backup)
            except OSError:  # a file system without links
                shutil.copy2(target, backup)
        # One call from C, so that no Ctrl-C comes between two of them.
        list(map(os.replace, list(map(str, temporaries)), list(map(str, targets))))
    except OSError:
        for target, temporary in zip(targets, temporaries, strict=True):
            if target in earlier and earlier[target].exists():
                os.replace(earlier[target], target)
            elif not temporary.exists():  # it was renamed
                _remove(target)
        raise
    finally:
        for backup in earlier.values():
            _remove(backup)


def _flush(path: Path) -> None:
    if path.is_dir() and os.name == "nt":  # Windows cannot open a folder
        return
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
