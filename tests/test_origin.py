"""Scenes far from 0 are read relative to an origin and written back exactly."""

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

import clod_adapter as clod
from clod_adapter.origin import NOWHERE, origin_of
from scenes import gaussians

UTM = np.array([437_123.25, -4_481_010.5, 1_000.0])


def moved(path: Path, out: Path, kind: str) -> Path:
    """The file's coordinates UTM away, as columns of ``kind``."""
    old = PlyData.read(str(path))["vertex"].data
    new = old.astype([(name, kind if name in "xyz" else old.dtype[name]) for name in old.dtype.names])
    for axis, by in zip("xyz", UTM, strict=True):
        new[axis] = old[axis].astype("f8") + by
    PlyData([PlyElement.describe(new, "vertex")], byte_order="<").write(str(out))
    return out


def test_only_distant_scenes_have_an_origin() -> None:
    near = np.random.default_rng(0).normal(size=(500, 3))
    floater = np.concatenate([near, [[1e9, 0, 0]]])
    none = (near, near + 40, floater, near[:1] + UTM, np.zeros((0, 3)), np.full((3, 3), np.nan))
    assert {origin_of(each) for each in none} == {NOWHERE}
    assert np.abs(np.array(origin_of(floater + UTM)) - UTM).max() < 5
    for length in (1e-320, 1e-9):
        assert origin_of(np.linspace([1, 0, 0], [1, 0, length], 100))[0] == 1.0
    origin = origin_of(near * [1, 1, 1e-3] + [1e6, -0.1, -1e-4])
    assert origin[0] > 9e5 and [str(value) for value in origin[1:]] == ["0.0", "0.0"]  # not -0.0


@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_round_trip_of_distant_scenes_is_exact(tmp_path: Path, kind: str) -> None:
    base = gaussians(200, 1, 0)
    clod.save(tmp_path / "near.ply", base)
    far = clod.load(moved(tmp_path / "near.ply", tmp_path / "far.ply", kind))
    stored = np.stack([far.vertex[axis].astype("f8") for axis in "xyz"], 1)
    np.testing.assert_allclose(far.gaussians.means.double().numpy() + far.origin, stored, rtol=0, atol=3e-7)
    if kind == "f8":  # the picture is that of the scene near 0
        apart = (far.gaussians.means - base.means).double().numpy() + far.origin - UTM
        assert np.abs(apart).max() < 1e-6
    else:
        assert (far.gaussians.means.double().numpy() + far.origin == stored).all()
    assert "far from 0" in far.notes[-1]
    tuned = far.gaussians.means.clone()
    tuned[:50] += 1e-4
    clod.save(tmp_path / "out.ply", clod.with_dial(far.gaussians.replace(means=tuned)), far)
    out = PlyData.read(str(tmp_path / "out.ply"))["vertex"].data
    written = np.stack([out[axis] for axis in "xyz"], 1)
    assert written.dtype == np.float64 and (written[50:] == stored[50:]).all()
    np.testing.assert_allclose(written[:50], tuned[:50].double().numpy() + far.origin, rtol=0, atol=1e-9)
    again = clod.load(tmp_path / "out.ply", origin=far.origin)
    assert again.gaussians.means.equal(tuned) and again.origin == far.origin
    adapter = clod.extract(far.gaussians, clod.with_dial(far.gaussians), fingerprint="", config={}, origin=far.origin)
    clod.save_adapter(tmp_path / "far.safetensors", adapter)
    assert clod.load_adapter(tmp_path / "far.safetensors").origin == far.origin
