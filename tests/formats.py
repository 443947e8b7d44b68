"""Shared by the tests of file formats: models with edge cases, damaged files, and splat-transform."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from clod_adapter.calibration import Calibration, CalibrationRow
from clod_adapter.config import AttenuationConfig
from clod_adapter.gaussians import Gaussians
from scenes import gaussians

ATTENUATION = AttenuationConfig(tau=0.02, cut="soft", reference_distance=3.217, max_sv=7.0)
CALIBRATION = Calibration((CalibrationRow(1, 30, 29.1, 0.9, 2.5),), 40, 3, 64, 48, "a machine")
ABOUT = ("made in a test", "of two lines")
ORIGIN = (5.1e5, -4096.0, 0.25)


def model(degree: int = 3, count: int = 40) -> Gaussians:
    """Gaussians with a dial: an opaque one, extreme values of sigma_d, and rotations of any length."""
    g = gaussians(count, degree, seed=degree)
    sigma = torch.rand(count, generator=torch.Generator().manual_seed(1)) * 4
    sigma[:4] = torch.tensor([1e9, 0.0, 1e-3, 65504.0])
    logits = g.opacity_logits.clone()
    logits[0] = torch.inf
    quats = g.quats.clone()
    quats[1:4] *= torch.tensor([1e-30, 1e30, 3.0])[:, None]
    return g.replace(opacity_logits=logits, quats=quats, sigma_d=sigma, attenuation=ATTENUATION)


def turned(a: torch.Tensor, b: torch.Tensor) -> float:
    """The largest angle between rotations, radians."""
    unit = [q.double() / q.double().abs().amax(1, keepdim=True) for q in (a, b)]
    unit = [q / q.norm(dim=1, keepdim=True) for q in unit]
    apart = torch.minimum((unit[0] - unit[1]).norm(dim=1), (unit[0] + unit[1]).norm(dim=1))
    return float(4 * torch.asin(apart.clamp(max=2**0.5) / 2).max())


def covariances(g: Gaussians) -> torch.Tensor:
    """``[N, 3, 3]`` float64 covariances, which do not depend on the choice among equivalent rotations."""
    w, x, y, z = (g.quats.double() / g.quats.double().norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    axes = torch.stack(rows, 1).reshape(-1, 3, 3) * g.log_scales.double().exp()[:, None]
    return axes @ axes.mT


def damaged(whole: bytes, data: st.DataObject) -> bytes:
    """A truncated file, or one with a few bytes changed, mostly near its beginning."""
    if data.draw(st.booleans()):
        return whole[: data.draw(st.integers(0, len(whole) - 1))]
    changed = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        end = data.draw(st.sampled_from([16, 64, 1024, len(whole)]))
        changed[data.draw(st.integers(0, min(end, len(whole)) - 1))] = data.draw(st.integers(0, 255))
    return bytes(changed)


def splat_transform(*arguments: str | Path) -> None:
    """Runs splat-transform from PATH or $CLOD_SPLAT_TRANSFORM; skips the test where it is missing."""
    command = os.environ.get("CLOD_SPLAT_TRANSFORM") or shutil.which("splat-transform")
    if command is None:
        pytest.skip("splat-transform is not on PATH, and CLOD_SPLAT_TRANSFORM does not say where it is")
    done = subprocess.run(
        [*command.split(), "-q", "-w", *map(str, arguments)], capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stdout + done.stderr


def rows_by_place(means: np.ndarray, others: np.ndarray) -> np.ndarray:
    """For each of ``means`` the row of ``others`` that is nearest to it; all different."""
    rows = np.linalg.norm(means[:, None] - others[None], axis=2).argmin(1)
    assert len(set(rows)) == len(rows)
    return rows


def change_setting(path: Path, name: str, old: str, new: str) -> Path:
    """Changes a setting in a file of any format that stores it, or in an adapter: text of the same length."""
    assert len(old) == len(new)
    pattern = rf'({name}\\?"?:? ?){old}(?![.\d])'.encode()  # of JSON, of JSON in JSON, and of the comments of a PLY

    def changed(whole: bytes) -> bytes:
        found, count = re.subn(pattern, rb"\g<1>" + new.encode(), whole)
        assert count, f"{name} is not in {path}"
        return found

    if path.suffix == ".pt":
        checkpoint = torch.load(path, weights_only=True)
        checkpoint["clod_adapter"] = changed(checkpoint["clod_adapter"].encode()).decode()
        torch.save(checkpoint, path)
    elif path.suffix == ".spz":
        gzip = zlib.compressobj(wbits=31)
        path.write_bytes(gzip.compress(changed(zlib.decompress(path.read_bytes(), wbits=31))) + gzip.flush())
    else:
        path.write_bytes(changed(path.read_bytes()))
    return path


def without_comments(path: Path, **columns: Any) -> Path:
    """The file as another tool writes it: without its comments, some columns added or changed in every row."""
    rows, found = with_columns(PlyData.read(str(path))["vertex"].data, **columns), path.with_name("rewritten.ply")
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(found))
    return found


def with_columns(old: np.ndarray, **columns: Any) -> np.ndarray:
    """The rows of a PLY with float columns added or changed."""
    added = [(name, "f4") for name in columns if name not in old.dtype.names]
    rows = np.zeros(len(old), old.dtype.descr + added)
    for name in rows.dtype.names or ():
        rows[name] = columns[name] if name in columns else old[name]
    return rows


def change_glb(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Changes the JSON of a glTF binary file, in place."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    gltf = json.loads(data[20 : 20 + size])
    change(gltf)
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    path.write_bytes(head + text + rest)
    return path
