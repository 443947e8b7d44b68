"""``clod-adapt view``: serves the page that shows a file, on the loopback address until Ctrl-C."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from clod_adapter._support.text import as_text
from clod_adapter._support.version import package_version
from clod_adapter.cameras import Camera
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.progress import Stopped
from clod_adapter.viewer.page import policy, served_page
from clod_adapter.viewer.payload import Payload, page_config
from clod_adapter.viewer.server import Response, Server

from .commands.view import view_files
from .shared.alignment import read_cameras
from .shared.browsers import open_browser
from .shared.command import check_stored_cameras, initial_dial
from .shared.console import Console
from .shared.inputs import read_checkpoint, with_filter, with_filter_of
from .shared.measure import solve_dials
from .shared.outputs import jsonable
from .shared.process import interrupt_as_stopped

MODEL, BASE = "/files/model", "/files/base"


def run(args: argparse.Namespace) -> None:
    """Prints the address, or with --json the report, and serves the page until it is interrupted."""
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


def make_page(args: argparse.Namespace, console: Console) -> tuple[dict[str, Response], dict[str, Any]]:
    """The answers of the server by path, and the report."""
    files, base = view_files(args.models), None
    model = with_filter(read_checkpoint(files[0], console, args.activated), args, console)
    if args.device_preset and args.images is None:
        check_stored_cameras(files[0], bool(model.viewpoints))
    others = [
        with_filter(read_checkpoint(file, console, args.activated, model.origin), args, console) for file in files[1:]
    ]
    if args.base:
        base = with_filter(read_checkpoint(args.base, console, args.activated, model.origin), args, console)
        base = with_filter_of(base, model, args)
    cameras, notes = read_cameras(model, args.images, console) if args.images else (list[Camera](), list[str]())
    attenuation = model.gaussians.attenuation
    solved, asked = solve_dials(args, model, cameras or model.viewpoints, console)
    opening = solved[0] if args.device_preset and solved else args.sv
    notes += asked
    if opening is not None:
        opening, more = initial_dial(opening, attenuation.max_sv if attenuation else None)
        notes += more
    for note in notes:
        console.note(note)
    payloads = payloads_of([model, *others]) | ({BASE: Payload.of(base)} if base else {})
    entries = {path: {"name": each.name, "href": path, "size": each.size} for path, each in payloads.items()}
    model_entry, base_entry = entries.pop(MODEL), entries.pop(BASE, None)
    shown, placed, rest = cameras or model.cameras, model.placed and not cameras, tuple(entries.values())
    page = served_page(page_config(model_entry, base_entry, shown, opening, rest, placed))
    answers = {"/": Response("text/html; charset=utf-8", len(page), lambda: (page,), policy("'self'"))}
    for path, payload in payloads.items():
        answers[path] = Response("application/octet-stream", payload.size, payload.blocks)
    return answers, {
        "command": "view", "version": package_version(), "model": files[0], "files": files, "base": args.base,
        "scene": args.images, "base_count": len(model.gaussians), "cameras": len(cameras),
        "notes": [*model.notes, *notes],
    }  # fmt: skip


def payloads_of(models: list[Checkpoint]) -> dict[str, Payload]:
    """The models by path; of two files with the same name, the names have their folders."""
    payloads = [Payload.of(model) for model in models]
    if len({payload.name for payload in payloads}) < len(payloads):
        names = [as_text("/".join(Path(model.path).absolute().parts[-2:])) for model in models]
        payloads = [replace(payload, name=name) for payload, name in zip(payloads, names, strict=True)]
    return {f"/files/{number}" if number else MODEL: payload for number, payload in enumerate(payloads)}
