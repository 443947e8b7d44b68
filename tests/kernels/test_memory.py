"""Recycled memory is not reused while a tensor, an array or an alias of it is alive, and then it is."""

import gc
import random
import sys
import threading
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


HOLDERS: dict[str, Callable[[Tensor], Any]] = {
    "slice": lambda t: t[5:, 3],
    "storage": lambda t: t.untyped_storage(),
    "numpy view of a view": lambda t: t[7:].numpy()[1:].reshape(-1)[5:],
    "other type": lambda t: t.numpy().reshape(-1).view(np.uint64)[2:],
    "dlpack": lambda t: torch.from_dlpack(t),
    "graph": lambda t: t.clone().requires_grad_() * t,
}


@pytest.mark.parametrize("holder", HOLDERS)
def test_held_memory_is_not_used_again(holder: str) -> None:
    tensor = recycled(SHAPE).fill_(7)
    first, end = tensor.data_ptr(), tensor.data_ptr() + 4 * tensor.numel()
    held = HOLDERS[holder](tensor)
    del tensor
    others = [recycled_array(SHAPE, np.float32) for _ in range(5)]
    for k, other in enumerate(others):
        other[:] = k
        assert other.ctypes.data >= end or other.ctypes.data + other.nbytes <= first
    del held
    gc.collect()
    assert recycled(SHAPE).data_ptr() == first  # and then it is
    assert all((other == k).all() for k, other in enumerate(others))


def test_idle_memory_is_reused_up_to_a_number_of_arrays() -> None:
    held = [recycled((20_000,)) for _ in range(2 * IDLE)]
    before = {tensor.data_ptr() for tensor in held}
    held.clear()
    assert {recycled((20_000 + k,)).data_ptr() for k in range(IDLE)} <= before


def test_threads_never_get_the_same_memory(workers: int = 4, rounds: int = 300) -> None:
    """Each thread fills its tensors with a number, which must be unchanged until another thread releases them.

    The interpreter switches threads as often as possible.
    """
    together, passed = threading.Barrier(workers), [deque[tuple[Tensor, float]]() for _ in range(workers)]

    def work(k: int) -> None:
        choose = random.Random(k)
        together.wait()
        for turn in range(rounds):
            tensor, number = recycled((choose.choice([20_000, 20_001, 40_000]),)), float(k * rounds + turn)
            passed[choose.randrange(workers)].append((tensor.fill_(number), number))
            while len(passed[k]) > choose.randrange(6):
                tensor, number = passed[k].popleft()
                assert (tensor == number).all()

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(work, range(workers)))
    finally:
        sys.setswitchinterval(before)
    assert all((tensor == number).all() for held in passed for tensor, number in held)
