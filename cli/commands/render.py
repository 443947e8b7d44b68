"""``clod-adapt render``: its text, options and checks."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.folder import find_cameras, photograph_folders

from ..shared.command import (
    Command,
    add_activated,
    add_antialiasing,
    add_device,
    add_dial_options,
    add_images,
    check_checkpoint,
    check_dials,
    check_scene,
    run_of,
)
from ..shared.outputs import Outputs


def render_options(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    given.add_argument("model", metavar="MODEL.ply", help="an adapted file, or a plain one")
    add_images(given)
    given.add_argument(
        "--views", metavar="NAME", nargs="+", default=["held-out"],
        help="photographs whose cameras to render: names, all, or held-out (default)",
    )  # fmt: skip
    add_activated(given)
    add_antialiasing(given)
    dial = parser.add_argument_group("dial values, one of")
    add_dial_options(dial, "dial values (default: 1)", "(mean over the images)", several=True)
    output = parser.add_argument_group("output")
    output.add_argument("-o", "--out", metavar="FOLDER", required=True, help="output folder; made if missing")
    output.add_argument("--beside", action="store_true", help="put the photograph left of the renders")
    add_device(output, "render")


def check_render(args: Namespace) -> None:
    check_dials(args, args.model)
    check_checkpoint(args.model)
    check_scene(args.images)
    check_folder(Path(args.out), Path(args.images))


def check_folder(out: Path, scene: Path) -> None:
    """Refuses an output folder in which images could replace photographs of the scene."""
    cameras = find_cameras(scene)
    places = [folder.resolve() for folder in (scene, cameras.parent, cameras.parent.parent)]
    folders = photograph_folders(scene, cameras)
    if cameras.is_dir():  # folders next to a model's images/ are free; a transforms.json may name any file below it
        folders.remove(scene)
    if out.resolve() in places or any(out.resolve().is_relative_to(folder.resolve()) for folder in folders):
        raise ClodError(f"{out}: the scene's own photographs may be there; choose another --out")


def render_outputs(args: Namespace) -> Outputs:
    """The folder; the names of the images in it are those of photographs, which are read later."""
    return Outputs(folders=[Path(args.out)], inputs=[args.model], scene=args.images)


RENDER = Command(
    summary="Render a scene's cameras at some dial values to PNG.",
    description="""\
Render the cameras of a scene's photographs at some dial values to PNG files.

Each image has the name of its photograph and shows all dial values side by
side, in the order given.
""",
    usage="MODEL.ply --images DIR -o FOLDER [options]",
    epilog="""\
"clod-adapt eval --help" explains the budgets --keep, --fps and --psnr-drop.
Ctrl-C finishes the image under way (exit code 0, "interrupted": true); a second
one aborts.

examples:
  clod-adapt render garden_clod.ply --images garden -o out --sv 3
  clod-adapt render garden_clod.ply --images garden -o out --sv 1 2 5 --beside
  clod-adapt render garden_clod.ply --images garden -o out --views a.jpg --sv 2
""",
    add_arguments=render_options,
    check=check_render,
    run=run_of("render"),
    outputs=render_outputs,
)
