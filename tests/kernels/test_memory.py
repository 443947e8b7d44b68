"""Recycled memory is not reused while a tensor or an alias of it is alive."""

from __future__ import annotations

import gc
import random
import sys
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from clod_adapter._kernels import memory
from clod_adapter._kernels.memory import IDLE, aligned, recycled

SHAPE = (120, 160, 3)


@pytest.fixture(autouse=True)
def nothing_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_idle", {})
    monkeypatch.setattr(memory, "_recent", deque())


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The sizes of new allocations."""
    sizes: list[int] = []

    def counted(size: int, dtype: Any) -> np.ndarray:
        sizes.append(size)
        return aligned(size, dtype)

    monkeypatch.setattr(memory, "aligned", counted)
    return sizes


def extent(x: Tensor) -> tuple[int, int]:
    """The first address, and the one after the last."""
    return x.data_ptr(), x.data_ptr() + x.numel() * x.element_size()


def overlap(a: tuple[int, int], b: tuple[int, int]) -> bool:
    return a[0] < b[1] and b[0] < a[1]


def idle() -> int:
    return sum(map(len, memory._idle.values()))


@pytest.mark.parametrize("dtype", [np.float32, np.int64, np.uint8], ids=str)
def test_aligned(dtype: type) -> None:
    for size in (1, 2, 15, 16, 17, 1000, 123_457):
        for _ in range(10):
            array = aligned(size, dtype)
            assert array.shape == (size,) and array.dtype == dtype
            assert array.ctypes.data % 64 == 0 and array.flags.c_contiguous and array.flags.writeable
            array[:] = 1
    assert aligned(0, dtype).shape == (0,)


def test_shapes() -> None:
    shapes = [(), (0,), (0, 3), (100_000, 0, 3), (5,), (16_383,), (16_384,), (16_385,), SHAPE, torch.Size((9, 9999))]
    for shape in shapes * 3:
        tensor = recycled(shape)
        assert tensor.shape == shape and tensor.dtype == torch.float32 and not tensor.requires_grad
        assert tensor.is_contiguous() and tensor.device.type == "cpu"
        assert tensor.numel() < 16_384 or tensor.data_ptr() % 64 == 0
        tensor.fill_(1)


def test_allocations_are_at_most_an_eighth_too_large(fresh: list[int]) -> None:
    sizes = [*range(16_384, 40_000, 777), *(2**k + d for k in range(15, 25) for d in (-1, 0, 1))]
    held = [recycled((size,)) for size in sizes]
    assert len(fresh) == len(held)
    assert all(size <= room <= size * 9 / 8 for size, room in zip(sizes, fresh, strict=True))


STEP = (SHAPE, SHAPE[:2], *((20_000, width) for width in (3, 4, 3, 1, 3, 45)))  # image, alpha and six gradients


@pytest.mark.parametrize(
    ("rounds", "allocated"), [([[SHAPE]] * 10 * IDLE, 1), ([STEP] * 50, len(STEP)), ([[(100_000,)], [(100_100,)]], 1)]
)
def test_memory_is_used_again(fresh: list[int], rounds: list[list[tuple[int, ...]]], allocated: int) -> None:
    """Memory of one tensor, of all tensors of a training step, and of similar sizes is reused."""
    for shapes in rounds:
        held = [recycled(shape) for shape in shapes]
        del held
    assert len(fresh) == allocated


def grad_of(tensor: Tensor) -> Tensor:
    leaf = torch.zeros(SHAPE, requires_grad=True)
    leaf.grad = tensor
    return leaf


HOLDERS: dict[str, Callable[[Tensor], Any]] = {
    "tensor": lambda t: t,
    "slice": lambda t: t[5:, 3],
    "transposed": lambda t: t.permute(2, 0, 1),
    "detached": lambda t: t.detach(),
    "alias of a gradient leaf": lambda t: t.requires_grad_().detach(),
    "parameter": lambda t: torch.nn.Parameter(t),
    "storage": lambda t: t.untyped_storage(),
    "numpy": lambda t: t.numpy(),
    "numpy view of a view": lambda t: t[7:].numpy()[1:].reshape(-1)[5:],
    "tensor of a numpy view": lambda t: torch.from_numpy(t.numpy()[7:]),
    "memoryview": lambda t: memoryview(t.numpy()),
    "dlpack": lambda t: torch.from_dlpack(t),
    "numpy by dlpack": lambda t: np.from_dlpack(t),
    "graph": lambda t: t.clone().requires_grad_() * t,
    "gradient": grad_of,
    "alias of a gradient": lambda t: grad_of(t).grad[3:],
    "cycle": lambda t: [t],
}


@pytest.mark.parametrize("holder", HOLDERS)
def test_held_memory_is_not_used_again(holder: str) -> None:
    tensor = recycled(SHAPE)
    tensor.fill_(7)
    where, held = extent(tensor), HOLDERS[holder](tensor)
    if holder == "cycle":
        held.append(held)
    del tensor
    others = [recycled(SHAPE).fill_(k) for k in range(5)]
    assert not any(overlap(extent(other), where) for other in others)
    if isinstance(held, Tensor | np.ndarray) and holder not in ("graph", "gradient"):
        assert (held == 7).all()
    del held
    if holder == "cycle":
        gc.collect()
    assert recycled(SHAPE).data_ptr() == where[0]  # and then it is
    assert all((other == k).all() for k, other in enumerate(others))


def test_oldest_idle_memory_is_freed(fresh: list[int]) -> None:
    held = deque(recycled((size,)) for size in (20_000, 50_000, 100_000) for _ in range(3 * IDLE))
    held.clear()
    assert 0 < idle() <= IDLE
    sizes = [(1 << 15) + 4096 * k for k in range(IDLE + 1)]
    held.extend(recycled((size,)) for size in sizes)
    while held:
        held.popleft()
    assert idle() == IDLE
    del fresh[:]
    held.extend(recycled((size,)) for size in sizes[1:])
    assert not fresh
    recycled((sizes[0],))
    assert len(fresh) == 1


def test_threads_never_get_the_same_memory(workers: int = 4, rounds: int = 500) -> None:
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
    passed.clear()
    assert 0 < idle() <= IDLE


def test_idle_memory_can_be_freed() -> None:
    array = recycled((3, 50_001))
    del array
    assert memory._idle and memory._recent
    memory.release()
    assert not memory._idle and not memory._recent


def test_large_arrays_are_freed(fresh: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Smaller ones are kept for reuse."""
    size = 4 * recycled(SHAPE).numel()
    fresh.clear()
    for limit, allocated in ((2 * size, 0), (size // 2, 1)):  # the first of these is the one that was kept
        monkeypatch.setattr(memory, "_LARGE", limit)
        for _ in range(2):
            tensor = recycled(SHAPE)
            del tensor
            gc.collect()
        assert len(fresh) == allocated
