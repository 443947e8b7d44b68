"""``--memory`` for scenes that do not fit: training in blocks, in one process or as separate jobs (``block_job``)."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace

from clod_adapter._support.version import package_version
from clod_adapter.blocks.divide import Division, block_config, check_divisible, divide
from clod_adapter.blocks.memory import MemoryPlan
from clod_adapter.blocks.train import Learned, adapt_block, merge
from clod_adapter.cameras import View
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.robustness import scene_fingerprint
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import usable_views
from clod_adapter.io.scene.load import ImageCache
from clod_adapter.progress import Phase, Stopped
from clod_adapter.rasterizers.frame import release_memory
from clod_adapter.training.plan import Plan
from clod_adapter.training.planner import make_plan
from clod_adapter.training.state import Adapted

from ..shared.console import duration
from .block_files import BlockFiles
from .display import ProgressDisplay
from .inputs import Inputs
from .memory import move_to_disk
from .plan import complete, override
from .resume import check_resumed, find_state, settings_key
from .saver import Saver
from .setup import Setup


@dataclass(frozen=True)
class Pass:
    """One block in one pass, and the result of the pass before."""

    block: int
    number: int
    before: Gaussians | None = None

    def name(self, division: Division) -> str:
        return f"block {self.block + 1} of {division.count}, pass {self.number} of {division.passes}"


@dataclass(frozen=True)
class Divided:
    """The plan, what it trains in blocks, their views, and their files."""

    plan: Plan
    division: Division
    views: Sequence[View]
    files: BlockFiles


@dataclass(frozen=True)
class Blocks:
    """A run in blocks. Its files hold its progress, so any process can continue it."""

    setup: Setup
    plan: MemoryPlan
    files: BlockFiles

    @classmethod
    def of(cls, setup: Setup, inputs: Inputs) -> Blocks | None:
        """None if the whole scene is trained at once; not for one block of a run that was started in blocks."""
        args, plan, files = setup.args, inputs.memory, BlockFiles(setup.outputs.ply, {})
        if plan is None or (plan.blocks == 1 and not args.block and not files.start.exists()):
            return None
        check_divisible(inputs.config)
        with setup.console.meter(Phase.FINGERPRINT) as meter:
            photographs = scene_fingerprint(inputs.scene, meter)
        run_of = {
            "version": package_version(), "settings": asdict(inputs.config), "checkpoint": inputs.base.fingerprint,
            "photographs": photographs, "screen_filter": asdict(inputs.base.gaussians.screen_filter),
            "--with or --without": [sorted(args.keep_in), sorted(args.leave_out)],
        }  # fmt: skip
        return cls(setup, plan, BlockFiles(setup.outputs.ply, run_of))

    def adapt(self, inputs: Inputs) -> tuple[Plan, Adapted]:
        """Trains the blocks that are not done yet, and merges all; the result is of all Gaussians.

        Raises:
            Stopped: Ctrl-C; finished blocks are in their files.
        """
        began = time.perf_counter()
        divided, failed, merged, steps, seconds, held = self.divided(inputs), list[str](), None, 0, 0.0, 0
        start_seconds, division, plan = time.perf_counter() - began, divided.division, divided.plan
        plan = complete(plan, self.setup, inputs)
        for number in range(1, division.passes + 1):
            jobs = [Pass(block, number, merged) for block in range(division.count)]
            results = [self.train(inputs, divided, job) for job in jobs]
            merged = merge(division, results)
            steps += sum(result.steps for result in results)
            seconds += sum(result.seconds for result in results)
            held = max(held, sum(result.held for result in results))  # mostly the same rows in both passes
            ended = zip(jobs, results, strict=True)
            failed += [f"{job.name(division)}: {result.failed}" for job, result in ended if result.failed]
        assert merged is not None
        return plan, Adapted(
            plan.whole(inputs.base.gaussians, merged), steps, seconds, start_seconds, interrupted=False,
            failed="; ".join(failed) or None, held=held,
        )  # fmt: skip

    def divided(self, inputs: Inputs) -> Divided:
        """The plan and the division in the file, which is made if it does not exist.

        Raises:
            ClodError: the file is of another run, or of one with another number of blocks.
            Stopped: Ctrl-C.
        """
        console, base, path = self.setup.console, inputs.base.gaussians, self.files.start
        views, exists = usable_views(base, inputs.scene.train), path.exists()
        if not exists:
            with self._display(Phase.TRAINING) as display:
                plan = make_plan(base, inputs.scene, inputs.config, override(self.setup.args), display)
                made = divide(plan.lean, views, plan.config, self.plan.blocks, total=len(plan.start), progress=display)
            self.files.save_start(plan, made)
            del plan, made
            release_memory()
        plan, division, files = self.files.load_start(base, views)
        if plan.kept is not None:  # what is trained is a copy
            move_to_disk(base, self.files.ply.parent)
        if division.count != self.plan.blocks:
            raise ClodError(
                f"{path}: is of a run in {division.count} blocks, and --memory {self.setup.args.memory} makes "
                f"{self.plan.blocks}; use the original --memory, or delete it to start over"
            )
        steps = [division.steps(block, plan.config) for block in range(division.count)]
        console.say(
            f"{path}: the initialization of {division.count} blocks exists" if exists else
            f"wrote {path}: {division.count} blocks of {min(steps)} to {max(steps)} steps, {sum(steps)} in "
            f"all (each takes {plan.config.steps} times its share of the views)"
        )  # fmt: skip
        return Divided(plan, division, views, files)

    def train(self, inputs: Inputs, divided: Divided, job: Pass) -> Learned:
        """Trains one block in one pass, unless its file exists.

        Raises:
            Stopped: Ctrl-C; the same command resumes.
        """
        division, files, console = divided.division, divided.files, self.setup.console
        if files.block(job.block, job.number).exists():
            return files.load_learned(division, job.block, job.number)
        name = job.name(division)
        config = divided.plan.config
        own = block_config(division, job.block, config, first=job.number == 1)
        path = files.state(job.block, job.number)
        resumed = find_state(path, path.exists(), own, console)
        of = f"{files.run_of['checkpoint']}, {files.run_of['start']}, {name}"
        run_of = settings_key(own) | {"base_sha256": of, "views_sha256": files.run_of["photographs"]}
        check_resumed(resumed, run_of, f"{self.setup.args.ply} in {files.start}", "before", console)
        saver = Saver(path, run_of, resumed, console, self.setup.stop)
        with saver.rescuing("the same command"):
            with self._display(name) as display:
                learned, adapted = adapt_block(
                    division, divided.views, config, job.block, after=job.before,
                    progress=saver.saving(display), resume=resumed.state if resumed else None,
                    cache=ImageCache(self.plan.cache),
                )  # fmt: skip
            saver.keep()
            release_memory()
            if adapted.failed or not adapted.interrupted:
                files.save_learned(learned, job.block, job.number)
        self._finish(name, saver, learned, adapted)
        return learned

    def _finish(self, name: str, saver: Saver, learned: Learned, adapted: Adapted) -> None:
        """Says how the training of a block has ended.

        Raises:
            Stopped: it was interrupted.
        """
        say = self.setup.console.say
        if adapted.failed:
            say(f"{name}: ended after step {adapted.steps}: {adapted.failed}")
        elif adapted.interrupted:
            more = "" if saver.saved is None else "; the same command resumes it"
            say(f"{name}: stopped after step {adapted.steps}{more}")
            raise Stopped(f"stopped in {name}")
        saver.close(finished=True)
        say(f"{name}: {len(learned.rows):,} Gaussians, {learned.steps} steps, {duration(learned.seconds)}")

    def remove(self) -> None:
        """Removes the files of this run, once its outputs are written."""
        replace(self.files, count=self.plan.blocks).remove()

    @contextmanager
    def _display(self, training: str) -> Iterator[ProgressDisplay]:
        display = ProgressDisplay(self.setup.console, self.setup.stop, None, (), None, training)
        with self.setup.stop.listening(), closing(display):
            yield display
