"""Reading checkpoints and scenes, with messages on their contents."""

from __future__ import annotations

from pathlib import Path

from clod_adapter.cameras import Scene
from clod_adapter.config import CLASSIC, AdaptConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint, load
from clod_adapter.io.ply.columns import dial_columns
from clod_adapter.io.ply.values import Activated
from clod_adapter.io.scene.load import ImageCache, load_scene
from clod_adapter.origin import Origin
from clod_adapter.progress import Phase
from clod_adapter.training.camera_placement import place_cameras
from clod_adapter.training.pseudo_views import LIGHTEST, STEPS_PER_PLACED, add_pseudo_views, render_pseudo_views

from .console import Console
from .files import size


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
