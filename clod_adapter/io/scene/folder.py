"""The places where a scene has its cameras, its photographs and every other file that reading it
may open.

Needs neither pycolmap nor torch, so that a wrong folder is rejected before they are imported.
"""

import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from itertools import product
from os.path import isfile
from pathlib import Path, PureWindowsPath
from typing import Any
from unicodedata import normalize

from clod_adapter._support.text import as_text, file_name
from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.io.file_formats import read_bytes, reject_long_numbers

TRANSFORMS = ("transforms_train.json", "transforms.json")
DATAPARSER = "dataparser_transforms.json"  # nerfstudio's: the frame it trained in
DESCRIPTIONS = (*TRANSFORMS, "transforms_test.json", "transforms_val.json", DATAPARSER)
FORMS = (".bin", ".txt")  # of the files of a COLMAP model, the preferred first
PATHS = ("file_path", "mask_path", "depth_file_path")  # of a frame
PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
ENDINGS = ("", ".png", ".jpg", ".jpeg")  # that the path of a frame may omit
MAX_BYTES = 256 * 2**20  # a hundred thousand frames have a tenth of that
# copies at a part of the size, as Mip-NeRF 360 and Inria's code have
SMALLER = ("images_2", "images_4", "images_8")
RAW = "input"  # Inria's name for the photographs before they are undistorted into images
NAMES = ("images", *SMALLER, RAW)  # of folders of photographs, the likeliest first
# of the photographs of models in these folders: COLMAP's undistorted ones, and Inria's distorted
OWN = {"dense": "dense/images", "distorted": RAW}
# what is said of masks
UNUSED = (
    "not used: where the checkpoint is empty under them, put them into the photographs' alpha"
    " channel"
)


def find_cameras(folder: Path) -> Path:
    """The folder of a COLMAP model, or the transforms file of a scene.

    Looked for in this order: a model in sparse/0, sparse/1, ..., sparse and ``folder``; TRANSFORMS
    there; nerfstudio's colmap/sparse/0, and colmap/0; COLMAP's dense/sparse; Inria's
    distorted/sparse/0; and a model in sparse beside ``folder``, which may be the images' own.
    """
    others = ("colmap/sparse", "colmap", "dense/sparse", "distorted/sparse")
    for name in ("sparse", "", *TRANSFORMS, *others, folder.resolve().parent / "sparse"):
        place = folder / name
        if place.is_file():
            return place
        if models := models_in(place):
            return models[0]
    raise ClodError(
        f"{folder}: no COLMAP model (cameras, images; .bin or .txt) in it, sparse or sparse/0, and"
        " no transforms.json; give the folder that holds images/ and sparse/0, or transforms.json"
    )


def models_in(folder: Path) -> list[Path]:
    """COLMAP's models in the numbered folders of this one, by number, and in itself."""
    numbered = [path for path in folder.glob("*") if path.name.isdecimal()]
    folders = [*sorted(numbered, key=lambda path: int(path.name)), folder]
    return [path for path in folders if form_of(path)]


def form_of(folder: Path) -> str:
    """The one of FORMS that a folder's COLMAP model has, empty without one; trainers need no
    points.
    """
    for form in FORMS:
        if (folder / f"cameras{form}").is_file() and (folder / f"images{form}").is_file():
            return form
    return ""


def photograph_folders(folder: Path, cameras: Path) -> list[Path]:
    """Folders where the photographs of ``find_cameras(folder)`` may be, the likeliest first."""
    if cameras.is_file():
        return [cameras.parent]
    bases = folder, cameras.parent, cameras.parent.parent
    first, *others = [base / name for name, base in product(NAMES, bases)]
    return [first, folder, *others]


def _roots(folder: Path, cameras: Path, raw: bool) -> list[Path]:
    """The folder of OWN alone, if it is there: photographs of the same names elsewhere are of other
    cameras. Else ``photograph_folders``, with ``input`` only if ``raw``: where the cameras are
    pinholes, Inria's code made them together with other photographs.
    """
    for parent, photographs in OWN.items():
        if folder / parent in cameras.parents and (folder / photographs).is_dir():
            return [folder / photographs]
    roots = photograph_folders(folder, cameras)
    return [root for root in roots if raw or root.name != RAW or root == folder]


def find_photographs(
    folder: Path, cameras: Path, names: Sequence[str], *, raw: bool
) -> tuple[list[Path | None], list[str]]:
    """The files of these names, None for those that are missing, and notes.

    All are from the one of ``_roots`` that has most of them.
    """
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ClodError(f"{cameras}: has image {twice[0]} more than once; export it again")
    roots = _roots(folder, cameras, raw)
    plain_names = [plain_name(name, cameras) for name in names]
    candidates = [(*find_files(root, plain_names), root) for root in roots]
    paths, others, root = min(candidates, key=lambda files: (files[0].count(None), len(files[1])))
    notes = []
    if others:
        example = as_text(f"{others[0].name} in {root.name}")
        notes.append(
            f"{len(others)} of {len(names)} photographs have another suffix or case, such as"
            f" {example}"
        )
    if root.name in (*SMALLER, RAW) and root != folder and len(roots) > 1:
        notes.append(f"the photographs are those in {root.name}, as there are more than in images")
    if cameras.is_dir():
        beside = root.parent if root.name in NAMES else root
        for masks in sorted(beside.glob("*[Mm][Aa][Ss][Kk]*")):
            if any(masks.glob("*")):
                notes.append(f"the masks in {masks} are {UNUSED}")
    missing = [name for name, path in zip(plain_names, paths, strict=True) if path is None]
    if missing:
        examples = f"({', '.join(missing[:3])}{', ...' if len(missing) > 3 else ''})"
        if root.is_dir() and not os.access(root, os.X_OK):
            raise ClodError(f"{root}: cannot be read; check its permissions")
        share = f"{len(missing)} of {len(names)}"
        if len(missing) > 0.5 * len(names):
            lists = cameras.name if cameras.is_file() else "the model"
            raise ClodError(
                f"{root}: {share} images of {lists} are missing {examples}, more than half; put"
                " them there under these names"
            )
        notes.append(f"{share} photographs are missing and left out {examples}")
    return paths, notes


