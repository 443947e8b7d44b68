"""Settings as columns, for tools that drop the comments of a PLY."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData

from clod_adapter.adapter import with_dial
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.inspection.report import inspect
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.ply_settings import simplest
from formats import splat_transform, without_comments, write_rows
from scenes import camera, gaussians

USUAL = AttenuationConfig(reference_distance=3.0)
PAPER = AttenuationConfig(tau=1 / 255, cut="hard", normalizer="max", reference_distance=3.0)
EACH = {
    "usual": USUAL, "tau": replace(USUAL, tau=0.013), "faint": replace(USUAL, tau=1.23457e-05),
    "large tau": replace(USUAL, tau=0.4, max_sv=2.0), "hard": replace(USUAL, cut="hard"), "paper": PAPER,
    "eps": replace(USUAL, eps=1e-6), "no eps": replace(USUAL, eps=0.0),
    "quantile": replace(USUAL, normalizer="quantile"), "median": replace(USUAL, normalizer="quantile", quantile=0.5),
}  # fmt: skip


def model(config: AttenuationConfig, growth: bool = False) -> Gaussians:
    some = with_dial(gaussians(400, 1, 2), torch.logspace(-1, 1.3, 400), config)
    return some.replace(growth_d=torch.linspace(-1, 3, 400)) if growth else some


def same_dial(found: Gaussians, g: Gaussians) -> None:
    """The same Gaussians are kept and drawn, bit for bit, at three dial values."""
    assert found.sigma_d is not None and g.sigma_d is not None and found.attenuation and g.attenuation
    for s in (1.0, 1.7, 3.1):
        want, got = (
            attenuate(x.opacity_logits, x.sigma_d, (x.means, camera()), s, x.attenuation)  # type: ignore[arg-type]
            for x in (g, found)
        )
        assert torch.equal(want.keep, got.keep) and torch.equal(want.drawn, got.drawn)
        assert 0 < want.keep.sum() < len(g) or s > 1 / g.attenuation.tau


@pytest.mark.parametrize("name", EACH)
def test_dial_survives_a_rewrite_without_comments(tmp_path: Path, name: str) -> None:
    config = EACH[name]
    g = model(config)
    save(tmp_path / "a.ply", g)
    assert load(tmp_path / "a.ply").gaussians.attenuation == config
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    assert rows.dtype.names[-1] == "sigma_d" and (name == "usual") == ("clod_" not in " ".join(rows.dtype.names))
    path = without_comments(tmp_path / "a.ply")
    again = load(path).gaussians
    same_dial(again, g)
    for field in ("tau", "cut", "eps", "normalizer", "quantile"):
        assert getattr(again.attenuation, field) == getattr(config, field)
    found = inspect(path)
    assert found.splat is not None and found.splat.dial is not None and found.splat.extra == ()
    assert found.splat.dial.attenuation == again.attenuation
    assert name != "paper" or any("read from columns: tau, cut, normalizer" in note for note in found.notes)
    if name in ("usual", "paper"):
        splat_transform(tmp_path / "a.ply", tmp_path / "b.ply")
        other = load(tmp_path / "b.ply")
        assert not any("clod_adapter" in comment for comment in other.comments)
        same_dial(other.gaussians, g)


@pytest.mark.parametrize("unit", [1.0, 7.0])
@pytest.mark.parametrize("distance", [0.0, 3.0, 0.123456789])
@pytest.mark.parametrize("name", ["usual", "paper", "median"])
def test_growth_survives_a_rewrite_without_comments(tmp_path: Path, name: str, distance: float, unit: float) -> None:
    g = model(replace(EACH[name], reference_distance=distance, scene_distance=unit), growth=True)
    save(tmp_path / "a.ply", g)
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    assert rows.dtype.names[-2:] == ("sigma_d", "growth_d")
    again = load(without_comments(tmp_path / "a.ply")).gaussians
    for s in (1.7, 3.1):
        want, got = (
            attenuate(x.opacity_logits, x.sigma_d, (x.means, camera()), s, x.attenuation, growth_d=x.growth_d).growth
            for x in (g, again)
        )
        assert want is not None and got is not None and want.max() > 1.1
        torch.testing.assert_close(got, want, rtol=1e-5, atol=0)  # the columns are float32


def test_comments_take_precedence_over_columns(tmp_path: Path) -> None:
    exact = replace(USUAL, tau=0.0123456789012345)
    save(tmp_path / "a.ply", model(exact))
    base = load(tmp_path / "a.ply")
    assert base.gaussians.attenuation == exact and base.notes == ()
    save(tmp_path / "b.ply", base.gaussians.replace(attenuation=replace(USUAL, cut="hard")), base)
    names = PlyData.read(str(tmp_path / "b.ply"))["vertex"].data.dtype.names
    assert names[-2:] == ("clod_hard_cut", "sigma_d") and "clod_tau" not in names
    assert load(without_comments(tmp_path / "b.ply")).gaussians.attenuation == AttenuationConfig(cut="hard")
    save(tmp_path / "c.ply", base.gaussians.replace(sigma_d=None, attenuation=None), base)
    assert "clod_tau" not in PlyData.read(str(tmp_path / "c.ply"))["vertex"].data.dtype.names


@settings(max_examples=200)
@given(st.integers(1, 999_999), st.integers(-12, 4))
def test_six_digits_are_read_as_written(digits: int, power: int) -> None:
    value = float(f"{digits}e{power}")
    assert simplest(np.float32(value)) == value


@settings(max_examples=200)
@given(st.floats(2**-90, 2**90, width=32))
def test_value_read_is_the_float32_stored(value: float) -> None:
    assert np.float32(simplest(np.float32(value))) == np.float32(value)


@pytest.mark.parametrize(
    ("rows", "value", "message"),
    [
        (3, 0.5, "property clod_tau must be one value for all rows and has several"),
        (slice(None), np.nan, "clod_tau"),
    ],
)
def test_invalid_column_values_are_refused(tmp_path: Path, rows: Any, value: float, message: str) -> None:
    save(tmp_path / "a.ply", model(EACH["tau"]))
    table = np.array(PlyData.read(str(tmp_path / "a.ply"))["vertex"].data)
    table["clod_tau"][rows] = value
    write_rows(tmp_path / "b.ply", table)
    for read in (load, inspect):
        with pytest.raises(ClodError, match=message):
            read(tmp_path / "b.ply")
