"""Inputs for fuzz.py: small whole files as their own writers make them, and ways to damage them.

An input is the files of one format by name. Where the shared data is present, the first rows of its checkpoints and the
first records of its models are among them.
"""

from __future__ import annotations

import io
import itertools
import json
import random
import re
import shutil
import zipfile
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from common import SHARED
from mutants_models import described, model_inputs, unpacked
from PIL import Image
from plyfile import PlyData, PlyElement

import clod_adapter as clod
from clod_adapter.io.adapter_file import save_adapter
from clod_adapter.io.ply.columns import inria_dtype
from clod_adapter.io.ply.header import read_head
from clod_adapter.training.state import TrainingState
from clod_adapter.training.state_file import save_state
from clod_adapter.version import package_version

Input = dict[str, bytes]
FORMATS = ("ply", "safetensors", "states", "colmap", "transforms", "pt", "models")
IMAGES = ("a.png", "b.png", "c.png")
SIZE = (8, 6)
CAMERAS = {
    "SIMPLE_PINHOLE": (9.0, 4, 3), "PINHOLE": (9.0, 9, 4, 3), "SIMPLE_RADIAL": (9.0, 4, 3, 0.02),
    "OPENCV": (9.0, 9, 4, 3, 0.01, 0, 0, 0.001),
}  # fmt: skip


def make(kind: str, folder: Path) -> list[Input]:
    """The undamaged inputs of a format; ``folder`` is for files on the way."""
    makers: dict[str, Callable[[Path], list[Input]]] = {
        "ply": _plys, "safetensors": _adapters, "states": _states, "colmap": _models, "transforms": _transforms,
        "pt": _pts,
        "models": lambda folder: model_inputs(folder, _base(folder).gaussians),
    }  # fmt: skip
    return makers[kind](folder)


def write(case: Input, folder: Path) -> None:
    """Puts the files of an input, and no others, in the folder where the reader looks for them."""
    for old in [path for path in folder.rglob("*") if path.is_file() and path.name not in (*case, *IMAGES)]:
        old.unlink()
    for name, data in case.items():
        (folder / name).write_bytes(data)


