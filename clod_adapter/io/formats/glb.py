"""glTF binary files with ``KHR_gaussian_splatting`` (Khronos, ratified 2026), with ``_SIGMA_D`` and
``_GROWTH_D`` where there is a dial.

One POINTS primitive, every attribute float32: activated opacities and scales, rotations of unit
length as xyzw, a VEC3 for each harmonic up to degree 3; and 8-bit ``COLOR_0`` for readers without
the extension. The values are the checkpoint's: glTF's y is up and its x goes left, so the node has
a half turn about z, and a translation where there is an origin. ``asset.extras.clod_adapter`` holds
the document (``settings.document``).
"""

import json
import re
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from clod_adapter._support.text import package_version
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io import values
from clod_adapter.io.file_formats import KEY
from clod_adapter.io.settings import MODEL, Metadata, Source, document, parse_metadata
from clod_adapter.io.values import GROWTH, OPACITY, SIGMA, arrays_of, dial_columns, half_turn
from clod_adapter.origin import NOWHERE, Origin, origin_of

EXTENSION = "KHR_gaussian_splatting"
COLOR_SPACE = "srgb_rec709_display"
_FLOAT = 5126
_BYTE = 5121


def harmonics(degree: int) -> list[str]:
    """The attributes of the spherical harmonics up to a degree, 0 first, in the order of
    ``Gaussians.shN``.
    """
    names: list[str] = []
    for band in range(degree + 1):
        names += [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{index}" for index in range(2 * band + 1)]
    return names


_JSON = 0x4E4F534A
_BIN = 0x004E4942
# Component types: those that the extension allows in the place of floats, whose largest value
# stands for 1, and these.
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
DIAL_ATTRIBUTES = {SIGMA: "_SIGMA_D", GROWTH: "_GROWTH_D", OPACITY: "_OPACITY_D"}
_ATTRIBUTES = {
    "means": "POSITION",
    "quats": f"{EXTENSION}:ROTATION",
    "log_scales": f"{EXTENSION}:SCALE",
    "opacity_logits": f"{EXTENSION}:OPACITY",
    "sh0": harmonics(0)[0],
}
_FAINTEST = -100.0  # logit of an opacity that float32 has rounded to 0
# a program that wrote SCALE so, whatever its range
_LOGARITHMS = r"splat-transform 2\.([0-2]\.\d+|3\.[01])"
_LINEAR = ("clod-adapter ", "splat-transform ")  # of which all others write SCALE as glTF has it
_STRAY = 0.01  # the largest share of values beyond the extension's range that are only damaged


def write(path: Path, gaussians: Gaussians, metadata: Metadata) -> tuple[str, ...]:
    """Writes with float32's rounding of the activations."""
    arrays = arrays_of(path, gaussians)
    sh0 = arrays["sh0"].reshape(-1, 3)
    opacities = values.sigmoid(arrays["opacity_logits"]).astype(np.float32)
    columns = {
        "POSITION": arrays["means"],
        "COLOR_0": values.colours_of(sh0, opacities),
        f"{EXTENSION}:ROTATION": np.roll(values.normalized(arrays["quats"]), -1, axis=1),
        f"{EXTENSION}:SCALE": values.scales_of(path, arrays["log_scales"]),
        f"{EXTENSION}:OPACITY": opacities,
    }
    first, *higher = harmonics(gaussians.sh_degree)
    columns[first] = sh0
    for k, name in enumerate(higher):
        columns[name] = arrays["shN"][:, k]
    columns |= {DIAL_ATTRIBUTES[name]: arrays[name] for name in dial_columns(arrays)}
    accessors: dict[str, dict[str, Any]] = {}
    views: list[dict[str, Any]] = []
    buffers = []
    offset = 0
    for name, array in columns.items():
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        accessors[name] = {"bufferView": len(views), "count": len(array), "type": kind}
        views.append(
            {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": 34962}
        )
        buffers.append(np.ascontiguousarray(array).data)
        offset += array.nbytes
    # a half turn about z: x right, y down becomes x left, y up; as splat-transform has it
    node = {"rotation": [0.0, 0.0, 1.0, 0.0]}
    if any(metadata.origin):
        x, y, z = metadata.origin
        node["translation"] = [0.0 - x, 0.0 - y, z]
    extras = {KEY: json.loads(document(MODEL, metadata))}
    write_points(path, gaussians.means, accessors, node, views, buffers, extras=extras)
    return ()


def write_points(
    path: Path,
    means: torch.Tensor,
    accessors: dict[str, dict[str, Any]],
    node: dict[str, Any],
    views: list[dict[str, Any]],
    buffers: Sequence[memoryview | bytes],
    extensions: dict[str, Any] | None = None,
    **asset: Any,
) -> None:
    """Writes one POINTS primitive, and the parts of its buffer one after another.

    ``accessors`` are by attribute, without component type and bounds; ``extensions``, which readers
    must know, those of KHR_gaussian_splatting.
    """
    for accessor in accessors.values():
        accessor["componentType"] = _FLOAT
    accessors["COLOR_0"] |= {"componentType": _BYTE, "normalized": True}
    accessors["POSITION"] |= {"min": means.amin(0).tolist(), "max": means.amax(0).tolist()}
    splats: dict[str, Any] = {
        "kernel": "ellipse",
        "colorSpace": COLOR_SPACE,
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    attributes = {name: index for index, name in enumerate(accessors)}
    size = sum(memoryview(buffer).nbytes for buffer in buffers)
    if size >= (1 << 32) - (1 << 20):  # the header has the size of all in 32 bits
        raise ClodError(
            f"{path}: {size:,} bytes are more than a .glb can hold; keep fewer Gaussians or write a"
            " .ply"
        )
    primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: splats}}
    gltf: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"clod-adapter {package_version()}", **asset},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": list(accessors.values()),
        "buffers": [{"byteLength": size}],
        "bufferViews": views,
        "extensionsUsed": [EXTENSION],
    }
    if extensions:
        splats["extensions"] = extensions
        gltf["extensionsUsed"] = gltf["extensionsRequired"] = [EXTENSION, *extensions]
    text = json.dumps(gltf, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    padded = size + -size % 4
    with open(path, "wb") as file:
        file.write(
            struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + padded, len(text), _JSON) + text
        )
        file.write(struct.pack("<II", padded, _BIN))
        file.writelines(buffers)
        file.write(bytes(padded - size))


