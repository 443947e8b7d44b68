"""Memory that is used again: a fresh large array costs more in page faults than the work that is done in it."""

from __future__ import annotations

import contextlib
import ctypes
import weakref
from collections import deque
from typing import Any

import numpy as np
import torch
from torch import Tensor

# Arrays that wait for their next use, at most; the oldest goes when there are more.
IDLE = 24
_SMALL = 16384
_idle: dict[int, list[np.ndarray]] = {}
_recent: deque[int] = deque()


def aligned(size: int, dtype: Any) -> np.ndarray:
    """A 1-D array that begins on a cache line, so that no vector and no record lies across two."""
    item = np.dtype(dtype).itemsize
    whole = np.empty(size + 64 // item, dtype)
    skip = -whole.ctypes.data % 64 // item
    return whole[skip : skip + size]


def recycled(shape: torch.Size | tuple[int, ...]) -> Tensor:
    """An uninitialised float32 tensor, in memory that an earlier one no longer uses."""
    size = int(np.prod(shape))
    if size < _SMALL:
        return torch.empty(shape, dtype=torch.float32, device="cpu")
    step = 1 << max(size.bit_length() - 4, 0)
    room = -(-size // step) * step  # at most an eighth too large, so that nearly equal sizes share
    try:
        whole = _idle[room].pop()
        with contextlib.suppress(ValueError):
            _recent.remove(room)
    except (KeyError, IndexError):
        whole = aligned(room, np.float32)
    array = whole[:size].reshape(shape)
    # torch holds on to this very object for as long as any tensor uses its memory.
    weakref.finalize(array, _give_back, whole).atexit = False
    return torch.from_numpy(array)


def _give_back(whole: np.ndarray) -> None:
    # No lock: this runs wherever the last tensor dies, perhaps within ``recycled``. Each operation is atomic.
    _idle.setdefault(len(whole), []).append(whole)
    _recent.append(len(whole))
    if len(_recent) > IDLE:
        with contextlib.suppress(IndexError):  # it is in use again
            _idle[_recent.popleft()].pop(0)


def release() -> None:
    """Gives the memory of arrays that wait for their next use back to the system."""
    _recent.clear()
    _idle.clear()
    with contextlib.suppress(AttributeError, OSError, TypeError):  # glibc alone keeps what is freed, and has this
        ctypes.CDLL(None).malloc_trim(0)
