"""Undistorts photographs to those of pinhole cameras, and caches the results."""

import hashlib
import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import PIL
import pycolmap
from PIL import Image, PngImagePlugin

from clod_adapter.errors import ClodError, refused_if_damaged
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.scene.colmap import PosedImage
from clod_adapter.io.scene.images import Photograph

_KEY = "clod-adapter"  # of the text in a cached PNG


def undistort(path: Path, pixels: Image.Image, camera: pycolmap.Camera) -> tuple[Image.Image, pycolmap.Camera]:
    """As ``colmap image_undistorter`` by default: bilinear, the same focal length, cropped to have no blank pixel."""
    with refused_if_damaged(path, "COLMAP cannot undistort it", "check its camera's parameters"):
        bitmap, pinhole = pycolmap.undistort_image(
            pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(np.asarray(pixels)), camera
        )
    return Image.fromarray(bitmap.to_array()), pinhole


def cache_folder(scene: Path) -> Path:
    """The folder of a scene's undistorted photographs in ``$XDG_CACHE_HOME`` or ``~/.cache``; created if missing."""
    try:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError as error:
        raise ClodError("no home folder to keep undistorted photographs in; set XDG_CACHE_HOME to a folder") from error
    folder = caches / "clod-adapter" / "undistorted" / scene.resolve().name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        raise ClodError(
            f"{folder}: undistorted photographs cannot be kept there ({error.strerror or error}); set XDG_CACHE_HOME "
            "to a folder that can be written to"
        ) from error
    return folder


def kept(folder: Path, image: PosedImage, path: Path, max_width: int, make: Callable[[], Photograph]) -> Photograph:
    """The result of ``make``, from ``folder`` where an earlier run cached it: a PNG named by a hash of its inputs."""
    state, camera = path.stat(), image.camera
    made_of = (
        str(path.resolve()), state.st_size, state.st_mtime_ns, camera.model_name, camera.width, camera.height,
        camera.params.tolist(), max_width, pycolmap.__version__, PIL.__version__,
    )  # fmt: skip
    file = folder / f"{hashlib.sha256(repr(made_of).encode()).hexdigest()[:32]}.png"
    # Absent, or damaged: Pillow raises many kinds.
    with suppress(Exception), Image.open(file, formats=["PNG"]) as source:
        about = json.loads(source.info[_KEY])
        notes = [(what, each) for what, each in about["notes"]]
        return Photograph(source.convert("RGB"), np.array(about["K"]), notes)
    photograph = make()
    about = PngImagePlugin.PngInfo()
    values = {"K": photograph.K.tolist(), "notes": photograph.notes}
    about.add_text(_KEY, json.dumps(values))
    with atomic_path(file) as temporary:
        photograph.pixels.save(temporary, pnginfo=about, compress_level=1)
    return photograph
