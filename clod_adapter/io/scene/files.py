"""Every file that reading a scene may open, by name alone, so that no output overwrites one."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from clod_adapter._support.text import file_name
from clod_adapter.io.scene.folder import find_cameras, photograph_folders

DESCRIPTIONS = (
    "transforms.json", "transforms_train.json", "transforms_test.json", "transforms_val.json",
    "dataparser_transforms.json",
)  # fmt: skip
PATHS = ("file_path", "mask_path", "depth_file_path")  # of a frame
ENDINGS = ("", ".png", ".jpg", ".jpeg")  # that the path of a frame may omit


def scene_files(folder: Path) -> Iterator[Path]:
    """The files of the model or the transforms, photographs, masks and depths; some may not exist.

    A damaged file gives no names; its reader refuses it.

    Raises:
        ClodError: the folder has no cameras.
    """
    cameras = find_cameras(folder)
    homes = dict.fromkeys((folder, cameras if cameras.is_dir() else cameras.parent))
    for home in homes:
        yield from (home / name for name in DESCRIPTIONS)
    if cameras.is_dir():
        yield from (path for path in cameras.iterdir() if path.suffix in (".bin", ".txt"))
        names = [*_names_in_binary(cameras / "images.bin"), *_names_in_text(cameras / "images.txt")]
    else:
        names = [name for each in DESCRIPTIONS for name in _names_in_json(cameras.with_name(each))]
    for root in photograph_folders(folder, cameras):
        yield from (root.joinpath(*Path(name).parts) for name in names)


def _names_in_binary(path: Path) -> Iterator[str]:
    try:
        data, at = path.read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            end = data.index(b"\0", at + 64)  # after id, rotation, translation and camera
            yield os.fsdecode(data[at + 64 : end].replace(b"\\", b"/"))
            at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    except (OSError, ValueError, struct.error):
        return


def _names_in_text(path: Path) -> Iterator[str]:
    try:
        lines = path.read_bytes().splitlines()
    except OSError:
        return
    for line in lines:  # of two lines an image the second has points, and at most names what is not there
        if not line.startswith(b"#") and len(words := line.split(None, 9)) == 10:
            yield os.fsdecode(words[9].strip().replace(b"\\", b"/"))


def _names_in_json(path: Path) -> Iterator[str]:
    from clod_adapter.errors import ClodError
    from clod_adapter.io.scene.transforms import read_json

    try:
        content: Any = read_json(path)
    except ClodError:
        return
    frames = content.get("frames") if isinstance(content, dict) else None
    for frame in frames if isinstance(frames, list) else ():
        for key in PATHS if isinstance(frame, dict) else ():
            if isinstance(frame.get(key), str) and (name := _on_disk(frame[key])):
                yield from (name + ending for ending in ENDINGS)


def _on_disk(name: str) -> str:
    """The name as the file system encodes it; empty for an impossible one."""
    try:
        return file_name(name.replace("\\", "/")) if "\0" not in name else ""
    except UnicodeEncodeError:
        return ""
