"""``clod-adapt demo``: adapts a scene that comes with the package, and draws figures of the result."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from clod_adapter.cameras import View
from clod_adapter.demo.packed import unpack
from clod_adapter.demo.pictures import Panel, dial_strip, quality_curve
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import load
from clod_adapter.io.scene.load import load_scene
from clod_adapter.render import render

from .adapt import run as adapt
from .commands.adapt import ADAPT
from .commands.demo import picture_files
from .shared.console import Console, duration, put
from .shared.inputs import prepare_kernels
from .shared.measure import Stopwatch
from .shared.outputs import AdaptFiles, claimed

MAX_SV = 5.0
DIALS = (1.0, 2.0, 3.0, 5.0)
VIEW = 0  # the held-out view on the strip: across the whole room
CROP = (150, 150, 150, 75)  # left, top, width and height of the part shown enlarged, pixels


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch, folder = Console(args.quiet), Stopwatch(), Path(args.out)
    capture, base, model = folder / "capture", folder / "base.ply", folder / "gallery.ply"
    pictures = picture_files(folder)
    if base.exists() and not capture.exists():
        raise ClodError(f"{base}: exists without {capture}, so the demo did not make it; choose another --out")
    prepare_kernels(console)
    unpack(capture, base)
    console.say(f"the scene is in {capture}, its checkpoint is {base}")
    arguments = adapt_arguments(args, base, capture, model)
    with claimed(ADAPT.outputs(arguments)):
        report = adapt.run(arguments)
    for path in pictures.values():  # of an earlier run
        path.unlink(missing_ok=True)
    if report["rows"]:
        draw(capture, base, model, report, pictures)
    else:
        pictures = {}
    print_next(folder, pictures, watch)
    return report | {"command": "demo", "folder": str(folder), "pictures": {k: str(v) for k, v in pictures.items()}}


def adapt_arguments(args: argparse.Namespace, base: Path, capture: Path, model: Path) -> argparse.Namespace:
    """The arguments of the main command for the demo's files."""
    words = [f"--images={capture}", f"--max-sv={MAX_SV:g}", f"--out={model}"]
    words += [f"--{name}" for name in ("quiet", "json") if getattr(args, name)]
    words += ["--resume"] if AdaptFiles.of(str(base), str(model)).state.exists() else []
    return ADAPT.parser("clod-adapt").parse_args([*words, "--", str(base)])


def print_next(folder: Path, pictures: dict[str, Path], watch: Stopwatch) -> None:
    put(f"\n{duration(watch.total())} for the demo; everything is in {folder.resolve()}")
    if pictures:
        put("dial.png shows a view at several dial values, curve.png quality against count")
    else:
        put("no figures: the measurements were interrupted")
    print("next, a splat of your own:\n  clod-adapt YOURS.ply --images YOUR_SCENE")


def draw(capture: Path, base: Path, model: Path, report: dict[str, Any], pictures: dict[str, Path]) -> None:
    """Draws a held-out view of the base and at several dial values, and the quality curve of all held-out views."""
    view, gaussians = load_scene(capture).test[VIEW], load(model).gaussians
    panels = [Panel(view.image.numpy(), "photograph"), *measured(load(base).gaussians, gaussians, DIALS, view)]
    dial_strip(pictures["dial"], panels, "One file, one dial: a held-out view", crop=CROP)
    title = "Quality against Gaussians, mean over the held-out views"
    quality_curve(pictures["curve"], report["rows"], report["base_rows"][0], title)


@torch.no_grad()
def measured(base: Gaussians, model: Gaussians, dials: Sequence[float], view: View) -> list[Panel]:
    """Panels of the base and of the ascending dial values."""
    times = time_frames([(base, [1.0]), (model, dials)], [view.camera]).milliseconds
    shown = [("base", base, 1.0), *((f"s = {s:.3g}", model, s) for s in dials)]
    panels = []
    for (heading, gaussians, s), taken in zip(shown, (*times[0], *times[1]), strict=True):
        (row,) = evaluate(gaussians, [view], [s])
        image = render(gaussians, view.camera, s).image.numpy()
        panels.append(Panel(image, heading, row.kept, row.kept_share, row.psnr, taken))
    return panels
