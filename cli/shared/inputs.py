"""Checkpoints, scenes and devices of a command, with messages on them, and the kernels compiled for them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath

import torch
from numba.core.caching import NullCache
from numba.core.event import Event, Listener, install_listener

from clod_adapter._support.text import first_line
from clod_adapter.alignment.screen_filter import FilterComparison, compare_filters
from clod_adapter.cameras import Camera, Scene, View
from clod_adapter.config import CLASSIC, FILTERS, AdaptConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint, load
from clod_adapter.io.scene.load import ImageCache, load_scene
from clod_adapter.io.values import Activated, dial_columns
from clod_adapter.origin import Origin
from clod_adapter.progress import Phase, Stopped
from clod_adapter.rasterizers.cuda import unusable
from clod_adapter.training.camera_placement import place_cameras
from clod_adapter.training.loop import adapt
from clod_adapter.training.pseudo_views import LIGHTEST, STEPS_PER_PLACED, add_pseudo_views, render_pseudo_views

from .console import Console
from .outputs import size


def read_checkpoint(
    path: str, console: Console, activated: Activated | None = None, origin: Origin | None = None
) -> Checkpoint:
    """Reads a checkpoint and prints its contents; options as for ``load``."""
    with console.status(f"reading {path} ({size(Path(path))}) ..."):
        checkpoint = load(path, activated=activated, origin=origin)
    gaussians = checkpoint.gaussians
    columns = " and ".join(dial_columns(gaussians.tensors()))
    dial = f", with {columns}" if columns else ""
    drawn = gaussians.screen_filter
    filtered = "" if drawn == CLASSIC else f", drawn with {drawn.description}"
    console.say(f"{path}: {len(gaussians):,} Gaussians, SH degree {gaussians.sh_degree}{dial}{filtered}")
    for note in checkpoint.notes:
        console.note(note)
    return checkpoint


def read_scene(folder: str, console: Console, origin: Origin, cache: ImageCache | None = None) -> Scene:
    """Reads the photographs and prints how they are used."""
    with console.meter(Phase.PHOTOGRAPHS) as meter:
        scene = load_scene(folder, origin=origin, progress=meter, cache=cache)
    camera = scene.train[0].camera
    size = f"{camera.width}x{camera.height}"
    console.say(f"{folder}: {len(scene.train)} photographs to train on, {len(scene.test)} held out, {size}")
    for note in scene.notes:
        console.note(note)
    return scene


def with_pseudo_views(
    gaussians: Gaussians, scene: Scene, config: AdaptConfig, console: Console
) -> tuple[Scene, AdaptConfig]:
    """``pseudo_views.add_pseudo_views``, with its notes."""
    with console.meter(Phase.CAMERAS) as meter:
        more, lighter = add_pseudo_views(gaussians, scene, config, meter)
    for note in more.notes[len(scene.notes) :]:
        console.note(note)
    return more, lighter


def place_scene(gaussians: Gaussians, config: AdaptConfig, console: Console) -> tuple[Scene, AdaptConfig]:
    """A scene of pseudo views, with its notes, and the settings to train on it."""
    with console.meter(Phase.CAMERAS) as meter:
        cameras = place_cameras(gaussians, seed=config.seed, progress=meter)
    with console.meter(Phase.PSEUDO_VIEWS) as meter:
        scene = render_pseudo_views(gaussians, cameras, progress=meter)
    for note in scene.notes:
        console.say(note)
    return scene, config.lighter(LIGHTEST).for_views(len(scene.train), STEPS_PER_PLACED)


def read_model_and_scene(
    args: argparse.Namespace, console: Console, others: Sequence[str] = ()
) -> tuple[Checkpoint, dict[str, Checkpoint], Scene, torch.device]:
    """The model of ``args``, other files by path, the scene, and the device that the Gaussians are on.

    All coordinates are relative to the model's origin.
    """
    device = pick_device(args.device, console)
    model = read_checkpoint(args.model, console, args.activated)
    read = {path: read_checkpoint(path, console, args.activated, model.origin) for path in others}
    scene = read_scene(args.images, console, model.origin)
    return on_device(model, device), {path: on_device(each, device) for path, each in read.items()}, scene, device


def pick_device(name: str, console: Console) -> torch.device:
    """The device of ``--device``; prints why a GPU is not used.

    Raises:
        ClodError: cuda was asked for and does not work; the message says what to install.
    """
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    reason = no_gpu()
    if reason is None:
        device = torch.device("cuda", torch.cuda.current_device())
        console.say(f"on {torch.cuda.get_device_name(device)}")
        return device
    if name == "cuda":
        raise ClodError(f"--device cuda: {reason}; or use --device cpu")
    console.say(f"on the CPU, although there is a GPU: {reason}")
    return torch.device("cpu")


def no_gpu() -> str | None:
    """Why no GPU backend works, None if one does. The first call may compile gsplat for minutes."""
    if torch.cuda.is_available():
        return _fails() or unusable()
    if torch.version.cuda is None:
        return f"torch {torch.__version__} is built without CUDA: install torch from https://pytorch.org for your CUDA"
    return "torch finds no NVIDIA GPU; check with nvidia-smi that there is one and that its driver is new enough"


def _fails() -> str | None:
    """Why torch cannot compute on the GPU that it finds: not supported by this torch, or in use."""
    try:
        torch.ones(1, device="cuda").add_(1).item()
    except (RuntimeError, AssertionError) as error:
        return f"torch cannot compute on it ({first_line(error)}); clod-adapt doctor prints a fix"
    return None


def on_device(checkpoint: Checkpoint, device: torch.device) -> Checkpoint:
    """The checkpoint with its Gaussians on the device. Photographs stay in main memory and are copied one at a time."""
    return replace(checkpoint, gaussians=checkpoint.gaussians.to(device))


WORDS = {"off": "without antialiasing", "on": "with antialiasing", "mip": "with Mip-Splatting's antialiasing"}


def with_filter(
    checkpoint: Checkpoint, args: argparse.Namespace, console: Console, views: Sequence[View] = ()
) -> Checkpoint:
    """The checkpoint with the filter to render it with, and a note, also printed, where the file has another or none.

    The filter is that of ``--antialiasing``. With ``auto`` it is the file's; if the file has none, the one whose
    renders of ``views`` are clearly closest to the photographs, or without views the default.
    """
    gaussians = checkpoint.gaussians
    if args.antialiasing != "auto":
        given = FILTERS[args.antialiasing]
        if given == gaussians.screen_filter or not checkpoint.filter_known:
            return replace(checkpoint, gaussians=gaussians.replace(screen_filter=given))
        stored = gaussians.screen_filter.description
        note = f"{checkpoint.path}: rendered {WORDS[args.antialiasing]} (--antialiasing); the file has {stored}"
        return _noted(checkpoint, given, note, console)
    if checkpoint.filter_known or not views:
        return checkpoint
    with console.status("comparing screen-space filters with the photographs ..."):
        found = compare_filters(gaussians, views, gaussians.screen_filter.name or "off")
    if found.chosen == found.expected:
        return checkpoint
    return _noted(checkpoint, found.screen_filter, _measured_note(checkpoint, found), console)


def with_filter_of(base: Checkpoint, model: Checkpoint, args: argparse.Namespace) -> Checkpoint:
    """The base of a model, with the model's filter if its own file has none."""
    if args.antialiasing != "auto" or base.filter_known or not model.filter_known:
        return base
    return replace(base, gaussians=base.gaussians.replace(screen_filter=model.gaussians.screen_filter))


