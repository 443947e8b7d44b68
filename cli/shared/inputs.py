"""What commands read: checkpoints, scenes in their frame, and the device; and the kernels compiled
for them.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path, PureWindowsPath

import torch
from numba.core.event import Event, Listener, install_listener

from clod_adapter import (
    AdaptConfig,
    Camera,
    Checkpoint,
    ClodError,
    Gaussians,
    Phase,
    Scene,
    ScreenFilter,
    Stopped,
    View,
    adapt,
    evaluate,
    load,
    load_scene,
)
from clod_adapter._support.text import first_line
from clod_adapter.alignment.align import WORDS, align, compare_frames, detect_filter
from clod_adapter.alignment.check import MOST_VIEWS
from clod_adapter.alignment.search import camera_in
from clod_adapter.cameras import with_near_planes
from clod_adapter.config import CLASSIC, FILTERS
from clod_adapter.io.scene.load import load_cameras
from clod_adapter.io.values import Activated
from clod_adapter.origin import Origin
from clod_adapter.rasterizers.cuda import unusable

from .console import Console
from .outputs import Report, size

CPU = torch.device("cpu")


def read_checkpoint(
    path: str,
    console: Console,
    activated: Activated | None = None,
    origin: Origin | None = None,
    device: torch.device = CPU,
) -> Checkpoint:
    with console.status(f"reading {path} ({size(Path(path))}) ..."):
        checkpoint = load(path, activated=activated, origin=origin)
    gaussians = checkpoint.gaussians
    drawn = gaussians.screen_filter
    more = "" if drawn == CLASSIC else f", drawn with {drawn.description}"
    console.say(f"{path}: Gaussians: {gaussians.summary}{more}")
    console.note(*checkpoint.notes, of=path)
    return replace(checkpoint, gaussians=gaussians.to(device))


def read_model(
    args: argparse.Namespace,
    path: str,
    console: Console,
    origin: Origin | None = None,
    device: torch.device = CPU,
) -> Checkpoint:
    """The checkpoint as the options for reading say, without photographs to compare with."""
    return with_filter(
        read_checkpoint(path, console, args.activated, origin, device), args, console
    )


def read_scene(folder: str, console: Console, origin: Origin) -> Scene:
    with console.meter(Phase.PHOTOGRAPHS) as meter:
        scene = load_scene(folder, origin=origin, progress=meter)
    camera = scene.train[0].camera
    size = f"{camera.width}x{camera.height}"
    console.say(
        f"{folder}: {len(scene.train)} photographs to train on, {len(scene.test)} held out, {size}"
    )
    console.note(*scene.notes)
    return scene


def read_inputs(
    args: argparse.Namespace,
    paths: Sequence[str],
    console: Console,
    *,
    held_out: bool = True,
    training: bool = False,
    required: bool = False,
) -> tuple[list[Checkpoint], Scene]:
    """Checkpoints, with their screen-space filters, and photographs, in the frame and origin of the
    first one.
    """
    device, found = pick_device(args.device, console), list[Checkpoint]()
    for path in paths:
        origin = found[0].origin if found else None
        found.append(read_checkpoint(path, console, args.activated, origin, device))
    scene = read_scene(args.images, console, found[0].origin)
    if held_out and not scene.test:
        raise ClodError(
            f"{args.images}: there are no held-out photographs to evaluate on; give at least two"
        )
    prepare_kernels(console, device, training=training)
    scene, _ = align_shown(found[0], scene, console, required=required)
    return [with_filter(each, args, console, [*scene.test, *scene.train]) for each in found], scene


def pick_device(name: str, console: Console) -> torch.device:
    """The device of ``--device``; prints why a GPU is not used. Without one that works, cuda is an
    error.
    """
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return CPU
    reason = no_gpu()
    if reason is None:
        device = torch.device("cuda", torch.cuda.current_device())
        console.say(f"on {torch.cuda.get_device_name(device)}")
        return device
    if name == "cuda":
        raise ClodError(f"--device cuda: {reason}; or use --device cpu")
    console.say(f"on the CPU, although there is a GPU: {reason}")
    return CPU


def no_gpu() -> str | None:
    """Why no GPU backend works, None if one does. The first call may compile gsplat for minutes."""
    if not torch.cuda.is_available():
        if torch.version.cuda is None:
            return (
                f"torch {torch.__version__} is built without CUDA: install torch from"
                " https://pytorch.org for your CUDA"
            )
        return (
            "torch finds no NVIDIA GPU; check with nvidia-smi that there is one and that its driver"
            " is new enough"
        )
    try:
        torch.ones(1, device="cuda").add_(1).item()
    except (RuntimeError, AssertionError) as error:  # not supported by this torch, or in use
        return f"torch cannot compute on it ({first_line(error)}); clod-adapt doctor prints a fix"
    return unusable()


def with_filter(
    checkpoint: Checkpoint, args: argparse.Namespace, console: Console, views: Sequence[View] = ()
) -> Checkpoint:
    """The checkpoint with the screen-space filter of ``--antialiasing``; with ``auto`` that of
    ``detect_filter``.
    """
    gaussians, name = checkpoint.gaussians, args.antialiasing
    if name == "auto":
        with console.status("comparing screen-space filters with the photographs ..."):
            return detect_filter(checkpoint, views, console.note)
    stored = gaussians.screen_filter
    if checkpoint.filter_known and FILTERS[name] != stored:
        console.note(
            f"{checkpoint.path}: rendered {WORDS[name]} (--antialiasing); the file has"
            f" {stored.description}"
        )
    return replace(checkpoint, gaussians=gaussians.replace(screen_filter=FILTERS[name]))


def pick_views(scene: Scene, wanted: Sequence[str]) -> list[View]:
    """The held-out views, all views, or those named, in the scene's order."""
    views = sorted([*scene.train, *scene.test], key=lambda view: view.camera.name)
    if list(wanted) == ["all"]:
        return views
    if list(wanted) == ["held-out"]:
        return list(scene.test or scene.train)  # a single photograph is not held out
    cameras = [view.camera for view in views]
    chosen = set[str]()
    for name in wanted:
        chosen.update(camera.name for camera in named(cameras, name, "--views"))
    return [view for view in views if view.camera.name in chosen]