def write_images(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in IMAGES:
        Image.fromarray(np.zeros((SIZE[1], SIZE[0], 3), np.uint8)).save(folder / name)


def _vertex(count: int, extra: tuple[str, ...] = (), degree: int = 1, kind: str = "f4") -> np.ndarray:
    names = [*(inria_dtype(degree).names or ()), *extra]
    vertex = np.zeros(count, [(name, kind) for name in names])
    values = np.random.default_rng(len(names)).normal(size=(count, len(names)))
    for k, name in enumerate(names):
        vertex[name] = values[:, k]
    return vertex


def _ply(vertex: np.ndarray, order: str = "<", comments: tuple[str, ...] = (), before: bool = False) -> Input:
    out = io.BytesIO()
    elements = [PlyElement.describe(vertex, "vertex", comments=list(comments))]
    if before:
        elements.insert(0, PlyElement.describe(np.zeros(2, [("fx", "f4"), ("n", "u1")]), "intrinsic"))
    PlyData(elements, text=order == "ascii", byte_order="=" if order == "ascii" else order).write(out)
    return {"model.ply": out.getvalue()}


def _plys(folder: Path) -> list[Input]:
    dial = ("clod_adapter version 0.1.0", "clod_adapter tau 0.004", "clod_adapter max_sv 5.0")
    inputs = [
        *(_ply(_vertex(4), order) for order in ("<", ">", "ascii")),
        *(_ply(_vertex(3, ("sigma_d",)), order, dial) for order in ("<", "ascii")),
        _ply(_vertex(4, ("masks_0", "masks_1"), 0)),
        *(_ply(_vertex(4, ("filter_3D",), 2), order, before=True) for order in ("<", "ascii")),
        _ply(_vertex(12, (), 3, "f8"), ">", ("double",)),
    ]
    for number, path in enumerate(sorted(SHARED.rglob("*.ply")) if SHARED.is_dir() else []):
        head = read_head(path)
        size = 12 * head.ply["vertex"].dtype("<").itemsize
        with open(path, "rb") as file:
            start = re.sub(rb"element vertex \d+", b"element vertex 12", file.read(head.size))
            inputs.append({f"real{number}.ply": start + file.read(size)})
    return inputs


def _adapters(folder: Path) -> list[Input]:
    """Of sigma_d alone, and of all updates with a calibration, through a base and its adapted copy."""
    inputs, base = [], _base(folder)
    gaussians = clod.attach(base.gaussians, torch.rand(6), clod.AttenuationConfig())
    row = {"virtual_scale": 1.0, "kept": 6.0, "psnr": 30.0, "ssim": 0.9, "frame_ms": 1.0}
    tuned = gaussians.replace(**{name: value + 0.1 for name, value in gaussians.tensors().items()})
    for adapted in (gaussians, tuned):
        adapter = clod.extract(base.gaussians, adapted, fingerprint=base.fingerprint, config={"seed": 0, "row": row})
        save_adapter(folder / "a.safetensors", adapter)
        inputs.append({"a.safetensors": (folder / "a.safetensors").read_bytes()})
    return inputs


def _states(folder: Path) -> list[Input]:
    """Of an interrupted training, as ``--resume`` looks for it: with a mean, and without one."""
    inputs, random = [], np.random.default_rng(0)
    for kinds in (("parameter", "first", "second"), ("parameter", "first", "second", "mean")):
        tensors = {f"{kind}.means": torch.rand(6, 3) for kind in kinds} | {"steps.means": torch.ones(6).int()}
        state = TrainingState(
            tensors, clod.AttenuationConfig(), random.bit_generator.state, (2, 0), 0.1, len(kinds) - 3, 1, 0.5, 0.5
        )
        belongs = {"version": package_version(), "config": asdict(clod.AdaptConfig()), "base_sha256": "0" * 64}
        save_state(folder / "a.safetensors", state, belongs | {"frozen": ["quats"], "overruled": {"--with": ["sh0"]}})
        inputs.append({"a.safetensors": (folder / "a.safetensors").read_bytes()})
    return inputs


def _base(folder: Path) -> clod.Checkpoint:
    path = folder / "base.ply"
    path.write_bytes(_ply(_vertex(6))["model.ply"])
    return clod.load(path)


def _model(*kinds: str) -> pycolmap.Reconstruction:
    """Three images of two cameras of these kinds, and points that they see."""
    model = pycolmap.Reconstruction()
    for number, kind in enumerate(kinds, start=1):
        params = CAMERAS[kind]
        size = {"width": SIZE[0], "height": SIZE[1]}
        model.add_camera_with_trivial_rig(pycolmap.Camera(model=kind, params=params, camera_id=number, **size))
    for number, name in enumerate(IMAGES, start=1):
        keypoints = [pycolmap.Point2D(np.array([k, number], float)) for k in range(3)]
        image = pycolmap.Image(name=name, camera_id=1 + number % 2, image_id=number, points2D=keypoints)
        pose = pycolmap.Rigid3d(np.hstack([np.eye(3), [[number], [0], [2]]]))
        model.add_image_with_trivial_frame(image, pose)
    for k in range(3):
        track = pycolmap.Track([pycolmap.TrackElement(number, k) for number in (1, 2, 3)])
        model.add_point3D(np.array([k, 1, 5], float), track, np.zeros(3, np.uint8))
    return model


def _models(folder: Path) -> list[Input]:
    """Binary and text, each as of today and as of before there were rigs; without and with distortion."""
    inputs = []
    pairs = (("SIMPLE_PINHOLE", "PINHOLE"), ("OPENCV", "SIMPLE_RADIAL"))
    for form, kinds in itertools.product(("binary", "text"), pairs):
        target = folder / form
        target.mkdir()
        getattr(_model(*kinds), f"write_{form}")(str(target))
        files = {path.name: path.read_bytes() for path in target.iterdir()}
        inputs += [files, {name: data for name, data in files.items() if name.split(".")[0] not in ("rigs", "frames")}]
        shutil.rmtree(target)
    return inputs


def _transforms(folder: Path) -> list[Input]:
    """Of nerfstudio with distortion, and of Blender's scenes, in two files."""
    pose = np.diag([1.0, -1, -1, 1]).tolist()
    frames = [{"file_path": f"images/{name}", "transform_matrix": pose} for name in IMAGES]
    size = {"w": SIZE[0], "h": SIZE[1], "fl_x": 9.0, "fl_y": 9.0, "cx": 4.0, "cy": 3.0}
    lens = {"camera_model": "OPENCV", "k1": 0.01, "k2": 0.0, "p1": 0.0, "p2": 0.001}
    named = [{**frame, "file_path": frame["file_path"][:-4]} for frame in frames]
    blender = [{"camera_angle_x": 0.8, "frames": part} for part in (named[:2], named[2:])]
    documents = [
        {"transforms.json": {**size, "frames": frames}}, {"transforms.json": {**size, **lens, "frames": frames[:1]}},
{"transforms_train.json": blender[0], "transforms_test.json": blender[1]},
    ]  # fmt: skip
    return [{name: json.dumps(content).encode() for name, content in files.items()} for files in documents]


def _pts(folder: Path) -> list[Input]:
    """As gsplat's trainer writes it, of SH degree 1 and 0."""
    inputs = []
    for bands in (3, 0):
        shapes = {
            "means": (4, 3), "quats": (4, 4), "scales": (4, 3), "opacities": (4,), "sh0": (4, 1, 3),
            "shN": (4, bands, 3),
        }  # fmt: skip
        out = io.BytesIO()
        torch.save({"step": 29999, "splats": {name: torch.randn(shape) for name, shape in shapes.items()}}, out)
        inputs.append({"model.pt": out.getvalue()})
    return inputs


VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1 << 31, 1 << 63, 1 << 200, 1e308, float("nan"), float("inf"), "", "x", "nan", "a\nb", "\x1b",
    [], {}, [1], {"a": 1}, [None, None], "[" * 100000, 0.5, "F64", [2**62, 2**62], [0, 2**63], 1e-300, 1e9, -0.5,
    "../a.png", "/etc/passwd", "images/a", "OPENCV_FISHEYE", "x" * 300,
)  # fmt: skip
NUMBERS = (0, 1, 2, 255, 1 << 15, 1 << 16, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 40, 1 << 62)
NUMBERS += ((1 << 63) - 1, 1 << 63, (1 << 64) - 1)
WORDS = (
    b"nan", b"inf", b"-inf", b"-1", b"1e999", b"-0", b"0x10", b"1_0", b"", b" ", b"\n", b"\r", b"\r\n", b"\0", b"\xff",
    b"../", b"../../etc/passwd", b"/etc/passwd\0", b"C:\\", b"..\\..\\", b"\\\\host\\x", b"~/", b"a" * 5000, b"\x1b[2J",
    b"b" * 300,
    b"element vertex", b"property float x", b"property list uchar int x", b"end_header",
    b"comment clod_adapter tau nan",
    b"ascii", b"binary_big_endian", b"double", b"uchar", b"PINHOLE", b"OPENCV", b"#", b"{", b"}", b"[" * 2000, b"null",
    b"99999999999999999999", *(str(number).encode() for number in NUMBERS),
)  # fmt: skip


