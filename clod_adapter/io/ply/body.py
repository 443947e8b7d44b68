"""The rows of a PLY, read in one pass with the hash of the file.

Not plyfile's reader, which allocates the rows that the header states and is slow on ascii.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import os
import warnings
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty

from clod_adapter.errors import ClodError
from clod_adapter.io.ply import header
from clod_adapter.io.ply.header import Head, parse_head
from clod_adapter.io.sniff import refuse_irregular

_PIECE = 1 << 20  # bytes; hashed while they are in the processor's cache


@dataclass(frozen=True)
class PlyFile:
    """A PLY as read.

    Attributes:
        head: its header.
        elements: by name, ``[N]`` structured arrays in file order and type, native byte order.
        sha256: hex, of the very bytes that were parsed.
    """

    head: Head
    elements: dict[str, np.ndarray]
    sha256: str


def read_elements(path: Path, choose: Callable[[Path, PlyData], Collection[str]]) -> PlyFile:
    """Reads a PLY from start to end, once.

    The length of the file is compared with the rows that the header states before anything is allocated for them.

    Args:
        choose: called with ``path`` and the header; the names of the elements to parse, which must be there and have
            no lists. It may refuse the file.

    Raises:
        ClodError: the file cannot be read, is shorter than its header states, damaged, or has lists before the last
            of those elements.
    """
    try:
        refuse_irregular(path)
        with open(path, "rb", buffering=0) as raw:
            source = _Hashed(raw)
            start = source.take_start(header.HEADER_LIMIT)
            head = parse_head(path, start)
            wanted = choose(path, head.ply)
            check_length(path, head, os.fstat(raw.fileno()).st_size)
            source.back_to(head.size)
            with io.BufferedReader(source, _PIECE) as file:
                read = _read_text if head.ply.text else _read_binary
                elements = read(path, cast(io.BufferedReader, file), head, wanted)
                while source.read(_PIECE):  # to the end, for the hash
                    pass
            return PlyFile(head, elements, source.digest.hexdigest())
    except OSError as error:
        raise ClodError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except (ValueError, TypeError, MemoryError) as error:  # numpy's, also of text that is not a number
        if "\0" in str(path):
            raise ClodError(f"{path}: cannot be read ({error}); check the path") from error
        raise ClodError(f"{path}: damaged or truncated ({error}); copy or export it again") from error


class _Hashed(io.RawIOBase):
    """A file whose bytes are hashed as they are read."""

    def __init__(self, raw: io.FileIO) -> None:
        self.raw, self.digest, self._start, self._again = raw, hashlib.sha256(), b"", memoryview(b"")

    def take_start(self, size: int) -> bytes:
        """The first ``size`` bytes, or all where there are fewer."""
        while len(self._start) < size and (piece := self.raw.read(size - len(self._start))):
            self._start += piece
        self.digest.update(self._start)
        return self._start

    def back_to(self, position: int) -> None:
        """The next byte that is read is that at ``position``, which was within the start."""
        self._again = memoryview(self._start)[position:]

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        target = memoryview(buffer)[:_PIECE]
        if self._again:
            count = min(len(target), len(self._again))
            target[:count], self._again = self._again[:count], self._again[count:]
            return count
        count = self.raw.readinto(target) or 0
        self.digest.update(target[:count])
        return count


def check_length(path: Path, head: Head, length: int) -> None:
    """Refuses a file that is too short for the least bytes that the rows of its header take."""
    least = head.size - (1 if head.ply.text else 0)  # the last line may lack its end
    for element, count in zip(head.ply, head.counts, strict=True):
        least += count * _least_bytes(element, head.ply.text)
    if least > length:
        rows = ", ".join(f"{count} of {e.name}" for e, count in zip(head.ply, head.counts, strict=True))
        raise ClodError(
            f"{path}: is truncated, or its header is damaged: it claims {rows}, which take at least {least} bytes, "
            f"and the file has {length}; copy or export it again"
        )


def _least_bytes(element: PlyElement, text: bool) -> int:
    if text:
        return max(1, 2 * len(element.properties))  # a digit and a space or line end
    kinds = [p.len_dtype if isinstance(p, PlyListProperty) else p.val_dtype for p in element.properties]
    return sum(np.dtype(kind).itemsize for kind in kinds)


def _read_text(path: Path, file: io.BufferedReader, head: Head, wanted: Collection[str]) -> dict[str, np.ndarray]:
    found = dict[str, np.ndarray]()
    text = io.TextIOWrapper(file, "ascii")
    lines = _lines(text)
    with warnings.catch_warnings(), np.errstate(over="ignore"):
        warnings.simplefilter("ignore")  # of blank lines, or none at all
        for element, count in zip(head.ply, head.counts, strict=True):
            if element.name in wanted:
                part = itertools.islice(lines, count) if len(wanted) > len(found) + 1 else lines
                rows = np.loadtxt(part, element.dtype("="), comments=None, max_rows=count, ndmin=1)
                found[element.name] = _complete(rows, count)
                if len(found) == len(wanted):
                    break
            else:
                for _ in itertools.islice(lines, count):
                    pass
    text.detach()
    return found


def _lines(text: io.TextIOWrapper) -> Iterator[str]:
    """The lines, none too long: a number of any length would be copied several times."""
    while line := text.readline(_PIECE):
        if len(line) == _PIECE:
            raise ValueError(f"a row of more than {_PIECE:,} characters")
        yield line


def _read_binary(path: Path, file: io.BufferedReader, head: Head, wanted: Collection[str]) -> dict[str, np.ndarray]:
    found = dict[str, np.ndarray]()
    for element, count in zip(head.ply, head.counts, strict=True):
        if len(found) == len(wanted):
            break
        if any(isinstance(p, PlyListProperty) for p in element.properties):
            names = ", ".join(name for name in wanted if name not in found)
            raise ClodError(f"{path}: element {element.name} has lists and stands before {names}; write it last")
        if element.name in wanted:
            rows = np.empty(count, element.dtype(head.ply.byte_order))
            size = file.readinto(rows.view(np.uint8).data) if rows.nbytes else 0
            _complete(rows[: size // max(rows.itemsize, 1)], count)
            found[element.name] = rows.astype(element.dtype("="), copy=False)
        else:
            left = count * _least_bytes(element, False)
            while left and (piece := file.read(min(left, _PIECE))):
                left -= len(piece)
    return found


def _complete(rows: np.ndarray, count: int) -> np.ndarray:
    if len(rows) != count:
        raise ValueError(f"{len(rows)} of {count} rows are there")
    return rows
