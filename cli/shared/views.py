"""Views of a scene, selected by the names of their photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PureWindowsPath

from clod_adapter.cameras import Camera, Scene, View
from clod_adapter.errors import ClodError


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
