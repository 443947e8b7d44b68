"""Where a scene has its COLMAP model. Apart from what reads it, so that a wrong folder is refused without pycolmap."""

from __future__ import annotations

from pathlib import Path

from clod_adapter.errors import ClodError


def find_model(folder: Path) -> Path:
    """The folder of the model: ``sparse/0``, ``sparse`` or ``folder`` itself, the first that has one.

    Then the first two beside ``folder``, which may be the images' own.

    Raises:
        ClodError: none of them has.
    """
    beside = folder.resolve().parent / "sparse"
    for candidate in (folder / "sparse" / "0", folder / "sparse", folder, beside / "0", beside):
        for suffix in ("bin", "txt"):
            if all((candidate / f"{name}.{suffix}").is_file() for name in ("cameras", "images", "points3D")):
                return candidate
    raise ClodError(
        f"{folder}: no COLMAP model (cameras, images, points3D as .bin or .txt) in sparse/0, sparse or the folder "
        "itself; give the folder that holds images/ and sparse/0"
    )
