"""Inputs for fuzz.py: small undamaged files as their own writers make them.

An input is the files of one format by name. Where the shared data is present, the first rows of its checkpoints are
among them.
"""

from __future__ import annotations

import io
import itertools
import json
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import clod_adapter as clod
from clod_adapter._support.version import package_version
from clod_adapter.io.file_formats import FORMATS as FILE_FORMATS
from clod_adapter.io.file_formats import WRITABLE
from clod_adapter.io.file_formats import write as write_model
from clod_adapter.io.ply.columns import inria_dtype
from clod_adapter.io.ply.header import read_head
from clod_adapter.training.state import TrainingState
from clod_adapter.training.state_file import save_state
from common import ROOT, SHARED

import numpy as np
import pycolmap
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

sys.path.insert(0, str(ROOT / "tests"))
from packing import write_packed  # noqa: E402

Input = dict[str, bytes]
IMAGES = ("a.png", "b.png", "c.png")
SIZE = (8, 6)
CAMERAS = {
    "SIMPLE_PINHOLE": (9.0, 4, 3), "PINHOLE": (9.0, 9, 4, 3), "SIMPLE_RADIAL": (9.0, 4, 3, 0.02),
    "OPENCV": (9.0, 9, 4, 3, 0.01, 0, 0, 0.001),
}  # fmt: skip


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
    gaussians = clod.with_dial(base.gaussians, torch.rand(6), clod.AttenuationConfig())
    row = {"virtual_scale": 1.0, "kept": 6.0, "psnr": 30.0, "ssim": 0.9, "frame_ms": 1.0}
    tuned = gaussians.replace(**{name: value + 0.1 for name, value in gaussians.tensors().items()})
    for adapted in (gaussians, tuned):
        adapter = clod.extract(base.gaussians, adapted, fingerprint=base.fingerprint, config={"seed": 0, "row": row})
        clod.save_adapter(folder / "a.safetensors", adapter)
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
        save_state(folder / "a.safetensors", state, belongs | {"overruled": {"--with": ["sh0"]}})
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
    for coefficients in (3, 0):
        shapes = {
            "means": (4, 3), "quats": (4, 4), "scales": (4, 3), "opacities": (4,), "sh0": (4, 1, 3),
            "shN": (4, coefficients, 3),
        }  # fmt: skip
        out = io.BytesIO()
        torch.save({"step": 29999, "splats": {name: torch.randn(shape) for name, shape in shapes.items()}}, out)
        inputs.append({"model.pt": out.getvalue()})
    return inputs


def _whole_models(folder: Path) -> list[Input]:
    """Each format that holds a whole model, without and, where it has room, with a dial; and a compressed PLY."""
    base = _base(folder).gaussians
    dial = clod.with_dial(base, torch.rand(len(base)) + 0.1, clod.AttenuationConfig())
    inputs = []
    for suffix in (suffix for suffix in WRITABLE if suffix != ".ply"):
        for gaussians in (base, dial)[: 1 + FILE_FORMATS[suffix].carries_sigma]:
            write_model(folder / f"whole{suffix}", gaussians, ("a comment",))
            inputs.append({f"whole{suffix}": (folder / f"whole{suffix}").read_bytes()})
    packed = write_packed(folder / "whole.compressed.ply", base)
    return [*inputs, {packed.name: packed.read_bytes()}]


# The undamaged inputs of each format; the folder is for files on the way.
MAKERS: dict[str, Callable[[Path], list[Input]]] = {
    "ply": _plys, "safetensors": _adapters, "states": _states, "colmap": _models, "transforms": _transforms,
    "pt": _pts, "models": _whole_models,
}  # fmt: skip
