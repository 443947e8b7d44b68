"""Checks of arguments and files that need no torch, whose import takes a second or two."""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Collection
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import PLY, check_readable, file_has_dial, format_of
from clod_adapter.io.ply.header import PREFIX, ROW, all_comments, read_head
from clod_adapter.io.scene.folder import find_cameras
from clod_adapter.report.charts import chart_file
from clod_adapter.report.style import check_matplotlib

from ..shared.dials import given_budget


def page_files(path: Path, charts: list[str]) -> list[Path]:
    """The files of a page and its charts; refuses a page that cannot be written."""
    check_matplotlib()
    if path.suffix.lower() != ".html":
        raise ClodError(f"{path}: --report names the page to write, so it must end in .html")
    return [path, *(chart_file(path, name) for name in charts)]


def check_dials(args: Namespace, model: str, *, measured: Collection[str] = ("fps",)) -> None:
    """Refuses dial values out of range, and budgets that need something the file does not have.

    Args:
        measured: budgets that the command solves by measuring, without a calibration.
    """
    for virtual_scale in args.sv or ():
        if not 0 <= virtual_scale < math.inf:
            raise ClodError(f"--sv has {virtual_scale:g}, it must be at least 0 (1 is full quality, 0 everything)")
    budget = given_budget(args)
    if budget is None:
        return
    name, option, values = budget
    for value in values:
        if not 0 < value < math.inf:
            raise ClodError(f"{option} has {value:g}, it must be positive and finite")
    if not model_has_dial(model):
        raise ClodError(f"{model}: has no sigma_d, which {option} needs; adapt it first: clod-adapt {model} ...")
    needed = name != "keep" and name not in measured
    if needed and not may_store(model, ROW):
        raise ClodError(
            f"{model}: has no calibration in its header, which {option} needs; adapt it again without interrupting, "
            "or give --sv or --keep"
        )


def may_store(model: str, name: str) -> bool:
    """Whether a PLY's header has a comment of this name (``ply.header``); True of other formats, which must be read."""
    path = Path(model)
    if format_of(path) is not PLY:
        return True
    return any(comment.startswith(f"{PREFIX}{name} ") for comment in all_comments(read_head(path).ply))


def check_stored_cameras(model: str, stored: bool) -> None:
    """Refuses --device-preset without a scene, of a file that stores no cameras."""
    if not stored:
        raise ClodError(f"{model}: stores no cameras, which --device-preset needs; give --images")


def model_has_dial(model: str) -> bool:
    """Whether the file's header has a sigma_d."""
    return file_has_dial(Path(model))


def check_checkpoint(path: str) -> None:
    """Refuses a file that is no checkpoint, by its first bytes."""
    check_readable(Path(path))


def check_scene(folder: str) -> None:
    """Refuses anything but a folder with a COLMAP model or a transforms.json."""
    if not Path(folder).is_dir():
        raise ClodError(f"{folder}: is not a folder; give the one that holds images/ and sparse/0")
    find_cameras(Path(folder))
