"""Reads posed photographs, or their cameras alone, from a COLMAP model or a transforms file."""

import warnings
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from clod_adapter._support.workers import in_order
from clod_adapter.cameras import Camera, Scene, View, in_its_unit, spread, with_near_planes
from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap import TEST_EVERY, PosedImage, held_out, read_colmap
from clod_adapter.io.scene.folder import find_cameras, find_photographs, models_in
from clod_adapter.io.scene.images import REDUCED, SCALED, Note, cache_folder, photograph
from clod_adapter.io.scene.transforms import in_trained_frame, read_transforms
from clod_adapter.origin import NOWHERE
from clod_adapter.progress import Listener, Phase, tell

MOST_AT_ONCE = 8  # photographs of full size in memory
Load = Callable[[], tuple[View, list[Note]]]


@torch.inference_mode(False)  # training takes no inference tensors
def load_scene(
    folder: str | Path,
    *,
    test_every: int = TEST_EVERY,
    max_width: int = 1600,
    most: int | None = None,
    origin: Sequence[float] = NOWHERE,
    progress: Listener | None = None,
) -> Scene:
    """Reads posed photographs: a COLMAP model (binary or text, any version) or a transforms.json,
    and its images.

    A model is looked for in ``sparse/0``, ``sparse`` and ``folder``, and is taken where there is a
    ``transforms.json`` (nerfstudio, instant-ngp, Blender's synthetic scenes) too. A model's images
    are looked for in ``images`` and ``folder``, then beside the model and its parent, then in
    ``images_2``, ``images_4``, ``images_8`` and, for distorted cameras, ``input``. What was done to
    the photographs is in the scene's notes.

    Where the folder has nerfstudio's ``dataparser_transforms.json``, the cameras are brought into
    the frame that it trained in, in which it exports its splats (``dataparser``).

    Views are sorted by image name; of those that the scene lists, present or not, the 0th, 8th,
    16th... are held out, as Inria's code does (``llffhold``). A single image is for training. With
    ``transforms_train.json`` and ``transforms_test.json`` those of the latter are held out instead.

    Photographs of a distorted camera are undistorted by COLMAP into the user's cache folder, where
    a later run finds them. A photograph of another size than its camera has that camera's
    intrinsics, scaled.

    Args:
        folder: usually the one with ``images/`` and ``sparse/0/``.
        test_every: one view in this many is held out; at least 2.
        max_width: wider images are scaled down to this many pixels, with Pillow's bicubic filter as
            in Inria's code; the intrinsics are scaled too, and a note states it.
        most: reads at most so many photographs, evenly spread.
        origin: ``[3]`` what the cameras' world is to be relative to, in its units:
            ``Checkpoint.origin``.
        progress: called in ``Phase.PHOTOGRAPHS`` after each image.

    Raises:
        ClodError: no usable cameras; images that are damaged, of another shape than their camera,
            or named outside their folder; more than half of them missing, or all that are for
            training.
    """
    if test_every < 2 or max_width < 1:
        raise ClodError(
            f"test_every is {test_every}, max_width {max_width}; they must be at least 2 and 1"
        )
    folder = Path(folder)
    cameras, images, notes = _posed(folder)
    if not cameras.is_file() and (folder / "transforms.json").is_file():
        notes.append("the cameras are the COLMAP model's, not those of transforms.json")
    names = [image.name for image in images]
    distorted = not all(image.is_pinhole for image in images)
    paths, file_notes = find_photographs(folder, cameras, names, raw=distorted)
    notes += file_notes
    present = [(image, path) for image, path in zip(images, paths, strict=True) if path is not None]
    testing = held_out(images, test_every)
    if not any(image.name not in testing for image, _ in present):
        raise ClodError(
            f"{folder}: has no photograph to train on, as all that are there are held out; add more"
        )
    chosen = spread(present, most or len(present))
    pinholes = all(image.is_pinhole for image, _ in chosen)
    undistorted = None if pinholes else cache_folder(folder)
    loads = [
        partial(_load_view, image.relative_to(origin), path, undistorted, max_width)
        for image, path in chosen
    ]
    views, done = _load(loads, progress)
    train = tuple(view for view in views if view.camera.name not in testing)
    test = tuple(view for view in views if view.camera.name in testing)
    left_out: list[tuple[str, str]] = []
    if pinholes:
        left_out.append(("undistortion", f"all {len(views)} cameras are pinholes"))
    if not any(change in (REDUCED, SCALED) for change, _ in done):
        left_out.append(("scaling", f"all {len(views)} photographs are used at full resolution"))
    return in_its_unit(
        Scene(train, test, (*notes, *_summary(done, len(views))), tuple(left_out), folder)
    )


