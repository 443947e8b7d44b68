from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import write
from clod_adapter.io.formats.splat import load_splat
from formats import ORIGIN, model, rows_by_place, splat_transform, turned


def plain(degree: int = 1, count: int = 40) -> Gaussians:
    return model(degree, count).replace(sigma_d=None, attenuation=None)


def test_rows(tmp_path: Path) -> None:
    """The layout, byte by byte, as its viewers document it."""
    g = plain(0).select(torch.arange(1))
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


def test_what_is_lost(tmp_path: Path) -> None:
    g = plain()
    notes = write(tmp_path / "a.splat", g, origin=ORIGIN)
    assert "8 bits" in notes[0] and "view-dependent" in notes[1] and "origin" in notes[2]
    again = load_splat(tmp_path / "a.splat").gaussians
    rows = torch.from_numpy(rows_by_place(g.means.numpy(), again.means.numpy()))
    found = again.select(rows)
    assert torch.equal(found.means, g.means) and again.sh_degree == 0
    torch.testing.assert_close(found.log_scales, g.log_scales, atol=1e-6, rtol=0)
    assert (found.opacities - g.opacities).abs().max() <= 0.501 / 255
    assert found.opacity_logits.isfinite().all()
    assert turned(found.quats, g.quats) < 0.02
    seen = (0.5 + SH_C0 * g.sh0).clamp(0, 1)
    assert (0.5 + SH_C0 * found.sh0 - seen).abs().max() <= 0.501 / 255


def test_the_largest_come_first(tmp_path: Path) -> None:
    g = plain(0, 300)
    write(tmp_path / "a.splat", g)
    rows = rows_by_place(load_splat(tmp_path / "a.splat").gaussians.means.numpy(), g.means.numpy())
    weights = (g.scales.prod(1) * g.opacities)[rows]
    assert (weights[1:] <= weights[:-1] * (1 + 1e-5)).all()


def test_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    for g, message in (
        (model(), "no room for sigma_d; choose a dial value to bake"),
        (plain().select(torch.zeros(40, dtype=torch.bool)), "no Gaussians to write"),
        (plain().replace(means=torch.full((40, 3), torch.nan)), "means holds a value that is not finite"),
        (plain().replace(log_scales=torch.full((40, 3), 90.0)), "a scale is beyond"),
        (plain().replace(quats=torch.zeros(40, 4)), "a rotation is zero"),
    ):
        with pytest.raises(ClodError, match=message):
            write(path, g)
    assert not list(tmp_path.iterdir())
    path.write_bytes(b"")
    with pytest.raises(ClodError, match="0 bytes are not a .splat"):
        load_splat(path)


def test_splat_transform_reads_it(tmp_path: Path) -> None:
    g = plain(0)
    write(tmp_path / "a.splat", g)
    splat_transform(tmp_path / "a.splat", tmp_path / "b.ply")
    ours, theirs = load_splat(tmp_path / "a.splat").gaussians, load(tmp_path / "b.ply").gaussians
    assert torch.equal(theirs.means, ours.means) and turned(theirs.quats, ours.quats) < 0.02
    torch.testing.assert_close(theirs.log_scales, ours.log_scales, atol=1e-5, rtol=0)
    torch.testing.assert_close(theirs.sh0, ours.sh0, atol=1e-5, rtol=0)
    torch.testing.assert_close(theirs.opacities, ours.opacities, atol=1.1e-3, rtol=0)  # of 0 and 255 we say a quarter
