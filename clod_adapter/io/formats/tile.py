"""A tile of 3D Tiles: a ``.glb`` with the Gaussians of one level.

CesiumJS 1.145 draws Gaussians only from glTF with ``KHR_gaussian_splatting_compression_spz_2``:
one POINTS primitive whose attributes have no data, and a buffer with the bytes of an SPZ file.
"""

import json
import struct
from pathlib import Path
from typing import Any

from clod_adapter._support.text import package_version
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.formats import spz
from clod_adapter.io.settings import Metadata
from clod_adapter.origin import Origin

EXTENSION = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"
_FLOAT = 5126
_BYTE = 5121


def write_tile(path: Path, gaussians: Gaussians, origin: Origin) -> tuple[str, ...]:
    """Writes a ``.glb`` whose only buffer is an SPZ file; what that rounds."""
    packed = path.with_suffix(".spz")
    notes = spz.write(packed, gaussians, Metadata(screen_filter=gaussians.screen_filter))
    data = packed.read_bytes()
    packed.unlink()
    gltf = _gltf(gaussians, origin, len(data))
    text = json.dumps(gltf, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    padded = data + bytes(-len(data) % 4)
    chunks = b""
    for kind, content in ((b"JSON", text), (b"BIN\0", padded)):
        chunks += struct.pack("<I4s", len(content), kind) + content
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return notes


def _gltf(gaussians: Gaussians, origin: Origin, size: int) -> dict[str, Any]:
    """The JSON of a tile, with the bounds of the centres and the node's placement."""
    shapes = {
        "POSITION": "VEC3",
        "COLOR_0": "VEC4",
        f"{EXTENSION}:SCALE": "VEC3",
        f"{EXTENSION}:ROTATION": "VEC4",
    }
    for degree in range(1, gaussians.sh_degree + 1):
        for k in range(2 * degree + 1):
            shapes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"] = "VEC3"
    accessors: dict[str, dict[str, Any]] = {}
    for name, shape in shapes.items():
        accessors[name] = {"count": len(gaussians), "type": shape, "componentType": _FLOAT}
    accessors["COLOR_0"] |= {"componentType": _BYTE, "normalized": True}
    means = gaussians.means
    accessors["POSITION"] |= {"min": means.amin(0).tolist(), "max": means.amax(0).tolist()}
    splats = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
        "extensions": {SPZ: {"bufferView": 0}},
    }
    primitive = {
        "attributes": {name: index for index, name in enumerate(accessors)},
        "mode": 0,
        "extensions": {EXTENSION: splats},
    }
    x, y, z = origin
    half_turn = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, -x, -y, z, 1]  # about z, by columns
    return {
        "asset": {"version": "2.0", "generator": f"clod-adapter {package_version()}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": half_turn}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": list(accessors.values()),
        "buffers": [{"byteLength": size}],
        "bufferViews": [{"buffer": 0, "byteLength": size}],
        "extensionsUsed": [EXTENSION, SPZ],
        "extensionsRequired": [EXTENSION, SPZ],
    }
