"""``clod-adapt demo``: the main job on a scene that comes with the package, and pictures of the result."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from clod_adapter.cli import adapt
from clod_adapter.cli.console import Console, announced_compiling, duration
from clod_adapter.cli.files import check_output
from clod_adapter.cli.report import Stopwatch
from clod_adapter.config import AdaptConfig
from clod_adapter.demo.pictures import Panel, dial_strip, quality_curve
from clod_adapter.errors import ClodError
from clod_adapter.evaluate import evaluate
from clod_adapter.io.colmap import load_scene
from clod_adapter.io.ply import load, save
from clod_adapter.render import render
from clod_adapter.train import Progress

SUMMARY = "Run everything on a built-in scene; nothing to download."
DESCRIPTION = """\
Run the whole job on a scene that comes with the package.

Ray-traces a small gallery (its ground truth owes nothing to splatting), trains
a plain checkpoint on it, gives that a dial, measures it on held-out views and
draws two pictures. A few minutes on two cores without a GPU, the first time;
the gallery and the checkpoint are kept and used again.
"""
USAGE = "[--out DIR] [options]"
EPILOG = """\
in DIR afterwards:
  capture/          64 images and their COLMAP model
  base.ply          the checkpoint, as any 3DGS trainer would leave it
  gallery.ply       the same with a dial; gallery.safetensors, gallery.json
  dial.png          one held-out view at several dial values
  curve.png         quality against the number of Gaussians
"""
POINTS, FIT_STEPS, MAX_SV = 40_000, 1500, 5.0
DIALS = (1.0, 2.0, 3.0, 5.0)
VIEW = 0  # the held-out view on the strip: across the whole room
CROP = (100, 70, 96, 72)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", default="demo", help="where everything goes (default: demo)")
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")


def run(args: argparse.Namespace) -> dict[str, Any]:
    folder, console, watch = Path(args.out), Console(args.quiet), Stopwatch()
    if folder.exists() and not folder.is_dir():
        raise ClodError(f"{folder}: is a file; give --out the name of a folder")
    folder.mkdir(parents=True, exist_ok=True)
    capture, base, model = folder / "capture", folder / "base.ply", folder / "gallery.ply"
    pictures = {"dial": folder / "dial.png", "curve": folder / "curve.png"}
    for path in (base, model, *pictures.values()):
        check_output(path, [])
    with announced_compiling(console):
        prepare(capture, base, console)
    given = argparse.Namespace(
        ply=str(base), images=str(capture), max_sv=MAX_SV, iters=AdaptConfig().iters, time_budget=None, seed=0,
        out=str(model), device="auto", quiet=args.quiet, json=args.json,
    )  # fmt: skip
    report = adapt.run(given)
    if report["rows"]:
        draw(capture, model, report, pictures)
        print(f"\npictures: {pictures['dial']} and {pictures['curve']}; {duration(watch.total())} for the demo")
    return report | {"command": "demo", "folder": str(folder), "pictures": {k: str(v) for k, v in pictures.items()}}


def prepare(capture: Path, base: Path, console: Console) -> None:
    """Makes the capture and the base checkpoint, or says that those there are used."""
    # Here and not above: the ray tracer brings scikit-image and Numba, which the other commands start without.
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
            gallery = write_gallery(
                capture, progress=lambda done, total: meter.update(done / total, f"view {done}/{total}")
            )
    points, colors = gallery.sample_points(POINTS)
    with console.meter("base") as meter:

        def follow(progress: Progress) -> None:
            meter.update(progress.share, f"{progress.done}/{progress.total}")

        fitted = fit_base(points, colors, load_scene(capture), iters=FIT_STEPS, progress=follow)
    save(base, fitted)
    console.say(f"trained a plain checkpoint of {len(fitted):,} Gaussians: {base}")


@torch.no_grad()
def draw(capture: Path, model: Path, report: dict[str, Any], pictures: dict[str, Path]) -> None:
    """One held-out view over the dial, and the curve over all held-out views."""
    view, gaussians = load_scene(capture).test[VIEW], load(model).gaussians
    panels = [Panel(view.image.numpy())]
    for row in evaluate(gaussians, [view], DIALS, repeats=5):
        image = render(gaussians, view.camera, row.virtual_scale).image.numpy()
        panels.append(Panel(image, row.virtual_scale, row.kept, row.kept_share, row.psnr, row.frame_ms))
    dial_strip(pictures["dial"], panels, "One file, one dial: a held-out view", crop=CROP)
    title = "Quality against Gaussians, mean over the held-out views"
    quality_curve(pictures["curve"], report["rows"], report["base_rows"][0], title)
