from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from clod_adapter.adapter import detach
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0
from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import write
from formats import ORIGIN, model, rows_by_place, turned


def test_layout_of_a_row(tmp_path: Path) -> None:
    """The layout, byte by byte, as its viewers document it."""
    g = detach(model(0)).select(torch.arange(1))
    assert len(write(tmp_path / "a.splat", g)) == 1
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 32
    floats, levels = np.frombuffer(data[:24], "<f4"), np.frombuffer(data[24:], np.uint8)
    np.testing.assert_array_equal(floats[:3], g.means[0])
    np.testing.assert_allclose(floats[3:], g.scales[0], rtol=1e-6)
    color = (0.5 + SH_C0 * g.sh0[0, 0]).clamp(0, 1) * 255
    np.testing.assert_array_equal(levels[:4], [*color.round().int(), 255])
    quat = g.quats[0] / g.quats[0].norm()
    np.testing.assert_array_equal(levels[4:], (quat * 128 + 128).round().clamp(max=255))


def test_losses(tmp_path: Path) -> None:
    """Precision, view-dependent colours, the origin, and the order: the largest come first."""
    g = detach(model(1, 300))
    notes = write(tmp_path / "a.splat", g, origin=ORIGIN)
    assert "8 bits" in notes[0] and "view-dependent" in notes[1] and "origin" in notes[2]
    again = load(tmp_path / "a.splat").gaussians
    found = again.select(torch.from_numpy(rows_by_place(g.means.numpy(), again.means.numpy())))
    assert torch.equal(found.means, g.means) and again.sh_degree == 0
    torch.testing.assert_close(found.log_scales, g.log_scales, atol=1e-6, rtol=0)
    assert (found.opacities - g.opacities).abs().max() <= 0.501 / 255
    assert found.opacity_logits.isfinite().all()
    assert turned(found.quats, g.quats) < 0.02
    seen = (0.5 + SH_C0 * g.sh0).clamp(0, 1)
    assert (0.5 + SH_C0 * found.sh0 - seen).abs().max() <= 0.501 / 255
    rows = rows_by_place(again.means.numpy(), g.means.numpy())
    weights = (g.scales.prod(1) * g.opacities)[rows]
    assert (weights[1:] <= weights[:-1] * (1 + 1e-5)).all()


def test_a_ply_is_not_read_as_rows(tmp_path: Path) -> None:
    write(tmp_path / "a.ply", detach(model(0)))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.splat").write_bytes(data + bytes(-len(data) % 32))
    with pytest.raises(ClodError, match="a.splat: is a PLY file; call it .ply"):
        load(tmp_path / "a.splat")
