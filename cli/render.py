"""``clod-adapt render``: the scene's cameras at some dial values, as PNG files."""

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
from clod_adapter.cameras import View
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.lock import output_lock
from clod_adapter.metrics import psnr
from clod_adapter.render import render
from clod_adapter.version import package_version

from .shared.antialiasing import with_filter
from .shared.budgets import solve_dials
from .shared.console import Console
from .shared.devices import on_device, pick_device
from .shared.files import make_folder
from .shared.inputs import read_checkpoint, read_scene
from .shared.kernels import prepare_kernels
from .shared.measure import choose_dials
from .shared.outputs import check_no_input, check_ours
from .shared.report import Stopwatch
from .shared.views import pick_views


@dataclass(frozen=True)
class Picture:
    """What was written for a view: per dial value the Gaussians kept, and dB against the photograph."""

    view: str
    file: str
    kept: list[int]
    psnr: list[float]


def run(args: argparse.Namespace) -> dict[str, Any]:
    console, watch, out = Console(args.quiet), Stopwatch(), Path(args.out)
    device = pick_device(args.device, console)
    model = on_device(read_checkpoint(args.model, console, args.activated), device)
    scene = read_scene(args.images, console, model.origin)
    prepare_kernels(console, device, training=False)
    model = with_filter(model, args, console, [*scene.test, *scene.train])
    views = pick_views(scene, args.views)
    written = [out / name for name in files(views)]
    check_no_input(written, [args.model], args.images)
    for path in written:
        check_ours(path)
    solved, notes = solve_dials(args, model, [view.camera for view in views], console)
    dials, beyond = choose_dials(solved or [1.0], model.gaussians.attenuation)
    notes += beyond
    for note in notes:
        console.say(note)
    gaussians, pictures, interrupted = model.gaussians.without_empty_bands(), [], False
    make_folder(out)
    try:
        with output_lock(out / "pictures", of=out), console.meter("render") as meter:
            for picture in draw(gaussians, views, dials, out, args.beside):
                pictures.append(picture)
                meter.update(len(pictures) / len(views), f"{len(pictures)}/{len(views)}")
    except KeyboardInterrupt:
        if not pictures:
            raise
        interrupted = True
    print(summary(pictures, dials, len(gaussians), out))
    return {
        "command": "render", "version": package_version(), "model": args.model, "scene": args.images,
        "base_count": len(gaussians), "virtual_scales": dials, "pictures": [vars(picture) for picture in pictures],
        "interrupted": interrupted, "notes": [*model.notes, *scene.notes, *notes], "seconds": watch.report(),
        "outputs": {"folder": args.out},
    }  # fmt: skip


def files(views: Sequence[View]) -> list[Path]:
    """For each view the PNG's name: that of its photograph, whose suffix stays where names would else collide."""
    paths = [Path(file_name(str(Path(*PureWindowsPath(view.camera.name).parts)))) for view in views]
    short = [path.with_suffix(".png") for path in paths]
    return short if len(set(short)) == len(short) else [path.with_name(f"{path.name}.png") for path in paths]


@torch.no_grad()
def draw(
    gaussians: Gaussians, views: Sequence[View], dials: Sequence[float], out: Path, beside: bool
) -> Iterator[Picture]:
    """Writes a picture for each view: the dial values from left to right, behind the photograph with ``beside``."""
    for view, name in zip(views, files(views), strict=True):
        shown = [render(gaussians, view.camera, dial) for dial in dials]
        panels = [picture.pixels.cpu() for picture in shown]
        write_png(out / name, torch.cat([view.image, *panels] if beside else panels, dim=1))
        kept = [int(picture.kept.sum()) for picture in shown]
        yield Picture(view.camera.name, str(out / name), kept, [psnr(p.image, view.image) for p in shown])


def write_png(path: Path, pixels: Tensor) -> None:
    """Writes ``[H, W, 3]`` uint8, in a folder that is made where it is missing."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ClodError(f"{path.parent}: cannot be made ({error.strerror or error}); choose another --out") from error
    with atomic_path(path) as temporary:
        about = PngImagePlugin.PngInfo()
        about.add_text("Software", f"clod-adapter {package_version()}")  # by which a later run knows it for its own
        Image.fromarray(pixels.cpu().numpy()).save(temporary, pnginfo=about)


def summary(pictures: Sequence[Picture], dials: Sequence[float], total: int, out: Path) -> str:
    lines = [f"wrote {len(pictures)} picture{'s' * (len(pictures) != 1)} to {out}"]
    for k, dial in enumerate(dials):
        kept = fmean(picture.kept[k] for picture in pictures)
        error = fmean(picture.psnr[k] for picture in pictures)
        lines.append(f"  s = {dial:.5g}: {kept:,.0f} of {total:,} Gaussians, {error:.2f} dB, means over the pictures")
    return "\n".join(lines)
