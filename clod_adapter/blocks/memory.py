"""What an adaptation takes in memory, and in how many blocks it stays below a limit.

The bytes a Gaussian are measured ones (docs/blocks.md), for the CPU rasterizer and float32 throughout; each is the
largest that the phase had at once. What is drawn beside a block depends on where the cameras are; a plan takes it to be
everything.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from clod_adapter.errors import ClodError

PROCESS = 520e6  # the interpreter, torch, compiled kernels
PIXEL = 260  # a pixel: picture, photograph, their maps and gradients, lists of tiles
DRAWN = 640  # a Gaussian that is drawn, beside its attributes: scratch of the rasterizer, gradients
TRAINED = 640  # one that is trained, on top: its copy, moments, mean, and the saving of all that
ORDERED = 560  # one whose place in the order of leaving is looked for
MERGED = 130  # one, while blocks are trained: what the pass before has made of it, and what this one has so far
WRITTEN = 560  # one that is written: what changed, and the rows of the file
IMAGES = 1 / 8  # of the limit, the share that photographs may take
MOST_BLOCKS = 1024


@dataclass(frozen=True)
class MemoryEstimate:
    """What a scene is, as far as memory goes.

    Attributes:
        count: Gaussians; attributes: bytes of one in memory; row: its bytes in the file.
        images: bytes of all photographs; pixels: of the largest.
        pictures: bytes of those that were made, and so cannot be read again: they stay.
    """

    count: int
    attributes: int
    row: int
    images: int
    pixels: int
    pictures: int = 0


@dataclass(frozen=True)
class MemoryPlan:
    """How a scene is adapted below a limit; all in bytes.

    Attributes:
        blocks: 1 where the whole fits.
        cache: what photographs may take, and of a block its own pictures once more.
        base, start, train, write: the most that is in memory at a time, in all: when the checkpoint is read, while it
            is ranked, in training, and when it is written.
    """

    limit: int
    blocks: int
    cache: int
    base: int
    start: int
    train: int
    write: int

    @property
    def peak(self) -> int:
        return max(self.base, self.start, self.train, self.write)


def plan_for_limit(needs: MemoryEstimate, limit: int) -> MemoryPlan:
    """The fewest blocks with which nothing takes more than ``limit`` bytes.

    Raises:
        ClodError: however many blocks, it takes more; says how much.
    """
    most = min(MOST_BLOCKS, max(needs.count, 1))
    plans = (_plan(needs, limit, blocks) for blocks in range(1, most + 1))
    plan = next((plan for plan in plans if plan.peak <= limit), _plan(needs, limit, 1))
    if plan.peak > limit:
        raise ClodError(
            f"--memory is {in_words(limit)}, and {needs.count:,} Gaussians take at least {in_words(least(needs))}, "
            "however small the blocks; give that"
        )
    return plan


def least(needs: MemoryEstimate) -> int:
    """The smallest limit that there is a plan for, bytes, rounded up to a tenth of a gigabyte."""
    limit, most = 100_000_000, min(MOST_BLOCKS, max(needs.count, 1))
    while min(_plan(needs, limit, blocks).peak for blocks in (1, most)) > limit:
        limit += 100_000_000
    return limit


def _plan(needs: MemoryEstimate, limit: int, blocks: int) -> MemoryPlan:
    count, cache = needs.count, min(needs.images, int(IMAGES * limit))
    always = PROCESS + cache + needs.pictures + PIXEL * needs.pixels
    if blocks > 1:  # a block's pictures are its own
        cache = min(needs.images + needs.pictures, int(IMAGES * limit))
        always += cache
    if blocks == 1:  # the file's rows stay in memory
        held = needs.row + needs.attributes
        train = always + count * (held + DRAWN + TRAINED)
    else:
        held = needs.attributes + 8
        train = always + count * (held + MERGED + needs.attributes + DRAWN) + math.ceil(count / blocks) * TRAINED
    base = PROCESS + count * (needs.row + 2 * needs.attributes)
    start = always + count * (held + max(DRAWN, ORDERED))
    write = always + count * (needs.attributes + needs.row + WRITTEN)
    return MemoryPlan(limit, blocks, cache, *(math.ceil(bytes) for bytes in (base, start, train, write)))


def in_words(count: float) -> str:
    """``3.14 GB``, ``500 MB``, ``1234.5 GB``."""
    return f"{round(count / 1e9, 2):g} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


UNITS = {"K": 1, "M": 2, "G": 3, "T": 4}


def parse_size(text: str) -> int:
    """Bytes of a size as people write it: ``8GB``, ``500 MB``, ``7.5GiB``, ``16G``.

    Raises:
        ClodError: it is none, or has no unit.
    """
    found = re.fullmatch(r"\s*([0-9]+\.?[0-9]*|\.[0-9]+)\s*([KMGT])(i?)B?\s*", text, re.IGNORECASE)
    if found is None:
        raise ClodError(f"--memory is {text!r}; give a number and its unit, as in 8GB, 500MB or 7.5GiB")
    number, unit, binary = float(found[1]), found[2].upper(), bool(found[3])
    size = int(number * (1024 if binary else 1000) ** UNITS[unit])
    if not 0 < size < 2**60:
        raise ClodError(f"--memory is {text!r}; give a size above 0, as in 8GB")
    return size
