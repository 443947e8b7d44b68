"""Adapting in several processes: the first one reads, prints and writes.

The others wait for its training job, or to be told in the launcher's store that there is none, and
end after it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, cast

import torch

from clod_adapter import AdaptConfig, ClodError, Gaussians, Plan, Scene, Stopped, View, adapt
from clod_adapter.progress import GracefulStop
from clod_adapter.training.distributed import (
    PATIENCE,
    ProcessGroup,
    ProcessLost,
    joined,
    require_distributed,
)
from clod_adapter.training.pseudo_views import supervision_to
from clod_adapter.training.state import Adapted, TrainingState

from ..shared.console import ProgressDisplay
from ..shared.process import Launch, launched

if TYPE_CHECKING:
    from torch.distributed.distributed_c10d import Store

BACKENDS = {"cpu": "gloo", "cuda": "nccl"}  # of torch.distributed, by device
# Keys in the store: by which the first process calls the others, to "train" or to "end"; and why a
# process has ended.
CALL, REASON = "clod/call", "clod/reason{}"
POLL_EVERY = 0.05  # seconds between checks for work


class Job(NamedTuple):
    """What ``adapt`` is given, and the device of the first process's Gaussians."""

    start: Gaussians
    views: tuple[View, ...]
    config: AdaptConfig
    state: TrainingState | None
    device: str


@contextmanager
def rank0_session() -> Iterator[None]:
    """Within the block the first process may give the others a job; after it they end."""
    store = _store()
    _use_threads(1)
    try:
        yield
    finally:
        with suppress(RuntimeError):  # the launcher has ended, which the others notice
            store.set(CALL, "end")


@contextmanager
def training_group(
    plan: Plan, scene: Scene, state: TrainingState | None, display: ProgressDisplay
) -> Iterator[ProcessGroup | None]:
    """The group to train with, after giving the others the job of ``plan.adapt``; None for a single
    process.
    """
    launch = launched()
    if launch.size == 1:
        yield None
        return
    start, config = plan.start, plan.config
    job = Job(start, scene.train, config, state, start.means.device.type)
    display.console.say(
        f"{launch.size} processes ({BACKENDS[job.device]}): {config.batch} views a step,"
        f" {config.steps:,} steps"
    )
    _store().set(CALL, "train")
    try:
        # it would wait for ten minutes
        if any(_store().check([REASON.format(k)]) for k in range(1, launch.size)):
            raise ProcessLost("a process of the group has ended")
        _use_threads(launch.local_size)
        with joined(_store(), launch.rank, launch.size) as group:
            group.broadcast(job)
            del job, start
            yield group
    except ProcessLost as error:
        if display.stop.requests:
            raise Stopped("stopped before the first step") from error
        raise ClodError(
            f"{explain(str(error))}; this was before the first step, so start again"
        ) from error
    finally:
        _use_threads(1)  # the others are done


def run_worker() -> None:
    """Trains silently, if there is a job, in a process that is not the first."""
    launch, stop = launched(), GracefulStop(aborts=False)
    _use_threads(launch.local_size)
    # A process that is lost is reported by the first one, or by the launcher.
    with stop.listening(), suppress(ProcessLost):
        if not _is_called(stop, launch.rank):
            return
        with joined(_store(), launch.rank, launch.size) as group:
            try:
                _train(group, launch, stop)
            except ProcessLost:
                raise
            except Exception as error:  # told before the others notice that this process has ended
                with suppress(RuntimeError):
                    said = str(error) or type(error).__name__
                    _store().set(REASON.format(launch.rank), f"process {launch.rank}: {said}")
                raise


def _train(group: ProcessGroup, launch: Launch, stop: GracefulStop) -> None:
    job: Job = group.broadcast(cast(Job, None))
    if job.device == "cuda":  # one for each process on this machine
        if (gpus := torch.cuda.device_count()) < launch.local_size:
            raise ClodError(
                f"{launch.local_size} processes on a machine with {gpus} GPUs; start as many as"
                " there are"
            )
        torch.cuda.set_device(launch.local_rank)
    scene = Scene(supervision_to(job.views, job.device), ())
    start = job.start.to(job.device)
    adapt(start, scene, job.config, stop.stop_on_signal(), job.state, group=group)


def explain(lost: str) -> str:
    """Why a process was lost, with the error that it reported, if any."""
    said = list[str]()
    with suppress(RuntimeError):  # the launcher's store has ended too
        keys = map(REASON.format, range(1, launched().size))
        said = [_store().get(key).decode() for key in keys if _store().check([key])]
    return "; ".join([lost, *said])


def must_exit_soon(adapted: Adapted) -> bool:
    """Whether the launcher ends the processes: after its signal, or a lost process, it waits for 30
    seconds.
    """
    return adapted.interrupted and not adapted.failed and launched().size > 1


def _is_called(stop: GracefulStop, rank: int) -> bool:
    """Waits for the job. Polls, because a wait of the store's own would delay signals."""
    store = _store()
    try:
        while not store.check([CALL]):
            if stop.requests:
                store.set(REASON.format(rank), f"process {rank}: ended by a signal")
                break
            time.sleep(POLL_EVERY)
        # it may have called before it could know
        return store.check([CALL]) and store.get(CALL) == b"train"
    except RuntimeError:  # the store has ended, and the first process with it
        return False


@lru_cache(maxsize=1)
def _store() -> Store:
    """The launcher's key-value store."""
    require_distributed()
    from torch.distributed.rendezvous import rendezvous

    try:
        store, _, _ = next(iter(rendezvous("env://", timeout=PATIENCE)))
    except (RuntimeError, ValueError) as error:
        raise ClodError(
            f"the processes cannot meet ({str(error).partition('. ')[0]}); use torchrun"
        ) from error
    return store


def _use_threads(local_size: int) -> None:
    """Uses this process's share of the machine's cores, or OMP_NUM_THREADS, unless it is torchrun's
    default, 1.
    """
    if os.environ.get("OMP_NUM_THREADS", "1") == "1":
        cores = (
            len(os.sched_getaffinity(0))
            if hasattr(os, "sched_getaffinity")
            else os.cpu_count() or 1
        )
        torch.set_num_threads(max(cores // local_size, 1))
