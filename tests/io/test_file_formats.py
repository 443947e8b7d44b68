"""Checks that hold for every format: round trips, damaged files, refused models."""

import gzip
import re
import zipfile

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData
from refusals import refused
from torch.testing import assert_close

from clod_adapter.adapter import detach, extract
from clod_adapter.errors import ClodError
from clod_adapter.inspection.report import inspect
from clod_adapter.io.adapter_file import load_adapter, save_adapter
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import WRITABLE, check_readable, file_has_dial, write
from clod_adapter.io.settings import Metadata
from clod_adapter.origin import NOWHERE
from formats import (
    ATTENUATION,
    ORIGIN,
    PACKED,
    QUALITY_TABLE,
    damaged,
    examples,
    model,
    rows_by_place,
    splat_transform,
    turned,
    write_elements,
)

ABOUT = "made in a test", "of two lines"
KINDS = (*WRITABLE, ".ascii.ply", ".big.ply", ".adapter.safetensors")


# Largest differences of positions, log scales, opacities, sh0, shN and sigma_d, and the largest
# angle.
EXACT = (0, 0, 0, 0, 0, 0, 1e-6)
LOSSES = {
    ".spz": (2.0**-20, 0.5001 / 16, 0.501 / 255, 0.51 / (0.15 * 255), 2.01 / 128, 2.0**-11, 5e-3),
    ".spz of splat-transform": (
        1.25e-4,
        0.5001 / 16,
        0.501 / 255,
        0.51 / (0.15 * 255),
        8.6 / 128,
        0,
        5e-3,
    ),
    ".compressed.ply": (4e-3, 2e-3, 0.51 / 255, 0.015, 4.1 / 128, 0, 9e-3),
}


def any_file(folder, kind):
    path, g = folder / f"a{kind}", model(0, 5)
    if kind == ".adapter.safetensors":
        save_adapter(path, extract(detach(g), g, fingerprint="ab", config={"steps": 3}))
        return path
    write(path, g, Metadata(quality_table=QUALITY_TABLE if g.sigma_d is not None else None))
    if kind in (".ascii.ply", ".big.ply"):
        write_elements(
            path,
            PlyData.read(str(path), mmap=False).elements,
            "ascii" if kind == ".ascii.ply" else ">",
        )
    return path


def read(path):
    load_adapter(path) if "adapter" in path.name else load(path, activated="none")


def same(kind, g, again):
    """Compares to the precision of the format."""
    *losses, sigma, angle = LOSSES.get(kind, EXACT)
    shN = g.shN.clamp(-1, 127 / 128) if "spz" in kind else g.shN
    wanted = g.replace(shN=shN)
    names = ("means", "log_scales", "opacities", "sh0", "shN")
    for name, atol in zip(names, losses, strict=True):
        assert_close(getattr(again, name), getattr(wanted, name), rtol=0, atol=atol, msg=name)
    assert turned(again.quats, g.quats) <= angle
    for name in ("sigma_d", "growth_d"):
        found, wanted_dial = getattr(again, name), getattr(g, name)
        assert (found is None) == (wanted_dial is None)
        if found is not None:
            most = wanted_dial.clamp(max=65504) if sigma else wanted_dial  # the largest float16
            assert_close(found, most, rtol=sigma, atol=1e-6 * sigma)


@pytest.mark.parametrize("kind", [".spz of splat-transform", ".compressed.ply"])
def test_files_of_splat_transform(capture, kind):
    """Files of version 3.7: an .spz of version 3; two blocks."""
    if "compressed" in kind:
        splat_transform("--version")
    found = load(PACKED.with_name(f"capture{kind.split()[0]}"))
    rows = rows_by_place(capture.gaussians.means.numpy(), found.gaussians.means.numpy())
    same(kind, capture.gaussians, found.gaussians[torch.from_numpy(rows)])
    assert found.gaussians.opacity_logits.isfinite().all() and not any(found.origin)
    assert any("quantised" in note for note in found.notes)


@pytest.mark.parametrize("suffix", WRITABLE)
@pytest.mark.parametrize(
    ("turn", "far", "growth"), [(0, False, False), (2, True, True), (3, False, True)]
)
def test_dial_round_trips(tmp_path, suffix, turn, far, growth):
    """Each SH degree occurs with one format or another."""
    degree = ([*WRITABLE].index(suffix) + turn) % 4
    g, origin = model(degree, growth=growth), ORIGIN if far else NOWHERE
    path = tmp_path / f"a{suffix.upper()}"
    write(path, g, Metadata(quality_table=QUALITY_TABLE, origin=origin, about=ABOUT))
    check_readable(path)
    assert file_has_dial(path)
    found = load(path, origin=origin if suffix == ".ply" else None)  # which a PLY does not store
    same(suffix, g, found.gaussians)
    assert (found.gaussians.attenuation, found.quality_table, found.origin) == (
        ATTENUATION,
        QUALITY_TABLE,
        origin,
    )
    assert found.filter_known and all(line in found.comments for line in ABOUT)
    known = "quantised|opacity = .inf|far from 0"
    assert all(re.search(known, note) for note in found.notes)
    assert (
        any("far from 0: read relative to (510000, -4096, 0.25)" in note for note in found.notes)
        == far
    )
    write(
        tmp_path / f"b{suffix}",
        g,
        Metadata(quality_table=QUALITY_TABLE, origin=origin, about=ABOUT),
    )
    assert path.read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    seen = inspect(path)
    assert seen.splat.dial.calibration == QUALITY_TABLE
    assert seen.splat.dial_columns == "sigma_d" + growth * " and growth_d"
    save(tmp_path / "out.ply", found.gaussians, found, quality_table=found.quality_table)
    again = load(tmp_path / "out.ply", origin=found.origin)
    for name, tensor in again.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(found.gaussians, name)), name
    assert (again.gaussians.attenuation, again.quality_table) == (ATTENUATION, QUALITY_TABLE)


