"""Adapting a trained checkpoint to virtual distance scaling: the training loop."""

import math
import signal
import time
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, Literal

import torch

from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians, LossNotFinite, largest_colour
from clod_adapter.initialization.importance import for_training, usable_views
from clod_adapter.progress import GracefulStop, Listener, Phase, Progress, progress_bar
from clod_adapter.training.dial import require_trainable
from clod_adapter.training.distributed import ProcessGroup, ProcessLost
from clod_adapter.training.paper import form_of
from clod_adapter.training.state import Adapted, StateRejected, TrainingState
from clod_adapter.training.trainer import Trainer

__all__ = ["Adapted", "Progress", "TrainingState", "adapt"]


@torch.inference_mode(False)
@torch.enable_grad()
def adapt(
    base: Gaussians,
    scene: Scene,
    config: AdaptConfig | None = None,
    progress: Listener | Literal[False] | None = None,
    resume: TrainingState | None = None,
    *,
    group: ProcessGroup | None = None,
    **settings: Any,
) -> Adapted:
    """Learns sigma_d for ``base`` on the training views of ``scene``, and tunes the other
    attributes lightly.

    A step follows the sum of the gradients of ``batch`` views, each rendered at one dial value
    (``schedule.Schedule``), to minimise ``w_s L_render(s)``, where L_render is
    ``losses.photometric_loss`` and ``w_s`` is ``Dial.weight``. ``target_count.count_gradient``
    moves sigma_d so that the share of Gaussians kept at their typical distances follows the
    target-count curve. The result is the mean of the parameters over the last fifth of the steps,
    in world units. Far Gaussians are added and trained, and those of the base stay as they are
    (``training/far.py``); a base that has far Gaussians is continued from. ``AdaptConfig.paper``
    gives CLoD-GS's own training.

    Training ends early, and returns the result so far with ``Adapted.interrupted``, in these cases.
    After the last one ``progress`` is called once more, with ``Progress.error``.

    - ``progress`` returns False. In a group of processes all of them end after the same step.
    - Ctrl-C, or another signal whose handler is Python's default one. The step under way is
      completed first, so the parameters are those of a whole step; a second Ctrl-C raises
      KeyboardInterrupt at once. Before the first step is complete, a Ctrl-C raises
      KeyboardInterrupt as everywhere.
    - A process of the group is lost, or the loss of a step is not finite.

    Any other error during a step is raised, after a last call of ``progress``. The result is finite
    where the base is (an opacity logit of +-inf stays). A row whose gradient is not finite is not
    moved by that step (``Adapted.held``).

    Args:
        progress: called after each step of each phase: ``Phase.IMPORTANCE``, ``PRUNING_ORDER``,
            ``TRAINING``. By default a progress bar, where stderr is a terminal or a notebook's;
            False for none.
        resume: ``Progress.state`` of an earlier call with the same base, views and config. With as
            many threads and processes the result has the same bits as an uninterrupted run. A time
            budget includes the earlier call.
        group: the processes that train together, given the same arguments except ``progress``. Each
            computes its share of a step's views. All have the same result: that of one process,
            except for rounding.
        settings: fields of ``AdaptConfig`` that replace those of ``config``:
            ``adapt(base, scene, max_sv=7)``.

    Raises:
        ClodError: no training views, none with a Gaussian in front of it, no Gaussians, an
            attribute that is not finite, a first step whose loss is not finite, ``resume`` does not
            fit or is damaged (StateRejected), fewer views a step than processes, or a process was
            lost before the first step.
        Stopped: ``progress`` returned False before training.

    Example:
        >>> base = clod.load("base.ply")
        >>> scene = clod.load_scene("scene", origin=base.origin)
        >>> adapted = clod.adapt(base.gaussians, scene, max_sv=5)
        >>> clod.save("model.ply", adapted.gaussians, base)
    """
    config = replace(config or AdaptConfig(), **settings)
    config = config.for_views(len(scene.train))
    require_trainable(base, scene, config, group.size if group else 1)
    began = time.perf_counter()
    views = usable_views(base, scene.train)
    with progress_bar(False if progress is None and group and group.rank else progress) as listener:
        # for a resumed run too, the same again
        start = _initialized(base, views, config, listener, group)
        trainer = Trainer(start, views, config, group)
        trainer.start_seconds = time.perf_counter() - began
        if resume is not None:
            try:
                trainer.restore(resume)
            except ClodError as error:
                raise StateRejected(str(error)) from error
        del resume, start, base  # the trainer has copies
        return _train(trainer, listener)


