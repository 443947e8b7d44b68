"""Memory that is used again: never while anybody holds it, and then over and over."""

from __future__ import annotations

import gc
import itertools
import random
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
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
    """The sizes for which new memory was asked."""
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


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, np.int64, np.uint64, np.uint8], ids=str)
@pytest.mark.parametrize("size", [1, 2, 15, 16, 17, 1000, 123_457])
def test_aligned(size: int, dtype: type) -> None:
    for _ in range(10):
        array = aligned(size, dtype)
        assert array.shape == (size,) and array.dtype == dtype
        assert array.ctypes.data % 64 == 0 and array.flags.c_contiguous and array.flags.writeable
        array[:] = 1
    assert aligned(0, dtype).shape == (0,)


@pytest.mark.parametrize(
    "shape",
    [
        (),
        (0,),
        (0, 3),
        (100_000, 0, 3),
        (5,),
        (16_383,),
        (16_384,),
        (16_385,),
        (7, 15, 3),
        SHAPE,
        torch.Size((9, 9999)),
    ],
    ids=str,
)
def test_shapes(shape: tuple[int, ...]) -> None:
    for _ in range(3):
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


@pytest.mark.parametrize("rounds", [2, IDLE, 10 * IDLE])
def test_memory_is_used_again(fresh: list[int], rounds: int) -> None:
    for _ in range(rounds):
        recycled(SHAPE)
    assert len(fresh) == 1


def test_memory_of_a_training_step_is_used_again(fresh: list[int]) -> None:
    """Picture, alpha and six gradients, held together and let go together."""
    shapes = [SHAPE, SHAPE[:2], *((20_000, width) for width in (3, 4, 3, 1, 3, 45))]
    for _ in range(50):
        held = [recycled(shape) for shape in shapes]
        del held
    assert len(fresh) == len(shapes)


def test_nearly_equal_sizes_share(fresh: list[int]) -> None:
    recycled((100_000,))
    recycled((100_100,))
    assert len(fresh) == 1


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


@pytest.mark.parametrize("holder", HOLDERS)
def test_never_while_it_is_held(holder: str) -> None:
    tensor = recycled(SHAPE)
    tensor.fill_(7)
    where, held = extent(tensor), HOLDERS[holder](tensor)
    if holder == "cycle":
        held.append(held)
    del tensor
    others = [recycled(SHAPE).fill_(k) for k in range(5)]
    assert not any(overlap(extent(other), where) for other in others)
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
    where = extent(leaf.grad)
    others = [recycled(SHAPE).fill_(-1) for _ in range(5)]
    assert not any(overlap(extent(other), where) for other in others)
    assert (leaf.grad == 2).all()
    _Doubled.apply(leaf).sum().backward()  # accumulated in place
    assert (leaf.grad == 4).all() and all((other == -1).all() for other in others)
    alias = leaf.grad[3:]
    leaf.grad = None
    recycled(SHAPE).fill_(-1)
    assert (alias == 4).all()


def test_what_a_graph_has_saved_is_held() -> None:
    leaf = torch.ones(SHAPE, requires_grad=True)
    out = _Doubled.apply(leaf)
    where, node = extent(out), out.grad_fn
    total = (out * out).sum()
    del out
    others = [recycled(SHAPE).fill_(-1) for _ in range(5)]
    assert not any(overlap(extent(other), where) for other in others)
    total.backward()
    assert (leaf.grad == 8).all() and node is not None


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))), ids=str)
def test_pictures_and_gradients_of_several_passes(order: tuple[int, ...]) -> None:
    """Large ones, whose memory is recycled: what is alive keeps its values, whatever else is drawn and dropped."""
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


@pytest.mark.parametrize("sizes", [(16_384,), (20_000, 50_000, 100_000)], ids=str)
def test_few_stay_idle(sizes: tuple[int, ...]) -> None:
    held = [recycled((size,)) for size in sizes for _ in range(3 * IDLE)]
    del held
    assert 0 < idle() <= IDLE
    for _ in range(3 * IDLE):
        for size in sizes:
            recycled((size,))
    assert 0 < idle() <= IDLE


def test_the_oldest_go(fresh: list[int]) -> None:
    shapes = [(1 << 15) + 4096 * k for k in range(IDLE + 1)]
    held = deque(recycled((size,)) for size in shapes)
    while held:
        held.popleft()
    assert idle() == IDLE
    del fresh[:]
    held.extend(recycled((size,)) for size in shapes[1:])
    assert not fresh
    recycled((shapes[0],))
    assert len(fresh) == 1


@pytest.fixture
def restless() -> Iterator[None]:
    """Threads take turns as often as they can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("restless")
def test_threads_never_get_the_same_memory(workers: int = 4, rounds: int = 500) -> None:
    """Each fills what it gets with a number of its own, which must be there until it lets go."""
    together, wrong = threading.Barrier(workers), []

    def work(k: int) -> None:
        choose, held = random.Random(k), deque()
        together.wait()
        try:
            for turn in range(rounds):
                tensor, number = recycled((choose.choice([20_000, 20_001, 40_000]),)), float(k * rounds + turn)
                held.append((tensor.fill_(number), number))
                if len(held) > choose.randrange(6):
                    tensor, number = held.popleft()
                    assert (tensor == number).all()
                    held.rotate(choose.randrange(3))
            assert all((tensor == number).all() for tensor, number in held)
        except BaseException as e:
            wrong.append(e)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert idle() <= IDLE


@pytest.mark.usefixtures("restless")
def test_let_go_by_another_thread() -> None:
    """Two threads take, two others let go."""
    passed: list[deque[tuple[Tensor, float]]] = [deque(maxlen=5) for _ in range(2)]
    done, wrong = threading.Event(), []

    def take(k: int) -> None:
        for turn in range(500):
            number = float(2 * turn + k)
            passed[k].append((recycled((20_000,)).fill_(number), number))

    def let_go(k: int) -> None:
        while not done.is_set():
            try:
                tensor, number = passed[k].popleft()
            except IndexError:
                continue
            if not (tensor == number).all():
                wrong.append(number)

    takers = [threading.Thread(target=take, args=(k,)) for k in range(2)]
    others = [threading.Thread(target=let_go, args=(k,)) for k in range(2)]
    for thread in [*takers, *others]:
        thread.start()
    for thread in takers:
        thread.join()
    done.set()
    for thread in others:
        thread.join()
    assert not wrong and idle() <= IDLE


def test_what_waits_can_be_given_back() -> None:
    array = recycled((3, 50_001))
    del array
    assert memory._idle and memory._recent
    memory.release()
    assert not memory._idle and not memory._recent
