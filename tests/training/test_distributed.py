"""Communication of processes, with a group of one; tests/cli/adapt/test_processes.py has several processes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
import torch.distributed as dist
from torch.torch_version import TorchVersion

from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.distributed import ProcessGroup, joined
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


def test_several_processes_need_a_torch_that_does_not_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.6.0+cu124"))
    with (
        joined(dist.HashStore(), 0, 1),
        pytest.raises(ClodError, match=r"need torch 2.9 or newer, and this is 2.6.0\+"),
    ):
        joined(dist.HashStore(), 0, 2).__enter__()