def time_steps(
    start: Gaussians,
    scene: Scene,
    config: AdaptConfig,
    steps: int,
) -> tuple[float, float]:
    """Seconds of a step of ``adapt``, as the mean of ``steps`` over the schedule, and of all beside
    the steps.
    """
    began = time.perf_counter()
    views = usable_views(start, scene.train)
    trainer = Trainer(_initialized(start, views, config), views, config)
    fixed = time.perf_counter() - began
    trainer.step(0.0)  # allocates memory
    began = time.perf_counter()
    for k in range(steps):
        trainer.step((k + 0.5) / steps)
    return (time.perf_counter() - began) / steps, fixed


def _initialized(
    base: Gaussians,
    views: tuple[View, ...],
    config: AdaptConfig,
    progress: Listener | None = None,
    group: ProcessGroup | None = None,
) -> Gaussians:
    """The Gaussians that training begins with; in a group the first process's, as others may round
    differently.
    """
    start = for_training(form_of(config).begin(base, views, config, progress))
    if group:
        start = group.broadcast(start)
    return start.to(base.means.device)


def _train(trainer: Trainer, progress: Listener | None) -> Adapted:
    """Steps until the steps or the time budget are used up, or something ends training early."""
    group = trainer.group
    lost = None
    failed = None
    began = time.perf_counter() - trainer.seconds
    going = True
    first = trainer.done + 1
    stop = GracefulStop()

    def tell(error: str | None = None) -> bool:
        """Whether the listener wants training to go on."""
        return progress is None or progress(_progress(trainer, error)) is not False

    with ExitStack() as block:
        try:
            while True:
                trainer.seconds = time.perf_counter() - began
                share = _progress(trainer).share
                if group:  # the clock of the first process decides for all
                    share, going = group.agree(share, going)
                if share >= 1 or not going:
                    break
                try:
                    trainer.step(share, began + (trainer.config.time_budget or math.inf))
                except Exception as error:
                    if trainer.done > 0 and not isinstance(error, ProcessLost | LossNotFinite):
                        tell(str(error) or type(error).__name__)  # the listener can save the state
                    raise
                trainer.seconds = time.perf_counter() - began
                if trainer.done == first:  # from here on there is a result
                    block.enter_context(stop.listening(in_place_of=signal.default_int_handler))
                going = tell() and not stop.requests
        except ProcessLost as error:
            going = False
            lost = str(error)
            tell(lost)
        except LossNotFinite as error:
            if trainer.done == 0:
                remedy = largest_colour(trainer.gaussians())
                raise ClodError(f"{error}, so nothing can be learned; {remedy}") from error
            going = False
            failed = str(error)
            tell(failed)
        trainer.seconds = time.perf_counter() - began
        result = trainer.gaussians()
    signalled = stop.requests > 0
    return Adapted(
        result,
        trainer.done,
        trainer.seconds,
        trainer.start_seconds,
        not going or signalled,
        lost,
        failed,
        int(trainer.ever_nonfinite.sum()),
        signalled,
    )


def _progress(trainer: Trainer, error: str | None = None) -> Progress:
    time_share = trainer.seconds / (trainer.config.time_budget or math.inf)
    return Progress(
        Phase.TRAINING,
        trainer.done,
        trainer.config.steps,
        trainer.seconds,
        time_share,
        trainer.loss,
        trainer.gaussians,
        trainer.state,
        error,
    )
