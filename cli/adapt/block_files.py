"""The files of a run in blocks, which any process can continue: their names and contents."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from clod_adapter.adapter import DIAL, dial_tensors, with_dial
from clod_adapter.blocks.divide import Division
from clod_adapter.blocks.file import checked, load_block, refused_if_damaged, save_block
from clod_adapter.blocks.train import Learned
from clod_adapter.cameras import View
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import remove_leftovers
from clod_adapter.training.plan import Decision, Plan


@dataclass(frozen=True)
class BlockFiles:
    """The files beside ``ply``, the output.

    Attributes:
        run_of: identifies the run in its files, and, once the initialization is read, that initialization: two jobs
            on different machines may divide the scene differently.
        count: of blocks; 0 before the initialization is read.
    """

    ply: Path
    run_of: dict[str, Any]
    count: int = 0

    @property
    def start(self) -> Path:
        return self.ply.with_suffix(".start.safetensors")

    def block(self, block: int, number: int) -> Path:
        """The result of a block after pass 1 or 2."""
        return self.ply.with_suffix(f".block{block + 1}.pass{number}.safetensors")

    def state(self, block: int, number: int) -> Path:
        """The training state of a block."""
        return self.block(block, number).with_suffix(".resume.safetensors")

    def missing(self, number: int) -> list[int]:
        """The numbers, from 1, of the blocks whose pass is not done."""
        return [block + 1 for block in range(self.count) if not self.block(block, number).exists()]

    def save_start(self, plan: Plan, division: Division) -> None:
        """Writes a plan and a division of what it trains, unless another job has written them."""
        if self.start.exists():
            return
        tensors = dial_tensors(plan.start) | {"block": division.block, "seen": division.seen}
        if plan.kept is not None:
            tensors["kept"] = plan.kept
        about = {
            "attenuation": plan.start.attenuation, "sh_degree": plan.sh_degree,
            "config": asdict(plan.config), "decisions": [asdict(decision) for decision in plan.decisions],
        }  # fmt: skip
        save_block(self.start, tensors, about, self.run_of)

    def load_start(self, base: Gaussians, views: Sequence[View]) -> tuple[Plan, Division, BlockFiles]:
        """The plan and the division of the file, and the files of the blocks that it makes.

        Raises:
            ClodError: it cannot be read, is damaged, or of another run.
        """
        tensors, about = load_block(self.start, self.run_of)
        device, kept = base.means.device, tensors.get("kept")
        count = tensors["seen"].shape[-1] if "seen" in tensors and tensors["seen"].dim() else 0
        names = DIAL if self.run_of["settings"]["growth"] == "on" else DIAL[:1]
        shapes: dict[str, tuple[torch.dtype, tuple[int, ...]]] = dict.fromkeys(names, (torch.float32, (len(base),)))
        if kept is not None:
            shapes["kept"] = (torch.bool, (len(base),))
        trained = len(base) if kept is None else int(kept.sum())
        shapes |= {"block": (torch.int16, (trained,)), "seen": (torch.float32, (len(views), count))}
        checked(self.start, tensors, shapes)
        if tensors["block"].unique().tolist() != list(range(count)):
            raise ClodError(f"{self.start}: a block has no Gaussians; delete it to make it again")
        with refused_if_damaged(self.start):
            settings = AttenuationConfig(**about["attenuation"])
            config, degree = AdaptConfig(**about["config"]), int(about["sh_degree"])
            decisions = tuple(Decision(**each) for each in about["decisions"])
            few = base.without_bands(degree)
        dial = {name: tensors[name].to(device) for name in names}
        begun = with_dial(few, attenuation=settings, **dial)
        plan = Plan(decisions, begun, None if kept is None else kept.to(device), degree, config, {"start": 0.0})
        division = Division(plan.lean, tensors["block"].to(device), tensors["seen"], len(base))
        return plan, division, replace(self, run_of=self.run_of | {"start": _digest(tensors)}, count=count)

    def save_learned(self, learned: Learned, block: int, number: int) -> None:
        about = {name: getattr(learned, name) for name in ("steps", "seconds", "failed", "held")}
        save_block(self.block(block, number), learned.values, about, self._of(block, number))

    def load_learned(self, division: Division, block: int, number: int) -> Learned:
        """The result of a block after a pass.

        Raises:
            ClodError: the file cannot be read, is damaged, or of another run, initialization, block or pass.
        """
        path, rows = self.block(block, number), division.rows(block)
        values, about = load_block(path, self._of(block, number))
        shapes = {name: (t.dtype, (len(rows), *t.shape[1:])) for name, t in division.initial.tensors().items()}
        checked(path, values, {n: shape for n, shape in shapes.items() if n in values or n == "sigma_d"})
        with refused_if_damaged(path):
            steps, seconds, held = int(about["steps"]), float(about["seconds"]), int(about["held"])
            failed = about["failed"]
        return Learned(
            rows, {name: value.to(rows.device) for name, value in values.items()}, steps, seconds,
            None if failed is None else str(failed), held,
        )  # fmt: skip

    def _of(self, block: int, number: int) -> dict[str, Any]:
        return self.run_of | {"block": f"{block + 1} of {self.count}, pass {number}"}

    def remove(self) -> None:
        """Removes the files of this run, and temporary files of killed jobs."""
        each = [(block, number) for block in range(self.count) for number in (1, 2)]
        for path in (self.start, *(name(*one) for one in each for name in (self.block, self.state))):
            path.unlink(missing_ok=True)
            remove_leftovers(path)


def _digest(tensors: dict[str, Tensor]) -> str:
    """SHA-256, hex."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(tensors[name].contiguous().flatten().numpy().data)
    return digest.hexdigest()