def read(path: Path, data: bytes) -> Source:
    """Reads the first primitive with the extension, into the axes of checkpoints: y down.

    Under a node without a rotation the values are in glTF's own axes, and are turned here; files of
    this package have the half turn in the node and store the checkpoint's values.
    """
    gltf, binary = _chunks(memoryview(data))
    (mesh, primitive), *others = _find(gltf)
    attributes = primitive["attributes"]
    stored = {}
    for name in (*_ATTRIBUTES.values(), *DIAL_ATTRIBUTES.values(), *harmonics(3)):
        if name in attributes:
            stored[name] = _values(gltf, binary, attributes[name])
    arrays = {name: stored[attribute] for name, attribute in _ATTRIBUTES.items()}
    dial = [name for name, attribute in DIAL_ATTRIBUTES.items() if attribute in stored]
    for name in dial_columns(dial):
        arrays[name] = stored[DIAL_ATTRIBUTES[name]]
    coefficients = [stored[name] for name in harmonics(3) if name in stored]
    arrays["shN"] = np.stack(coefficients, 1)[:, 1:]
    if len(set(map(len, arrays.values()))) > 1:
        raise ValueError("its attributes are of different lengths")
    space = primitive["extensions"][EXTENSION].get("colorSpace", COLOR_SPACE)
    notes = []
    if space != COLOR_SPACE:
        notes.append(f"its colours are in {space!r:.40}, and taken as {COLOR_SPACE}")
    if others:
        notes.append(f"{len(others)} more primitives with Gaussians in it are left out")
    text = gltf["asset"].get("extras", {}).get(KEY)
    metadata = parse_metadata(path, text, dial=SIGMA in arrays)
    arrays, changed = _stored(arrays, str(gltf["asset"].get("generator")))
    notes += changed
    scale, turned, moved = _placed(gltf, mesh)
    if not turned:
        arrays = half_turn(arrays)
    if scale != 1:
        if SIGMA in arrays:
            raise ValueError(f"its node scales a dial by {scale:g}, which must be 1")
        arrays["means"] = arrays["means"] * np.float32(scale)
        arrays["log_scales"] = arrays["log_scales"] + np.float32(np.log(scale))
        notes.append(f"its node scales it by {scale:g}, which is applied")
    if moved != metadata.origin:  # another program moved the node
        world_means = arrays["means"].astype(np.float64) + moved
        if not any(origin_of(world_means)):  # float32 has enough digits
            arrays["means"] = world_means
            moved = NOWHERE
        metadata = replace(metadata, origin=moved)
    return Source(arrays, metadata, tuple(notes), metadata.about)


def _chunks(data: memoryview) -> tuple[dict[str, Any], memoryview]:
    """The JSON chunk, and what follows its head of the binary chunk."""
    version, size, kind = struct.unpack_from("<4xI4xII", data)
    if version != 2 or kind != _JSON or 20 + size > len(data):
        raise ValueError("it is truncated, or no glTF 2.0")
    return json.loads(bytes(data[20 : 20 + size])), data[28 + size :]


def _find(gltf: dict[str, Any]) -> list[tuple[int, dict[str, Any]]]:
    """The primitives with Gaussians, at least one, each after the number of its mesh."""
    primitives = []
    for number, mesh in enumerate(gltf.get("meshes", [])):
        for primitive in mesh["primitives"]:
            if EXTENSION in primitive.get("extensions", {}):
                primitives.append((number, primitive))
    if not primitives:
        raise ValueError(f"it has no Gaussians, {EXTENSION}, so it is a mesh")
    first = primitives[0][1]
    compressed = first["extensions"][EXTENSION].get("extensions")
    if compressed or any(name not in first["attributes"] for name in _ATTRIBUTES.values()):
        raise ValueError("its Gaussians are compressed, or have no spherical harmonics")
    return primitives


