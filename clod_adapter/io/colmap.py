"""Scenes in COLMAP layout: posed photographs in, and models out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PureWindowsPath

import numpy as np
import pycolmap
import torch
from PIL import Image

from clod_adapter.cameras import Camera, Scene, View, in_its_unit
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.colmap_folder import find_model
from clod_adapter.io.colmap_model import PosedImage, read_model

DEEP_MODES = ("I", "F")  # Pillow's modes of more than 8 bits begin with these; it would clip, not scale, them


def load_scene(
    folder: str | Path,
    *,
    test_every: int = 8,
    max_width: int = 1600,
    progress: Callable[[int, int], None] | None = None,
) -> Scene:
    """Reads posed photographs: a COLMAP model (binary or text, any version) and its images.

    The model is looked for in ``sparse/0``, ``sparse`` and ``folder``, the images in ``images`` and
    ``folder``, then beside the model and its parent. Views are sorted by image name; the 0th, 8th,
    16th... are held out, as Inria's code does (``llffhold``). A single image is for training.

    Args:
        folder: usually the one with ``images/`` and ``sparse/0/``.
        test_every: one view in this many is held out; at least 2.
        max_width: wider images are scaled down to this many pixels, with Pillow's bicubic filter as
            in Inria's code; the intrinsics follow, and a note says so.
        progress: called with (images loaded, images in all).

    Raises:
        ClodError: no usable model, a camera with distortion, or images that are missing, damaged, of
            another shape than their camera, or named outside the images folder.
    """
    if test_every < 2 or max_width < 1:
        raise ClodError(f"test_every is {test_every}, max_width {max_width}; they must be at least 2 and 1")
    folder = Path(folder)
    model = find_model(folder)
    images, notes = read_model(model)
    paths = _find_images(folder, model, images)
    with ThreadPoolExecutor(2) as pool:
        loaded = []
        for view_and_notes in pool.map(lambda image, path: _load_view(image, path, max_width), images, paths):
            loaded.append(view_and_notes)
            if progress:
                progress(len(loaded), len(images))
    views = [view for view, _ in loaded]
    for note, count in Counter(note for _, remarks in loaded for note in remarks).items():
        notes.append(f"{count} of {len(views)} images {note}")
    held_out = {i for i in range(len(views)) if i % test_every == 0} if len(views) > 1 else set()
    train = tuple(view for i, view in enumerate(views) if i not in held_out)
    return in_its_unit(Scene(train, tuple(views[i] for i in sorted(held_out)), tuple(notes)))


def write_model(
    folder: str | Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    points: np.ndarray | None = None,
    colors: np.ndarray | None = None,
) -> None:
    """Writes a binary COLMAP model to ``folder/sparse/0``, which must not exist or be empty.

    Args:
        folder: an existing folder.
        cameras: one per image; those with the same intrinsics and size share a PINHOLE camera.
        names: the images' names under ``folder/images``.
        points: ``[M, 3]`` positions for points3D, world units; without them it is empty.
        colors: ``[M, 3]`` uint8 RGB of the points, which are black without.

    Raises:
        ClodError: names and cameras differ in number, or the model cannot be written there.
    """
    if len(names) != len(cameras) or len(set(names)) != len(names):
        raise ClodError(f"{folder}: {len(cameras)} cameras need as many different names, {len(set(names))} were given")
    reconstruction = pycolmap.Reconstruction()
    ids: dict[tuple[float, ...], int] = {}
    for image_id, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
        K = camera.K.double().cpu()
        params = (K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item())
        key = (camera.width, camera.height, *params)
        if key not in ids:
            ids[key] = len(ids) + 1
            size = {"width": camera.width, "height": camera.height}
            pinhole = pycolmap.Camera(model="PINHOLE", params=params, camera_id=ids[key], **size)
            reconstruction.add_camera_with_trivial_rig(pinhole)
        image = pycolmap.Image(name=name, camera_id=ids[key], image_id=image_id)
        pose = pycolmap.Rigid3d(camera.viewmat[:3].double().cpu().numpy())
        reconstruction.add_image_with_trivial_frame(image, pose)
    xyz = np.zeros((0, 3)) if points is None else np.asarray(points, np.float64)
    rgb = np.zeros(xyz.shape, np.uint8) if colors is None else np.asarray(colors, np.uint8)
    for position, color in zip(xyz, rgb, strict=True):
        reconstruction.add_point3D(position, pycolmap.Track(), color)
    target = Path(folder) / "sparse" / "0"
    if Path(folder).is_dir():
        target.parent.mkdir(exist_ok=True)
    with atomic_path(target) as temporary:
        temporary.mkdir()
        reconstruction.write_binary(str(temporary))


def _find_images(folder: Path, model: Path, images: Sequence[PosedImage]) -> list[Path]:
    """The image files, from the candidate folder that has most of them."""
    parts = []
    for image in images:
        name = PureWindowsPath(image.name)  # splits at / and at the \ of models made on Windows
        if not name.parts or name.anchor or ".." in name.parts:
            raise ClodError(f"{model}: image name {image.name!r} leaves the images folder; rename it in the model")
        parts.append(name.parts)
    roots = [folder / "images", folder, model.parent / "images", model.parent.parent / "images"]
    found = [[root.joinpath(*name) for name in parts] for root in roots]
    missing = [[path for path in paths if not path.is_file()] for paths in found]
    best = min(range(len(roots)), key=lambda i: len(missing[i]))
    if missing[best]:
        first = ", ".join(str(path.relative_to(roots[best])) for path in missing[best][:3])
        raise ClodError(
            f"{roots[best]}: {len(missing[best])} of {len(images)} images of the model are missing ({first}"
            f"{', ...' if len(missing[best]) > 3 else ''}); put them there under these names"
        )
    return found[best]


def _load_view(image: PosedImage, path: Path, max_width: int) -> tuple[View, list[str]]:
    pixels, notes = _decode(path)
    width, height = pixels.size
    if abs(width * image.height / (height * image.width) - 1) > 0.01:
        raise ClodError(
            f"{path}: is {width}x{height}, its camera {image.width}x{image.height}, another shape; "
            "give the images the model was made from"
        )
    if (width, height) != (image.width, image.height):
        notes.append(f"are {width}x{height} where the model says {image.width}x{image.height}: intrinsics scaled")
    if width > max_width:
        size = (max_width, max(1, int(height * max_width / width)))
        pixels = pixels.resize(size, Image.Resampling.BICUBIC)
        notes.append(f"scaled from {width}x{height} to {size[0]}x{size[1]} (Pillow bicubic, as in Inria's code)")
    # With pixel centres at +0.5, in COLMAP as here, the principal point scales like the focal length.
    scale = np.array([[pixels.width / image.width], [pixels.height / image.height], [1.0]])
    K = torch.from_numpy(scale * image.K).float()
    camera = Camera(torch.from_numpy(image.viewmat).float(), K, pixels.width, pixels.height, image.name)
    return View(camera, torch.from_numpy(np.array(pixels))), notes


def _decode(path: Path) -> tuple[Image.Image, list[str]]:
    """The file as RGB, and notes on what that took. EXIF rotation is not applied, as COLMAP does not."""
    try:
        with Image.open(path) as source:
            if source.mode.startswith(DEEP_MODES):
                raise ClodError(f"{path}: has more than 8 bits per channel; convert it to 8-bit sRGB")
            if "A" in source.getbands() or "transparency" in source.info:
                rgba = source.convert("RGBA")
                black = Image.new("RGBA", rgba.size, (0, 0, 0, 255))
                return Image.alpha_composite(black, rgba).convert("RGB"), ["have transparency: laid over black"]
            return source.convert("RGB"), []
    except ClodError:
        raise
    except Exception as error:  # Pillow raises many kinds, some of its own, on damaged files
        raise ClodError(f"{path}: cannot be decoded ({error}); copy or export it again") from error
