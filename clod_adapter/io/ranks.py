"""Checkpoints of several GPUs, of which each wrote the Gaussians that it held: gsplat's trainer,
and Grendel-GS.
"""

import hashlib
import re
from collections.abc import Sequence
from glob import escape
from itertools import chain
from pathlib import Path

from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.io.settings import Source

_NAME = re.compile(
    r"(?P<before>.+_(?:rank|rk))(?P<rank>\d{1,4})(?P<after>\.pt|_ws(?P<count>\d{1,4})\.ply)"
)


def ranks_of(path: Path) -> dict[int, Path]:
    """The files of the same checkpoint in its folder, itself too, by rank; empty where its name has
    no rank.
    """
    match = _NAME.fullmatch(path.name)
    if not match:
        return {}
    beside = path.parent.glob(f"{escape(match['before'])}*{escape(match['after'])}")
    names = [_NAME.fullmatch(file.name) for file in beside]
    ranks = {int(name["rank"]): path.with_name(name[0]) for name in names if name}
    return dict(sorted((ranks | {int(match["rank"]): path}).items()))


def check_ranks(path: Path, ranks: dict[int, Path]) -> None:
    """Rejects a checkpoint of which a rank is missing; Grendel-GS has their number in its names."""
    match = _NAME.fullmatch(path.name)
    count = max(int((match and match["count"]) or 0), max(ranks) + 1)
    if missing := set(range(count)) - ranks.keys():
        raise ClodError(
            f"{path}: is of a checkpoint of several GPUs, whose rank {min(missing)} is not beside"
            " it; put the files of all ranks into one folder"
        )


def joined(path: Path, sources: Sequence[Source]) -> Source:
    """The sources of all ranks as one."""
    import numpy as np  # here: names are checked without it

    first = sources[0]
    with rejected_if_damaged(
        path, "does not fit the other ranks beside it", "put those of one run into a folder"
    ):
        arrays = {}
        for name in first.arrays:
            arrays[name] = np.concatenate([source.arrays[name] for source in sources])
        source_rows = [source.rows for source in sources if source.rows is not None]
        rows = np.concatenate(source_rows) if source_rows else None
    digest = hashlib.sha256("".join(source.sha256 for source in sources).encode()).hexdigest()
    notes = dict.fromkeys(chain(*(source.notes for source in sources)))
    note = f"its {len(sources)} ranks, in files beside it, are read as one checkpoint"
    return first._replace(arrays=arrays, rows=rows, notes=(*notes, note), sha256=digest)
