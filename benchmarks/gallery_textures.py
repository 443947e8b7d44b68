"""Textures for the demo, linear float32 ``[h, w, 3]`` with sides that are powers of two.

The photographs are those in scikit-image's wheel, without a download; other textures are computed.
"""

from __future__ import annotations

from importlib import resources

from gallery_raytrace import decode_srgb

import numpy as np
from PIL import Image, ImageOps

SIDE = 512
Colour = tuple[int, int, int]  # sRGB, 0..255


def photograph(name: str) -> Image.Image:
    """One of scikit-image's bundled photographs, as RGB."""
    with resources.as_file(resources.files("skimage") / "data" / name) as path:
        return Image.open(path).convert("RGB")


def linear(image: Image.Image) -> np.ndarray:
    """An image resized to a square texture."""
    return decode_srgb(np.asarray(image.convert("RGB").resize((SIDE, SIDE), Image.Resampling.LANCZOS)))


def framed(name: str, size: tuple[float, float], frame: Colour, mat: float = 0.09, rim: float = 0.035) -> np.ndarray:
    """A photograph behind a mat in a bevelled frame, for a panel of `size` metres; `mat` and `rim` are in metres too.

    The photograph is cropped to the opening of the mat, not distorted.
    """
    scale = 2 * SIDE / max(size)
    width, height = (round(x * scale) for x in size)
    picture = Image.new("RGB", (width, height), frame)
    half = round(rim * scale / 2)
    # the inner half of the frame is shaded
    picture.paste(shaded(frame, 0.6), (half, half, width - half, height - half))
    picture.paste((240, 236, 226), (2 * half, 2 * half, width - 2 * half, height - 2 * half))
    edge = round((rim + mat) * scale)
    picture.paste((150, 144, 132), (edge - 3, edge - 3, width - edge + 3, height - edge + 3))
    opening = (width - 2 * edge, height - 2 * edge)
    picture.paste(ImageOps.fit(photograph(name), opening, Image.Resampling.LANCZOS), (edge, edge))
    return linear(picture)


def shaded(colour: Colour, factor: float) -> Colour:
    """The colour with each sRGB value multiplied."""
    r, g, b = (min(round(c * factor), 255) for c in colour)
    return r, g, b


def brickwork(dark: Colour, light: Colour) -> np.ndarray:
    """The photograph of a brick wall, rotated and with its perspective corrected."""
    image = photograph("brick.png").rotate(90)
    rows_meet_left = (0, 62, 0, 454, 512, 512, 512, 0)
    square = image.transform((SIDE, SIDE), Image.Transform.QUAD, rows_meet_left, Image.Resampling.BICUBIC)
    return toned(square, dark, light)


def toned(image: Image.Image, dark: Colour, light: Colour) -> np.ndarray:
    """A photograph's brightness as a material: its 2nd to 98th percentile maps to `dark` to `light`."""
    grey = np.asarray(image.convert("L").resize((SIDE, SIDE), Image.Resampling.LANCZOS), np.float32)
    low, high = np.percentile(grey, [2, 98])
    return mixed(dark, light, np.clip((grey - low) / (high - low), 0, 1))


def mixed(dark: Colour, light: Colour, share: np.ndarray) -> np.ndarray:
    """Linear colours between two sRGB colours, mixed in sRGB by `share` ``[h, w]``."""
    mixed = np.array(dark) + share[..., None] * (np.array(light) - np.array(dark))
    return decode_srgb(np.clip(mixed, 0, 255))


def plain(colour: Colour) -> np.ndarray:
    """One colour."""
    return mixed(colour, colour, np.zeros((2, 2)))


def plaster(colour: Colour, contrast: float, seed: int, side: int = 256) -> np.ndarray:
    """A painted wall: noise of four octaves around `colour` with relative `contrast`."""
    random = np.random.default_rng(seed)
    clouds = np.zeros((side, side))
    for octave in range(4):
        n = 6 * 2**octave
        noise = Image.fromarray(random.normal(size=(n, n)).astype(np.float32))
        clouds += np.asarray(noise.resize((side, side), Image.Resampling.BICUBIC)) / 2**octave
    return mixed(shaded(colour, 1 - contrast), shaded(colour, 1 + contrast), 0.5 + clouds / 4)


def planks(dark: Colour, light: Colour, rows: int = 12, seed: int = 3) -> np.ndarray:
    """Floor boards along v with varying tone, grain and thin dark joints."""
    random = np.random.default_rng(seed)
    grain = Image.fromarray(random.normal(size=(24, 256)).astype(np.float32))
    tone = 0.12 * np.asarray(grain.resize((SIDE, SIDE), Image.Resampling.BICUBIC))
    x, y = np.meshgrid(np.arange(SIDE) / SIDE * rows, np.arange(SIDE) / SIDE)
    board = x.astype(int)
    ends = random.random(rows)[board]
    second = ((y - ends) % 1 > 0.5).astype(int)
    tone = 0.5 + tone + random.uniform(-0.4, 0.4, (rows, 2))[board, second]
    joint = (x % 1 < 0.05) | ((y - ends) % 0.5 < 0.006)
    return mixed(dark, light, np.where(joint, -0.6, np.clip(tone, -0.2, 1.2)))


def chequers(columns: int, rows: int, one: Colour, other: Colour) -> np.ndarray:
    """A chequerboard with soft-edged squares."""
    y, x = np.mgrid[0.5:SIDE, 0.5:SIDE] / SIDE
    wave = np.sin(np.pi * columns * x) * np.sin(np.pi * rows * y)
    return mixed(one, other, np.clip(0.5 + 12 * wave, 0, 1))