def find_files(root: Path, names: Sequence[str]) -> tuple[list[Path | None], list[Path]]:
    """The files of these names, and which of them have another suffix or case.

    In place of a missing one that is the only photograph of the same name otherwise, if no other
    name stands for it.
    """
    expected = [root / file_name(name) for name in names]
    count = Counter(map(_without_suffix, expected))
    photographs = defaultdict[Path, list[Path]](list)
    for folder in {path.parent for path in expected if not isfile(path)}:
        for path in folder.glob("*"):
            if path.suffix.lower() in PHOTOGRAPHS:
                photographs[_without_suffix(path)].append(path)
    files: list[Path | None] = []
    others = []
    for path in expected:
        key = _without_suffix(path)
        if isfile(path):
            files.append(path)
        elif len(photographs[key]) == count[key] == 1:
            files += photographs[key]
            others += photographs[key]
        else:
            files.append(None)
    return files, others


def _without_suffix(path: Path) -> Path:
    # macOS has letters and their accents apart
    return path.with_name(normalize("NFC", path.stem).casefold())


def plain_name(name: str, cameras: Path, home: Path | None = None) -> str:
    """A photograph's name as a relative path with /, also of files made on Windows; rejects what is
    no name.

    Where the path leads out of ``home`` it is the longest end that is a file there, with one of
    ENDINGS.
    """
    if as_text(name) != name:
        raise ClodError(
            f"{cameras}: image name {as_text(name)[:80]!r} is not UTF-8; rename the photograph,"
            " there too"
        )
    path = PureWindowsPath(name)
    longest = max((len(component.encode()) for component in path.parts), default=0)
    control = re.search(r"[\x00-\x1f\x7f-\x9f]", name)
    # characters and bytes that file systems have room for
    if control or len(name) > 4000 or longest > 255:
        raise ClodError(
            f"{cameras}: image name {name[:40]!r} ({len(name)} characters) is no file's name;"
            " rename it"
        )
    if path.parts and not leaves(name):
        return path.as_posix()
    if home is not None:
        for count in range(min(8, len(path.parts) - 1), 0, -1):
            end = "/".join(path.parts[-count:])
            if not leaves(end) and with_ending(home, end):
                return end
    raise ClodError(
        f"{cameras}: image name {name[:80]!r} leaves the images folder or is no name; put the"
        " photograph there, or correct the name"
    )


def with_ending(folder: Path, name: str) -> str | None:
    """The name with the first of ENDINGS that makes it a file's; None where none does."""
    for ending in ENDINGS:
        if isfile(folder / file_name(name + ending)):  # False for what can be no path
            return name + ending
    return None


def leaves(name: str) -> bool:
    """Whether a path is absolute or may lead out of the folder that it is relative to."""
    path = PureWindowsPath(name)
    return bool(path.anchor) or ".." in path.parts


def scene_files(folder: Path) -> Iterator[Path]:
    """Files that no output may overwrite: the model or the transforms, photographs, masks and
    depths; some may not exist.
    """
    cameras = find_cameras(folder)
    home = cameras if cameras.is_dir() else cameras.parent
    for base in dict.fromkeys((folder, home)):
        yield from (base / name for name in DESCRIPTIONS)
    if cameras.is_file():
        for name in DESCRIPTIONS:
            yield from (home / listed for listed in _names_in_json(cameras.with_name(name)))
        return
    yield from (path for path in cameras.glob("*") if path.suffix in FORMS)
    # glob passes over what cannot be read
    roots = [
        path
        for path in photograph_folders(folder, cameras)
        if path.name in NAMES and any(path.glob("*"))
    ]
    for root in roots or [folder]:
        yield from (path for path in root.rglob("*") if path.suffix.lower() in PHOTOGRAPHS)


def _names_in_json(path: Path) -> Iterator[str]:
    """Names in the frames of a transforms file; none of a damaged one, which its reader rejects."""
    try:
        frames = read_json(path).get("frames")
    except ClodError:
        return
    for frame in frames if isinstance(frames, list) else ():
        for name in map(frame.get, PATHS) if isinstance(frame, dict) else ():
            if isinstance(name, str) and as_text(name) == name:
                yield from (file_name(name.replace("\\", "/") + ending) for ending in ENDINGS)


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file."""
    if path.is_file() and path.stat().st_size > MAX_BYTES:
        raise ClodError(
            f"{path}: is larger than {MAX_BYTES >> 20} MB, so it is no list of cameras; check the"
            " path"
        )
    text = read_bytes(path)
    reject_long_numbers(path, text)
    with rejected_if_damaged(path, "is no JSON or damaged", "export it again"):
        content = json.loads(text)
    if not isinstance(content, dict):
        raise ClodError(f"{path}: is no JSON object; copy or export it again")
    return content
