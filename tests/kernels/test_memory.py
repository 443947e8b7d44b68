"""Recycled memory is not reused while a tensor, an array or an alias of it is alive, and then it is."""

import gc
import sys
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from clod_adapter._kernels.memory import IDLE, recycled, recycled_array, release

SHAPE = (120, 160, 3)
HOLDERS: dict[str, Callable[[Tensor], Any]] = {
    "slice": lambda t: t[5:, 3],
    "storage": lambda t: t.untyped_storage(),
    "numpy view of a view": lambda t: t[7:].numpy()[1:].reshape(-1)[5:],
    "other type": lambda t: t.numpy().reshape(-1).view(np.uint64)[2:],
    "dlpack": lambda t: torch.from_dlpack(t),
    "graph": lambda t: t.clone().requires_grad_() * t,
}


@pytest.fixture(autouse=True)
def nothing_idle() -> Iterator[None]:
    release()
    yield
    release()


def test_shapes_and_alignment() -> None:
    for shape in [(), (100_000, 0, 3), (16_383,), (16_384,), torch.Size((9, 9999))] * 3:
        tensor = recycled(shape)
        assert tensor.shape == shape and tensor.dtype == torch.float32 and tensor.is_contiguous()
        for dtype in (np.float32, np.int32, np.uint64):
            array = recycled_array(shape, dtype)
            assert array.shape == shape and array.dtype == dtype and array.flags.c_contiguous
            assert array.size < 16_384 or array.ctypes.data % 64 == 0
        tensor.fill_(1)


@pytest.mark.parametrize("holder", HOLDERS)
def test_held_memory_is_not_used_again(holder: str) -> None:
    tensor = recycled(SHAPE).fill_(7)
    first, end = tensor.data_ptr(), tensor.data_ptr() + 4 * tensor.numel()
    held = HOLDERS[holder](tensor)
    del tensor
    others = [recycled(SHAPE) for _ in range(IDLE)]
    assert all(other.data_ptr() >= end or other.data_ptr() + 4 * other.numel() <= first for other in others)
    del held
    gc.collect()
    assert recycled(SHAPE).data_ptr() == first  # and then it is
    before = {other.data_ptr() for other in others} | {first}
    others.clear()
    assert {recycled(SHAPE).data_ptr() for _ in range(IDLE)} <= before


def test_threads_never_get_the_same_memory() -> None:
    """Each fills tensors with a number, which is unchanged until another thread releases them."""
    passed = deque[tuple[Tensor, float]]()

    def work(k: int) -> None:
        for turn in range(300):
            tensor, number = recycled(((20_000, 20_001, 40_000)[turn % 3],)), float(k * 300 + turn)
            passed.append((tensor.fill_(number), number))
            while len(passed) > turn % 7 + 4:
                tensor, number = passed.popleft()
                assert (tensor == number).all()

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # as often as possible
    try:
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(work, range(4)))
    finally:
        sys.setswitchinterval(before)
