from __future__ import annotations

import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clod_adapter.adapter import detach
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.equation.growth import growth_distance, growth_factors
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import load
from clod_adapter.io.file_formats import write
from formats import ATTENUATION, model, splat_transform, turned
from scenes import camera


@pytest.mark.parametrize(("typical", "known"), [(50.0, True), (250.0, True), (40_000.0, False)])
def test_sigma_of_large_units_is_not_clipped(tmp_path: Path, typical: float, known: bool) -> None:
    g = model(0)
    sigma = typical * torch.logspace(-1, 3.3, len(g))
    direction = torch.randn(len(g), 3, generator=torch.Generator().manual_seed(0))
    config = replace(ATTENUATION, reference_distance=typical if known else 0.0)
    means = typical * torch.nn.functional.normalize(direction)
    write(tmp_path / "a.spz", g.replace(sigma_d=sigma, means=means, attenuation=config))
    again = load(tmp_path / "a.spz").gaussians
    assert again.attenuation is not None and again.attenuation.scene_distance == 1
    assert again.attenuation.eps == config.eps and (not known or again.attenuation.reference_distance == typical)
    torch.testing.assert_close(again.sigma_d, sigma, rtol=2.0**-11, atol=0)


def test_header_and_record(tmp_path: Path) -> None:
    g = model(1)
    write(tmp_path / "a.spz", g)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (data[:4], version, count, degree, flags, reserved) == (b"NGSP", 3, 40, 1, 2, 0)
    end = 16 + 40 * (9 + 1 + 3 + 3 + 4 + 9)
    assert struct.unpack_from("<III", data, end) == (0xADBE0003, 4, 6)  # right, down, forward
    kind, size, text = struct.unpack_from("<III", data, end + 12)
    assert kind == 0x434C0001 and len(data) == end + 20 + size and size == 4 + text + 2 * 2 * 40
    document, values = json.loads(data[end + 24 : end + 24 + text]), data[end + 24 + text :]
    assert document["columns"] == ["sigma_d", "growth_d"] and g.growth_d is not None
    np.testing.assert_array_equal(np.frombuffer(values, "<f2")[40:], g.growth_d.half())
    write(tmp_path / "b.spz", detach(g))
    plain = gzip.decompress((tmp_path / "b.spz").read_bytes())
    assert plain == data[: end + 12]


def grown(g: Gaussians, s: float) -> torch.Tensor:
    """``[N, 3]`` logarithms of the scales that a camera at 0 sees."""
    assert g.attenuation is not None and g.growth_d is not None
    from_0 = replace(camera(), viewmat=torch.eye(4))
    d = normalized_distances(g.means, from_0, g.attenuation)
    return g.log_scales + growth_factors(g.growth_d, d, s, growth_distance(g.attenuation)).log()[:, None]


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("typical", [3.0, 250.0, 40_000.0])
def test_growth_is_the_same_in_other_units(tmp_path: Path, typical: float, known: bool) -> None:
    g = model(0)
    config = replace(ATTENUATION, reference_distance=typical if known else 0.0)
    means = typical * torch.nn.functional.normalize(g.means) * torch.linspace(0.5, 2, 40)[:, None]
    g = g.replace(means=means, attenuation=config, growth_d=torch.linspace(-1, 1, 40))
    write(tmp_path / "a.spz", g)
    again = load(tmp_path / "a.spz").gaussians
    for s in (1.0, 6.0):
        assert (grown(again, s) - grown(g, s)).abs().max() <= 0.04  # half a step of the scales, of 1/16


@pytest.mark.parametrize(
    ("columns", "values", "fits"),
    [
        (["sigma_d"], 40, True), (["sigma_d", "growth_d"], 80, True), (["sigma_d", "growth_d"], 0, True),
        (["sigma_d", "growth_d"], 40, False), (["sigma_d"], 80, False), (["growth_d", "sigma_d"], 80, False),
        (7, 40, False),
    ],
)  # fmt: skip
def test_record_of_other_columns(tmp_path: Path, columns: Any, values: int, fits: bool) -> None:
    write(tmp_path / "a.spz", model(0))
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    at = 16 + 40 * 20 + 12
    text = json.dumps(
        json.loads(data[at + 12 : at + 12 + struct.unpack_from("<I", data, at + 8)[0]]) | {"columns": columns}
    )
    body = struct.pack("<I", len(text)) + text.encode() + bytes(2 * values)
    (tmp_path / "b.spz").write_bytes(gzip.compress(data[:at] + struct.pack("<II", 0x434C0001, len(body)) + body))
    if not fits:
        with pytest.raises(ClodError, match="b.spz: its record of sigma_d is damaged"):
            load(tmp_path / "b.spz")
    else:
        g = load(tmp_path / "b.spz").gaussians
        assert (g.sigma_d is None, g.growth_d is None) == (values == 0, values < 80)