@pytest.mark.parametrize("suffix", WRITABLE)
def test_model_without_dial_round_trips(tmp_path, suffix):
    g, path = detach(model(1)), tmp_path / f"a{suffix}"
    write(path, g)
    assert not file_has_dial(path)
    found = load(path)
    rows = torch.from_numpy(rows_by_place(g.means.numpy(), found.gaussians.means.numpy()))
    assert found.gaussians.sigma_d is None
    assert (found.gaussians.means[rows] - g.means).abs().max() <= 2.0**-20
    assert any("quantised" in note for note in found.notes) == (suffix == ".spz")
    seen = inspect(path)
    assert seen.splat.dial is None
    assert seen.what.endswith(suffix if suffix != ".ply" else "PLY")


@pytest.mark.parametrize("suffix", WRITABLE)
def test_refused_write_leaves_no_file(tmp_path, suffix):
    plain = detach(model(1))
    unfit = [
        (plain.select(torch.zeros(40, dtype=torch.bool)), "no Gaussians to write"),
        (plain.replace(sh0=plain.sh0 * torch.nan), "a value is not finite; drop such rows"),
        (plain.replace(quats=plain.quats * 0), "rotation is zero"),
    ]
    for g, message in unfit:
        with refused(f"a{suffix}: .*{message}"):
            write(tmp_path / f"a{suffix}", g)
    with refused("does not exist"):
        write(tmp_path / "folder" / f"a{suffix}", plain)
    with refused("no format to write"):
        write(tmp_path / "a.obj", plain)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", KINDS)
@examples(15)
@given(data=st.data(), inside=st.booleans())
def test_damage_raises_only_clod_error(tmp_path, kind, data, inside):
    """Damage of the file, or ``inside`` of the contents of an SPZ before compression, or of the
    pickle in a .pt.
    """
    source = tmp_path / f"a{kind}"
    whole = (source if source.exists() else any_file(tmp_path, kind)).read_bytes()
    path = tmp_path / f"damaged{kind}"
    if inside and kind == ".spz":
        path.write_bytes(gzip.compress(damaged(gzip.decompress(whole), data)))
    elif inside and kind == ".pt":
        with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w") as new:
            for name in old.namelist():
                entry = old.read(name)
                new.writestr(name, damaged(entry, data) if name.endswith("data.pkl") else entry)
    else:
        path.write_bytes(damaged(whole, data))
    try:
        read(path)
    except ClodError as error:
        assert str(error).isprintable() and str(path) in str(error)


def test_adapter_is_refused_as_model(tmp_path):
    path = any_file(tmp_path, ".adapter.safetensors")
    for opened in (check_readable, load):
        with refused(f"{path}: is no model but perhaps an adapter; clod-adapt apply BASE.ply"):
            opened(path)


@pytest.mark.parametrize("kind", KINDS)
def test_truncation_is_refused(tmp_path, kind):
    whole, path = any_file(tmp_path, kind).read_bytes(), tmp_path / f"cut{kind}"
    # An ascii file that ends within its last number is a whole file with another number.
    least = len(whole) - whole.rstrip().rfind(b" ") if kind == ".ascii.ply" else 1
    for size in (1, len(whole) // 2, len(whole) - least):
        path.write_bytes(whole[:size])
        with refused(f"cut{kind}: "):
            read(path)


def test_what_cannot_be_read_again_is_not_written(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"earlier")
    with refused(f"^{tmp_path}/a.ply: is not written, because it could not be read again: "):
        write(tmp_path / "a.ply", model(0), Metadata(about=("x" * 1000,) * 1100))
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"earlier"]


def test_text_is_made_ascii_and_infinite_opacity_finite(tmp_path):
    write(tmp_path / "a.pt", model(0), Metadata(about=("caf\u00e9", "clod_adapter max_sv 2")))
    found = load(tmp_path / "a.pt")
    assert found.comments == ("caf?",) and found.gaussians.attenuation == ATTENUATION
    (note,) = write(tmp_path / "a.ply", model())
    assert note == "1 opacities of +inf are written as 20, which is 1 too"
    again = load(tmp_path / "a.ply").gaussians
    assert torch.equal(again.opacities, model().opacities) and again.opacity_logits.isfinite().all()
