"""``clod-adapt view``: serves the page that shows a file, on the loopback address until Ctrl-C."""

from __future__ import annotations

import json
import os
import re
import sys
import webbrowser
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from clod_adapter import ClodError, Stopped
from clod_adapter._support.text import package_version
from clod_adapter.io.file_formats import FORMATS, check_readable

from .shared import command as common
from .shared.console import Console
from .shared.outputs import Report, jsonable
from .shared.process import interrupt_as_stopped

MODEL, BASE, CONVERTER = "/files/model", "/files/base", "/convert"
# they would take over the terminal
IN_TERMINAL = ("lynx", "w3m", "links", "links2", "elinks", "www-browser")


def add_arguments(parser: ArgumentParser) -> None:
    given = parser.add_argument_group("input")
    text = (
        "an adapted file, or a plain one, which has no dial; several, or a folder of them, to"
        " switch between"
    )
    given.add_argument("models", metavar="MODEL.ply", nargs="+", help=text)
    given.add_argument(
        "--base", metavar="BASE.ply", help="the checkpoint, or another file, to compare with"
    )
    common.add_reading(given, "scene folder, for its cameras only", photographs=False)
    page = parser.add_argument_group("page")
    initial: Any = page.add_mutually_exclusive_group()
    text = (
        "initial dial value (default: 1 with photographs, else everything; then it holds 30 frames"
        " per second)"
    )
    initial.add_argument("--sv", metavar="S", type=float, nargs=1, help=text)
    common.add_device_preset(initial)
    page.add_argument(
        "--port", metavar="P", type=int, default=0, help="port of the server (default: a free one)"
    )
    page.add_argument("--no-browser", action="store_true", help="print the address only")


def view_files(given: Sequence[str]) -> list[str]:
    """The files to show: those given, and of a folder the checkpoints in it, by name, numbers by
    their value.
    """
    files = list[str]()
    for path in given:
        files += _files_in(Path(path)) if Path(path).is_dir() else [path]
    return files


def _files_in(folder: Path) -> list[str]:
    def natural(path: Path) -> list[Any]:
        """Text and numbers in turn."""
        parts = re.split(r"(\d+)", path.name)
        return [int(part) if k % 2 else part for k, part in enumerate(parts)]

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
        raise ClodError(
            f"--port is {args.port}, it must be between 1 and 65535, or 0 for a free one"
        )
    files = view_files(args.models)
    common.check_inputs(args.images, *files, *([args.base] if args.base else []))
    common.check_dials(args, files[0])


def execute(args: Namespace) -> None:
    """Prints the address, or with --json the report, and serves the page until it is
    interrupted.
    """
    from clod_adapter.viewer.server import Server

    console = Console(args.quiet)
    answers, report = make_page(args, console)
    with Server(answers, args.port) as server:
        report |= {"url": server.url, "port": server.port}
        # Here, and not by main after the command: a script needs the address while the page is
        # served.
        shown = json.dumps(jsonable(report)) if args.json else f"{server.url}  (Ctrl-C ends)"
        # Around print: a reader of the address may interrupt before the server waits.
        with suppress(Stopped), interrupt_as_stopped():
            print(shown, file=sys.__stdout__ if args.json else None, flush=True)
            browser = None if args.no_browser else find_browser()
            if not args.no_browser and not (browser and browser.open(server.url)):
                console.say(
                    f"no browser found; open {server.url}, from another machine through ssh -L"
                )
            server.serve_forever()
        console.say("ended")


