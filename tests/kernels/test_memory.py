"""Recycled memory: never used again while a tensor or an alias of it is alive."""

from __future__ import annotations

import gc
import random
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from clod_adapter._kernels import memory
from clod_adapter._kernels.memory import IDLE, aligned, recycled
from clod_adapter.rasterizers import cpu
from oracle import BACKGROUND, assert_same, differentiate, weights
from scenes import camera, scene

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


def extent(x: Tensor | np.ndarray) -> tuple[int, int]:
    """First address and the one behind the last."""
    if isinstance(x, Tensor):
        return x.data_ptr(), x.data_ptr() + x.numel() * x.element_size()
    return x.ctypes.data, x.ctypes.data + x.nbytes


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


def test_at_most_an_eighth_too_large(fresh: list[int]) -> None:
    sizes = [*range(16_384, 40_000, 777), *(2**k + d for k in range(15, 25) for d in (-1, 0, 1))]
    held = [recycled((size,)) for size in sizes]
    assert len(fresh) == len(held)
    assert all(size <= room <= size * 9 / 8 for size, room in zip(sizes, fresh, strict=True))


STEP = (SHAPE, SHAPE[:2], *((20_000, width) for width in (3, 4, 3, 1, 3, 45)))  # image, alpha and six gradients


@pytest.mark.parametrize(
    ("rounds", "allocated"), [([[SHAPE]] * 10 * IDLE, 1), ([STEP] * 50, len(STEP)), ([[(100_000,)], [(100_100,)]], 1)]
)
def test_memory_is_used_again(fresh: list[int], rounds: list[list[tuple[int, ...]]], allocated: int) -> None:
    """Of one tensor, of the tensors of a training step, held and released together, and of nearly equal sizes."""
    for shapes in rounds:
        held = [recycled(shape) for shape in shapes]
        del held
    assert len(fresh) == allocated


