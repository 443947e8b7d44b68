"""Checkpoints of several GPUs, of which each wrote the Gaussians that it held: gsplat's trainer,
and Grendel-GS.
"""

import hashlib
import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.io.settings import Source

# Around the rank; Grendel-GS has the number of ranks in its names.
_NAME = re.compile(r"(.+_(?:rank|rk))(\d{1,4})(\.pt|_ws(\d{1,4})\.ply)")


def ranks_of(path: Path) -> dict[int, Path]:
    """The files of the same checkpoint in its folder, itself too, by rank; empty where its name has
    no rank.
    """
    match = _NAME.fullmatch(path.name)
    if not match:
        return {}
    ranks = {int(match[2]): path}
    for file in path.parent.glob("*"):
        other = _NAME.fullmatch(file.name)
        if other and other.group(1, 3) == match.group(1, 3):
            ranks[int(other[2])] = file
    return dict(sorted(ranks.items()))


def check_ranks(path: Path, ranks: dict[int, Path]) -> None:
    """Rejects a checkpoint of which a rank is missing."""
    match = _NAME.fullmatch(path.name)
    stated = int(match[4] or 0) if match else 0
    for rank in range(max(stated, *ranks)):
        if rank not in ranks:
            raise ClodError(
                f"{path}: is of a checkpoint of several GPUs, whose rank {rank} is not beside it;"
                " put the files of all ranks into one folder"
            )


def joined(path: Path, sources: Sequence[Source]) -> Source:
    """The sources of all ranks as one."""
    import numpy as np  # here: names are checked without it

    first = sources[0]
    arrays = {}
    with rejected_if_damaged(
        path, "does not fit the other ranks beside it", "put those of one run into a folder"
    ):
        for name in first.arrays:
            arrays[name] = np.concatenate([source.arrays[name] for source in sources])
        rows = None
        if first.rows is not None:
            rows = np.concatenate([source.rows for source in sources])
    digest = hashlib.sha256("".join(source.sha256 for source in sources).encode()).hexdigest()
    notes = dict.fromkeys(chain(*(source.notes for source in sources)))
    note = f"its {len(sources)} ranks, in files beside it, are read as one checkpoint"
    return first._replace(arrays=arrays, rows=rows, notes=(*notes, note), sha256=digest)
