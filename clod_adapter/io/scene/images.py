"""Photographs as pinhole cameras have them: decoded to 8-bit RGB, undistorted (cached) and
scaled.
"""

import hashlib
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import PIL
import pycolmap
from PIL import Image, PngImagePlugin, UnidentifiedImageError

from clod_adapter._kernels.memory import release
from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.file_formats import read_bytes
from clod_adapter.io.scene.colmap import HUGE, PosedImage

# a change to a photograph, with {} for what differs between photographs, and that
Note = tuple[str, str]
# A pinhole camera's photograph: 8-bit RGB at the size that is used, ``[3, 3]`` the intrinsics, and
# the changes.
Photograph = tuple[Image.Image, np.ndarray, list[Note]]

# Pillow opens files by content, and starts another program for some (PostScript). JPEG includes the
# MPO of phones.
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP")
OTHERS = {
    b"ftyphei": "HEIC",
    b"ftypmif1": "HEIC",
    b"ftypavif": "AVIF",
    b"jP  ": "JPEG 2000",
    b"GIF8": "GIF",
    b"%!PS": "PostScript",
    b"%PDF": "PDF",
}  # by what is in their first 12 bytes, for the message

LARGE = 1 << 26  # pixels; a larger photograph is reduced first
REDUCED = f"have more than {LARGE / 1e6:.0f} million pixels, which takes long: reduced first"
Turn = Image.Transpose
# EXIF orientations that swap the sides
_TURNS = {5: Turn.TRANSPOSE, 6: Turn.ROTATE_270, 7: Turn.TRANSVERSE, 8: Turn.ROTATE_90}
# Tags of EXIF and TIFF.
_ORIENTATION = 0x0112
_BITS = 258
_PLANES = 284
SCALED = "scaled {} (Pillow bicubic, as in Inria's code)"
_ONE_LARGE = threading.Lock()  # of more than LARGE pixels one at a time
_KEY = "clod-adapter"  # of the text in a cached PNG