def _values(gltf: dict[str, Any], binary: memoryview, number: int) -> np.ndarray:
    """``[N, width]`` float32, the values of an accessor; ``[N]`` where the width is 1."""
    accessor = gltf["accessors"][_count(number)]
    if "sparse" in accessor:
        raise ValueError("an attribute is sparse")
    width = _WIDTHS[accessor["type"]]
    kind = np.dtype(_KINDS[accessor["componentType"]])
    view = gltf["bufferViews"][_count(accessor["bufferView"])]
    if _count(view["buffer"]) or "uri" in gltf["buffers"][0] or view.get("extensions"):
        raise ValueError("its data are compressed, or in another file")
    size = kind.itemsize * width
    stride = _count(view.get("byteStride", size))
    start = _count(accessor.get("byteOffset", 0))
    count = _count(accessor["count"])
    data = binary[_count(view.get("byteOffset", 0)) :][: _count(view["byteLength"])]
    if not count or stride < size or start + (count - 1) * stride + size > len(data):
        raise ValueError("an attribute has no values, or more than the file")
    stored = np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))
    numbers = stored.astype(np.float32)
    if accessor.get("normalized") and kind.kind != "f":
        numbers = np.maximum(numbers / np.float32(np.iinfo(kind).max), -1)
    return numbers[:, 0] if width == 1 else numbers


def _count(value: Any) -> int:
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"{value!r:.20} is no count")
    return value


def _placed(gltf: dict[str, Any], mesh: int) -> tuple[float, bool, Origin]:
    """The placement of a mesh by the nodes above it: their scale, whether they make the half turn,
    and their translation as an origin in the axes of checkpoints.
    """
    nodes: list[dict[str, Any]] = gltf.get("nodes", [])
    parents: dict[int, int] = {}
    above = None
    for number, node in enumerate(nodes):
        parents |= dict.fromkeys(map(_count, node.get("children", [])), number)
        if node.get("mesh") == mesh and above is None:
            above = number
    placed = np.eye(4)
    seen = set()
    while above is not None:
        if above in seen:
            raise ValueError("its nodes are above each other in a circle")
        seen.add(above)
        placed = _matrix(nodes[above]) @ placed
        above = parents.get(above)
    linear = placed[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    turned = bool(linear[0, 0] < 0)
    straight = np.diag([-1.0, -1.0, 1.0] if turned else [1.0, 1.0, 1.0])
    if scale <= 0 or not np.allclose(linear, scale * straight, rtol=0, atol=1e-5 * scale):
        raise ValueError("its node is turned, mirrored or stretched, which is not undone")
    if abs(scale - 1) < 1e-6:
        scale = 1.0  # a rounded one, which changes no value
    x, y, z = placed[:3, 3].tolist()
    return scale, turned, (0.0 - x, 0.0 - y, z)


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """``[4, 4]`` transformation of a node, from its own axes into its parent's."""
    from scipy.spatial.transform import Rotation

    if "matrix" in node:  # by columns
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
    else:
        matrix = np.eye(4)
        turn = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
        matrix[:3, :3] = turn * np.array(node.get("scale", [1, 1, 1]), np.float64)
        matrix[:3, 3] = node.get("translation", [0, 0, 0])
    if not np.isfinite(matrix).all():
        raise ValueError("its node has numbers that are not finite")
    return matrix


def _stored(
    arrays: dict[str, np.ndarray], generator: str
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The values as checkpoints store them, and a line for each that the extension does not
    allow.
    """
    scales = arrays["log_scales"]
    opacities = arrays["opacity_logits"]
    notes = []
    if re.fullmatch(_LOGARITHMS, generator) or np.mean(scales < 0) > _STRAY:
        notes.append("its SCALE is not linear, as glTF has it, and is read as logarithms")
    else:
        if not generator.startswith(_LINEAR) and _may_be_logarithms(scales, arrays["means"]):
            notes.append(
                "its SCALE is read as linear, as glTF has it, but may be logarithms: if its"
                " Gaussians look too small, export it again, as a .ply"
            )
        scales = values.logs_of(scales)
    if np.mean((opacities < 0) | (opacities > 1)) > _STRAY:
        notes.append("its OPACITY is not within 0 and 1, as glTF has it, and is read as logits")
    else:
        opacities = np.maximum(values.logit(np.clip(opacities, 0, 1)), _FAINTEST)
    arrays |= {"log_scales": scales, "opacity_logits": opacities, "sh0": arrays["sh0"][:, None]}
    return arrays | {"quats": np.roll(arrays["quats"], 1, axis=1)}, notes


def _may_be_logarithms(scales: np.ndarray, means: np.ndarray) -> bool:
    """Whether positive scales would, as logarithms, be of unequal sizes within the scene; those of
    most linear ones are equal, or far larger.
    """
    low, high = np.nanquantile(scales, (0.05, 0.95))
    extent = (np.nanmax(means, 0) - np.nanmin(means, 0)).max()
    return bool(high - low > 1 and high < np.log(max(extent, 1.0)))
