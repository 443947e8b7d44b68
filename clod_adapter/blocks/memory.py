"""The memory that adapting takes, and the number of blocks that keeps it below a limit.

Bytes per Gaussian are measured peaks of the CPU rasterizer. The context of a block is assumed to be the whole scene.
"""

import math
import re
from dataclasses import dataclass

from clod_adapter.errors import ClodError

PROCESS = 520e6  # the interpreter, torch, compiled kernels
PIXEL = 260  # per pixel: image, photograph, their maps and gradients, lists of tiles
DRAWN = 640  # per rendered Gaussian, besides its attributes: rasterizer buffers, gradients
TRAINED = 640  # more per trained Gaussian: its copy, moments, mean, and their saving
ORDERED = 560  # per Gaussian, while the pruning order is computed
MERGED = 130  # per Gaussian, while blocks are trained: result of the previous pass and, so far, of this one
WRITTEN = 560  # per written Gaussian: changes, and the rows of the file
IMAGES = 1 / 8  # of the limit, the share that photographs may take
MOST_BLOCKS = 1024


@dataclass(frozen=True)
class MemoryEstimate:
    """The sizes that a scene's memory is estimated from."""

    count: int
    attributes: int  # bytes of a Gaussian in memory
    row: int  # its bytes in the file
    images: int  # bytes of all photographs
    pixels: int  # of the largest
    pictures: int = 0  # bytes of rendered images, which cannot be read again and stay in memory


@dataclass(frozen=True)
class MemoryPlan:
    """A plan for adapting below a limit: sizes in bytes, and the peaks of the parts of a run."""

    limit: int
    blocks: int  # 1 where the whole scene fits
    cache: int  # of photographs in memory, and, for blocks, again of target images
    base: int
    start: int
    train: int
    write: int

    @property
    def peak(self) -> int:
        return max(self.base, self.start, self.train, self.write)


def plan_for_limit(needs: MemoryEstimate, limit: int) -> MemoryPlan:
    """The plan with the fewest blocks whose peak is at most ``limit`` bytes; otherwise the error names the least."""
    for blocks in range(1, min(MOST_BLOCKS, max(needs.count, 1)) + 1):
        if (plan := _plan(needs, limit, blocks)).peak <= limit:
            return plan
    fewest = f"{needs.count:,} Gaussians take at least {in_words(least(needs))} in the smallest blocks"
    raise ClodError(f"--memory is {in_words(limit)}, and {fewest}; give that")


def least(needs: MemoryEstimate) -> int:
    """The smallest possible limit, bytes, rounded up to a tenth of a gigabyte."""
    limit, most = 100_000_000, min(MOST_BLOCKS, max(needs.count, 1))
    while min(_plan(needs, limit, blocks).peak for blocks in (1, most)) > limit:
        limit += 100_000_000
    return limit


def _plan(needs: MemoryEstimate, limit: int, blocks: int) -> MemoryPlan:
    count, cache = needs.count, min(needs.images, int(IMAGES * limit))
    always = PROCESS + cache + needs.pictures + PIXEL * needs.pixels
    held = needs.attributes
    train = always + count * (held + DRAWN + TRAINED)
    if blocks > 1:  # a block has target images of its own
        cache, held = min(needs.images + needs.pictures, int(IMAGES * limit)), held + 8
        always += cache
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
    """Bytes of a size with a unit: ``8GB``, ``500 MB``, ``7.5GiB``, ``16G``."""
    found = re.fullmatch(r"\s*([0-9]+\.?[0-9]*|\.[0-9]+)\s*([KMGT])(i?)B?\s*", text, re.IGNORECASE)
    if found is None:
        raise ClodError(f"--memory is {text!r}; give a number and its unit, as in 8GB, 500MB or 7.5GiB")
    number, unit, binary = float(found[1]), found[2].upper(), bool(found[3])
    size = int(number * (1024 if binary else 1000) ** UNITS[unit])
    if not 0 < size < 2**60:
        raise ClodError(f"--memory is {text!r}; give a size above 0, as in 8GB")
    return size