def read_image(
    path: Path, width: int, height: int, max_width: int
) -> tuple[Image.Image, list[Note]]:
    """The file as 8-bit RGB in the shape of its camera, and notes on the changes.

    16 bits per channel are reduced to 8, grey becomes RGB, transparency is composited over black.
    Colour profiles are not applied. The EXIF rotation is not either, as COLMAP does not, unless the
    photograph has its camera's shape only once it is turned: then the model was made from turned
    copies.

    A photograph of more than LARGE pixels is first reduced by an integer factor, to ``2 max_width``
    or more: a JPEG by its decoder, others by the mean over squares of pixels.

    Args:
        width, height: the camera's; the photograph may be of another size, but not of another
            shape.
        max_width: its final width at most.
    """
    notes: list[Note] = []
    with _opened(path) as source:
        size = source.size
        final_width = size[0]
        turn = None
        if not _same_shape(size, width, height):
            final_width = size[1]
            turn = _TURNS.get(source.getexif().get(_ORIENTATION, 1))
            if turn is None or not _same_shape(size, height, width):
                raise ClodError(
                    f"{path}: is {size[0]}x{size[1]}, its camera {width}x{height}, another shape;"
                    " give the images the model was made from"
                )
        factor = final_width // (2 * max_width) if size[0] * size[1] > LARGE else 1
        if factor > 1:
            source.draft(source.mode, (size[0] // factor, size[1] // factor))  # of JPEG alone
            factor = max(1, factor * source.width // size[0])
            notes.append((REDUCED, ""))
        pixels = _rgb(path, source, notes)
    if factor > 1:
        pixels = pixels.reduce(factor)
    if turn is not None:
        pixels = pixels.transpose(turn)
        notes.append(("rotated by their EXIF orientation, as the cameras are", ""))
    return pixels, notes


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, from the file's header."""
    with _opened(path) as source:
        return source.size


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    with rejected_if_damaged(path, "cannot be decoded"):
        try:
            with Image.open(path, formats=FORMATS) as source:
                yield source
        except UnidentifiedImageError as error:
            start = read_bytes(path, 12)
            names = [name for mark, name in OTHERS.items() if mark in start]
            kind = names[0] if names else f"damaged or none of {', '.join(FORMATS)}"
            raise ClodError(
                f"{path}: cannot be decoded, is {kind}; export it as JPEG or PNG"
            ) from error
        except Image.DecompressionBombError as error:
            raise ClodError(
                f"{path}: has more than the 178 million pixels that are read; scale it down"
            ) from error


def _same_shape(size: tuple[int, int], width: int, height: int) -> bool:
    # a scaled copy is rounded to whole pixels
    return abs(size[0] * height / (size[1] * width) - 1) <= 0.01


def _rgb(path: Path, source: Image.Image, notes: list[Note]) -> Image.Image:
    """The photograph in 8-bit RGB."""
    tags: dict[int, Any] = getattr(source, "tag_v2", {})  # a TIFF's
    # Pillow would take each byte for a pixel
    if tags.get(_PLANES) == 2 and max(tags.get(_BITS) or (8,)) > 8:
        raise ClodError(
            f"{path}: has more than 8 bits in planes of one colour each; convert it to 8 bits"
        )
    if source.mode.startswith("I;16") or (source.mode == "I" and source.format == "PNG"):
        # grey; 16-bit colour Pillow has brought to 8 bits itself
        values = np.asarray(source).astype(np.uint32)
        return Image.fromarray(((values + 128) // 257).astype(np.uint8)).convert("RGB")
    if source.mode in ("I", "F"):
        raise ClodError(
            f"{path}: has 32 bits per channel, whose range is not known; convert it to 8 bits"
        )
    if source.mode == "CMYK":
        notes.append(("are CMYK: brought to RGB without their colour profile", ""))
    if source.mode == "RGB" and "transparency" not in source.info:
        source.load()  # convert would copy it, a second photograph of full size in memory
        return source
    rgba = source.convert("RGBA")
    if rgba.getchannel("A").getextrema() != (255, 255):
        notes.append(("have transparency: laid over black", ""))
        rgba = Image.alpha_composite(Image.new("RGBA", rgba.size, (0, 0, 0, 255)), rgba)
    return rgba.convert("RGB")


def photograph(image: PosedImage, path: Path, max_width: int, cache: Path | None) -> Photograph:
    """The photograph of a pinhole camera, no wider than ``max_width``; an undistorted one is kept
    in ``cache``.

    There it is a PNG named by a hash of what it was made from, which a later run reads.
    """
    if cache is None or image.is_pinhole:
        return _made_pinhole(image, path, max_width)
    state = path.stat()
    camera = image.camera
    ingredients = (
        str(path.resolve()),
        state.st_size,
        state.st_mtime_ns,
        camera.model_name,
        camera.width,
        camera.height,
        camera.params.tolist(),
        max_width,
        pycolmap.__version__,
        PIL.__version__,
    )
    digest = hashlib.sha256(repr(ingredients).encode()).hexdigest()
    file = cache / f"{digest[:32]}.png"
    pixels: Image.Image | None = None
    # Absent, or damaged: Pillow raises many kinds.
    with suppress(Exception), Image.open(file, formats=["PNG"]) as source:
        about = json.loads(source.info[_KEY])
        K = np.array(about["K"])
        notes = [(change, detail) for change, detail in about["notes"]]
        pixels = source.convert("RGB")
    if pixels is None:
        pixels, K, notes = _made_pinhole(image, path, max_width)
        about = PngImagePlugin.PngInfo()
        about.add_text(_KEY, json.dumps({"K": K.tolist(), "notes": notes}))
        with atomic_path(file) as temporary:
            pixels.save(temporary, pnginfo=about, compress_level=1)
    lens = f"from {camera.model_name} into {cache}"
    notes.append(("undistorted {}, which may be deleted; the sources are untouched", lens))
    return pixels, K, notes


def _made_pinhole(image: PosedImage, path: Path, max_width: int) -> Photograph:
    width, height = image_size(path)
    large = width * height > LARGE
    with _ONE_LARGE if large else nullcontext():
        camera = copy(image.camera)
        pixels, notes = read_image(path, camera.width, camera.height, max_width)
        if pixels.size != (camera.width, camera.height):
            sizes = (
                f"{pixels.width}x{pixels.height} where the model has {camera.width}x{camera.height}"
            )
            notes.append(("are {}: intrinsics scaled", sizes))
            # With pixel centres at +0.5, in COLMAP as here, the principal point scales like the
            # focal length.
            camera.rescale(*pixels.size)
        if not image.is_pinhole:
            # As ``colmap image_undistorter`` by default: bilinear, the same focal length, and no
            # blank pixel.
            with rejected_if_damaged(
                path, "COLMAP cannot undistort it", "check its camera's parameters"
            ):
                bitmap = pycolmap.Bitmap.from_array(np.asarray(pixels))
                bitmap, camera = pycolmap.undistort_image(
                    pycolmap.UndistortCameraOptions(), bitmap, camera
                )
                pixels = Image.fromarray(bitmap.to_array())
        width, height = pixels.size
        if width > max_width:
            size = (max_width, max(1, int(height * max_width / width)))
            pixels = pixels.resize(size, Image.Resampling.BICUBIC)
            notes.append((SCALED, f"from {width}x{height} to {size[0]}x{size[1]}"))
        if large:
            release()  # or this thread keeps memory that the next one allocates again
    scale = np.array([[pixels.width / width], [pixels.height / height], [1.0]])
    K = scale * camera.calibration_matrix()
    if not 0 < min(K[0, 0], K[1, 1]) <= np.abs(K).max() < HUGE:
        raise ClodError(
            f"{path}: its camera is not usable once undistorted; check the camera's parameters"
        )
    return pixels, K, notes


def cache_folder(scene: Path) -> Path:
    """The folder of a scene's undistorted photographs in ``$XDG_CACHE_HOME`` or ``~/.cache``;
    created if missing.
    """
    try:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = caches / "clod-adapter" / "undistorted" / scene.resolve().name
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(13, "Permission denied")
    except RuntimeError as error:
        raise ClodError(
            "no home folder to keep undistorted photographs in; set XDG_CACHE_HOME to a folder"
        ) from error
    except OSError as error:
        raise ClodError(
            f"{folder}: undistorted photographs cannot be kept there ({error.strerror or error});"
            " set XDG_CACHE_HOME to a folder that can be written to"
        ) from error
    return folder
