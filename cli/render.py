"""``clod-adapt render``: renders the scene's cameras at some dial values to PNG files."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from statistics import fmean
from typing import TYPE_CHECKING

from clod_adapter import ClodError
from clod_adapter._support.text import file_name, package_version
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.scene.folder import find_cameras, photograph_folders
from clod_adapter.progress import GracefulStop

from .shared import command as common
from .shared.console import Console
from .shared.outputs import Outputs, Report, check_outputs, make_folder

if TYPE_CHECKING:
    from torch import Tensor

    from clod_adapter import Gaussians, View


def add_arguments(parser: ArgumentParser) -> None:
    given = common.add_input(parser, "model", "MODEL.ply", "an adapted file, or a plain one")
    common.add_reading(given)
    text = "photographs whose cameras to render: names, all, or held-out (default)"
    given.add_argument("--views", metavar="NAME", nargs="+", default=["held-out"], help=text)
    dial = parser.add_argument_group("dial values, one of")
    common.add_dial_options(
        dial, "dial values (default: 1)", "(mean over the images)", several=True
    )
    output = common.add_out(parser, "FOLDER", "output folder; made if missing", required=True)
    output.add_argument(
        "--beside", action="store_true", help="put the photograph left of the renders"
    )
    common.add_device(output, "render")


def check(args: Namespace) -> None:
    common.check_dials(args, args.model)
    common.check_inputs(args.images, args.model)
    # Images must not replace photographs of the scene.
    out, scene = Path(args.out), Path(args.images)
    cameras = find_cameras(scene)
    places = [folder.resolve() for folder in (scene, cameras.parent, cameras.parent.parent)]
    folders = photograph_folders(scene, cameras)
    # folders next to a model's images/ are free; a transforms.json may name any file below it
    if cameras.is_dir():
        folders.remove(scene)
    if out.resolve() in places or any(
        out.resolve().is_relative_to(folder.resolve()) for folder in folders
    ):
        raise ClodError(f"{out}: the scene's own photographs may be there; choose another --out")


def outputs(args: Namespace) -> Outputs:
    """The folder; the names of the images in it are those of photographs, which are read later."""
    return Outputs(folders=[Path(args.out)], inputs=[args.model], scene=args.images)


def execute(args: Namespace) -> Report:
    from .shared.inputs import pick_views, read_inputs
    from .shared.measure import Stopwatch, choose_dials, solve_dials

    console, watch, out = Console(args.quiet), Stopwatch(), Path(args.out)
    (model,), scene = read_inputs(args, [args.model], console, held_out=False)
    views = pick_views(scene, args.views)
    images = [out / name for name in image_names(views)]
    check_outputs(replace(outputs(args), derived=images))
    solved = solve_dials(args, model, [view.camera for view in views], console)
    dials = choose_dials(solved or [1.0], model, console)
    gaussians = model.gaussians.without_empty_bands()
    pictures = write_images(
        gaussians, [*zip(images, views, strict=True)], dials, args.beside, console
    )
    print(f"wrote {len(pictures)} image{'s' * (len(pictures) != 1)} to {out}")
    for k, dial in enumerate(dials):
        kept = fmean(picture["kept"][k] for picture in pictures)
        error = fmean(picture["psnr"][k] for picture in pictures)
        about = (
            f"{kept:,.0f} of {gaussians.whole:,} Gaussians, {error:.2f} dB, means over the images"
        )
        print(f"  s = {dial:.5g}: {about}")
    return {
        "model": args.model,
        "scene": args.images,
        "base_count": gaussians.whole,
        "virtual_scales": dials,
        "pictures": pictures,
        "interrupted": len(pictures) < len(views),
        "notes": console.notes,
        "seconds": watch.report(),
        "outputs": {"folder": args.out},
    }


def image_names(views: Sequence[View]) -> list[Path]:
    """The PNG's name for each view: that of its photograph, with its suffix only where names would
    collide.
    """
    paths = [Path(file_name(str(Path(*PureWindowsPath(view.camera.name).parts)))) for view in views]
    short = [path.with_suffix(".png") for path in paths]
    return (
        short
        if len(set(short)) == len(short)
        else [path.with_name(f"{path.name}.png") for path in paths]
    )


def write_images(
    gaussians: Gaussians,
    views: Sequence[tuple[Path, View]],
    dials: Sequence[float],
    beside: bool,
    console: Console,
) -> list[Report]:
    """Writes a file per view, until Ctrl-C: the dial values from left to right, after the
    photograph if asked for.

    Gives of each the view, the file, and per dial value the Gaussians kept, and PSNR (dB) against
    the photograph.
    """
    import torch

    from clod_adapter import render
    from clod_adapter.losses import psnr

    written, stop, plain = list[Report](), GracefulStop(), gaussians.sigma_d is None
    with console.meter("render") as meter, stop.listening():
        for file, view in views:
            with torch.no_grad():
                shown = [render(gaussians, view.camera, 1.0 if plain else dial) for dial in dials]
            panels = [rendering.pixels.cpu() for rendering in shown]
            write_png(file, torch.cat([view.image, *panels] if beside else panels, dim=1))
            kept = [int(rendering.kept.sum()) for rendering in shown]
            errors = [psnr(rendering.image, view.image) for rendering in shown]
            written.append({"view": view.camera.name, "file": file, "kept": kept, "psnr": errors})
            meter.update(len(written) / len(views), f"{len(written)}/{len(views)}")
            if stop.requests:
                break
    return written


def write_png(path: Path, pixels: Tensor) -> None:
    """Writes ``[H, W, 3]`` uint8 pixels."""
    from PIL import Image, PngImagePlugin

    make_folder(path.parent)
    with atomic_path(path) as temporary:
        about = PngImagePlugin.PngInfo()
        about.add_text("Software", f"clod-adapter {package_version()}")  # outputs.OURS looks for it
        Image.fromarray(pixels.cpu().numpy()).save(temporary, pnginfo=about)


DESCRIPTION = """\
Render the cameras of a scene's photographs to PNG files with their names: all
dial values side by side, in the order given.
"""
USAGE = "MODEL.ply --images DIR -o FOLDER [options]"
EPILOG = """\
"clod-adapt eval --help" explains the budgets --keep, --fps and --psnr-drop.
Ctrl-C finishes the image under way (exit code 0, "interrupted": true); a second
one aborts.

examples:
  clod-adapt render garden_clod.ply --images garden -o out --sv 1 2 5 --beside
  clod-adapt render garden_clod.ply --images garden -o out --views a.jpg --sv 2
"""
