"""What the tests of the file formats share: models with the odd cases, damage, and splat-transform where it is."""

from __future__ import annotations

import json
import os
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
from safetensors import safe_open
from safetensors.torch import save_file

from clod_adapter.calibration import Calibration, CalibrationRow
from clod_adapter.config import AttenuationConfig
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import load
from clod_adapter.io.ply.header import stored_settings
from scenes import gaussians

ATTENUATION = AttenuationConfig(tau=0.02, cut="soft", reference_distance=3.217, max_sv=7.0)
CALIBRATION = Calibration((CalibrationRow(1, 30, 29.1, 0.9, 2.5),), 40, 3, 64, 48, "a machine")
ABOUT = ("made in a test", "of two lines")
ORIGIN = (5.1e5, -4096.0, 0.25)


def model(degree: int = 3, count: int = 40) -> Gaussians:
    """With a dial, an opaque Gaussian, one that never decays, one that does not fade at all, and long rotations."""
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
    """``[N, 3, 3]`` float64 of the ellipsoids, whichever of several rotations says so."""
    w, x, y, z = (g.quats.double() / g.quats.double().norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    axes = torch.stack(rows, 1).reshape(-1, 3, 3) * g.log_scales.double().exp()[:, None]
    return axes @ axes.mT


def damaged(whole: bytes, data: st.DataObject) -> bytes:
    """A file cut short, or with a few bytes changed, its beginning more often than the rest."""
    if data.draw(st.booleans()):
        return whole[: data.draw(st.integers(0, len(whole) - 1))]
    changed = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        end = data.draw(st.sampled_from([16, 64, 1024, len(whole)]))
        changed[data.draw(st.integers(0, min(end, len(whole)) - 1))] = data.draw(st.integers(0, 255))
    return bytes(changed)


def splat_transform(*arguments: str | Path) -> None:
    """Runs splat-transform, or skips the test where it is not: on PATH, or at $CLOD_SPLAT_TRANSFORM."""
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


def change_document(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Changes the settings that a file of any format or an adapter stores, in place; of a PLY its comments."""
    suffix = path.suffix
    if suffix == ".ply":
        data = path.read_bytes()
        head = [line for line in data.split(b"end_header\n")[0].decode().splitlines() if "clod_adapter" not in line]
        values = stored_settings(load(path).comments)
        if "screen_filter" in values:
            words = values["screen_filter"].split()
            values["screen_filter"] = dict(zip(("variance", "compensate"), words, strict=True))
        change(values)
        at = next(k for k, line in enumerate(head) if line.startswith("element vertex")) + 1
        head[at:at] = [f"comment clod_adapter {line}" for line in _comments(values)]
        path.write_bytes("\n".join([*head, "end_header\n"]).encode() + data.split(b"end_header\n", 1)[1])
    elif suffix == ".pt":
        checkpoint = torch.load(path, weights_only=True)
        checkpoint["clod_adapter"] = _changed(checkpoint["clod_adapter"], change)
        torch.save(checkpoint, path)
    elif suffix == ".safetensors":
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            text = file.metadata()["clod_adapter"]
        save_file(tensors, path, {"clod_adapter": _changed(text, change)})
    elif suffix == ".glb":
        change_glb(path, lambda gltf: change(gltf["asset"]["extras"]["clod_adapter"]))
    elif suffix == ".spz":
        data = zlib.decompress(path.read_bytes(), wbits=31)
        at = data.index(struct.pack("<I", 0x434C0001)) + 12
        size, length = struct.unpack_from("<II", data, at - 8)
        text, rest = data[at : at + length].decode(), data[at + length : at - 4 + size]
        text = _changed(text, change)
        record = struct.pack("<III", 0x434C0001, 4 + len(text) + len(rest), len(text)) + text.encode() + rest
        gzip = zlib.compressobj(wbits=31)
        path.write_bytes(gzip.compress(data[: at - 12] + record) + gzip.flush())
    return path


def _changed(text: str, change: Callable[[dict[str, Any]], object]) -> str:
    values = json.loads(text)
    change(values)
    return json.dumps(values)


def _comments(values: dict[str, Any]) -> list[str]:
    """Settings, also damaged ones, as the comments of a PLY."""
    lines = [f"version {values['package_version']}"]
    lines += [f"{name} {value}" for name, value in values.get("attenuation", {}).items()]
    if "screen_filter" in values:
        stored = values["screen_filter"]
        lines.append(f"screen_filter {' '.join(map(str, stored.values())) if isinstance(stored, dict) else stored}")
    if "calibration" in values:
        table = values["calibration"]
        extent = [table.get(name) for name in ("total", "views", "width", "height", "against")]
        lines += [f"calibrated_on {table['machine']}", f"calibrated_with {' '.join(map(str, extent))}"]
        lines += [f"calibrated {' '.join(map(str, row.values()))}" for row in table["rows"]]
    return lines


def change_glb(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Changes the JSON of a glTF binary file, in place."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    text = _changed(data[20 : 20 + size].decode(), change).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    path.write_bytes(head + text + rest)
    return path
