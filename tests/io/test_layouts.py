"""What each format stores, byte by byte where its readers document it; files of other programs, and
files they read.
"""

import gzip
import json
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from refusals import refused
from torch.testing import assert_close

from clod_adapter.adapter import detach
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import growth_distance, growth_factors
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.integrations.splats import to_gsplat
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import write
from formats import (
    ATTENUATION,
    covariances,
    inria_rows,
    model,
    resaved,
    splat_transform,
    turned,
    write_rows,
)
from scenes import camera, gaussians


def spz(path):
    return bytearray(gzip.decompress(path.read_bytes()))


def test_header_and_record_of_an_spz(tmp_path):
    g = model(1)
    write(tmp_path / "a.spz", g)
    data = spz(tmp_path / "a.spz")
    version, count = struct.unpack_from("<II", data, 4)
    degree, _, *flags = data[12:16]
    assert (data[:4], version, count, degree, flags) == (b"NGSP", 3, 40, 1, [2, 0])
    end = 16 + 40 * (9 + 1 + 3 + 3 + 4 + 9)
    assert struct.unpack_from("<III", data, end) == (0xADBE0003, 4, 6)  # right, down, forward
    kind, size, text = struct.unpack_from("<III", data, end + 12)
    assert kind == 0x434C0001 and len(data) == end + 20 + size and size == 4 + text + 2 * 2 * 40
    document, values = json.loads(data[end + 24 : end + 24 + text]), data[end + 24 + text :]
    assert document["columns"] == ["sigma_d", "growth_d"]
    assert_array_equal(np.frombuffer(values, "<f2")[40:], g.growth_d.half())
    write(tmp_path / "b.spz", detach(g))
    assert spz(tmp_path / "b.spz") == data[: end + 12]


def test_axes_of_an_spz(tmp_path):
    """Others than a PLY's are rejected."""
    write(tmp_path / "a.spz", gaussians(40, 3, 3))
    data = spz(tmp_path / "a.spz")
    struct.pack_into("<I", data, 16 + 40 * 65 + 8, 4)
    (tmp_path / "b.spz").write_bytes(gzip.compress(data))
    with refused("its axes are of kind 4.*convert it"):
        load(tmp_path / "b.spz")


def test_spz_of_version_2(tmp_path):
    """Read through splat-transform: rotations in three bytes, x, y and z, with w >= 0."""
    splat_transform("--version")
    rows = (
        struct.pack("<IIIBBBB", 0x5053474E, 2, 2, 0, 12, 0, 0)
        + bytes(18)
        + bytes([0, 255])
        + bytes(12)
    )
    (tmp_path / "a.spz").write_bytes(gzip.compress(rows + bytes([128, 128, 128, 255, 128, 128])))
    g = load(tmp_path / "a.spz").gaussians
    assert turned(g.quats, torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0]])) < 0.02
    assert g.opacity_logits.isfinite().all()


def grown(g, s):
    """``[N, 3]`` logarithms of the scales that a camera at 0 sees."""
    from_0 = replace(camera(), viewmat=torch.eye(4))
    d = normalized_distances(g.means, from_0, g.attenuation)
    return (
        g.log_scales
        + growth_factors(g.growth_d, d, s, growth_distance(g.attenuation)).log()[:, None]
    )


@pytest.mark.parametrize(
    ("typical", "known", "step"),
    [(3e-3, True, 2.0**-20), (250.0, False, 2.0**-13), (40_000.0, True, 2.0**-6)],
)
def test_units_of_an_spz(tmp_path, typical, known, step):
    """Positions use the available bits; a sigma_d of large units is not clipped to float16; the
    growth is the same.
    """
    g, sigma = model(0), typical * torch.logspace(-1, 3.3, 40)
    config = replace(ATTENUATION, reference_distance=typical if known else 0.0)
    means = typical * torch.nn.functional.normalize(g.means) * torch.linspace(0.5, 2, 40)[:, None]
    g = g.replace(
        means=means, attenuation=config, sigma_d=sigma, growth_d=torch.linspace(-1, 1, 40)
    )
    write(tmp_path / "a.spz", g)
    again = load(tmp_path / "a.spz").gaussians
    assert again.attenuation.scene_distance == 1
    assert not known or again.attenuation.reference_distance == typical
    assert_close(again.sigma_d, sigma, rtol=2.0**-11, atol=0)
    assert (again.means - means).abs().max() <= step
    for s in (1.0, 6.0):
        # half a step of the scales, of 1/16
        assert (grown(again, s) - grown(g, s)).abs().max() <= 0.04


def test_far_positions_of_an_spz(tmp_path):
    """A few are moved closer, with the same direction, angular size and fading seen from 0."""
    path, g = tmp_path / "a.spz", model(0, 400).replace(growth_d=torch.full((400,), 0.25))
    with refused("within 4,000,000 of 0"):
        write(path, g.replace(means=g.means * 1e7))
    assert not path.exists()
    means, scales = g.means.clone(), g.log_scales.clone()
    means[9], scales[9] = torch.tensor([3e5, -1e5, 2e3]), 9.0
    far = g.replace(means=means, log_scales=scales)
    notes = write(path, far)
    again = load(path).gaussians
    assert "the 1 farthest are moved to 64 from 0" in notes[0]
    others, factor = torch.arange(400) != 9, 64 / 3e5
    assert (again.means - means)[others].abs().max() <= 2.0**-17
    assert_close(again.means[9], means[9] * factor, atol=1e-4, rtol=1e-4)
    assert_close(again.sigma_d[9], g.sigma_d[9] * factor, atol=0, rtol=1e-3)
    for s in (1.0, 6.0):  # the angle that it covers
        size, close = (grown(x, s) - x.means.norm(dim=1).log()[:, None] for x in (far, again))
        assert (close - size)[9].abs().max() <= 0.04


