"""``--block``: one job of a run in blocks, for launchers that start each in a process of its own."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from clod_adapter._support.version import package_version
from clod_adapter.blocks.train import merge
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians

from ..shared.measure import machine
from ..shared.outputs import size
from .blocks import Blocks, Divided, Pass
from .inputs import Inputs
from .plan import complete


def run_job(blocks: Blocks, inputs: Inputs) -> dict[str, Any]:
    """Does the job of ``--block``, the initialization or the next pass of one block; returns the report.

    Raises:
        ClodError: there is no such block, or its second pass needs first passes that are missing.
        Stopped: Ctrl-C; the same command resumes.
    """
    args, result, number = blocks.setup.args, None, 1
    if args.block != "start" and not blocks.files.start.exists():
        _require_block(args.block, blocks.plan.blocks)
    divided = blocks.divided(inputs)
    division, files, block = divided.division, divided.files, args.block
    path = files.start
    if block == "start":
        complete(divided.plan, blocks.setup, inputs)
    else:
        _require_block(block, division.count)
        block = int(block) - 1
        number = 1 if not files.block(block, 1).exists() else division.passes
        before = _first_pass(divided, args.block) if number == 2 else None
        result = blocks.train(inputs, divided, Pass(block, number, before))
        path = files.block(block, number)
    number = next((n for n in range(1, division.passes + 1) if files.missing(n)), 0)
    missing = files.missing(number) if number else []
    print(f"{size(path):>9}  {path}")
    print(f"pass {number}: blocks {missing} are missing" if number else "all blocks are done: leave out --block")
    return {
        "command": "adapt", "version": package_version(), "model": args.ply, "scene": args.images,
        "block": block, "blocks": division.count, "passes": division.passes, "pass": number, "missing": missing,
        "steps": result.steps if result else 0, "memory": asdict(blocks.plan), "machine": machine(),
        "outputs": {"block": str(path)}, "exit_code": 1 if result and result.failed else 0,
    }  # fmt: skip


def _require_block(block: str, count: int) -> None:
    if int(block) > count:
        raise ClodError(f"--block is {block}, and the number of blocks is {count}; give a number from 1 to {count}")


def _first_pass(divided: Divided, block: str) -> Gaussians:
    """The merged result of the first pass, from its files."""
    division, files = divided.division, divided.files
    if missing := files.missing(1):
        raise ClodError(
            f"block {block} has its first pass, and the second needs the first of all: run --block {missing[0]} first "
            f"({len(missing)} are missing)"
        )
    return merge(division, [files.load_learned(division, number, 1) for number in range(division.count)])
