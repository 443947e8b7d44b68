"""The rows of a PLY. Not plyfile's reader, which allocates whatever the header claims and is slow on ascii."""

from __future__ import annotations

import io
import itertools
import os
import warnings
from pathlib import Path
from typing import BinaryIO

import numpy as np
from plyfile import PlyElement, PlyListProperty

from clod_adapter.errors import ClodError
from clod_adapter.io.ply.header import Head


def read_element(path: Path, head: Head, name: str = "vertex") -> np.ndarray:
    """``[N]`` structured array of an element, by default the vertices, in file order and type, native byte order.

    That element must be there and have no lists (``sh_degree_of`` and ``check_packed`` see to it). The file's length
    is compared with the rows that the header claims before anything is allocated for them. Elements after it are not
    read.

    Raises:
        ClodError: the file is shorter than its header says, damaged, or has lists before the element.
    """
    try:
        with open(path, "rb") as file:
            _check_length(path, head, os.fstat(file.fileno()).st_size)
            file.seek(head.size)
            return _read_text(file, head, name) if head.ply.text else _read_binary(path, file, head, name)
    except OSError as error:
        raise ClodError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except (ValueError, TypeError, MemoryError) as error:  # numpy's; a ValueError of text that is no number, too
        raise ClodError(f"{path}: damaged or truncated ({error}); copy or export it again") from error


def _check_length(path: Path, head: Head, length: int) -> None:
    """Refuses a file that cannot hold the rows of its header, each of which takes at least so many bytes."""
    least = head.size - (1 if head.ply.text else 0)  # the last line may do without its end
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


def _read_text(file: BinaryIO, head: Head, name: str) -> np.ndarray:
    element, count, before = _element(head, name)
    with (
        io.TextIOWrapper(file, "ascii") as text,
        warnings.catch_warnings(action="ignore"),  # of blank lines, and of no lines at all
        np.errstate(over="ignore"),
    ):
        lines = itertools.islice(text, sum(rows for _, rows in before), None)
        rows = np.loadtxt(lines, element.dtype("="), comments=None, max_rows=count, ndmin=1)
    if len(rows) != count:
        raise ValueError(f"{len(rows)} of {count} rows are there")
    return rows


def _read_binary(path: Path, file: BinaryIO, head: Head, name: str) -> np.ndarray:
    element, count, before = _element(head, name)
    for other, rows in before:
        if any(isinstance(p, PlyListProperty) for p in other.properties):
            raise ClodError(f"{path}: element {other.name} has lists and stands before {name}; write it last")
        file.seek(rows * _least_bytes(other, False), os.SEEK_CUR)
    found = np.fromfile(file, element.dtype(head.ply.byte_order), count)
    if len(found) != count:
        raise ValueError(f"{len(found)} of {count} rows are there")
    return found.astype(element.dtype("="), copy=False)


def _element(head: Head, name: str) -> tuple[PlyElement, int, list[tuple[PlyElement, int]]]:
    """The element, its rows, and the elements before it with theirs."""
    elements = list(zip(head.ply, head.counts, strict=True))
    at = next(k for k, (element, _) in enumerate(elements) if element.name == name)
    return *elements[at], elements[:at]
