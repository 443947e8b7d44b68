"""The demo's capture and its base, as the package contains them."""

import zipfile
from importlib import resources
from pathlib import Path

from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import load, save


def unpack(capture: Path, base: Path) -> None:
    """Writes the capture and the base checkpoint that come with the package, unless they exist."""
    packed = resources.files("clod_adapter.demo")
    if not capture.exists():
        with atomic_path(capture) as part, (packed / "capture.zip").open("rb") as file, zipfile.ZipFile(file) as photos:
            photos.extractall(part)
    if not base.exists():
        with resources.as_file(packed / "base.spz") as path:
            save(base, load(path).gaussians)