def make_page(args: Namespace, console: Console) -> tuple[dict[str, Any], Report]:
    """What the server answers by path, and the report."""
    from clod_adapter.viewer.page import (
        Payload,
        camera_entry,
        distinct_names,
        document,
        page_config,
        policy,
    )
    from clod_adapter.viewer.server import MOST_BYTES, Response

    from .shared.inputs import read_cameras, read_model
    from .shared.measure import solve_dials

    def answer(payload: Payload) -> Response:
        return Response("application/octet-stream", payload.size, payload.blocks)

    def convert(path: Path) -> Response:
        """A file that was dropped on the page."""
        return answer(Payload.of(read_model(args, str(path), Console(quiet=True))))

    files = view_files(args.models)
    model = read_model(args, files[0], console)
    models = [model, *(read_model(args, path, console, model.origin) for path in files[1:])]
    base = read_model(args, args.base, console, model.origin) if args.base else None
    if args.device_preset and args.images is None and not model.viewpoints:
        raise ClodError(
            f"{model.path}: stores no cameras, which --device-preset needs; give --images"
        )
    if base and args.antialiasing == "auto" and not base.filter_known:  # drawn as the model is
        drawn = model.gaussians.screen_filter
        base = replace(base, gaussians=base.gaussians.replace(screen_filter=drawn))
    cameras = read_cameras(model, args.images, console) if args.images else []
    dials = solve_dials(args, model, cameras or model.viewpoints, console)
    opening = common.initial_dial(dials[0], model.gaussians.attenuation, console) if dials else None
    payloads = {
        MODEL if k == 0 else f"/files/{k}": Payload.of(each) for k, each in enumerate(models)
    }
    names = distinct_names(models)
    entries = [{"name": name, "href": path} for name, path in zip(names, payloads, strict=True)]
    payloads |= {BASE: Payload.of(base)} if base else {}
    base_entry = {"name": payloads[BASE].name, "href": BASE} if base else None
    shown, placed = cameras or model.cameras, model.placed and not cameras
    config = page_config(
        entries,
        base_entry,
        [camera_entry(each, placed) for each in shown],
        opening,
        {"href": CONVERTER, "limit": MOST_BYTES},
    )
    page = b"".join(document(config))
    answers: dict[str, Any] = {path: answer(payload) for path, payload in payloads.items()}
    answers[CONVERTER] = convert
    answers["/"] = Response(
        "text/html; charset=utf-8", len(page), lambda: (page,), policy("'self'")
    )
    return answers, {
        "command": "view",
        "version": package_version(),
        "model": files[0],
        "files": files,
        "base": args.base,
        "scene": args.images,
        "base_count": len(model.gaussians),
        "cameras": len(cameras),
        "notes": console.notes,
    }


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
    # an editor's, whose end is not waited for
    return webbrowser.BackgroundBrowser([browser.name, *browser.args])


DESCRIPTION = """\
Show a file in the browser, with its dial and a free camera: a page is served on
127.0.0.1 until Ctrl-C.
"""
USAGE = "MODEL.ply ... [--base BASE.ply] [--images DIR] [options]"
EPILOG = """\
The page opens at s = 1 with photographs, else with everything shown, and holds
30 frames per second by the dial if half of that is in reach; --sv sets a value
that stays. It compares MODEL.ply with BASE.ply, or with itself without the
dial, on the two sides of a line, and with --images jumps between the scene's
cameras. Drop another file on it, of any format, to open that. The address holds
the view.

Other machines cannot reach the page, and it loads nothing from the network. To
see it from another machine, forward the port (-t passes Ctrl-C on):
  ssh -t -L 8000:127.0.0.1:8000 HOST \\
      clod-adapt view MODEL.ply --no-browser --port 8000
"clod-adapt export MODEL.ply ... -o page.html" writes the page to a file.
--device-preset takes the cameras of --images, or those stored in MODEL.ply.
--json prints its object at the start: {"url": ..., ...}.

exit codes: 0 ended by Ctrl-C or a signal; 2 bad input, or the port is in use

examples:
  clod-adapt view garden_clod.ply
  clod-adapt view garden_clod.ply --base garden.ply --images garden --sv 3
  clod-adapt view garden_clod.ply --device-preset phone
  clod-adapt view levels/
"""
