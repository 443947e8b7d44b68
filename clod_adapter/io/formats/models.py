"""Models read from whichever of the formats besides PLY, by the suffix of the file."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from clod_adapter.errors import ClodError
from clod_adapter.io.formats.metadata import Model

# The module under clod_adapter.io, and its function.
LOADERS = {
    ".glb": ("formats.glb_reader", "load_glb"),
    ".spz": ("formats.spz_reader", "load_spz"),
    ".safetensors": ("formats.safetensors", "load_safetensors"),
    ".pt": ("formats.pt_model", "load_pt"),
    ".splat": ("formats.splat", "load_splat"),
}


def load_model(path: str | Path) -> Model:
    """What a file holds, as it is in it: rows with values that are not finite are not dropped here.

    Raises:
        ClodError: its suffix stands for none of these formats, or as the format's own function.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in LOADERS:
        raise ClodError(f"{path}: {suffix or 'no suffix'} is none of {', '.join(LOADERS)}; convert it to one of them")
    module, function = LOADERS[suffix]
    load: Callable[[str | Path], Model] = getattr(import_module(f"clod_adapter.io.{module}"), function)
    return load(path)
