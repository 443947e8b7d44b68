"""Communication of processes, with a group of one; tests/cli/adapt/test_processes.py has several processes."""

from __future__ import annotations

import pytest
import torch
import torch.distributed as dist
from torch.torch_version import TorchVersion

from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.training.distributed import joined
from clod_adapter.training.loop import adapt
from scenes import assert_equal, capture


def test_a_group_of_one_changes_no_bit() -> None:
    base, scene = capture(n=60, views=4)
    config = AdaptConfig(iters=3, batch=2)
    want = adapt(base, scene, config)
    with joined(dist.HashStore(), 0, 1) as peers:
        found = adapt(base, scene, config, group=peers)
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
