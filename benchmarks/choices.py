"""Choices of the method against their alternatives: PSNR at equal shares of the Gaussians, one
change at a time.

    python benchmarks/choices.py plush_half bonsai146 --names SHARE NEARER full
    python benchmarks/choices.py demo --names SHARE full    # the folder of clod-adapt demo
    python benchmarks/choices.py SCENE.ply    # no photographs

A scene is a folder of the shared data, one of the demo, or a file, whose placed cameras and renders
are used. Each run adds one row to ``results/choices.jsonl``; "default" changes nothing. A choice is
a constant of ``training/far.py``, a field of ``schedule.FAR``, or a field of ``AdaptConfig``.
"""

from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import clod_adapter as clod
from adapt import adapted
from clod_adapter.training import dial, far
from clod_adapter.training.pseudo_views import with_pseudo_views
from clod_adapter.training.schedule import FAR
from common import (
    Table,
    append,
    arguments,
    by_scene,
    last,
    opened,
    psnr_at,
    psnr_kept,
)
from stream import rendered

FILE, MAX_SV = "choices.jsonl", 7.0  # of captures, as adapt.jsonl has them
CHOICES = {  # name and value, and what the table calls it
    ("default", None): "default",
    ("SHARE", 0.6): "0.6 times as many far ones",
    ("SHARE", 0.4): "0.4 times",
    ("NEARER", 0.3): "from the 30th percentile of the distances on",
    ("NEARER", 0.5): "from the median on",
    ("full", 0.0): "no steps at s = 1",
    ("full", 0.5): "half of the first steps at s = 1",
    ("coarse", 0.0): "no step with photographs of half the size",
    ("growth", "off"): "no growth",
}
PLACED = {  # without photographs
    ("default", None): "default",
    ("PLACED_SHARE", 0.8): "0.8 times as many, not 0.4",
    ("PLACED_NEARER", 0.2): "from the 20th percentile, not the 60th",
    ("PLACED_NEARER", 0.5): "from the median on",
    ("PLACED_CONTRAST", 1.0): "importance itself, not its cube",
    ("exponent", 1.5): "counts `s^-1.5`, not `s^-1.75`",
    ("exponent", 2.0): "counts `s^-2`",
}
NAMES = sorted({name for name, _ in CHOICES | PLACED} - {"default"})


def main():
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--names", nargs="+", choices=NAMES, default=NAMES)
    args = parser.parse_args()
    for scene in args.scenes:
        base, views = inputs(scene)
        for name, value in PLACED if scene.endswith(".ply") else CHOICES:
            if name in ("default", *args.names):
                measure(scene, base, views, name, value)


def inputs(scene):
    """The checkpoint and the views to train and to measure on."""
    if not scene.endswith(".ply"):
        base, views = opened(scene)
        return base.gaussians, views
    base = clod.load(scene).gaussians
    return base, clod.Scene(with_pseudo_views(base, None).train, tuple(rendered(base)))


def measure(scene, base, views, name, value):
    """Adapts with one change, and adds the row."""
    make = partial(clod.AdaptConfig, max_sv=MAX_SV)
    if scene.endswith(".ply"):
        make = partial(clod.AdaptConfig.placed)
    change = nullcontext()
    if hasattr(far, name):
        change = patch.object(far, name, value)
    elif hasattr(FAR, name):
        change = patch.object(dial, "FAR", replace(FAR, **{name: value}))
    elif name != "default":
        make = partial(make, **{name: value})
    with change:
        row = adapted(base, views, views.test, make())
    about = {"scene": Path(scene).stem, "choice": name, "value": value, "full": row["rows"][0]}
    append(FILE, about | row)


def page_table():
    """CHOICES on two captures."""
    return table(CHOICES, ("plush_half", "demo"), (0.35, 0.12))


def placed_table():
    """PLACED on large scenes; empty where one was not run."""
    return table(PLACED, ("taebak4", "showroom3"), (0.35, 0.05))


def table(choices, scenes, shares):
    found = last(FILE, "scene", "choice", "value")
    rows, lines = [], []
    for choice, label in choices.items():
        line = [label]
        for scene in scenes:
            row = found.get((scene, *choice))
            if row is None:
                line += [""] * (1 + len(shares))
            else:
                rows.append(row)
                line.append(psnr_kept(row["full"]))
                line += [psnr_at(row["at_shares"], share) for share in shares]
        lines.append(line)
    return Table(["", *by_scene(scenes, shares)], lines, rows)


if __name__ == "__main__":
    main()