def named(cameras: Sequence[Camera], name: str, option: str) -> list[Camera]:
    """The cameras whose photograph has this name; if none has, without its suffix, its folder, or
    both.
    """
    if found := [camera for camera in cameras if camera.name == name]:
        return found
    for camera in cameras:
        path = PureWindowsPath(camera.name)
        if name in (str(Path(camera.name).with_suffix("")), path.name, path.stem):
            found.append(camera)
    if found:
        return found
    some = ", ".join(camera.name for camera in cameras[:3])
    raise ClodError(f"{option}: no photograph is named {name!r}; names are like {some}")


def prepare_kernels(
    console: Console,
    device: torch.device = CPU,
    *,
    training: bool = True,
    screen_filter: ScreenFilter = CLASSIC,
) -> None:
    """Evaluates, and with ``training`` adapts, a scene of one Gaussian, so that all kernels are
    compiled.
    """
    one = Gaussians(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.ones(1, 4),
        torch.zeros(1, 3),
        torch.zeros(1),
        torch.zeros(1, 1, 3),
        torch.zeros(1, 3, 3),
        screen_filter=screen_filter,
    ).to(device)
    view = View(Camera(torch.eye(4), torch.eye(3), 4, 4), torch.zeros(4, 4, 3, dtype=torch.uint8))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # after a Ctrl-C in one, each of several would compile on its own
    try:
        with install_listener("numba:compile", _Compiling(console)):
            evaluate(one, [view], [1.0])
            if (
                training
                and adapt(one, Scene((view,), ()), AdaptConfig(iters=1), progress=False).interrupted
            ):
                raise Stopped("stopped while the kernels were compiled")
    finally:
        torch.set_num_threads(threads)


class _Compiling(Listener):  # type: ignore[misc]
    """Says once that something is compiled."""

    def __init__(self, console: Console) -> None:
        self.say_once = cache(console.say)

    def on_start(self, event: Event) -> None:
        self.say_once(
            "compiling kernels (first run only, or without a writable NUMBA_CACHE_DIR) ..."
        )

    def on_end(self, event: Event) -> None:
        pass


SMALL = 320  # pixels, width of photographs that only tell the frame


def align_shown(
    checkpoint: Checkpoint, scene: Scene, console: Console, *, required: bool
) -> tuple[Scene, Report]:
    """``align``, with a status line on a terminal."""
    with console.status("comparing the checkpoint with the photographs ..."):
        return align(checkpoint, scene, console.note, required=required)


def read_cameras(
    model: Checkpoint, images: str, console: Console, *, training: bool = False
) -> list[Camera]:
    """``load_cameras``, moved into the model's frame, which few small photographs tell."""
    every, notes = load_cameras(images, model.origin)
    cameras = load_cameras(images, model.origin, training=True)[0] if training else every
    console.note(*notes)
    try:
        scene = load_scene(images, origin=model.origin, max_width=SMALL, most=MOST_VIEWS)
    except ClodError:  # cameras alone will do
        return cameras
    prepare_kernels(console, model.gaussians.means.device, training=False)
    with console.status("comparing the checkpoint with the photographs ..."):
        _, guess = compare_frames(model, scene, console.note, every)
    if not (guess and guess.clear):
        return cameras
    return with_near_planes([camera_in(camera, guess.frame) for camera in cameras])
