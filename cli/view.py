"""``clod-adapt view``: serves the page that shows a file, on the loopback address until Ctrl-C."""

from __future__ import annotations

import json
import math
import os
import re
import sys
import webbrowser
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clod_adapter._support.text import as_text
from clod_adapter._support.version import package_version
from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import FORMATS, check_readable, file_has_dial
from clod_adapter.progress import Stopped

from .shared import command as common
from .shared.console import Console
from .shared.outputs import jsonable
from .shared.process import interrupt_as_stopped

if TYPE_CHECKING:
    from clod_adapter.io.checkpoint import Checkpoint
    from clod_adapter.viewer.payload import Payload
    from clod_adapter.viewer.server import Response

MODEL, BASE = "/files/model", "/files/base"
IN_TERMINAL = ("lynx", "w3m", "links", "links2", "elinks", "www-browser")  # they would take over the terminal


def add_arguments(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    given.add_argument(
        "models", metavar="MODEL.ply", nargs="+",
        help="an adapted file, or a plain one, which has no dial; several, or a folder of them, to switch between",
    )  # fmt: skip
    given.add_argument("--base", metavar="BASE.ply", help="the checkpoint, or another file, to compare with")
    common.add_reading(given, "scene folder, for its cameras only", photographs=False)
    page = parser.add_argument_group("page")
    initial: Any = page.add_mutually_exclusive_group()
    initial.add_argument(
        "--sv", metavar="S", type=float,
        help="initial dial value (default: 1 with photographs, else everything; then it holds 30 frames per second)",
    )  # fmt: skip
    common.add_device_preset(initial)
    page.add_argument("--port", metavar="P", type=int, default=0, help="port of the server (default: a free one)")
    page.add_argument("--no-browser", action="store_true", help="print the address only")


def view_files(given: Sequence[str]) -> list[str]:
    """The files to show: those given, and of a folder the checkpoints in it, by name, numbers by their value."""
    return [file for path in given for file in (_files_in(Path(path)) if Path(path).is_dir() else [path])]


def _files_in(folder: Path) -> list[str]:
    def natural(path: Path) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", path.name)]

    splats = []
    for path in sorted(folder.iterdir(), key=natural):
        if path.suffix.lower() in FORMATS and path.is_file():
            with suppress(ClodError):  # point clouds and meshes are .ply files too
                check_readable(path)
                splats.append(str(path))
    if not splats:
        raise ClodError(f"{folder}: has no splat in it; give the file, or the folder that has it")
    return splats


def check(args: Namespace) -> None:
    if not 0 <= args.port < 1 << 16:
        raise ClodError(f"--port is {args.port}, it must be between 1 and 65535, or 0 for a free one")
    if args.sv is not None and not 0 <= args.sv < math.inf:
        raise ClodError(f"--sv is {args.sv:g}, it must be at least 0 (1 is full quality, 0 everything)")
    files = view_files(args.models)
    for path in (*files, *([args.base] if args.base else [])):
        check_readable(Path(path))
    if args.device_preset and not file_has_dial(Path(files[0])):
        raise ClodError(f"{files[0]}: has no sigma_d, which --device-preset needs; adapt it first")
    if args.images is not None:
        common.check_scene(args.images)


def execute(args: Namespace) -> None:
    """Prints the address, or with --json the report, and serves the page until it is interrupted."""
    from clod_adapter.viewer.server import Server

    console = Console(args.quiet)
    answers, report = make_page(args, console)
    with Server(answers, args.port) as server:
        report |= {"url": server.url, "port": server.port}
        # Here, and not by main after the command: a script needs the address while the page is served.
        shown = json.dumps(jsonable(report)) if args.json else f"{server.url}  (Ctrl-C ends)"
        # Around print: a reader of the address may interrupt before the server waits.
        with suppress(Stopped), interrupt_as_stopped():
            print(shown, file=sys.__stdout__ if args.json else None, flush=True)
            if not args.no_browser and not open_browser(server.url):
                console.say(f"no browser found; open {server.url}, from another machine through ssh -L")
            server.serve_forever()
        console.say("ended")


def make_page(args: Namespace, console: Console) -> tuple[dict[str, Response], dict[str, Any]]:
    """The answers of the server by path, and the report."""
    from clod_adapter.viewer.page import policy, served_page
    from clod_adapter.viewer.payload import Payload, page_config
    from clod_adapter.viewer.server import Response

    from .shared.inputs import read_cameras, read_checkpoint, with_filter
    from .shared.measure import solve_dials

    files = view_files(args.models)
    models: list[Checkpoint] = []
    for path in (*files, *([args.base] if args.base else [])):
        origin = models[0].origin if models else None
        models.append(with_filter(read_checkpoint(path, console, args.activated, origin), args, console))
    base, model = models.pop() if args.base else None, models[0]
    if args.device_preset and args.images is None and not model.viewpoints:
        raise ClodError(f"{model.path}: stores no cameras, which --device-preset needs; give --images")
    if base and args.antialiasing == "auto" and not base.filter_known:  # drawn as the model is
        drawn = model.gaussians.screen_filter
        base = replace(base, gaussians=base.gaussians.replace(screen_filter=drawn))
    cameras = read_cameras(model, args.images, console) if args.images else []
    attenuation, opening = model.gaussians.attenuation, args.sv
    solved = solve_dials(args, model, cameras or model.viewpoints, console)
    if args.device_preset and solved:
        opening = solved[0]
    if opening is not None:
        opening = common.initial_dial(opening, attenuation.max_sv if attenuation else None, console)
    payloads = payloads_of(models) | ({BASE: Payload.of(base)} if base else {})
    entries = {path: {"name": each.name, "href": path} for path, each in payloads.items()}
    model_entry, base_entry = entries.pop(MODEL), entries.pop(BASE, None)
    shown, placed, rest = cameras or model.cameras, model.placed and not cameras, tuple(entries.values())
    page = served_page(page_config(model_entry, base_entry, shown, opening, rest, placed))
    answers = {"/": Response("text/html; charset=utf-8", len(page), lambda: (page,), policy("'self'"))}
    for path, payload in payloads.items():
        answers[path] = Response("application/octet-stream", payload.size, payload.blocks)
    return answers, {
        "command": "view", "version": package_version(), "model": files[0], "files": files, "base": args.base,
        "scene": args.images, "base_count": len(model.gaussians), "cameras": len(cameras), "notes": console.notes,
    }  # fmt: skip


def payloads_of(models: list[Checkpoint]) -> dict[str, Payload]:
    """The models by path; of two files with the same name, the names have their folders."""
    from clod_adapter.viewer.payload import Payload

    payloads = [Payload.of(model) for model in models]
    if len({payload.name for payload in payloads}) < len(payloads):
        names = [as_text("/".join(Path(model.path).absolute().parts[-2:])) for model in models]
        payloads = [replace(payload, name=name) for payload, name in zip(payloads, names, strict=True)]
    return {f"/files/{number}" if number else MODEL: payload for number, payload in enumerate(payloads)}


def find_browser() -> webbrowser.BaseBrowser | None:
    """The default browser; None if there is none, or only one that runs in the terminal."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return None
    if type(browser) is not webbrowser.GenericBrowser:
        return browser
    if "BROWSER" not in os.environ or browser.basename in IN_TERMINAL:
        return None
    return webbrowser.BackgroundBrowser([browser.name, *browser.args])  # an editor's, whose end is not waited for


def open_browser(url: str) -> bool:
    """Opens ``url`` in a browser window; False if there is no such browser."""
    browser = find_browser()
    return browser is not None and browser.open(url)


SUMMARY = "Look at a file in the browser, and turn its dial."
DESCRIPTION = """\
Show a file in the browser, with its dial and a free camera.

Serves a page on 127.0.0.1, prints the address, opens it in the browser, and
runs until Ctrl-C.
"""
USAGE = "MODEL.ply ... [--base BASE.ply] [--images DIR] [options]"
EPILOG = """\
The page opens at s = 1 with photographs, else with everything shown, and holds
30 frames per second by the dial if half of that is in reach; --sv sets a value
that stays. It shows the Gaussians kept and the frame time, switches the
attenuation on and off, and compares MODEL.ply with BASE.ply, or with itself
without the dial, on the two sides of a line. Drop another file on the page to
open it; --sv holds for it too, within its trained range. The address holds the
view. With --images the page can jump between the scene's cameras. Several
files, such as levels or variants, and a folder of files open with a list to
switch between them; the view and the dial value stay.

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
"""
