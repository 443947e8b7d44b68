"""Communication of processes, with a group of one; tests/cli/adapt/test_processes.py has several processes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch.torch_version import TorchVersion

from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.progress import Listener, Phase, Progress, Stopped, tell
from clod_adapter.training import distributed
from clod_adapter.training.distributed import ProcessGroup, ProcessLost, joined
from clod_adapter.training.loop import adapt
from clod_adapter.training.optimizer import GradientSum
from scenes import assert_equal, capture


@pytest.fixture
def peers() -> Iterator[ProcessGroup]:
    with joined(dist.HashStore(), 0, 1) as peers:
        yield peers


def test_a_group_of_one_exchanges_with_itself(peers: ProcessGroup) -> None:
    pull = GradientSum({"means": torch.randn(5, 3), "sigma": torch.randn(5)}, torch.rand(5) < 0.5, 0.25)
    summed = peers.sum(replace(pull, gradients={name: g.clone() for name, g in pull.gradients.items()}))
    assert summed.loss == pull.loss and torch.equal(summed.kept, pull.kept)
    assert all(torch.equal(summed.gradients[name], gradient) for name, gradient in pull.gradients.items())
    assert peers.share([1, 2, 3]) == [1, 2, 3]
    assert peers.agree(0.25, True) == (0.25, True) and peers.agree(1.5, False) == (1.5, False)
    assert peers.broadcast({"a": [1]}) == {"a": [1]}
    assert peers.waiting > 0 and peers.exchanging > 0


@pytest.mark.parametrize("growth", ["on", "off"])
def test_a_group_of_one_changes_no_bit(peers: ProcessGroup, growth: str) -> None:
    base, scene = capture(n=60, views=4)
    config = AdaptConfig(iters=3, batch=2, growth=growth)
    want, found = adapt(base, scene, config), adapt(base, scene, config, group=peers)
    assert_equal(found.gaussians, want.gaussians)
    assert found.waiting > 0 and want.waiting == want.exchanging == 0 and found.lost is None
    peers.size = 3
    with pytest.raises(ClodError, match="batch is 2, it must be at least 3, a view for each of the processes"):
        adapt(base, scene, config, group=peers)


def test_the_first_process_computes_and_tells_all(peers: ProcessGroup, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its value, its progress, its errors; here the two sides of the exchange are one after the other."""
    told: list[tuple[int, int]] = []

    def heard(now: Progress) -> bool:
        told.append((now.done, now.total))
        return now.done < 3

    def compute(steps: int, listener: Listener) -> str:
        for done in range(1, steps + 1):
            tell(listener, Phase.PRUNING_ORDER, done, 5)
        return "done"

    assert peers.once(partial(compute, 2), heard) == "done" and told == [(1, 5), (2, 5)]
    assert peers.once(partial(compute, 5)) == "done"
    with pytest.raises(Stopped, match="stopped at pruning order 3/5"):
        peers.once(partial(compute, 5), heard)
    with pytest.raises(ZeroDivisionError):
        peers.once(lambda _: 1 / 0)

    said = [Progress(Phase.PRUNING_ORDER, 1, 5), Progress(Phase.PRUNING_ORDER, 3, 5), None]
    answers: list[bool] = []
    monkeypatch.setattr(peers, "rank", 1)
    monkeypatch.setattr(peers, "_exchange_progress", lambda _, going: (answers.append(going), (said.pop(0), True))[1])
    monkeypatch.setattr(peers, "broadcast", lambda _: (None, ClodError("no start")))
    told.clear()
    with pytest.raises(ClodError, match="no start"):
        peers.once(pytest.fail, heard)
    assert told == [(1, 5), (3, 5)] and answers == [True, True, False]


def test_objects_survive_being_sent() -> None:
    """Tensors of any kind within picklable objects, including empty tensors and views."""
    base, scene = capture(n=10, views=2)
    sent = (base.replace(shN=base.shN[:, :0]), scene, {"a": torch.arange(6).view(2, 3).t(), "b": torch.tensor(True)})
    tensors: list[torch.Tensor] = []
    pickled = distributed._without_tensors(sent, tensors)
    assert len(pickled) < 4000 and all(tensor.is_contiguous() for tensor in tensors)
    gaussians, views, more = distributed._with_tensors(pickled, [tensor.clone() for tensor in tensors])
    assert_equal(gaussians, sent[0])
    assert views.train[0].camera.name == scene.train[0].camera.name
    assert torch.equal(views.test[0].image, scene.test[0].image)
    assert torch.equal(more["a"], sent[2]["a"]) and more["b"].dtype == torch.bool


def test_a_lost_process_is_distinguished_from_other_errors() -> None:
    with (
        pytest.raises(ProcessLost, match=r"ended \(Connection closed by peer \[127.0.0.1\]:1\)$"),
        distributed._losses(),
    ):
        raise RuntimeError("[/a/b/pair.cc:547] Connection closed by peer [127.0.0.1]:1. This may be caused by\nmore")
    with pytest.raises(torch.cuda.OutOfMemoryError), distributed._losses():
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")


def test_several_processes_need_a_torch_that_does_not_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.6.0+cu124"))
    with (
        joined(dist.HashStore(), 0, 1),
        pytest.raises(ClodError, match=r"need torch 2.9 or newer, and this is 2.6.0\+"),
    ):
        joined(dist.HashStore(), 0, 2).__enter__()


def test_connecting_prints_nothing(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    """In some versions of torch, gloo prints from C++ to standard output, which --json uses."""
    connect = dist.init_process_group

    def noisy(*words: Any, **more: Any) -> None:
        os.write(1, b"[Gloo] Rank 0 is connected\n")
        connect(*words, **more)

    monkeypatch.setattr(dist, "init_process_group", noisy)
    with joined(dist.HashStore(), 0, 1):
        os.write(1, b"after\n")
    assert capfd.readouterr().out == "after\n"