@pytest.mark.parametrize("degree", [0, 3])
def test_checkpoint_of_gsplat(tmp_path, degree):
    """A checkpoint with other number types and strides, other entries, and a row that is not
    finite.
    """
    g = gaussians(12, degree, 0)
    values = to_gsplat(g) | {"means": g.means.double(), "quats": g.quats.half().T.contiguous().T}
    values["scales"][3] = torch.nan
    splats = torch.nn.ParameterDict(values).state_dict()
    extra = {"app_module": torch.nn.Linear(2, 2).state_dict(), "optimizer": [torch.zeros(3)]}
    torch.save({"step": 6999, "splats": splats, **extra}, tmp_path / "a.PT")
    base = load(tmp_path / "a.PT")
    assert base.gaussians.sh_degree == degree
    assert base.gaussians.sigma_d is None
    assert "normalised" in base.notes[1]
    assert "1 of 12 Gaussians dropped" in base.notes[0] and len(base.fingerprint) == 64
    for name, tensor in to_gsplat(base.gaussians).items():
        assert torch.equal(tensor, values[name][torch.arange(12) != 3].float()), name
    write(tmp_path / "own.pt", base.gaussians)
    assert torch.load(tmp_path / "own.pt")["step"] == 0  # which gsplat's trainer and viewer expect
    again = resaved(base)
    assert again.gaussians == base.gaussians and again.vertex.dtype.names[3:6] == ("nx", "ny", "nz")


@pytest.mark.parametrize("name", ["ckpt_29999_rank{}.pt", "point_cloud_rk{}_ws3.ply"])
def test_ranks_of_several_gpus(tmp_path, name):
    """Any of them is all of them; a file of another run or number does not matter, a missing or odd
    one is refused.
    """
    g = gaussians(30, 1, 0)
    paths = [tmp_path / name.format(rank) for rank in range(3)]
    for rank, path in enumerate(paths):
        part = g.select(torch.arange(10) + 10 * rank)
        if path.suffix == ".pt":
            corrections = {"pose_adjust": {}} if rank == 1 else {}
            torch.save({"splats": to_gsplat(part), **corrections}, path)
        else:
            write_rows(path, inria_rows(part))
    for other in (name.replace("_r", "0_r"), name.replace("{}", "_").replace("ws3", "ws4")):
        (tmp_path / other.format(9)).write_bytes(b"another")
    found = [load(path) for path in paths]
    assert all(each.gaussians == g for each in found)
    assert len({each.fingerprint for each in found}) == 1
    assert found[0].notes[-1] == "its 3 ranks, in files beside it, are read as one checkpoint"
    assert any("(pose_adjust)" in note for note in found[0].notes) == (path.suffix == ".pt")
    with refused("is the input file"):
        save(paths[2], g, found[0])
    save(tmp_path / "out.ply", g, found[0])
    assert load(tmp_path / "out.ply").gaussians == g
    shutil.copy(tmp_path / "out.ply", tmp_path / "out_rk1_ws3.ply")  # of this package
    assert load(tmp_path / "out_rk1_ws3.ply").gaussians == g
    if path.suffix == ".pt":
        torch.save({"splats": to_gsplat(gaussians(5, 2, 0))}, paths[1])
    else:
        write_rows(paths[1], inria_rows(gaussians(5, 2, 0)))
    with refused(f"{paths[0].name}: does not fit the other ranks"):
        load(paths[0])
    paths[1].unlink()
    with refused(f"{paths[2].name}: is of a checkpoint of several GPUs, whose rank 1 is not"):
        load(paths[2])


@pytest.mark.parametrize(
    ("name", "what"), [("pose_adjust", "cameras"), ("post_processing", "colours")]
)
def test_corrections_of_gsplat_are_not_applied(tmp_path, name, what):
    """A warning says so."""
    module = {"embeds.weight": torch.zeros(3, 9)}
    torch.save({"splats": to_gsplat(gaussians(12, 0, 0)), name: module}, tmp_path / "a.pt")
    (warning,) = (note for note in load(tmp_path / "a.pt").notes if note.startswith("warning: "))
    assert f"trained with {what}" in warning and f"({name})" in warning


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_splat_transform_reads_files(tmp_path, suffix):
    """It keeps the dial's columns of a PLY bit for bit and in order, but drops the comments with
    the settings.
    """
    write(tmp_path / f"a{suffix}", model(3))
    splat_transform(tmp_path / f"a{suffix}", tmp_path / "b.ply")
    ours, found = load(tmp_path / f"a{suffix}").gaussians, load(tmp_path / "b.ply")
    theirs, atol = found.gaussians, 0.0 if suffix == ".ply" else 1e-5
    for name in ("means", "sh0", "shN"):
        assert_close(getattr(theirs, name), getattr(ours, name), atol=atol, rtol=0)
    assert_close(covariances(theirs), covariances(ours), atol=1e-6, rtol=1e-3)
    # 1.1e-3: the levels 0 and 255 are read as a quarter of a level inside.
    assert_close(theirs.opacities, ours.opacities, atol=1.1e-3, rtol=0)
    if suffix == ".ply":
        for name in ("sigma_d", "growth_d"):
            assert torch.equal(getattr(theirs, name), getattr(ours, name))
        assert theirs.attenuation == AttenuationConfig(reference_distance=3.217)
        assert any("its dial is not described" in note for note in found.notes)
        # of version 4, which splat-transform reads
        splat_transform(tmp_path / "b.ply", tmp_path / "c.spz")
        assert load(tmp_path / "c.spz").gaussians.means.shape == theirs.means.shape