def _measured_note(checkpoint: Checkpoint, found: FilterComparison) -> str:
    chosen, expected = (f"{found.psnr[name]:.2f} dB {WORDS[name]}" for name in (found.chosen, found.expected))
    return (
        f"{checkpoint.path}: by the photographs it was trained {WORDS[found.chosen]}: {chosen}, {expected}; "
        f"rendered so (--antialiasing {found.expected} overrides it)"
    )


def _noted(checkpoint: Checkpoint, screen_filter: ScreenFilter, note: str, console: Console) -> Checkpoint:
    console.say(note)
    gaussians = checkpoint.gaussians.replace(screen_filter=screen_filter)
    return replace(checkpoint, gaussians=gaussians, notes=(*checkpoint.notes, note))


def pick_views(scene: Scene, wanted: Sequence[str]) -> list[View]:
    """The held-out views, all views, or those named, in the scene's order."""
    views = sorted([*scene.train, *scene.test], key=lambda view: view.camera.name)
    if list(wanted) == ["all"]:
        return views
    if list(wanted) == ["held-out"]:
        return list(scene.test or scene.train)  # a single photograph is not held out
    cameras = [view.camera for view in views]
    chosen = {camera.name for name in wanted for camera in named(cameras, name, "--views")}
    return [view for view in views if view.camera.name in chosen]


def named(cameras: Sequence[Camera], name: str, option: str) -> list[Camera]:
    """The cameras whose photograph has this name; if none has, without its suffix, its folder, or both.

    Raises:
        ClodError: no photograph has this name.
    """
    whole = [camera for camera in cameras if camera.name == name]
    if found := whole or [camera for camera in cameras if name in _shorter(camera.name)]:
        return found
    some = ", ".join(camera.name for camera in cameras[:3])
    raise ClodError(f"{option}: no photograph is named {name!r}; names are like {some}")


def _shorter(name: str) -> tuple[str, ...]:
    path = PureWindowsPath(name)
    return str(Path(name).with_suffix("")), path.name, path.stem


CPU = torch.device("cpu")


def prepare_kernels(
    console: Console, device: torch.device = CPU, *, training: bool = True, screen_filter: ScreenFilter = CLASSIC
) -> None:
    """Evaluates, and with ``training`` adapts, a scene of one Gaussian, so that all kernels are compiled.

    Training with a filter that compensates opacities needs another kernel.
    """
    one = Gaussians(
        torch.zeros(1, 3), torch.ones(1, 4), torch.zeros(1, 3), torch.zeros(1), torch.zeros(1, 1, 3),
        torch.zeros(1, 3, 3), screen_filter=screen_filter,
    ).to(device)  # fmt: skip
    viewmat, K = torch.eye(4), torch.eye(3)
    viewmat[2, 3] = 2.0
    view = View(Camera(viewmat, K, 4, 4), torch.zeros(4, 4, 3, dtype=torch.uint8))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # after a Ctrl-C in one, each of several would compile on its own
    try:
        with install_listener("numba:compile", _Compiling(console)):
            evaluate(one, [view], [1.0])
            if training:
                adapted = adapt(one, Scene((view,), ()), AdaptConfig(iters=1), progress=False)
                if adapted.interrupted:
                    raise Stopped("stopped while the kernels were compiled")
    finally:
        torch.set_num_threads(threads)


class _Compiling(Listener):  # type: ignore[misc]
    """Says once that something is compiled."""

    def __init__(self, console: Console) -> None:
        self.console, self.said = console, False

    def on_start(self, event: Event) -> None:
        if not self.said:
            self.said, cached = True, not isinstance(event.data["dispatcher"]._cache, NullCache)
            nowhere = "on every run, as no cache folder is writable: set NUMBA_CACHE_DIR"
            self.console.say(f"compiling kernels ({'first run only, well under a minute' if cached else nowhere}) ...")

    def on_end(self, event: Event) -> None:
        pass
