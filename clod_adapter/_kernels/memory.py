"""Reuse of large arrays: page faults of a new one cost more than the work on it."""

import contextlib
import ctypes
import math
import weakref
from collections import deque
from typing import Any

import numpy as np
import torch
from torch import Tensor

# beyond these the oldest idle array is freed
IDLE = 48  # arrays
IDLE_FLOATS = 1 << 27
_SMALL = 16384
_idle: dict[int, list[np.ndarray]] = {}
_recent: deque[int] = deque()


def recycled(shape: torch.Size | tuple[int, ...]) -> Tensor:
    """An uninitialised float32 tensor in memory of an earlier, freed one; a large one begins on a
    cache line.
    """
    size = math.prod(shape)
    if size < _SMALL:
        return torch.empty(shape, dtype=torch.float32, device="cpu")
    step = 1 << max(size.bit_length() - 4, 0)
    room = -(-size // step) * step  # up to an eighth larger, so that similar sizes share memory
    try:
        buffer = _idle[room].pop()
        with contextlib.suppress(ValueError):
            _recent.remove(room)
    except (KeyError, IndexError):
        unaligned = np.empty(room + 16, np.float32)
        buffer = unaligned[-unaligned.ctypes.data % 64 // 4 :][:room]
    array = buffer[:size].reshape(shape)
    # torch keeps a reference to this object as long as a tensor uses its memory.
    weakref.finalize(array, _give_back, buffer).atexit = False
    return torch.from_numpy(array)


def recycled_array(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """``recycled`` as an array, of a type with 4 or 8 bytes."""
    size = math.prod(shape)
    # Views keep a tensor's array alive, as they would not keep another view.
    return recycled((size * np.dtype(dtype).itemsize // 4,)).numpy().view(dtype).reshape(shape)


def _give_back(buffer: np.ndarray) -> None:
    # No lock: this runs where the last tensor is freed, perhaps within ``recycled``. Each operation
    # is atomic.
    _idle.setdefault(len(buffer), []).append(buffer)
    _recent.append(len(buffer))
    while len(_recent) > IDLE or sum(_recent) > IDLE_FLOATS:
        with contextlib.suppress(IndexError):  # already in use again
            _idle[_recent.popleft()].pop(0)


def release() -> None:
    """Returns the memory of idle arrays to the system."""
    _recent.clear()
    _idle.clear()
    # Only glibc retains freed memory and has this function.
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