@pytest.mark.parametrize(("axes", "signs"), [(4, [1, -1, -1]), (7, [-1, -1, 1])])
def test_other_axes_are_rotated(tmp_path: Path, axes: int, signs: list[int]) -> None:
    write(tmp_path / "a.spz", model(1))
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    struct.pack_into("<I", data, 16 + 40 * 29 + 8, axes)
    (tmp_path / "b.spz").write_bytes(gzip.compress(data))
    ours, other = (load(tmp_path / name).gaussians.means for name in ("a.spz", "b.spz"))
    assert torch.equal(other, ours * torch.tensor(signs))
    struct.pack_into("<I", data, 16 + 40 * 29 + 8, 16)
    (tmp_path / "b.spz").write_bytes(gzip.compress(data))
    with pytest.raises(ClodError, match="axes are of kind 16"):
        load(tmp_path / "b.spz")


def test_file_of_splat_transform(tmp_path: Path) -> None:
    g = model(3).select(torch.arange(4, 40))  # without the rotations of odd length, on which it fails
    write(tmp_path / "a.ply", g)
    splat_transform("--spz-version", "3", tmp_path / "a.ply", tmp_path / "b.spz")
    found = load(tmp_path / "b.spz")
    again, note = found.gaussians, found.notes[-1]
    assert again.sigma_d is None and note.startswith("quantised: positions in 24 bits")
    assert (again.means - g.means).abs().max() <= 2.0**-13
    assert (again.opacities - g.opacities).abs().max() <= 0.501 / 255
    assert (again.sh0 - g.sh0).abs().max() <= 0.51 / (0.15 * 255)
    assert (again.log_scales - g.log_scales).abs().max() <= 0.5001 / 16
    assert (again.shN - g.shN.clamp(-1, 127 / 128)).abs().max() <= 8.6 / 128
    assert turned(again.quats, g.quats) < 5e-3
    splat_transform(tmp_path / "a.ply", tmp_path / "c.spz")  # version 4
    assert load(tmp_path / "c.spz").gaussians.means.shape == g.means.shape


def test_version_2(tmp_path: Path) -> None:
    """Rotations in three bytes: x, y, z of unit length with w >= 0."""
    rows = struct.pack("<IIIBBBB", 0x5053474E, 2, 2, 0, 12, 0, 0) + bytes(18) + bytes([0, 255]) + bytes(12)
    (tmp_path / "a.spz").write_bytes(gzip.compress(rows + bytes([128, 128, 128, 255, 128, 128])))
    g = load(tmp_path / "a.spz").gaussians
    assert turned(g.quats, torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0]])) < 0.02
    assert g.opacity_logits.isfinite().all()


def test_false_sizes_are_refused(tmp_path: Path) -> None:
    def claiming(count: int) -> bytes:
        return gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, count, 3, 12, 0, 0), mtime=0)

    for data, message in (
        (gzip.compress(bytes(1 << 26), mtime=0), "unpacks to more"),
        (claiming(9_999_999), "truncated"), (claiming(1 << 31), "no SPZ file of version"),
        (claiming(0), "no Gaussians"), (gzip.compress(b"short", mtime=0), "truncated"),
        (b"NGSP" + bytes(40), "of version 4 is read through splat-transform|cannot be read"),
        (b"", "is empty"),
    ):  # fmt: skip
        (tmp_path / "a.spz").write_bytes(data)
        with pytest.raises(ClodError, match=message):
            load(tmp_path / "a.spz")


def test_positions_use_the_available_bits(tmp_path: Path) -> None:
    """A few far positions are moved closer, with the same direction, angular size and fading seen from 0."""
    g = model(0, 400, growth=False)
    for factor, step in ((1e-3, 2.0**-20), (1e3, 2.0**-10), (5e5, 1.0)):
        scaled = g.replace(means=g.means * factor)
        write(tmp_path / "a.spz", scaled)
        assert (load(tmp_path / "a.spz").gaussians.means - scaled.means).abs().max() <= step
    with pytest.raises(ClodError, match="within 4,000,000 of 0"):
        write(tmp_path / "b.spz", g.replace(means=g.means * 1e7))
    assert not (tmp_path / "b.spz").exists() and g.sigma_d is not None
    means, scales = g.means.clone(), g.log_scales.clone()
    means[9], scales[9] = torch.tensor([3e5, -1e5, 2e3]), 9.0
    notes = write(tmp_path / "a.spz", g.replace(means=means, log_scales=scales))
    again = load(tmp_path / "a.spz").gaussians
    assert again.sigma_d is not None and "the 1 farthest are moved to 64 from 0" in notes[0]
    others, factor = torch.arange(400) != 9, 64 / 3e5
    assert (again.means - means)[others].abs().max() <= 2.0**-17
    torch.testing.assert_close(again.means[9], means[9] * factor, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(again.log_scales[9], scales[9] + np.log(factor), atol=0.04, rtol=0)
    growth = torch.full((400,), 0.25)
    write(tmp_path / "a.spz", g.replace(means=means, log_scales=scales, growth_d=growth))
    more = load(tmp_path / "a.spz").gaussians
    for s in (1.0, 6.0):  # the angle that it covers
        size = grown(g.replace(means=means, log_scales=scales, growth_d=growth), s) - means.norm(dim=1).log()[:, None]
        close = grown(more, s) - more.means.norm(dim=1).log()[:, None]
        assert (close - size)[9].abs().max() <= 0.04
    torch.testing.assert_close(again.sigma_d[9], g.sigma_d[9] * factor, atol=0, rtol=1e-3)
