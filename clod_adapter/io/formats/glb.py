"""glTF binary files with ``KHR_gaussian_splatting`` (Khronos, ratified 2026), with ``_SIGMA_D`` and ``_GROWTH_D``
where there is a dial.

One POINTS primitive, every attribute float32: activated opacities and scales, rotations of unit length as xyzw,
spherical harmonics up to degree 3 with a VEC3 for each coefficient, and 8-bit ``COLOR_0`` for readers without the
extension. The values are the checkpoint's: glTF's y is up and its x goes left, so the node has a half turn
about z, and a translation where there is an origin. ``asset.extras.clod_adapter`` holds the document (``metadata``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from clod_adapter._support.version import package_version
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.file_formats import History
from clod_adapter.io.formats.arrays import arrays_of, colours_of, normalized, scales_of, sigmoid
from clod_adapter.io.formats.metadata import KEY, write_metadata
from clod_adapter.io.ply.columns import GROWTH, SIGMA, dial_columns
from clod_adapter.origin import Origin

EXTENSION = "KHR_gaussian_splatting"
DIAL = {SIGMA: "_SIGMA_D", GROWTH: "_GROWTH_D"}
COLOR_SPACE = "srgb_rec709_display"
DEGREE = 3  # the highest that the extension has
HALF_TURN = [0.0, 0.0, 1.0, 0.0]  # about z, as xyzw: x right, y down becomes x left, y up; as splat-transform has it
_LIMIT = 1 << 32  # bytes of a file, whose header says how many in 32 bits
_FLOAT, _BYTE = 5126, 5121
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def coefficient(degree: int, index: int) -> str:
    """The attribute of a spherical harmonic: ``index`` of ``2 degree + 1``, in the order of ``Gaussians.shN``."""
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"


def write_glb(path: Path, gaussians: Gaussians, history: History) -> tuple[str, ...]:
    """Writes with float32's rounding of the activations; arguments and errors as ``file_formats.write``."""
    try:
        import pygltflib
    except ModuleNotFoundError as error:
        raise ClodError(f"{path}: .glb needs pygltflib: pip install pygltflib") from error
    columns, dropped = _columns(path, gaussians)
    size = sum(array.nbytes for array in columns.values())
    if size >= _LIMIT - (1 << 20):
        raise ClodError(f"{path}: {size:,} bytes are more than a .glb can hold; keep fewer Gaussians or write a .ply")
    gltf = pygltflib.GLTF2(
        asset=pygltflib.Asset(generator=f"clod-adapter {package_version()}"),
        extensionsUsed=[EXTENSION], scene=0, scenes=[pygltflib.Scene(nodes=[0])],
        nodes=[pygltflib.Node(mesh=0, rotation=HALF_TURN, translation=_in_gltf(history.origin))],
        buffers=[pygltflib.Buffer(byteLength=size)],
    )  # fmt: skip
    gltf.asset.extras = {KEY: write_metadata(gaussians, history)}
    offset = 0
    for index, (name, array) in enumerate(columns.items()):
        view = {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": pygltflib.ARRAY_BUFFER}
        gltf.bufferViews.append(pygltflib.BufferView(**view))
        gltf.accessors.append(_accessor(pygltflib, index, name, array))
        offset += array.nbytes
    attributes = pygltflib.Attributes(**{name: index for index, name in enumerate(columns)})
    how = {
        "kernel": "ellipse", "colorSpace": COLOR_SPACE, "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }  # fmt: skip
    primitive = pygltflib.Primitive(attributes=attributes, mode=pygltflib.POINTS, extensions={EXTENSION: how})
    gltf.meshes = [pygltflib.Mesh(primitives=[primitive])]
    gltf.set_binary_blob(b"".join(array.tobytes() for array in columns.values()))
    gltf.save_binary(str(path))
    return dropped


def _in_gltf(origin: Origin) -> list[float] | None:
    x, y, z = origin
    return [0.0 - x, 0.0 - y, z] if any(origin) else None


def _columns(path: Path, gaussians: Gaussians) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """The attributes, and a line for what the extension does not store."""
    arrays = arrays_of(path, gaussians)
    scales = scales_of(path, arrays["log_scales"])
    opacities = sigmoid(arrays["opacity_logits"]).astype(np.float32)
    sh0 = arrays["sh0"].reshape(-1, 3)
    columns: dict[str, np.ndarray] = {
        "POSITION": arrays["means"],
        "COLOR_0": colours_of(sh0, opacities),
        f"{EXTENSION}:ROTATION": np.ascontiguousarray(np.roll(normalized(arrays["quats"]), -1, axis=1)),
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities,
        coefficient(0, 0): sh0,
    }
    degree = min(gaussians.sh_degree, DEGREE)
    for band in range(1, degree + 1):
        for index in range(2 * band + 1):
            columns[coefficient(band, index)] = np.ascontiguousarray(arrays["shN"][:, band**2 - 1 + index])
    columns |= {DIAL[name]: arrays[name] for name in dial_columns(arrays)}
    lost = arrays["shN"][:, (degree + 1) ** 2 - 1 :].any()
    return columns, (f"spherical harmonics above degree {DEGREE} are dropped",) if lost else ()


def _accessor(pygltflib: Any, index: int, name: str, array: np.ndarray) -> Any:
    accessor = pygltflib.Accessor(
        bufferView=index, count=len(array), type=_TYPES[array.shape[1] if array.ndim == 2 else 1],
        componentType=_BYTE if array.dtype == np.uint8 else _FLOAT,
    )  # fmt: skip
    accessor.normalized = array.dtype == np.uint8
    if name == "POSITION":
        accessor.min, accessor.max = array.min(0).tolist(), array.max(0).tolist()
    return accessor
