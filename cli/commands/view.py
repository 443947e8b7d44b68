"""``clod-adapt view``: its text, options and checks."""

from __future__ import annotations

import math
import re
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import FORMATS
from clod_adapter.io.ply.header import VIEWPOINT

from ..shared.command import (
    Command,
    add_activated,
    add_antialiasing,
    add_device_preset,
    check_checkpoint,
    check_scene,
    check_stored_cameras,
    may_store,
    model_has_dial,
    run_of,
)


def view_options(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    given.add_argument(
        "models", metavar="MODEL.ply", nargs="+",
        help="an adapted file, or a plain one, which has no dial; several, or a folder of them, to switch between",
    )  # fmt: skip
    given.add_argument("--base", metavar="BASE.ply", help="the checkpoint, or another file, to compare with")
    given.add_argument("--images", metavar="DIR", help="scene folder, for its cameras only")
    add_activated(given)
    add_antialiasing(given, photographs=False)
    page = parser.add_argument_group("page")
    initial: Any = page.add_mutually_exclusive_group()
    initial.add_argument(
        "--sv", metavar="S", type=float,
        help="initial dial value (default: 1 with photographs, else everything; then what the browser draws at 30 fps)",
    )  # fmt: skip
    add_device_preset(initial)
    page.add_argument("--port", metavar="P", type=int, default=0, help="port of the server (default: a free one)")
    page.add_argument("--no-browser", action="store_true", help="print the address only")


def view_files(given: Sequence[str]) -> list[str]:
    """The files to show: those given, and of a folder the checkpoints in it, by name, numbers by their value.

    Raises:
        ClodError: a folder has none.
    """
    return [file for path in given for file in (_files_in(Path(path)) if Path(path).is_dir() else [path])]


def _files_in(folder: Path) -> list[str]:
    def natural(path: Path) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", path.name)]

    found = sorted(
        (path for path in folder.iterdir() if path.suffix.lower() in FORMATS and path.is_file()), key=natural
    )
    splats = [str(path) for path in found if _is_checkpoint(path)]
    if not splats:
        raise ClodError(f"{folder}: has no splat in it; give the file, or the folder that has it")
    return splats


def _is_checkpoint(path: Path) -> bool:
    """Whether it is one by its first bytes; point clouds and meshes are .ply files too."""
    try:
        check_checkpoint(str(path))
    except ClodError:
        return False
    return True


def check_view(args: Namespace) -> None:
    if not 0 <= args.port < 1 << 16:
        raise ClodError(f"--port is {args.port}, it must be between 1 and 65535, or 0 for a free one")
    if args.sv is not None and not 0 <= args.sv < math.inf:
        raise ClodError(f"--sv is {args.sv:g}, it must be at least 0 (1 is full quality, 0 everything)")
    files = view_files(args.models)
    for path in (*files, *([args.base] if args.base else [])):
        check_checkpoint(path)
    if args.device_preset and not model_has_dial(files[0]):
        raise ClodError(f"{files[0]}: has no sigma_d, which --device-preset needs; adapt it first")
    if args.images is not None:
        check_scene(args.images)
    elif args.device_preset:
        check_stored_cameras(files[0], may_store(files[0], VIEWPOINT))


VIEW = Command(
    summary="Look at a file in the browser, and turn its dial.",
    description="""\
Show a file in the browser, with its dial and a free camera.

Serves a page on 127.0.0.1, prints the address, opens it in the browser, and
runs until Ctrl-C.
""",
    usage="MODEL.ply ... [--base BASE.ply] [--images DIR] [options]",
    epilog="""\
The page opens at s = 1 with photographs, else with everything shown, then at
the dial value at which the browser draws 30 frames per second; --sv sets one
that stays. It shows the Gaussians kept and the frame time, switches the
attenuation on and off, and compares two dial values, or MODEL.ply and BASE.ply,
on the two sides of a line. Drop another file on the page to open it; --sv
holds for it too, within its trained range. The address holds the view. With
--images the page can jump between the scene's cameras. Several files, such as
levels or variants, and a folder of files open with a list to switch between
them; the view and the dial value stay.

Other machines cannot reach the page, and it loads nothing from the network. To
see it from another machine, forward the port (-t passes Ctrl-C on):
  ssh -t -L 8000:127.0.0.1:8000 HOST \\
      clod-adapt view MODEL.ply --no-browser --port 8000
"clod-adapt export MODEL.ply -o page.html" writes the page to a file.
--device-preset opens it at the dial value whose count suits a device, by the
cameras of --images or those stored in MODEL.ply.

--json prints its object at the start: {"url": ..., ...}.

exit codes: 0 ended by Ctrl-C or a signal; 2 bad input, or the port is in use

examples:
  clod-adapt view garden_clod.ply
  clod-adapt view garden_clod.ply --base garden.ply --images garden --sv 3
  clod-adapt view garden_clod.ply --device-preset phone
  clod-adapt view levels/
""",
    add_arguments=view_options,
    check=check_view,
    run=run_of("view"),
)
