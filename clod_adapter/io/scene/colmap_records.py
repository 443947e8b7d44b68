"""Refuses damaged COLMAP models before COLMAP, which trusts its files, reads them."""

from __future__ import annotations

import struct
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.colmap_library import pycolmap
from clod_adapter.io.sniff import refuse_irregular, refuse_long_numbers


def check_records(model: Path) -> None:
    """Walks the binary records, as COLMAP reads past the end of a cut file until memory runs out.

    Raises:
        ClodError: a file cannot be read or does not hold the number of records that it states.
    """
    for name, after in _RECORDS.items():
        path = model / name
        text = path.with_suffix(".txt")
        if data := _content(text):
            refuse_long_numbers(text, data)
        if not (data := _content(path)) and not path.exists():
            continue
        try:
            at = 8
            for _ in range(struct.unpack_from("<Q", data)[0]):
                at = after(data, at)
        except (struct.error, ValueError, OverflowError):
            at = len(data) + 1
        if at > len(data):
            raise ClodError(f"{path}: is truncated or damaged; copy or export the model again")


def _content(path: Path) -> bytes:
    """The file's bytes; none where there is no file."""
    refuse_irregular(path, "copy the model again")
    try:
        return path.read_bytes() if path.is_file() else b""
    except OSError as error:
        raise ClodError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error


def _count(data: bytes, at: int) -> int:
    return struct.unpack_from("<Q", data, at)[0]


def _camera_end(data: bytes, at: int) -> int:
    model = pycolmap.CameraModelId(struct.unpack_from("<i", data, at + 4)[0])
    parameters = pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params  # ValueError: no such model
    return at + 24 + 8 * len(parameters)  # id, model, width, height, parameters


def _rig_end(data: bytes, at: int) -> int:
    sensors = struct.unpack_from("<I", data, at + 4)[0]
    at += 16 if sensors else 8  # id, count, the reference sensor
    for _ in range(sensors - 1):
        at += 65 if struct.unpack_from("<?", data, at + 8)[0] else 9  # sensor, whether it has a pose, the pose
    return at


# Where the record that starts at a position ends, by file.
_RECORDS = {
    "cameras.bin": _camera_end,
    "rigs.bin": _rig_end,
    # id, rotation, translation, camera id, name, keypoints
    "images.bin": lambda data, at: (end := data.index(b"\0", at + 64) + 1) + 8 + 24 * _count(data, end),
    # id, position, colour, error, track
    "points3D.bin": lambda data, at: at + 51 + 8 * _count(data, at + 43),
    # id, rig id, rotation, translation, members (the count has 32 bits here)
    "frames.bin": lambda data, at: at + 68 + 16 * struct.unpack_from("<I", data, at + 64)[0],
}
