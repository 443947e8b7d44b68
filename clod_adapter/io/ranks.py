"""Checkpoints of several GPUs, of which each wrote the Gaussians that it held: gsplat's trainer,
and Grendel-GS.
"""

import hashlib
import re
from collections.abc import Sequence
from glob import escape
from pathlib import Path

from clod_adapter.errors import ClodError, refused_if_damaged
from clod_adapter.io.settings import Source

_NAME = re.compile(r"(.+_(?:rank|rk))(\d{1,4})(\.pt|_ws(\d{1,4})\.ply)")


def ranks_of(path: Path) -> dict[int, Path]:
    """The files of the same checkpoint in its folder, itself too, by rank; empty where its name has
    no rank.
    """
    found = _NAME.fullmatch(path.name)
    if not found:
        return {}
    before, rank, after, _ = found.groups()
    beside = [
        _NAME.fullmatch(other.name)
        for other in path.parent.glob(f"{escape(before)}*{escape(after)}")
    ]
    others = {int(name[2]): path.with_name(name[0]) for name in beside if name}
    return dict(sorted((others | {int(rank): path}).items()))


def check_ranks(path: Path, ranks: dict[int, Path]) -> None:
    """Refuses a checkpoint of which a rank is missing; Grendel-GS has their number in its names."""
    found = _NAME.fullmatch(path.name)
    count = max(int((found and found[4]) or 0), max(ranks) + 1)
    if missing := set(range(count)) - ranks.keys():
        what = f"is of a checkpoint of several GPUs, whose rank {min(missing)} is not beside it"
        raise ClodError(f"{path}: {what}; put the files of all ranks into one folder")


def joined(path: Path, parts: Sequence[Source]) -> Source:
    """The sources of all ranks as one."""
    import numpy as np  # here: names are checked without it

    first = parts[0]
    with refused_if_damaged(
        path, "does not fit the other ranks beside it", "put those of one run into a folder"
    ):
        arrays = {
            name: np.concatenate([part.arrays[name] for part in parts]) for name in first.arrays
        }
        rows = [part.rows for part in parts if part.rows is not None]
        whole = np.concatenate(rows) if rows else None
    digest = hashlib.sha256("".join(part.sha256 for part in parts).encode()).hexdigest()
    note = f"its {len(parts)} ranks, in files beside it, are read as one checkpoint"
    return first._replace(arrays=arrays, rows=whole, notes=(*first.notes, note), sha256=digest)
