"""``--memory``: the memory plan, which is printed before any work."""

from __future__ import annotations

import argparse
import math
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from clod_adapter.blocks.memory import IMAGES, MemoryEstimate, MemoryPlan, in_words, parse_size, plan_for_limit
from clod_adapter.cameras import Scene, StoredView
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.io.scene.load import ImageCache

from ..shared.console import Console


def image_cache(args: argparse.Namespace) -> ImageCache | None:
    """The cache that holds the photographs within their share of ``--memory``."""
    return ImageCache(int(IMAGES * parse_size(args.memory))) if args.memory else None


def plan_memory(args: argparse.Namespace, base: Checkpoint, scene: Scene, console: Console) -> MemoryPlan | None:
    """The plan for ``--memory``, which is printed; None without the option.

    Raises:
        ClodError: it is too small; gives the minimum.
    """
    if not args.memory:
        return None
    views, gaussians = (*scene.train, *scene.test), base.gaussians
    pixels = [view.camera.width * view.camera.height for view in views]
    attributes = sum(tensor.element_size() * tensor.numel() for tensor in gaussians.tensors().values())
    made = sum(3 * size for view, size in zip(views, pixels, strict=True) if not isinstance(view, StoredView))
    needs = MemoryEstimate(
        len(gaussians), math.ceil(attributes / len(gaussians)), base.vertex.dtype.itemsize,
        images=3 * sum(pixels) - made, pixels=max(pixels), pictures=made,
    )  # fmt: skip
    plan = plan_for_limit(needs, parse_size(args.memory))
    how = "the whole scene at once" if plan.blocks == 1 else f"in {plan.blocks} blocks"
    console.say(f"memory: {in_words(plan.peak)} of {in_words(plan.limit)}, {how}; peaks, including the program itself:")
    for name, what in (
        ("base", "reading the checkpoint"), ("start", "initialization of the whole scene"), ("train", "training"),
        ("write", "writing"), ("cache", "of it for photographs"),
    ):  # fmt: skip
        console.say(f"  {in_words(getattr(plan, name)):>8}  {what}")
    return plan


def rows_on_disk(base: Checkpoint, folder: Path) -> Checkpoint:
    """The checkpoint with its file's rows, which only writing needs, on disk (``_mapped``).

    A later change of the checkpoint's file does not reach them.
    """
    return replace(base, vertex=_mapped(base.vertex, folder))


def move_to_disk(gaussians: Gaussians, folder: Path) -> None:
    """Replaces, in place, the memory of all tensors on the CPU by a file (``_mapped``), whoever refers to them."""
    for tensor in gaussians.tensors().values():
        if tensor.device.type == "cpu" and tensor.numel():
            tensor.data = torch.from_numpy(_mapped(tensor.numpy(), folder))


def _mapped(array: np.ndarray, folder: Path) -> np.ndarray:
    """The array in a mapped file without a name in ``folder``; itself where that cannot be written.

    Room for the outputs remains: four times its size must be free.
    """
    try:
        if array.nbytes == 0 or shutil.disk_usage(folder).free < 4 * array.nbytes:
            return array
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(array.reshape(-1).view(np.uint8).data)  # not tofile, which loses the error of a full disk
            file.flush()
            return np.asarray(np.memmap(file, array.dtype, "c", shape=array.shape))
    except OSError:
        return array


def without_rows(base: Checkpoint) -> Checkpoint:
    """The checkpoint without the rows of its file, for jobs that write no output."""
    return replace(base, vertex=base.vertex[:0].copy())
