"""Reuse of large arrays: page faults of a new one cost more than the work on it."""

from __future__ import annotations

import contextlib
import ctypes
import math
import weakref
from collections import deque
from typing import Any

import numpy as np
import torch
from torch import Tensor

# Most idle arrays; beyond it the oldest is freed.
IDLE = 24
_SMALL = 16384
# Bytes beyond which an array is freed: numpy asks for huge pages for it, so a new one takes little time.
_LARGE = 16_000_000
_idle: dict[int, list[np.ndarray]] = {}
_recent: deque[int] = deque()


def aligned(size: int, dtype: Any) -> np.ndarray:
    """A 1-D array that begins on a cache line, so that no vector and no record spans two."""
    item = np.dtype(dtype).itemsize
    whole = np.empty(size + 64 // item, dtype)
    skip = -whole.ctypes.data % 64 // item
    return whole[skip : skip + size]


def recycled(shape: torch.Size | tuple[int, ...]) -> Tensor:
    """An uninitialised float32 tensor in memory of an earlier, freed one."""
    size = math.prod(shape)
    if size < _SMALL:
        return torch.empty(shape, dtype=torch.float32, device="cpu")
    step = 1 << max(size.bit_length() - 4, 0)
    room = -(-size // step) * step  # up to an eighth larger, so that similar sizes share memory
    try:
        whole = _idle[room].pop()
        with contextlib.suppress(ValueError):
            _recent.remove(room)
    except (KeyError, IndexError):
        whole = aligned(room, np.float32)
    array = whole[:size].reshape(shape)
    # torch keeps a reference to this object as long as a tensor uses its memory.
    weakref.finalize(array, _give_back, whole).atexit = False
    return torch.from_numpy(array)


def _give_back(whole: np.ndarray) -> None:
    if whole.nbytes > _LARGE:
        return
    # No lock: this runs where the last tensor is freed, perhaps within ``recycled``. Each operation is atomic.
    _idle.setdefault(len(whole), []).append(whole)
    _recent.append(len(whole))
    if len(_recent) > IDLE:
        with contextlib.suppress(IndexError):  # already in use again
            _idle[_recent.popleft()].pop(0)


def release() -> None:
    """Returns the memory of idle arrays to the system."""
    _recent.clear()
    _idle.clear()
    with contextlib.suppress(
        AttributeError, OSError, TypeError
    ):  # only glibc retains freed memory and has this function
        ctypes.CDLL(None).malloc_trim(0)
