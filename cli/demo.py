"""``clod-adapt demo``: adapts a scene that comes with the package, and draws figures of the result."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path
from typing import Any

import torch

from clod_adapter.demo.pictures import Panel, dial_strip, quality_curve
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.lock import output_lock
from clod_adapter.io.scene.load import load_scene
from clod_adapter.render import render

from .adapt import run as adapt
from .commands.adapt import ADAPT
from .commands.parser import make_parser
from .shared.console import Console, duration, put
from .shared.files import Outputs, make_folder
from .shared.kernels import announced_compiling, prepare_kernels
from .shared.outputs import check_outputs
from .shared.report import Stopwatch

POINTS, FIT_STEPS, ADAPT_STEPS, MAX_SV = 60_000, 2000, 1500, 5.0
DIALS = (1.0, 2.0, 3.0, 5.0)
EXTRA = {"matplotlib": "matplotlib", "skimage": "scikit-image"}  # module, and the package that brings it
VIEW = 0  # the held-out view on the strip: across the whole room
CROP = (100, 70, 96, 72)


def run(args: argparse.Namespace) -> dict[str, Any]:
    folder = Path(args.out)
    check_extra()
    make_folder(folder)
    with output_lock(folder / "demo", of=folder):
        return run_demo(args, folder)


def run_demo(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Runs the demo; the caller holds the lock of the folder."""
    console, watch = Console(args.quiet), Stopwatch()
    capture, base, model = folder / "capture", folder / "base.ply", folder / "gallery.ply"
    pictures = {"dial": folder / "dial.png", "curve": folder / "curve.png"}
    check_outputs((), (), beside=[*vars(Outputs.of(str(base), str(model))).values(), *pictures.values()])
    if base.exists() and not capture.exists():
        raise ClodError(f"{base}: exists without {capture}, so the demo did not make it; choose another --out")
    prepare_kernels(console)
    with announced_compiling(console):
        make_inputs(capture, base, console)
    report = adapt.run(adapt_arguments(args, base, capture, model))
    for path in pictures.values():  # of an earlier run
        path.unlink(missing_ok=True)
    if report["rows"]:
        draw(capture, model, report, pictures)
    else:
        pictures = {}
    print_next(folder, pictures, watch)
    return report | {"command": "demo", "folder": str(folder), "pictures": {k: str(v) for k, v in pictures.items()}}


def check_extra() -> None:
    """Raises the ClodError of a missing package before minutes are spent."""
    for module, package in EXTRA.items():
        if importlib.util.find_spec(module) is None:
            raise ClodError(f"the demo needs {package}: pip install {package}")


def adapt_arguments(args: argparse.Namespace, base: Path, capture: Path, model: Path) -> argparse.Namespace:
    """The arguments of the main command for the demo's files."""
    words = [f"--images={capture}", f"--max-sv={MAX_SV:g}", f"--iters={ADAPT_STEPS}", f"--out={model}"]
    words += [f"--{name}" for name in ("quiet", "json") if getattr(args, name)]
    words += ["--resume"] if Outputs.of(str(base), str(model)).state.exists() else []
    return make_parser(ADAPT, "clod-adapt").parse_args([*words, "--", str(base)])


def print_next(folder: Path, pictures: dict[str, Path], watch: Stopwatch) -> None:
    put(f"\n{duration(watch.total())} for the demo; everything is in {folder.resolve()}")
    if pictures:
        put("dial.png shows a view at several dial values, curve.png quality against count")
    else:
        put("no figures: the measurements were interrupted")
    print("next, a splat of your own:\n  clod-adapt YOURS.ply --images YOUR_SCENE")


def make_inputs(capture: Path, base: Path, console: Console) -> None:
    """Makes the capture and the base checkpoint, unless they exist."""
    # Here and not above: the ray tracer brings scikit-image, whose absence check_extra is to report first.
    from clod_adapter.demo.fit import fit_base
    from clod_adapter.demo.gallery import make_gallery, write_gallery

    if capture.exists() and base.exists():
        console.say(f"using {capture} and {base}, made earlier")
        return
    console.say("building the gallery ...")
    if capture.exists():
        gallery = make_gallery()
    else:
        with console.meter("ray tracing") as meter:
            gallery = write_gallery(capture, progress=meter)
    points, colors = gallery.sample_points(POINTS)
    with console.meter("base") as meter:
        fitted = fit_base(points, colors, load_scene(capture), iters=FIT_STEPS, progress=meter)
    save(base, fitted)
    console.say(f"trained a plain checkpoint of {len(fitted):,} Gaussians: {base}")


@torch.no_grad()
def draw(capture: Path, model: Path, report: dict[str, Any], pictures: dict[str, Path]) -> None:
    """Draws a held-out view at several dial values, and the quality curve of all held-out views."""
    view, gaussians = load_scene(capture).test[VIEW], load(model).gaussians
    panels = [Panel(view.image.numpy())]
    (times,) = time_frames([(gaussians, DIALS)], [view.camera]).milliseconds
    for row, taken in zip(evaluate(gaussians, [view], DIALS), times, strict=True):
        image = render(gaussians, view.camera, row.virtual_scale).image.numpy()
        panels.append(Panel(image, row.virtual_scale, row.kept, row.kept_share, row.psnr, taken))
    dial_strip(pictures["dial"], panels, "One file, one dial: a held-out view", crop=CROP)
    title = "Quality against Gaussians, mean over the held-out views"
    quality_curve(pictures["curve"], report["rows"], report["base_rows"][0], title)