def load_cameras(
    folder: str | Path, origin: Sequence[float] = NOWHERE, *, training: bool = False
) -> tuple[list[Camera], list[str]]:
    """The cameras that ``load_scene`` would give photographs to, sorted by name, and notes.

    A distorted one is the pinhole of the same focal length and centre. With ``training`` without
    those held out. Of a transforms.json without sizes, cameras whose photograph is missing too are
    left out.
    """
    folder = Path(folder)
    source, images, notes = _posed(folder)
    testing = held_out(images, TEST_EVERY) if training else set()
    cameras = []
    for image in images:
        lens = image.camera
        if min(lens.width, lens.height) > 1:
            posed = image.relative_to(origin)
            cameras.append(_pinhole(posed, lens.calibration_matrix(), lens.width, lens.height))
    if unsized := len(images) - len(cameras):
        notes.append(
            f"{unsized} of {len(images)} cameras left out: neither {source.name} nor a photograph"
            " has a size"
        )
    if not cameras:
        raise ClodError(
            f"{source}: has no size of a photograph, and none is there; put them beside it, or w"
            " and h in it"
        )
    return [camera for camera in with_near_planes(cameras) if camera.name not in testing], notes


def _posed(folder: Path) -> tuple[Path, list[PosedImage], list[str]]:
    """The model or transforms file, its images, and notes."""
    cameras = find_cameras(folder)
    reader = read_transforms if cameras.is_file() else read_colmap
    images, notes = reader(cameras)
    if cameras.is_dir() and cameras != folder:
        notes += _other_models(cameras)
    images, frame_notes = in_trained_frame(folder, cameras, images)
    return cameras, images, notes + frame_notes


def _other_models(model: Path) -> list[str]:
    """A note for each model beside this one, of photographs that COLMAP could not join to its
    own.
    """
    notes = []
    for folder in models_in(model.parent):
        with suppress(ClodError):  # a damaged one is no choice
            if folder != model:
                count = len(read_colmap(folder)[0])
                notes.append(
                    f"{folder} is another model, of {count} images: give this folder if the"
                    " checkpoint is of it"
                )
    return notes


def _load(loads: Sequence[Load], progress: Listener | None) -> tuple[list[View], list[Note]]:
    """The views of the images, and notes. Each worker holds one photograph of full size at a
    time.
    """
    views: list[View] = []
    notes: list[Note] = []
    workers = min(MOST_AT_ONCE, max(2, torch.get_num_threads()))
    with warnings.catch_warnings(), closing(in_order(loads, workers)) as loaded:
        # Large, but below the size at which it is rejected: photographs are no attack.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        for view, remarks in loaded:
            views.append(view)
            notes += remarks
            tell(progress, Phase.PHOTOGRAPHS, len(views), len(loads))
    return views, notes


def _summary(notes: Sequence[Note], total: int) -> list[str]:
    """One line for each thing done, however many sizes it was done to."""
    details = defaultdict[str, list[str]](list)
    for change, detail in notes:
        details[change].append(detail)
    lines = []
    for change, those in details.items():
        kinds = len(set(those))
        others = f" (and {kinds - 1} more)" if kinds > 1 else ""
        lines.append(f"{len(those)} of {total} images {change.format(those[0] + others)}")
    return lines


def _load_view(
    image: PosedImage, path: Path, cache: Path | None, max_width: int
) -> tuple[View, list[Note]]:
    pixels, K, notes = photograph(image, path, max_width, cache)
    return View(_pinhole(image, K, *pixels.size), torch.from_numpy(np.array(pixels))), notes


def _pinhole(image: PosedImage, K: np.ndarray, width: int, height: int) -> Camera:
    return Camera(
        torch.from_numpy(image.viewmat).float(),
        torch.from_numpy(K).float(),
        width,
        height,
        image.name,
    )
