"""Photographs as people have them, decoded to 8-bit RGB."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from clod_adapter.errors import ClodError

Note = tuple[str, str]
"""What was done to a photograph, with {} for what differs between photographs, and that: a size, say."""


class Photograph(NamedTuple):
    """A photograph as a pinhole camera has it.

    Attributes:
        pixels: 8-bit RGB, at the size that is used.
        K: ``[3, 3]`` the intrinsics of that camera.
        source: width and height in the file.
        notes: on what it took.
    """

    pixels: Image.Image
    K: np.ndarray
    source: tuple[int, int]
    notes: list[Note]


TRANSPARENT: Note = ("have transparency: laid over black", "")

_TURNS = {
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # what an EXIF orientation that swaps width and height asks for
_ORIENTATION, _BITS, _PLANES = 0x0112, 258, 284  # tags of EXIF and TIFF


def read_image(path: Path, width: int, height: int) -> tuple[Image.Image, list[Note]]:
    """The file as 8-bit RGB in the shape of its camera, and notes on what that took.

    16 bits per channel are brought to 8, grey becomes RGB, transparency is laid over black. Colour profiles are not
    applied. The EXIF rotation is not either, as COLMAP does not, unless the photograph has its camera's shape only
    once it is turned: then the model was made from turned copies.

    Args:
        width, height: the camera's; the photograph may be of another size, but not of another shape.

    Raises:
        ClodError: the file cannot be decoded, has too many pixels, or another shape than the camera.
    """
    notes: list[Note] = []
    with _opened(path) as source:
        turned = _same_shape(source.size, height, width) and not _same_shape(source.size, width, height)
        turn = _TURNS.get(source.getexif().get(_ORIENTATION, 1)) if turned else None
        pixels = _rgb(path, source, notes)
    if turn is not None:
        pixels = pixels.transpose(turn)
        notes.append(("turned as their EXIF says, as the cameras have the turned shape", ""))
    if not _same_shape(pixels.size, width, height):
        raise ClodError(
            f"{path}: is {pixels.width}x{pixels.height}, its camera {width}x{height}, another shape; "
            "give the images the model was made from"
        )
    return pixels, notes


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, from the file's header; raises ClodError where that cannot be read."""
    with _opened(path) as source:
        return source.size


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        with Image.open(path) as source:
            yield source
    except (ClodError, MemoryError):
        raise
    except UnidentifiedImageError as error:
        raise ClodError(
            f"{path}: cannot be decoded, is damaged or no known format; export it as JPEG or PNG"
        ) from error
    except Image.DecompressionBombError as error:
        raise ClodError(f"{path}: has more than the 178 million pixels that are read; scale it down") from error
    except Exception as error:  # Pillow raises many kinds, some of its own, on damaged files
        raise ClodError(f"{path}: cannot be decoded ({error}); copy or export it again") from error


def _same_shape(size: tuple[int, int], width: int, height: int) -> bool:
    return abs(size[0] * height / (size[1] * width) - 1) <= 0.01  # a scaled copy is rounded to whole pixels


def _rgb(path: Path, source: Image.Image, notes: list[Note]) -> Image.Image:
    tags: dict[int, Any] = getattr(source, "tag_v2", {})  # a TIFF's
    if tags.get(_PLANES) == 2 and max(tags.get(_BITS) or (8,)) > 8:  # Pillow would take each byte for a pixel
        raise ClodError(f"{path}: has more than 8 bits in planes of one colour each; convert it to 8 bits")
    if source.mode.startswith("I;16") or (source.mode == "I" and source.format == "PNG"):
        deep = np.asarray(source).astype(np.uint32)  # grey; 16-bit colour Pillow has brought to 8 bits itself
        return Image.fromarray(((deep + 128) // 257).astype(np.uint8)).convert("RGB")
    if source.mode in ("I", "F"):
        raise ClodError(f"{path}: has 32 bits per channel, whose range is not known; convert it to 8 bits")
    if source.mode == "CMYK":
        notes.append(("are CMYK: brought to RGB without their colour profile", ""))
    if "A" not in source.getbands() and "transparency" not in source.info:
        if source.mode != "RGB":
            return source.convert("RGB")
        source.load()  # convert would copy it, a second photograph of full size in memory
        return source
    rgba = source.convert("RGBA")
    if rgba.getchannel("A").getextrema() == (255, 255):
        return rgba.convert("RGB")
    notes.append(TRANSPARENT)
    return Image.alpha_composite(Image.new("RGBA", rgba.size, (0, 0, 0, 255)), rgba).convert("RGB")
