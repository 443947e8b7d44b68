"""``clod-adapt render``: renders the scene's cameras at some dial values to PNG files."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from statistics import fmean
from typing import Any

import torch
from PIL import Image, PngImagePlugin
from torch import Tensor

from clod_adapter._support.text import file_name
from clod_adapter._support.version import package_version
from clod_adapter.cameras import View
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.metrics import psnr
from clod_adapter.render import render

from .shared.alignment import align
from .shared.console import Console, put
from .shared.inputs import pick_views, prepare_kernels, read_model_and_scene, with_filter
from .shared.measure import Stopwatch, choose_dials, solve_dials
from .shared.outputs import Outputs, check_outputs, make_folder
from .shared.process import GracefulStop


@dataclass(frozen=True)
class Written:
    """An image file of a view; per dial value the Gaussians kept, and PSNR (dB) against the photograph."""

    view: str
    file: str
    kept: list[int]
    psnr: list[float]


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch, out = Console(args.quiet), Stopwatch(), Path(args.out)
    model, _, scene, device = read_model_and_scene(args, console)
    prepare_kernels(console, device, training=False)
    scene, _ = align(model, scene, args.images, console, required=False)
    model = with_filter(model, args, console, [*scene.test, *scene.train])
    views = pick_views(scene, args.views)
    images = [out / name for name in image_names(views)]
    check_outputs(Outputs(derived=images, folders=[out], inputs=[args.model], scene=args.images))
    solved, notes = solve_dials(args, model, [view.camera for view in views], console)
    dials, beyond = choose_dials(solved or [1.0], model.gaussians.attenuation)
    notes += beyond
    if model.gaussians.sigma_d is None and max(dials) > 1:
        notes.append(f"{args.model} has no sigma_d, so every dial value renders all of it")
    for note in notes:
        console.say(note)
    gaussians = model.gaussians.without_empty_bands()
    pictures, interrupted = write_all(write_images(gaussians, views, dials, out, args.beside), len(views), console)
    put(summary(pictures, dials, len(gaussians), out))
    return {
        "command": "render", "version": package_version(), "model": args.model, "scene": args.images,
        "base_count": len(gaussians), "virtual_scales": dials, "pictures": [vars(picture) for picture in pictures],
        "interrupted": interrupted, "notes": [*model.notes, *scene.notes, *notes], "seconds": watch.report(),
        "outputs": {"folder": args.out},
    }  # fmt: skip


def image_names(views: Sequence[View]) -> list[Path]:
    """The PNG's name for each view: that of its photograph, with its suffix only where names would collide."""
    paths = [Path(file_name(str(Path(*PureWindowsPath(view.camera.name).parts)))) for view in views]
    short = [path.with_suffix(".png") for path in paths]
    return short if len(set(short)) == len(short) else [path.with_name(f"{path.name}.png") for path in paths]


def write_all(images: Iterator[Written], total: int, console: Console) -> tuple[list[Written], bool]:
    """Writes the images with a progress bar; those written, and whether Ctrl-C ended it. A second one aborts."""
    written, stop = list[Written](), GracefulStop()
    with console.meter("render") as meter, stop.listening():
        for image in images:
            written.append(image)
            meter.update(len(written) / total, f"{len(written)}/{total}")
            if stop.requests:
                break
    return written, len(written) < total


@torch.no_grad()
def write_images(
    gaussians: Gaussians, views: Sequence[View], dials: Sequence[float], out: Path, beside: bool
) -> Iterator[Written]:
    """Writes an image per view: the dial values from left to right, after the photograph with ``beside``."""
    for view, name in zip(views, image_names(views), strict=True):
        plain = gaussians.sigma_d is None
        shown = [render(gaussians, view.camera, 1.0 if plain else dial) for dial in dials]
        panels = [rendering.pixels.cpu() for rendering in shown]
        write_png(out / name, torch.cat([view.image, *panels] if beside else panels, dim=1))
        kept = [int(rendering.kept.sum()) for rendering in shown]
        errors = [psnr(rendering.image, view.image) for rendering in shown]
        yield Written(view.camera.name, str(out / name), kept, errors)


def write_png(path: Path, pixels: Tensor) -> None:
    """Writes ``[H, W, 3]`` uint8 pixels; makes the folder if it is missing."""
    make_folder(path.parent)
    with atomic_path(path) as temporary:
        about = PngImagePlugin.PngInfo()
        about.add_text("Software", f"clod-adapter {package_version()}")  # outputs.OURS looks for it
        Image.fromarray(pixels.cpu().numpy()).save(temporary, pnginfo=about)


def summary(pictures: Sequence[Written], dials: Sequence[float], total: int, out: Path) -> str:
    lines = [f"wrote {len(pictures)} image{'s' * (len(pictures) != 1)} to {out}"]
    for k, dial in enumerate(dials):
        kept = fmean(picture.kept[k] for picture in pictures)
        error = fmean(picture.psnr[k] for picture in pictures)
        lines.append(f"  s = {dial:.5g}: {kept:,.0f} of {total:,} Gaussians, {error:.2f} dB, means over the images")
    return "\n".join(lines)
