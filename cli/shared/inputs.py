"""What commands read: checkpoints, scenes in their frame, and the device; and the kernels compiled for them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import Any

import torch
from numba.core.caching import NullCache
from numba.core.event import Event, Listener, install_listener

from clod_adapter._support.text import first_line
from clod_adapter.alignment.check import MOST_VIEWS, Alignment, check_alignment
from clod_adapter.alignment.screen_filter import FilterComparison, compare_filters
from clod_adapter.alignment.search import Guess, cameras_in, guess_frame, scene_in
from clod_adapter.cameras import Camera, Scene, View
from clod_adapter.config import CLASSIC, FILTERS, AdaptConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint, load
from clod_adapter.io.scene.colmap import load_points
from clod_adapter.io.scene.load import ImageCache, load_cameras, load_scene
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


OTHER_COLOURS = (
    "warning: {ply} matches the photographs in {images}, but some differ more from it than from their own mean "
    "colours; check for another exposure, views that it does not cover, or a poor checkpoint"
)
FLAT = "warning: the photographs in {images} have a single colour each, on which the checkpoint is trained"
SMALL = 320  # pixels, width of photographs that only tell the frame


def align(
    checkpoint: Checkpoint, scene: Scene, images: str, console: Console, *, required: bool
) -> tuple[Scene, dict[str, Any]]:
    """Compares renders with the photographs; after a poor match tries other frames, and uses one that fits clearly.

    Args:
        required: for training: raises where the checkpoint fits in no frame, and warns of a poor match; otherwise
            warns of the former alone.

    Returns:
        The scene with its cameras in the checkpoint's frame, and with notes, which are printed. For the report, the
        numbers of ``check_alignment``, in the frame given; ``guess``, another frame that fits, in words; and ``frame``,
        the one that the cameras were moved to, with its ``psnr``.

    Raises:
        ClodError: the checkpoint does not match.
    """
    base, ply, views = checkpoint.gaussians, checkpoint.path, [*scene.test, *scene.train]
    with console.status("comparing the checkpoint with the photographs ..."):
        found = check_alignment(base, views)
    guess = _other_frame(checkpoint, views, found, images, console) if found.doubtful else None
    numbers: dict[str, Any] = found.as_dict() | {"guess": guess and guess.frame.description, "frame": None}
    if guess and guess.clear:
        scene, numbers["frame"] = scene_in(scene, guess.frame), guess.frame.as_dict() | {"psnr": guess.psnr}
        notes = [_moved(checkpoint, images, found, guess)]
    elif found.fits and guess is None:
        notes = [FLAT.format(images=images)] if required and not found.views else []
        notes += [OTHER_COLOURS.format(ply=ply, images=images)] if required and found.margin < 0 else []
    else:
        message = f"{ply}: does not match {images}: {mismatch(found, guess)}"
        if required:
            raise ClodError(f"{message}; use --misaligned-ok to train anyway")
        notes = [f"warning: {message}"]
    for note in notes:
        console.say(note)
    return replace(scene, notes=(*scene.notes, *notes)), numbers


def read_cameras(
    model: Checkpoint, images: str, console: Console, *, training: bool = False
) -> tuple[list[Camera], list[str]]:
    """``load_cameras``, moved into the model's frame, which few small photographs tell; and notes."""
    cameras, notes = load_cameras(images, model.origin, training=training)
    try:
        scene = load_scene(images, origin=model.origin, max_width=SMALL, most=MOST_VIEWS)
    except ClodError:  # cameras alone will do
        return cameras, notes
    prepare_kernels(console, model.gaussians.means.device, training=False)
    views = [*scene.test, *scene.train]
    found = check_alignment(model.gaussians, views)
    if not found.doubtful:
        return cameras, notes
    every = load_cameras(images, model.origin)[0] if training else cameras
    guess = _other_frame(model, views, found, images, console, every)
    if guess is None or not guess.clear:
        return cameras, notes
    return cameras_in(cameras, guess.frame), [*notes, _moved(model, images, found, guess)]


def _moved(checkpoint: Checkpoint, images: str, found: Alignment, guess: Guess) -> str:
    return (
        f"{images}: the cameras are moved into the frame of {checkpoint.path} ({guess.frame.name}): renders have "
        f"{guess.psnr:.1f} dB there, {found.psnr:.1f} dB as given"
    )


def _other_frame(
    checkpoint: Checkpoint,
    views: Sequence[View],
    found: Alignment,
    images: str,
    console: Console,
    cameras: Sequence[Camera] = (),
) -> Guess | None:
    """Another frame that explains the photographs better, if there is one."""
    with console.status("poor match: trying other frames ..."):
        points = load_points(images, checkpoint.origin)
        return guess_frame(checkpoint.gaussians, views, found, points, cameras)


def mismatch(found: Alignment, guess: Guess | None) -> str:
    """The measurements, and a remedy."""
    share = f"{found.in_view:.2g}" if 0 < found.in_view < 0.01 else f"{found.in_view:.0%}"
    facts = f"{share} of its Gaussians are in view"
    if found.views:
        facts = (
            f"renders of {found.views} views have a PSNR of {found.psnr:.1f} dB against the photographs, the mean "
            f"colours of these {found.mean_colour_psnr:.1f} dB; {facts}"
        )
    if found.on_white:
        return (
            f"{facts}; over white the renders have {found.white_psnr:.1f} dB, but clod-adapt renders over black: give "
            "photographs with a transparent background (PNG; composited over black), or a checkpoint trained on black"
        )
    if guess:
        return f"{facts}; in another frame renders have {guess.psnr:.1f} dB: {guess.frame.description}"
    return f"{facts}; give the checkpoint of this scene, in the cameras' frame"
