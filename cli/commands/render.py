"""``clod-adapt render``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.folder import find_cameras, photograph_folders

from ..shared.dials import BUDGETS, add_dial_options
from .checks import check_checkpoint, check_dials, check_makeable, check_scene
from .command import Command
from .options import add_activated, add_antialiasing, add_device, add_images


def render_options(parser: ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL.ply", help="an adapted file, or a plain one")
    add_images(parser)
    parser.add_argument("-o", "--out", metavar="FOLDER", required=True, help="where the pictures go; made if missing")
    add_dial_options(
        parser, "dial values (default: 1); several are put side by side", "(mean over the pictures)", several=True,
        required=False,
    )  # fmt: skip
    parser.add_argument(
        "--views", metavar="NAME", nargs="+", default=["held-out"],
        help="photographs whose cameras to render, by name, or all, or held-out (default)",
    )  # fmt: skip
    parser.add_argument("--beside", action="store_true", help="put the photograph left of the renderings")
    add_device(parser, "render")
    add_activated(parser)
    add_antialiasing(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress, no notes")


def check_render(args: Namespace) -> None:
    check_dials(args, args.model)
    check_checkpoint(args.model)
    check_scene(args.images)
    check_folder(Path(args.out), Path(args.images))


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


RENDER = Command(
    module="render",
    summary="Render a scene's cameras at some dial values to PNG.",
    description="""\
Render the cameras of a scene's photographs at some dial values, to PNG files.

One picture for each photograph, named like it; several dial values are side by
side in it, from left to right as given.
""",
    usage="MODEL.ply --images DIR -o FOLDER [options]",
    epilog=f"""\
{BUDGETS}
Ctrl-C leaves the pictures that are finished (exit code 0, "interrupted": true).

examples:
  clod-adapt render garden_clod.ply --images garden -o out --sv 3
  clod-adapt render garden_clod.ply --images garden -o out --sv 1 2 5 --beside
  clod-adapt render garden_clod.ply --images garden -o out --views a.jpg --sv 2
""",
    add_arguments=render_options,
    check=check_render,
)
