"""``--memory`` for scenes that do not fit: training in blocks, whose results stay in files until all are merged."""

import hashlib
import time
from collections.abc import Sequence
from contextlib import closing
from typing import Any

from clod_adapter._kernels.memory import release
from clod_adapter.adapter import dial_tensors
from clod_adapter.blocks.divide import PASSES, Division, block_config, check_divisible, divide
from clod_adapter.blocks.train import Learned, adapt_block, load_block, merge, save_block
from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig
from clod_adapter.evaluation.robustness import scene_fingerprint
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.importance import usable_views
from clod_adapter.io.scene.load import ImageCache
from clod_adapter.progress import Phase, Stopped
from clod_adapter.training.plan import Plan
from clod_adapter.training.state import Adapted

from ..shared.console import ProgressDisplay, duration
from .listeners import Saver, settings_key
from .prepare import Run, decide


def adapt_in_blocks(run: Run) -> tuple[Plan, Adapted]:
    """Trains the blocks whose files do not exist, and merges all; the result is of all Gaussians."""
    assert run.memory is not None
    check_divisible(run.config)
    with run.console.meter(Phase.FINGERPRINT) as meter:
        photographs = scene_fingerprint(run.scene, meter)
    began, base = time.perf_counter(), run.base.gaussians
    views = usable_views(base, run.scene.train)
    with closing(ProgressDisplay(run.console, run.stop)) as display:
        plan = decide(run, display)
        division = divide(plan.lean, views, plan.config, run.memory.blocks, total=len(plan.start), progress=display)
    release()
    start_seconds, counts = time.perf_counter() - began, [division.steps(k, plan.config) for k in range(division.count)]
    run.console.say(f"{division.count} blocks of {min(counts)} to {max(counts)} steps, {sum(counts)} in all")
    blocks = Blocks(run, plan.config, division, views, photographs)
    failed, steps, seconds, held, merged = list[str](), 0, 0.0, 0, None
    for number in range(1, PASSES + 1):
        results = [blocks.train(block, number, merged) for block in range(division.count)]
        merged = merge(division, results)
        steps += sum(result.steps for result in results)
        seconds += sum(result.seconds for result in results)
        held = max(held, sum(result.held for result in results))  # mostly the same rows in both passes
        failed += [f"{blocks.name(k, number)}: {each.failed}" for k, each in enumerate(results) if each.failed]
    assert merged is not None
    release()
    return plan, Adapted(
        plan.whole(base, merged), steps, seconds, start_seconds, interrupted=False, failed="; ".join(failed) or None,
        held=held,
    )  # fmt: skip


class Blocks:
    """The blocks of a run, and their files; ``key`` identifies run and division, whose hash differs if rounding has."""

    def __init__(
        self, run: Run, config: AdaptConfig, division: Division, views: Sequence[View], photographs: str
    ) -> None:
        self.run, self.config, self.division, self.views = run, config, division, views
        digest = hashlib.sha256(f"{run.checkpoint()}, SH degree {division.initial.sh_degree}".encode())
        for tensor in (*dial_tensors(division.initial).values(), division.block, division.seen):
            digest.update(tensor.cpu().numpy().data)
        self.key: dict[str, Any] = settings_key(config) | {
            "photographs": photographs, "number of blocks": division.count, "checkpoint": digest.hexdigest(),
        }  # fmt: skip

    def name(self, block: int, number: int) -> str:
        return f"block {block + 1} of {self.division.count}, pass {number} of {PASSES}"

    def train(self, block: int, number: int, before: Gaussians | None) -> Learned:
        """Trains one block in one pass, the second from the result ``before``, unless its file exists."""
        run, division, name = self.run, self.division, self.name(block, number)
        path = run.outputs.ply.with_suffix(f".block{block + 1}.pass{number}.safetensors")
        key = self.key | {"block": name}
        if path.exists():
            return load_block(path, key, division, block)
        own, _ = block_config(division, block, self.config, first=number == 1)
        state = path.with_suffix(".resume.safetensors")
        saver = Saver(state, own, run.console, run.stop, resume=state.exists())
        checkpoint = f"{key['checkpoint']}, {name}"
        saver.identify(run.args.ply, "before", base_sha256=checkpoint, views_sha256=key["photographs"])
        with saver.rescuing("the same command"):
            with closing(ProgressDisplay(run.console, run.stop, name)) as display:
                learned = adapt_block(
                    division, self.views, self.config, block, after=before, progress=saver.saving(display),
                    resume=saver.state, cache=ImageCache(run.memory.cache) if run.memory else None,
                )  # fmt: skip
            saver.keep()
            release()
            if learned.failed or not learned.interrupted:
                save_block(path, learned, key)
        if learned.failed:
            run.console.say(f"{name}: ended after step {learned.steps}: {learned.failed}")
        elif learned.interrupted:
            more = "" if saver.saved is None else "; the same command resumes it"
            run.console.say(f"{name}: stopped after step {learned.steps}{more}")
            raise Stopped(f"stopped in {name}")
        saver.close(finished=True)
        run.console.say(f"{name}: {len(learned.rows):,} Gaussians, {learned.steps} steps, {duration(learned.seconds)}")
        return learned
