"""pycolmap or, where it has no wheel (Linux on arm64), what this package needs of it: ``colmap_plain``."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pycolmap
else:
    try:
        import pycolmap
    except ModuleNotFoundError:
        from clod_adapter.io.scene import colmap_plain as pycolmap

__all__ = ["pycolmap"]
