"""``--memory`` where the whole does not fit: training in blocks, in one process or as jobs, from file to file."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

from clod_adapter.blocks.divide import Division, check_divisible, divide
from clod_adapter.blocks.memory import MemoryPlan
from clod_adapter.blocks.targets import block_config
from clod_adapter.blocks.train import Learned, adapt_block, merge
from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.robustness import scene_fingerprint
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import usable_views
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.scene.image_cache import ImageCache
from clod_adapter.rasterizers.cpu import release_memory
from clod_adapter.training.loop import Adapted
from clod_adapter.training.state import Progress, StateRefused
from clod_adapter.version import package_version

from ..shared.console import Console, duration
from ..shared.files import Outputs, size
from ..shared.interrupts import GracefulStop
from ..shared.report import machine
from .block_files import BlockFiles
from .progress import LABELS, ProgressDisplay
from .resume import Saver


@dataclass
class Blocked:
    """One run in blocks. Its files are where it goes on from, in whichever process.

    Attributes:
        failed: of the blocks that this process has trained, where training ended early for a loss that was not finite.
    """

    args: argparse.Namespace
    plan: MemoryPlan
    console: Console
    stop: GracefulStop
    files: BlockFiles
    failed: list[str] = field(default_factory=list)

    @classmethod
    def of(
        cls, args: argparse.Namespace, outputs: Outputs, plan: MemoryPlan | None, base: Checkpoint, scene: Scene,
        config: AdaptConfig, console: Console, stop: GracefulStop,
    ) -> Blocked | None:  # fmt: skip
        """None where the whole is trained at once; not where that was begun as a block of its own."""
        files = BlockFiles(outputs.ply, {})
        if plan is None or (plan.blocks == 1 and not args.block and not files.start.exists()):
            return None
        check_divisible(config)
        if args.trim or args.keep_in or args.leave_out:
            raise ClodError(
                "--trim, --with and --without are of a plan that looks at all Gaussians at once, which does not fit; "
                "leave them out, or give more --memory"
            )
        console.say("plan: none is made of blocks; all bands and Gaussians stay, and every attribute is trained")
        with console.meter("looking through the photographs") as meter:
            photographs = scene_fingerprint(scene, lambda done, of: meter.update(done / of, f"{done}/{of}"))
        files.belongs = {
            "version": package_version(), "settings": asdict(config), "checkpoint": base.fingerprint,
            "photographs": photographs, "screen_filter": asdict(base.gaussians.screen_filter),
        }  # fmt: skip
        return cls(args, plan, console, stop, files)

    def all(self, base: Gaussians, scene: Scene, config: AdaptConfig) -> Adapted:
        """Does what is not in files yet, and puts all together.

        Raises:
            KeyboardInterrupt: Ctrl-C; what is finished is in files.
        """
        views = usable_views(base, scene.train)
        began = time.perf_counter()
        division, after, steps, seconds = self.start(base, views, config), None, 0, 0.0
        start_seconds = time.perf_counter() - began
        for number in range(1, division.passes + 1):
            learned = [self.learn(division, views, config, block, number, after) for block in range(division.count)]
            after = merge(division, learned)
            steps, seconds = steps + sum(p.steps for p in learned), seconds + sum(p.seconds for p in learned)
        assert after is not None
        failed = "; ".join(self.failed) or None
        return Adapted(after, steps, seconds, start_seconds, interrupted=False, failed=failed)

    def alone(self, base: Gaussians, scene: Scene, config: AdaptConfig) -> dict[str, Any]:
        """Does what ``--block`` asks for, and no more: the start, or the next pass of one block; returns the report."""
        views, block = usable_views(base, scene.train), self.args.block
        files = self.files
        division, path, learned = self.start(base, views, config), files.start, None
        if block != "start":
            if int(block) > division.count:
                raise ClodError(f"--block is {block}, and there are {division.count} blocks; give 1 to that")
            block = int(block) - 1
            number = 1 if not files.block(block, 1).exists() else division.passes
            after = self._first_pass(division, views, config) if number == 2 else None
            learned = self.learn(division, views, config, block, number, after)
            path = files.block(block, number)
        number = next((n for n in range(1, division.passes + 1) if files.missing(n)), 0)
        missing = files.missing(number) if number else []
        print(f"{size(path):>9}  {path}")
        print(f"of pass {number}, blocks {missing} are to come" if number else "all are there: leave out --block")
        return {
            "command": "adapt", "version": package_version(), "model": self.args.ply, "scene": self.args.images,
            "block": block, "blocks": division.count, "passes": division.passes, "pass": number, "missing": missing,
            "steps": learned.steps if learned else 0, "memory": asdict(self.plan), "machine": machine(),
            "outputs": {"block": str(path)}, "exit_code": 1 if self.failed else 0,
        }  # fmt: skip

    def _first_pass(self, division: Division, views: Sequence[View], config: AdaptConfig) -> Gaussians:
        if missing := self.files.missing(1):
            raise ClodError(
                f"block {self.args.block} has its first pass, and the second needs the first of all: run --block "
                f"{missing[0]} first ({len(missing)} are missing)"
            )
        learned = [self.learn(division, views, config, block, 1, None) for block in range(division.count)]
        return merge(division, learned)

    def start(self, base: Gaussians, views: Sequence[View], config: AdaptConfig) -> Division:
        """The division, of the file, which is made where there is none.

        Raises:
            ClodError: the file is of another run, or of one with another number of blocks.
        """
        path, there = self.files.start, self.files.start.exists()
        if not there:
            with self._following("start") as follow:
                division = divide(base, views, config, self.plan.blocks, _told(follow, base))
            self.files.save_start(division)
            del division
            release_memory()
        division = self.files.load_start(base, views)
        if division.count != self.plan.blocks:
            raise ClodError(
                f"{path}: is of a run in {division.count} blocks, and --memory {self.args.memory} makes "
                f"{self.plan.blocks}; give the --memory that it was begun with, or remove it to start afresh"
            )
        if there:
            self.console.say(f"{path}: the start of {division.count} blocks is there")
            return division
        steps = [division.steps(block, config) for block in range(division.count)]
        self.console.say(
            f"wrote {path}: {division.count} blocks of {min(steps)} to {max(steps)} steps, {sum(steps)} in "
            f"all (each takes {config.iters} times its share of the views)"
        )
        return division

    def learn(
        self, division: Division, views: Sequence[View], config: AdaptConfig, block: int, number: int,
        after: Gaussians | None,
    ) -> Learned:  # fmt: skip
        """What one block learns in a pass, of the file where there is one."""
        files = self.files
        if files.block(block, number).exists():
            return files.load_learned(division, block, number)
        name = f"block {block + 1} of {division.count}, pass {number} of {division.passes}"
        own, state = block_config(division, block, config, first=number == 1), files.state(block, number)
        saver = Saver(state, state.exists(), own, self.console, self.stop)
        of = f"{files.belongs['checkpoint']}, {files.belongs['start']}, {name}"
        saver.claim(of, files.belongs["photographs"], f"{self.args.ply} in {files.start}", "before")
        try:
            with self._following(name) as follow:
                learned, adapted = adapt_block(
                    division, views, config, block, after=after, progress=saver.watching(follow), resume=saver.state,
                    cache=ImageCache(self.plan.cache),
                )  # fmt: skip
            saver.keep()
            release_memory()
            if adapted.failed or not adapted.interrupted:
                files.save_learned(learned, block, number)
        except StateRefused as error:
            raise saver.naming(error) from error
        except Exception:
            saver.rescue("the same command")
            raise
        if adapted.failed:
            self.failed.append(f"{name}: {adapted.failed}")
            self.console.say(f"{name}: ended after step {adapted.steps}: {adapted.failed}")
        elif adapted.interrupted:
            more = "" if saver.saved is None else "; the same command goes on with it"
            self.console.say(f"{name}: stopped after step {adapted.steps}{more}")
            raise KeyboardInterrupt
        saver.close(finished=True)
        self.console.say(f"{name}: {len(learned.rows):,} Gaussians, {learned.steps} steps, {duration(learned.seconds)}")
        return learned

    def remove(self) -> None:
        """Removes the files of this run, once its outputs are there."""
        self.files.remove()

    @contextmanager
    def _following(self, name: str) -> Iterator[Callable[[Progress], None]]:
        follower = ProgressDisplay(self.console, self.stop, None, (), 1.0, None)
        follower.labels = LABELS | {"train": name}
        with self.stop.listening(), closing(follower):
            yield follower


def _told(follow: Callable[[Progress], None], base: Gaussians) -> Callable[[str, int, int], None]:
    """The progress of ``divide`` as that of an adaptation."""
    return lambda phase, done, total: follow(
        Progress(phase, done, total, 0.0, done / max(total, 1), math.nan, lambda: base)
    )
