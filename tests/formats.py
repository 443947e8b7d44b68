"""What the tests of the file formats share: models with the odd cases, damage, and splat-transform where it is."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from clod_adapter.calibration import Calibration, CalibrationRow
from clod_adapter.config import AttenuationConfig
from clod_adapter.gaussians import Gaussians
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
