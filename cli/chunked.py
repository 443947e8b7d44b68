"""``--memory`` where the whole does not fit: training in chunks, in one process or as jobs, from file to file."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from clod_adapter.cameras import Scene, View
from clod_adapter.chunks import DIALS, Division, Learned, adapt_chunk, check_divisible, config_of, divide, merge
from clod_adapter.cli.console import Console, duration
from clod_adapter.cli.files import Outputs, size
from clod_adapter.cli.interrupts import GracefulStop
from clod_adapter.cli.report import machine
from clod_adapter.cli.resume import Saver
from clod_adapter.cli.training import LABELS, Follower
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.importance import seeing
from clod_adapter.io.chunk_file import checked, load_chunk, save_chunk
from clod_adapter.io.image_cache import ImageCache
from clod_adapter.io.ply import Checkpoint
from clod_adapter.io.version import package_version
from clod_adapter.memory import MemoryPlan
from clod_adapter.rasterizers.cpu import release_memory
from clod_adapter.robustness import scene_fingerprint
from clod_adapter.train import Adapted
from clod_adapter.training_state import Progress


@dataclass
class Chunked:
    """One run in chunks. Its files are where it goes on from, in whichever process.

    Attributes:
        belongs: what the files of this run say that they are of.
    """

    args: argparse.Namespace
    outputs: Outputs
    plan: MemoryPlan
    console: Console
    stop: GracefulStop
    belongs: dict[str, Any]

    @classmethod
    def of(
        cls, args: argparse.Namespace, outputs: Outputs, plan: MemoryPlan | None, base: Checkpoint, scene: Scene,
        config: AdaptConfig, console: Console, stop: GracefulStop,
    ) -> Chunked | None:  # fmt: skip
        """None where the whole is trained at once."""
        if plan is None or (plan.chunks == 1 and not args.chunk):
            return None
        check_divisible(config)
        if args.trim or args.keep_in or args.leave_out:
            raise ClodError(
                "--trim, --with and --without are of a plan that looks at all Gaussians at once, which does not fit; "
                "leave them out, or give more --memory"
            )
        console.say("plan: none is made of chunks; all bands and Gaussians stay, and every attribute is trained")
        belongs = {
            "version": package_version(), "settings": asdict(config), "checkpoint": base.fingerprint,
            "photographs": scene_fingerprint(scene),
        }  # fmt: skip
        return cls(args, outputs, plan, console, stop, belongs)

    @property
    def start_file(self) -> Path:
        return self.outputs.ply.with_suffix(".start.safetensors")

    def chunk_file(self, block: int, number: int) -> Path:
        """What a chunk learns in a pass, 1 or 2."""
        return self.outputs.ply.with_suffix(f".chunk{block + 1}.pass{number}.safetensors")

    def missing(self, division: Division, number: int) -> list[int]:
        """The chunks, from 1, whose pass is not done."""
        return [block + 1 for block in range(division.count) if not self.chunk_file(block, number).exists()]

    def all(self, base: Gaussians, scene: Scene, config: AdaptConfig) -> Adapted:
        """Does what is not in files yet, and puts all together.

        Raises:
            KeyboardInterrupt: Ctrl-C; what is finished is in files.
        """
        views = seeing(base, scene.train)
        division, after, steps, seconds = self.start(base, views, config), None, 0, 0.0
        for number in range(1, division.passes + 1):
            learned = [self.learn(division, views, config, block, number, after) for block in range(division.count)]
            after = merge(division, learned)
            steps, seconds = steps + sum(p.steps for p in learned), seconds + sum(p.seconds for p in learned)
        assert after is not None
        return Adapted(after, steps, seconds, 0.0, interrupted=False)

    def alone(self, base: Gaussians, scene: Scene, config: AdaptConfig) -> dict[str, Any]:
        """Does what ``--chunk`` asks for, and no more: the start, or the next pass of one chunk; returns the report."""
        views, chunk = seeing(base, scene.train), self.args.chunk
        division, path, learned = self.start(base, views, config), self.start_file, None
        if chunk != "start":
            if int(chunk) > division.count:
                raise ClodError(f"--chunk is {chunk}, and there are {division.count} chunks; give 1 to that")
            block = int(chunk) - 1
            number = 1 if not self.chunk_file(block, 1).exists() else division.passes
            after = self._first_pass(division, views, config) if number == 2 else None
            learned = self.learn(division, views, config, block, number, after)
            path = self.chunk_file(block, number)
        number = next((n for n in range(1, division.passes + 1) if self.missing(division, n)), 0)
        missing = self.missing(division, number) if number else []
        print(f"{size(path):>9}  {path}")
        print(f"of pass {number}, chunks {missing} are to come" if number else "all are there: leave out --chunk")
        return {
            "command": "adapt", "version": package_version(), "model": self.args.ply, "scene": self.args.images,
            "chunk": chunk, "chunks": division.count, "passes": division.passes, "pass": number, "missing": missing,
            "steps": learned.steps if learned else 0, "memory": asdict(self.plan), "machine": machine(),
            "outputs": {"chunk": str(path)},
        }  # fmt: skip

    def _first_pass(self, division: Division, views: Sequence[View], config: AdaptConfig) -> Gaussians:
        if missing := self.missing(division, 1):
            raise ClodError(
                f"chunk {self.args.chunk} has its first pass, and the second needs the first of all: run --chunk "
                f"{missing[0]} first ({len(missing)} are missing)"
            )
        learned = [self.learn(division, views, config, block, 1, None) for block in range(division.count)]
        return merge(division, learned)

    def start(self, base: Gaussians, views: Sequence[View], config: AdaptConfig) -> Division:
        """The division, of the file where there is one."""
        if self.start_file.exists():
            division = self._load_start(base, views)
            self.console.say(f"{self.start_file}: the start of {division.count} chunks is there")
            return division
        with self._following("start") as follow:
            division = divide(base, views, config, self.plan.chunks, _told(follow, base))
        release_memory()
        assert division.begun.sigma_d is not None
        tensors = {"sigma_d": division.begun.sigma_d, "block": division.block, "seen": division.seen}
        about = {"extent": division.extent, "attenuation": division.begun.attenuation}
        save_chunk(self.start_file, tensors | {"kept": division.kept}, about, self.belongs)
        steps = [division.steps(block, config) for block in range(division.count)]
        self.console.say(
            f"wrote {self.start_file}: {division.count} chunks of {min(steps)} to {max(steps)} steps, {sum(steps)} in "
            f"all (each takes {config.iters} times its share of the views)"
        )
        return division

    def _load_start(self, base: Gaussians, views: Sequence[View]) -> Division:
        tensors, about = load_chunk(self.start_file, self.belongs)
        device = base.means.device
        count = tensors["seen"].shape[-1] if "seen" in tensors else 0
        shapes = {
            "sigma_d": (torch.float32, (len(base),)), "block": (torch.int16, (len(base),)),
            "seen": (torch.float32, (len(views), count)), "kept": (torch.float32, (len(views), DIALS)),
        }  # fmt: skip
        checked(self.start_file, tensors, shapes)
        if tensors["block"].unique().tolist() != list(range(count)):
            raise ClodError(f"{self.start_file}: a chunk has no Gaussians; remove it to have it made anew")
        settings = AttenuationConfig(**about["attenuation"])
        begun = base.replace(sigma_d=tensors["sigma_d"].to(device), attenuation=settings)
        return Division(begun, tensors["block"].to(device), tensors["seen"], tensors["kept"], float(about["extent"]))

    def learn(
        self, division: Division, views: Sequence[View], config: AdaptConfig, block: int, number: int,
        after: Gaussians | None,
    ) -> Learned:  # fmt: skip
        """What one chunk learns in a pass, of the file where there is one."""
        path, rows = self.chunk_file(block, number), division.rows(block)
        name = f"chunk {block + 1} of {division.count}, pass {number} of {division.passes}"
        belongs = self.belongs | {"chunk": name}
        if path.exists():
            values, about = load_chunk(path, belongs)
            shapes = {n: (t.dtype, (len(rows), *t.shape[1:])) for n, t in division.begun.tensors().items()}
            checked(path, values, {n: shape for n, shape in shapes.items() if n in values or n == "sigma_d"})
            values = {name: value.to(rows.device) for name, value in values.items()}
            return Learned(rows, values, int(about["steps"]), float(about["seconds"]))
        own = config_of(division, block, config, first=number == 1)
        state = path.with_suffix(".resume.safetensors")
        saver = Saver(state, state.exists(), own, self.console, self.stop)
        saver.claim(f"{self.belongs['checkpoint']}, {name}", self.belongs["photographs"], self.args.ply, "before")
        with self._following(name) as follow:
            learned, adapted = adapt_chunk(
                division, views, config, block, after=after, progress=saver.watching(follow), resume=saver.state,
                cache=ImageCache(self.plan.cache),
            )  # fmt: skip
        if adapted.interrupted:
            self.console.say(f"{name}: stopped after step {adapted.steps}; the same command goes on with it")
            raise KeyboardInterrupt
        release_memory()
        save_chunk(path, learned.values, {"steps": learned.steps, "seconds": learned.seconds}, belongs)
        saver.close(finished=True)
        self.console.say(f"{name}: {len(rows):,} Gaussians, {learned.steps} steps, {duration(learned.seconds)}")
        return learned

    def remove(self) -> None:
        """Removes the files of this run, once its outputs are there."""
        for path in (self.start_file, *self.outputs.ply.parent.glob(f"{self.outputs.ply.stem}.chunk*.safetensors")):
            path.unlink(missing_ok=True)

    @contextmanager
    def _following(self, name: str) -> Iterator[Callable[[Progress], None]]:
        follower = Follower(self.console, self.stop, None, (), 1.0, None)
        follower.labels = LABELS | {"train": name}
        with self.stop.listening(), closing(follower):
            yield follower


def _told(follow: Callable[[Progress], None], base: Gaussians) -> Callable[[str, int, int], None]:
    """The progress of ``divide`` as that of an adaptation."""
    return lambda phase, done, total: follow(
        Progress(phase, done, total, 0.0, done / max(total, 1), math.nan, lambda: base)
    )
