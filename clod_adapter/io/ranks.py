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

_NAME = re.compile(
    r"(?P<before>.+_(?:rank|rk))(?P<rank>\d{1,4})(?P<after>\.pt|_ws(?P<count>\d{1,4})\.ply)"
)


def ranks_of(path: Path) -> dict[int, Path]:
    """The files of the same checkpoint in its folder, itself too, by rank; empty where its name has
    no rank.
    """
    named = _NAME.fullmatch(path.name)
    if not named:
        return {}
    beside = path.parent.glob(f"{escape(named['before'])}*{escape(named['after'])}")
    names = [_NAME.fullmatch(file.name) for file in beside]
    ranks = {int(name["rank"]): path.with_name(name[0]) for name in names if name}
    return dict(sorted((ranks | {int(named["rank"]): path}).items()))


def check_ranks(path: Path, ranks: dict[int, Path]) -> None:
    """Refuses a checkpoint of which a rank is missing; Grendel-GS has their number in its names."""
    named = _NAME.fullmatch(path.name)
    count = max(int((named and named["count"]) or 0), max(ranks) + 1)
    if missing := set(range(count)) - ranks.keys():
        raise ClodError(
            f"{path}: is of a checkpoint of several GPUs, whose rank {min(missing)} is not beside"
            " it; put the files of all ranks into one folder"
        )


def joined(path: Path, parts: Sequence[Source]) -> Source:
    """The sources of all ranks as one."""
    import numpy as np  # here: names are checked without it

    first = parts[0]
    with refused_if_damaged(
        path, "does not fit the other ranks beside it", "put those of one run into a folder"
    ):
        arrays = {}
        for name in first.arrays:
            arrays[name] = np.concatenate([part.arrays[name] for part in parts])
        parts_rows = [part.rows for part in parts if part.rows is not None]
        rows = np.concatenate(parts_rows) if parts_rows else None
    digest = hashlib.sha256("".join(part.sha256 for part in parts).encode()).hexdigest()
    note = f"its {len(parts)} ranks, in files beside it, are read as one checkpoint"
    return first._replace(arrays=arrays, rows=rows, notes=(*first.notes, note), sha256=digest)