def mutate(case: Input, others: list[Input], chance: random.Random) -> Input:
    """Damages one of the files, or two, in one to four ways."""
    whole, case = case, dict(case)
    for _ in range(chance.choice((1, 1, 1, 2))):
        name = chance.choice(sorted(case))
        data = bytearray(case[name])
        inside = INSIDE.get(Path(name).suffix)
        if inside and case[name] is whole[name] and chance.random() < 0.5:
            data = inside(bytes(data), chance)
        else:
            damage(data, chance)
        case[name] = bytes(data)
    if chance.random() < 0.02 and len(case) > 1:  # files missing, or of another model
        del case[chance.choice(sorted(case))]
    if chance.random() < 0.02 and len(case) > 1:
        other = chance.choice(others)
        case |= {name: other[name] for name in chance.sample(sorted(other), 1)}
    return case


def damage(data: bytearray, chance: random.Random) -> None:
    for _ in range(chance.choice((1, 1, 2, 4))):
        chance.choice(WAYS)(data, chance)


def _describe(data: bytes, chance: random.Random) -> bytearray:
    """A safetensors file whose description is damaged: as text, or a value in it, the lengths right again."""
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    (key,) = header["__metadata__"]
    about = json.loads(header["__metadata__"][key])
    if chance.random() < 0.3:
        text = bytearray(json.dumps(about).encode())
        damage(text, chance)
        header["__metadata__"][key] = text.decode("latin1")
    else:
        _replace(header if chance.random() < 0.2 else about, chance)
        if isinstance(header.get("__metadata__"), dict):
            header["__metadata__"][key] = json.dumps(about)
    changed = json.dumps(header).encode()
    return bytearray(len(changed).to_bytes(8, "little") + changed + data[8 + size :])


