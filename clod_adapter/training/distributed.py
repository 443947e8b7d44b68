"""Several processes that train one set of Gaussians, on ``torch.distributed``.

All hold the same parameters, sample the same views, and make every step. Only the views of a batch
are divided.
"""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, TypeVar, cast

import torch
import torch.distributed as dist

from clod_adapter.errors import ClodError
from clod_adapter.training.optimizer import GradientSum

if TYPE_CHECKING:
    from torch.distributed.distributed_c10d import Store

T = TypeVar("T")

# A process that does not answer for so long counts as lost. The first one may be evaluating or
# saving meanwhile.
PATIENCE = timedelta(minutes=10)
OLDEST = "2.9"  # torch


class ProcessLost(ClodError):
    """Another process of the group has ended, or does not answer."""


class ProcessGroup:
    """The processes that train together: the default group of ``torch.distributed``.

    All call the methods in the same order. They raise ProcessLost if a process has ended; no
    exchange is possible then.
    """

    def __init__(self) -> None:
        self.rank = dist.get_rank()
        self.size = dist.get_world_size()

    def share(self, work: Sequence[T]) -> Sequence[T]:
        """This process's share of the work: every ``size``-th item, from its rank on."""
        return work[self.rank :: self.size]

    def agree(self, share_done: float, going: bool) -> tuple[float, bool]:
        """The first process's ``share_done``, and whether all processes continue."""
        share = share_done if self.rank == 0 else -math.inf
        numbers = torch.tensor([share, 0.0 if going else 1.0], dtype=torch.float64)
        with _losses():
            dist.all_reduce(numbers, dist.ReduceOp.MAX)
        return float(numbers[0]), not numbers[1]

    def sum(self, total: GradientSum) -> GradientSum:
        """The sum over all processes; overwrites the gradients given."""
        loss = torch.tensor([float(total.loss), total.views], dtype=torch.float64)
        gradients = {name: gradient.contiguous() for name, gradient in total.gradients.items()}
        kept = total.kept.to(torch.uint8)
        # All at once and in place. Sending only the rows kept, or one packed message, takes longer:
        # on loopback a million Gaussians take 80 ms, packed 150 ms, only the rows kept 300 ms.
        with _losses():
            dist.all_reduce(loss)  # on the CPU first, where gloo reports a lost process at once
            under_way = [dist.all_reduce(kept, dist.ReduceOp.MAX, async_op=True)]
            for gradient in gradients.values():
                under_way.append(dist.all_reduce(gradient, async_op=True))
            for work in under_way:
                work.wait()
            if kept.is_cuda:
                torch.cuda.synchronize()  # NCCL's own wait returns at once
        return GradientSum(gradients, kept.bool(), loss[0], int(loss[1]))

    def broadcast(self, value: T) -> T:
        """The first process's value, with its tensors on the CPU; the argument of the others is
        ignored.
        """
        file = io.BytesIO()
        if self.rank == 0:
            torch.save(value, file)
        message = [file.getvalue()]
        with _losses():
            dist.broadcast_object_list(message, 0)
        if self.rank == 0:
            return value
        received = io.BytesIO(message[0])
        return cast(T, torch.load(received, map_location="cpu", weights_only=False))


def require_distributed() -> None:
    """Rejects a torch that cannot train in several processes; 2.4 and 2.6 hang in the exchange of
    three.
    """
    if not dist.is_available():
        raise ClodError(
            "this torch has no torch.distributed, so only one process can train: leave out torchrun"
        )
    if torch.__version__ < OLDEST:
        fix = "leave out torchrun, or pip install --upgrade torch"
        raise ClodError(
            f"several processes need torch {OLDEST} or newer, and this is {torch.__version__}:"
            f" {fix}"
        )


@contextmanager
def joined(store: Store, rank: int, size: int) -> Iterator[ProcessGroup]:
    """The group of the processes that enter with the same ``store``: gloo on CPUs, NCCL on GPUs."""
    if size > 1:
        require_distributed()
    nccl = torch.cuda.is_available() and dist.is_nccl_available()
    with _losses(), _silent_stdout():
        backend = "cpu:gloo,cuda:nccl" if nccl else "gloo"
        dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=PATIENCE)
    try:
        yield ProcessGroup()
    finally:
        dist.destroy_process_group()


@contextmanager
def _silent_stdout() -> Iterator[None]:
    """Discards output to the file descriptor of stdout, where gloo prints its connections (torch
    2.9.1).
    """
    try:
        stdout = os.dup(1)
    except OSError:  # it is closed
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 1)
        yield
    finally:
        os.dup2(stdout, 1)
        os.close(stdout)


@contextmanager
def _losses() -> Iterator[None]:
    """Turns the backends' RuntimeErrors into ProcessLost."""
    try:
        yield
    except (torch.cuda.OutOfMemoryError, ProcessLost):
        raise
    except RuntimeError as error:
        line, *_ = str(error).split("\n")
        reason, *_ = re.sub(r"^\[[^]]*\] *", "", line).split(". ")
        raise ProcessLost(f"a process of the group has ended ({reason})") from error
