"""What can be seen to be wrong without torch, which takes a second or two to import; refused before that."""

from __future__ import annotations

import math
import os
from argparse import Namespace
from collections.abc import Callable, Collection
from pathlib import Path

from clod_adapter.cli.checks_export import check_export
from clod_adapter.cli.checks_inspect import check_inspect
from clod_adapter.cli.checks_memory import check_memory
from clod_adapter.cli.checks_plan import check_plan
from clod_adapter.cli.checks_view import check_view
from clod_adapter.cli.dials import given_budget
from clod_adapter.cli.files import Outputs, check_ply_name, labels
from clod_adapter.cli.outputs import check_no_input, check_outputs
from clod_adapter.cli.settings import make_config, make_configs
from clod_adapter.errors import ClodError
from clod_adapter.io.ply_header import PREFIX, ROW, all_comments, read_header
from clod_adapter.io.readers import PLY, check_readable, file_has_dial, reader_of
from clod_adapter.io.scene_folder import find_cameras, photograph_folders
from clod_adapter.report.charts import chart_file
from clod_adapter.report.style import check_matplotlib


def check_adapt(args: Namespace) -> None:
    make_config(args)
    check_plan(args)
    check_memory(args)
    check_checkpoint(args.ply)
    if args.images is not None:
        check_scene(args.images)
    outputs, page = Outputs.of(args.ply, args.out), list[Path]()
    if args.report:
        page = page_files(outputs.ply.with_suffix(".html"), ["rendering", "adapting"])
    outputs.check([args.ply], args.images, page)


def check_evaluate(args: Namespace) -> None:
    check_dials(args, args.model)
    labels(args.against)
    for path in (args.model, *args.against):
        check_checkpoint(path)
    if args.base:
        check_checkpoint(args.base)
        if has_dial(args.base):
            raise ClodError(
                f"{args.base}: has a dial (sigma_d); give --base the checkpoint that was adapted, or give it to "
                "--against"
            )
    check_scene(args.images)
    if args.report:
        inputs = [args.model, *args.against, *([args.base] if args.base else [])]
        page, *charts = page_files(Path(args.report), ["rendering"])
        check_outputs([page], inputs, args.images, beside=charts)


def check_render(args: Namespace) -> None:
    check_dials(args, args.model)
    check_checkpoint(args.model)
    check_scene(args.images)
    check_folder(Path(args.out), Path(args.images))


def check_apply(args: Namespace) -> None:
    out = Path(args.out)
    check_ply_name(out, "--out")
    if not Path(args.adapter).is_file():
        raise ClodError(f"{args.adapter}: No such file; give the .safetensors that clod-adapt wrote")
    check_outputs([out], [args.base, args.adapter])
    check_checkpoint(args.base)


def check_robustness(args: Namespace) -> None:
    check_matplotlib()
    make_configs(args)
    labels(args.ply)
    for folder in (Path(args.out), Path(args.out) / "cells"):
        check_makeable(folder)
    for path in args.ply:
        check_checkpoint(path)
    check_scene(args.images)
    folder = Path(args.out)
    there = [*folder.glob("robustness.*"), *(folder / "cells").glob("*")]
    check_no_input(there, args.ply, args.images)


def page_files(path: Path, charts: list[str]) -> list[Path]:
    """A page and its charts; refuses a page that could not be drawn."""
    check_matplotlib()
    if path.suffix.lower() != ".html":
        raise ClodError(f"{path}: --report names the page to write, so it must end in .html")
    return [path, *(chart_file(path, name) for name in charts)]


def check_dials(args: Namespace, model: str, *, measured: Collection[str] = ("fps",)) -> None:
    """Refuses values that are none, and budgets that the file's header says nothing can be solved for.

    Args:
        measured: the budgets that the command measures for itself, without a calibration.
    """
    for virtual_scale in args.sv or ():
        if not 1 <= virtual_scale < math.inf:
            raise ClodError(f"--sv has {virtual_scale:g}, dial values must be at least 1 (1 is full quality)")
    budget = given_budget(args)
    if budget is None:
        return
    name, option, values = budget
    for value in values:
        if not 0 < value < math.inf:
            raise ClodError(f"{option} has {value:g}, it must be positive and finite")
    if not has_dial(model):
        raise ClodError(f"{model}: has no sigma_d, so no dial for {option}; give it one first: clod-adapt {model} ...")
    needed = name != "keep" and name not in measured
    if needed and reader_of(Path(model)) is PLY and not _has_calibration(model):  # others say so when they are read
        raise ClodError(
            f"{model}: has no calibration in its header, which {option} needs; adapt it again, and let it measure to "
            "the end, or give --sv or --keep"
        )


def _has_calibration(model: str) -> bool:
    return any(comment.startswith(f"{PREFIX}{ROW} ") for comment in all_comments(read_header(Path(model))))


def has_dial(model: str) -> bool:
    """Whether the file's header has a sigma_d."""
    return file_has_dial(Path(model))


def check_checkpoint(path: str) -> None:
    """Refuses what by its first bytes is no checkpoint."""
    check_readable(Path(path))


def check_scene(folder: str) -> None:
    """Refuses what is no folder with a COLMAP model or a transforms.json."""
    if not Path(folder).is_dir():
        raise ClodError(f"{folder}: is not a folder; give the one that holds images/ and sparse/0")
    find_cameras(Path(folder))


def check_makeable(out: Path) -> None:
    """Refuses a folder that is no folder, or cannot be made or written to."""
    parent = next(folder for folder in (out, *out.parents) if folder.exists())
    if not parent.is_dir():
        raise ClodError(f"{out}: {parent} is a file; choose another --out")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise ClodError(f"{out}: folder {parent} is not writable; choose another --out")


def check_folder(out: Path, scene: Path) -> None:
    """Refuses a folder for pictures that cannot be made, or where they could replace photographs of the scene."""
    check_makeable(out)
    cameras = find_cameras(scene)
    places = [folder.resolve() for folder in (scene, cameras.parent, cameras.parent.parent)]
    folders = photograph_folders(scene, cameras)
    if cameras.is_dir():  # beside a model's images/ there is room; a transforms.json may name any file below it
        folders.remove(scene)
    if out.resolve() in places or any(out.resolve().is_relative_to(folder.resolve()) for folder in folders):
        raise ClodError(f"{out}: the scene's own photographs may be there; choose another --out")


# By the command's module; the demo's only input is its --out, which it makes itself, and the doctor has none.
CHECKS: dict[str, Callable[[Namespace], None]] = {
    "adapt": check_adapt,
    "evaluate": check_evaluate,
    "apply": check_apply,
    "render": check_render,
    "export": check_export,
    "robustness": check_robustness,
    "inspect": check_inspect,
    "demo": lambda args: None,
    "view": check_view,
    "doctor": lambda args: None,
}