def _document(data: bytes, chance: random.Random) -> bytearray:
    """JSON with some of its values replaced."""
    document = json.loads(data)
    for _ in range(chance.choice((1, 1, 2, 4))):
        _replace(document, chance)
    return bytearray(json.dumps(document).encode())


def _replace(where: Any, chance: random.Random) -> None:
    """Puts another value somewhere into a JSON document."""
    while True:
        key = chance.choice(sorted(where) if isinstance(where, dict) else range(len(where)))
        if not isinstance(where[key], dict | list) or not where[key] or chance.random() < 0.3:
            break
        where = where[key]
    where[key] = deepcopy(chance.choice(VALUES))


def _repack(data: bytes, chance: random.Random) -> bytearray:
    """A zip archive one of whose entries is damaged, its checksum right again."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        names = old.namelist()
        chosen = chance.choice([name for name in names if name.endswith("data.pkl")] * 3 + names)
        for name in names:
            entry = bytearray(old.read(name))
            if name == chosen:
                damage(entry, chance)
            new.writestr(name, bytes(entry))
    return bytearray(out.getvalue())


def _flip(data: bytearray, chance: random.Random) -> None:
    for _ in range(chance.choice((1, 1, 3, 8))):
        if data:
            data[_place(data, chance)] ^= 1 << chance.randrange(8)


def _truncate(data: bytearray, chance: random.Random) -> None:
    del data[_place(data, chance) :]


def _drop(data: bytearray, chance: random.Random) -> None:
    start = _place(data, chance)
    del data[start : start + chance.choice((1, 2, 4, 8, 64))]


def _insert(data: bytearray, chance: random.Random) -> None:
    place = _place(data, chance)
    data[place:place] = chance.randbytes(chance.choice((1, 4, 8, 100)))


def _word(data: bytearray, chance: random.Random) -> None:
    """A telling word over what is there, or between."""
    place, word = _place(data, chance), chance.choice(WORDS)
    data[place : place + (len(word) if chance.random() < 0.5 else 0)] = word


def _number(data: bytearray, chance: random.Random) -> None:
    """An extreme integer, as 1, 2, 4 or 8 bytes of either order."""
    size, place = chance.choice((1, 2, 4, 8)), _place(data, chance)
    number = chance.choice(NUMBERS) % (1 << 8 * size)
    data[place : place + size] = number.to_bytes(size, chance.choice(("little", "little", "big")))


def _block(data: bytearray, chance: random.Random) -> None:
    """Copies a part over another, or between."""
    start, place, size = _place(data, chance), _place(data, chance), chance.choice((4, 16, 64, 256))
    data[place : place + (size if chance.random() < 0.5 else 0)] = data[start : start + size]


def _line(data: bytearray, chance: random.Random) -> None:
    """Among the lines that text begins with: drops, doubles or swaps one, or changes a word of it."""
    end = data.find(b"end_header")
    text, rest = (bytes(data[:end]), bytes(data[end:])) if end > 0 else (bytes(data), b"")
    lines = text.split(b"\n")
    at, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    way = chance.randrange(5)
    if way == 0:
        del lines[at]
    elif way == 1:
        lines.insert(other, lines[at])
    elif way == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        words = lines[at].split(b" ")
        words[chance.randrange(len(words))] = chance.choice(WORDS)
        lines[at] = b" ".join(words)
    data[:] = b"\n".join(lines) + rest


def _place(data: bytearray, chance: random.Random) -> int:
    """Anywhere, but every third time near the start, where the counts are."""
    return chance.randrange(max(1, min(len(data), 200) if chance.random() < 0.33 else len(data)))


INSIDE = {
    ".safetensors": _describe, ".pt": _repack, ".json": _document,
    ".spz": lambda data, chance: unpacked(data, chance, damage),
    ".glb": lambda data, chance: described(data, chance, damage, _replace),
}  # fmt: skip
WAYS = (_flip, _truncate, _drop, _insert, _word, _number, _number, _block, _line, _line)
