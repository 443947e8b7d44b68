"""Adapting in several processes: the first one does what one does alone, and the others train along when it trains.

They meet at the launcher's store. What the others need they are sent, so only the first one reads files, says anything
and writes; they wait for work until it says that there is no more.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import count
from typing import TYPE_CHECKING, Any

import torch

from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.training.distributed import PATIENCE, ProcessGroup, ProcessLost, joined
from clod_adapter.training.loop import adapt
from clod_adapter.training.objective import TrainableSubset
from clod_adapter.training.plan import Plan
from clod_adapter.training.state import Adapted, Progress, TrainingState

from ..shared.interrupts import GracefulStop
from ..shared.launch import Launch, launched
from .progress import ProgressDisplay

BACKENDS = {"cpu": "gloo", "cuda": "nccl"}  # what processes talk by, by where they train
if TYPE_CHECKING:
    from torch.distributed.distributed_c10d import Store

JOBS, OVER = "clod/jobs", "clod/over"  # in the store: how many times all were called to train, and that it was the last
LOOK_EVERY = 0.05  # seconds between looks for work


@dataclass(frozen=True)
class Job:
    """What the others are sent: the arguments of ``adapt``, and the kind of device that the first one trains on."""

    base: Gaussians
    views: tuple[View, ...]
    config: AdaptConfig
    state: TrainingState | None
    part: TrainableSubset
    device: str

    @classmethod
    def of(cls, plan: Plan, scene: Scene, state: TrainingState | None) -> Job:
        """What ``plan.adapt`` does, from ``state`` or where the plan has begun."""
        state = next(iter(plan.begun), None) if state is None else state
        lean = plan.lean
        return cls(lean, scene.train, plan.config, state, plan.part, lean.means.device.type)


@contextmanager
def leading() -> Iterator[None]:
    """Within, this first process may call for the others; after it they end."""
    store = _store()
    try:
        with _threads(Launch()):
            yield
    finally:
        with suppress(RuntimeError):  # the launcher is gone, and the others know of it by that
            store.set(OVER, "1")


@contextmanager
def together(make_job: Callable[[], Job], follower: ProgressDisplay) -> Iterator[ProcessGroup | None]:
    """The processes to train with, which then do so too; None where this one is alone, and no job is made.

    Raises:
        ClodError: within, what ended one of them, where the loss of a process is what ended this.
    """
    launch = launched()
    if launch.size == 1:
        yield None
        return
    job = make_job()
    follower.console.say(_describe(launch, job.config, job.device))
    number = _store().add(JOBS, 1)
    try:
        with _threads(launch), joined(_of_job(number), launch.rank, launch.size) as peers:
            peers.broadcast(job)
            del job
            yield peers
    except ProcessLost as error:
        if follower.stop.requests:  # which the others have heard of too
            raise KeyboardInterrupt from error
        raise ClodError(f"{explain(str(error))}; nothing was learned by then, so start again") from error


def take_part() -> None:
    """What a process that is not the first does: trains along, silently, until there is no more to do."""
    launch, store, stop = launched(), _store(), GracefulStop(aborts=False)
    with stop.listening(), _threads(launch):
        for number in count(1):
            if not _is_called(store, number, stop):
                return
            try:
                _train_along(number, launch, stop)
            except ProcessLost:
                continue  # the first one says so; where it is the one that is gone, the launcher does


def explain(lost: str) -> str:
    """Why a process was lost, with what it said itself, if it could."""
    said = []
    with suppress(RuntimeError):  # without the launcher's store nobody could say anything
        for key in map(_reason, range(1, launched().size)):
            said += [_store().get(key).decode()] if _store().check([key]) else []
    return "; ".join([lost, *said])


def hurried(adapted: Adapted) -> bool:
    """Whether the launcher is ending this: after its signal, or where a process is gone, it waits for 30 seconds."""
    return adapted.interrupted and not adapted.failed and launched().size > 1


def describe_processes(adapted: Adapted, batch: int) -> dict[str, Any]:
    """For the report; of the seconds those of this process, which for one by itself are 0."""
    count, device = launched().size, adapted.gaussians.means.device.type
    return {
        "count": count, "backend": BACKENDS[device] if count > 1 else None, "batch": batch,
        "waiting_seconds": round(adapted.waiting, 3), "exchange_seconds": round(adapted.exchanging, 3),
    }  # fmt: skip


def _train_along(number: int, launch: Launch, stop: GracefulStop) -> None:
    def follow(progress: Progress) -> None:
        if stop.requests:
            raise KeyboardInterrupt

    with joined(_of_job(number), launch.rank, launch.size) as peers, _giving_reasons(launch.rank):
        job: Any = peers.broadcast(None)
        if job.device == "cuda":
            _take_gpu(launch)
        base, scene, begun = job.base.to(job.device), Scene(job.views, ()), [job.state]
        config, part = job.config, job.part
        del job  # so that the state, as large as all that is trained, goes as soon as it is restored
        adapt(base, scene, config, follow, begun.pop(), part=part, peers=peers)


def _take_gpu(launch: Launch) -> None:
    """A GPU for each process on this machine."""
    if (gpus := torch.cuda.device_count()) < launch.local_size:
        raise ClodError(f"{launch.local_size} processes on a machine with {gpus} GPUs; start as many as there are")
    torch.cuda.set_device(launch.local_rank)


@contextmanager
def _giving_reasons(rank: int) -> Iterator[None]:
    """Leaves word of what ends this process; to be left before the others notice that it does."""
    try:
        yield
    except ProcessLost:
        raise
    except Exception as error:
        with suppress(RuntimeError):
            _store().set(_reason(rank), f"process {rank}: {str(error) or type(error).__name__}")
        raise


def _is_called(store: Store, number: int, stop: GracefulStop) -> bool:
    """Waits for work. Not by a wait of the store's own, within which no signal would be heard."""
    try:
        while store.add(JOBS, 0) < number:
            if store.check([OVER]) or stop.requests:
                return False
            time.sleep(LOOK_EVERY)
    except RuntimeError:  # the store is gone, and with it whoever could call
        return False
    return True


@lru_cache(maxsize=1)
def _store() -> Store:
    """What the launcher has for its processes to meet at."""
    if not torch.distributed.is_available():
        raise ClodError("this build of torch has no torch.distributed, so it takes one process: do without torchrun")
    from torch.distributed.rendezvous import rendezvous

    try:
        store, _, _ = next(iter(rendezvous("env://", timeout=PATIENCE)))
    except (RuntimeError, ValueError) as error:
        raise ClodError(f"the processes cannot meet ({str(error).partition('. ')[0]}); use torchrun") from error
    return store


def _of_job(number: int) -> Store:
    from torch.distributed.distributed_c10d import PrefixStore

    return PrefixStore(f"clod/job{number}", _store())


def _reason(rank: int) -> str:
    return f"clod/reason{rank}"


@contextmanager
def _threads(launch: Launch) -> Iterator[None]:
    """Within, this process uses its part of the machine's cores, or what OMP_NUM_THREADS gives it.

    torchrun sets that to 1, which is no one's wish.
    """
    before = torch.get_num_threads()
    if os.environ.get("OMP_NUM_THREADS", "1") == "1":
        torch.set_num_threads(max(_cores() // launch.local_size, 1))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _describe(launch: Launch, config: AdaptConfig, device: str) -> str:
    views = f"{config.batch} views a step, {config.iters:,} steps"
    return f"{launch.size} processes ({BACKENDS[device]}): {views}, {config.batch * config.iters:,} views in all"