class _Doubled(torch.autograd.Function):
    """Twice its input; gradient, and what it saves, in recycled memory."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        out = recycled(x.shape)
        out.copy_(2 * x)
        ctx.save_for_backward(out)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        out = recycled(gradients[0].shape)
        out.copy_(2 * gradients[0])
        return out


HOLDERS: dict[str, Callable[[Tensor], Any]] = {
    "tensor": lambda t: t,
    "slice": lambda t: t[5:, 3],
    "last element": lambda t: t[-1, -1, -1],
    "reshaped": lambda t: t.reshape(-1),
    "transposed": lambda t: t.permute(2, 0, 1),
    "detached": lambda t: t.detach(),
    "alias of a gradient leaf": lambda t: t.requires_grad_().detach(),
    "parameter": lambda t: torch.nn.Parameter(t),
    "storage": lambda t: t.untyped_storage(),
    "numpy": lambda t: t.numpy(),
    "numpy view": lambda t: t.numpy()[7:, :, 1],
    "numpy view of a view": lambda t: t[7:].numpy()[1:].reshape(-1)[5:],
    "tensor of a numpy view": lambda t: torch.from_numpy(t.numpy()[7:]),
    "memoryview": lambda t: memoryview(t.numpy()),
    "dlpack": lambda t: torch.from_dlpack(t),
    "numpy by dlpack": lambda t: np.from_dlpack(t),
    "graph": lambda t: t.clone().requires_grad_() * t,
    "cycle": lambda t: [t],
}


def filled(extents: tuple[int, int]) -> list[Tensor]:
    """Five new tensors, each filled with its number, none of them in this memory."""
    others = [recycled(SHAPE).fill_(k) for k in range(5)]
    assert not any(overlap(extent(other), extents) for other in others)
    return others


@pytest.mark.parametrize("holder", HOLDERS)
def test_held_memory_is_not_used_again(holder: str) -> None:
    tensor = recycled(SHAPE)
    tensor.fill_(7)
    where, held = extent(tensor), HOLDERS[holder](tensor)
    if holder == "cycle":
        held.append(held)
    del tensor
    others = filled(where)
    if isinstance(held, Tensor | np.ndarray) and holder != "graph":
        assert (held == 7).all()
    del held
    if holder == "cycle":
        gc.collect()
    assert recycled(SHAPE).data_ptr() == where[0]  # and then it is
    assert all((other == k).all() for k, other in enumerate(others))


def test_gradients_are_held_by_their_leaves() -> None:
    leaf = torch.ones(SHAPE, requires_grad=True)
    _Doubled.apply(leaf).sum().backward()
    assert leaf.grad is not None
    others = filled(extent(leaf.grad))
    assert (leaf.grad == 2).all()
    _Doubled.apply(leaf).sum().backward()  # accumulated in place
    assert (leaf.grad == 4).all() and all((other == k).all() for k, other in enumerate(others))
    alias = leaf.grad[3:]
    leaf.grad = None
    recycled(SHAPE).fill_(-1)
    assert (alias == 4).all()


def test_saved_tensors_are_held_by_the_graph() -> None:
    leaf = torch.ones(SHAPE, requires_grad=True)
    out = _Doubled.apply(leaf)
    where, node = extent(out), out.grad_fn
    total = (out * out).sum()
    del out
    filled(where)
    total.backward()
    assert (leaf.grad == 8).all() and node is not None


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)], ids=str)
def test_images_and_gradients_of_several_passes(order: tuple[int, ...]) -> None:
    """Large ones, in recycled memory: live tensors keep their values while others are drawn and released."""
    cases = [(scene(6000, 1, seed, size=0.03), camera(150, 121 + 5 * seed)) for seed in range(3)]
    alone = [differentiate(cpu.rasterize, some, view, weights(view)) for some, view in cases]
    alone = [r._replace(gradients={name: g.clone() for name, g in r.gradients.items()}) for r in alone]
    alive = []
    for some, view in cases:
        leaves = {name: value.clone().requires_grad_() for name, value in some.items()}
        leaves["background"] = BACKGROUND.clone().requires_grad_()
        alive.append((leaves, *cpu.rasterize(**leaves, camera=view)))
        differentiate(cpu.rasterize, *cases[0], weights(cases[0][1]))  # dropped
    for k in order:
        leaves, image, alpha = alive[k]
        v = weights(cases[k][1])
        ((image * v[0]).sum() + (alpha * v[1]).sum()).backward()
    for (leaves, image, alpha), want in zip(alive, alone, strict=True):
        gradients = {name: leaf.grad for name, leaf in leaves.items()}
        assert_same(want._replace(image=image.detach(), alpha=alpha.detach(), gradients=gradients), want)


def test_few_stay_idle_and_the_oldest_are_freed(fresh: list[int]) -> None:
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


@pytest.fixture
def restless() -> Iterator[None]:
    """Threads take turns as often as they can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def run_threads(*work: Callable[[], None]) -> None:
    """Runs these at the same time and raises what one of them raised."""
    with ThreadPoolExecutor(len(work)) as pool:
        for future in [pool.submit(each) for each in work]:
            future.result()


@pytest.mark.usefixtures("restless")
def test_threads_never_get_the_same_memory(workers: int = 4, rounds: int = 500) -> None:
    """Each fills its tensors with a number of its own, which must be there until the tensor is released."""
    together = threading.Barrier(workers)

    def work(k: int) -> None:
        choose, held = random.Random(k), deque()
        together.wait()
        for turn in range(rounds):
            tensor, number = recycled((choose.choice([20_000, 20_001, 40_000]),)), float(k * rounds + turn)
            held.append((tensor.fill_(number), number))
            if len(held) > choose.randrange(6):
                tensor, number = held.popleft()
                assert (tensor == number).all()
                held.rotate(choose.randrange(3))
        assert all((tensor == number).all() for tensor, number in held)

    run_threads(*(partial(work, k) for k in range(workers)))
    assert idle() <= IDLE


@pytest.mark.usefixtures("restless")
def test_tensors_released_by_another_thread(rounds: int = 500) -> None:
    """Two threads allocate, two others release."""
    passed: list[deque[tuple[Tensor, float] | None]] = [deque(maxlen=5) for _ in range(2)]

    def allocate(k: int) -> None:
        for turn in range(rounds):
            number = float(2 * turn + k)
            passed[k].append((recycled((20_000,)).fill_(number), number))
        passed[k].append(None)

    def release(k: int) -> None:
        while True:
            try:
                given = passed[k].popleft()
            except IndexError:
                continue
            if given is None:
                return
            assert (given[0] == given[1]).all()

    run_threads(*(partial(work, k) for k in range(2) for work in (allocate, release)))
    assert idle() <= IDLE


def test_idle_memory_can_be_freed() -> None:
    array = recycled((3, 50_001))
    del array
    assert memory._idle and memory._recent
    memory.release()
    assert not memory._idle and not memory._recent
