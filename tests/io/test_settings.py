"""Settings in files: one tolerance for every format and for adapters."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from clod_adapter.adapter import Adapter, detach, extract
from clod_adapter.calibration import Calibration
from clod_adapter.config import CLASSIC, FILTERS, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.adapter_file import load_adapter, save_adapter
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import write
from clod_adapter.io.ply.columns import inria_dtype
from clod_adapter.io.settings import EARLIER, read_metadata
from formats import ATTENUATION, CALIBRATION, change_document, model

pytest.importorskip("pygltflib", reason="pygltflib is not installed")
KINDS = ["a.ply", "a.glb", "a.spz", "a.safetensors", "a.pt", "adapter.safetensors"]
OTHER = ScreenFilter(variance=0.123456789, compensate=True)


class Read(NamedTuple):
    attenuation: AttenuationConfig | None
    screen_filter: ScreenFilter
    calibration: Calibration | None
    notes: tuple[str, ...]


def written(path: Path, screen_filter: ScreenFilter = CLASSIC) -> Path:
    g = model(0).replace(screen_filter=screen_filter)
    if path.name.startswith("adapter"):
        adapter = extract(detach(model(0)), g, fingerprint="0", config={})
        save_adapter(path, replace(adapter, calibration=CALIBRATION))
    else:
        write(path, g, calibration=CALIBRATION)
    return path


def read(path: Path) -> Read:
    if path.name.startswith("adapter"):
        found: Adapter = load_adapter(path)
        return Read(found.attenuation, found.screen_filter, found.calibration, found.notes)
    base = load(path)
    notes = tuple(note for note in base.notes if "opacity = +inf" not in note and "quantised" not in note)
    return Read(base.gaussians.attenuation, base.gaussians.screen_filter, base.calibration, notes)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("screen_filter", [CLASSIC, OTHER], ids=["classic", "other"])
def test_settings_survive(tmp_path: Path, kind: str, screen_filter: ScreenFilter) -> None:
    path = written(tmp_path / kind, screen_filter)
    assert read(path) == (ATTENUATION, screen_filter, CALIBRATION, ())
    change_document(path, lambda values: None)
    assert read(path) == (ATTENUATION, screen_filter, CALIBRATION, ())


def nested(name: str, **changes: Any) -> Callable[[dict[str, Any]], object]:
    return lambda values: values[name].update(changes)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (nested("attenuation", tau="banana"), "could not convert string to float: 'banana'"),
        (nested("attenuation", tau=7), "tau is 7.0, it must be between 0 and 1"),
        (nested("attenuation", normalizer="mean"), "normalizer is mean, it must be one of"),
        (nested("attenuation", scene_distance="nan"), "scene_distance is nan"),
        (nested("screen_filter", compensate="yes"), "compensate is yes, it must be true or false"),
        (nested("screen_filter", variance=-1), "variance is -1.0, it must be between"),
        (lambda values: values.update(screen_filter="0.3"), "zip"),
        (lambda values: values.update(screen_filter="0.3 True 1"), "zip"),
    ],
)
def test_a_damaged_setting_is_refused(
    tmp_path: Path, kind: str, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    path = change_document(written(tmp_path / kind, FILTERS["on"]), change)
    with pytest.raises(ClodError, match=f"{kind}: its settings are damaged .*{message}.*; restore them, or export"):
        read(path)


@pytest.mark.parametrize("kind", KINDS[1:])
@pytest.mark.parametrize(
    "change",
    [
        lambda values: values.update(attenuation=3), nested("attenuation", tau=None),
        lambda values: values.update(screen_filter=None), lambda values: values.update(screen_filter=[]),
        lambda values: values.update(origin=[1, 2]), lambda values: values.update(origin="far"),
        lambda values: values.update(package_version=1), lambda values: values.pop("format"),
        lambda values: values.update(about=["long"] * 20_000),
    ],
)  # fmt: skip
def test_a_damaged_document_is_refused(tmp_path: Path, kind: str, change: Callable[[dict[str, Any]], object]) -> None:
    path = change_document(written(tmp_path / kind), change)
    with pytest.raises(ClodError, match=f"{kind}: its settings are damaged"):
        read(path)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_a_newer_format_is_refused(tmp_path: Path, kind: str) -> None:
    path = change_document(written(tmp_path / kind), lambda values: values.update(format_version=3))
    with pytest.raises(ClodError, match=f"{kind}: its format 3 is too new.*upgrade"):
        read(path)
    change_document(path, lambda values: values.update(format="other"))
    with pytest.raises(ClodError, match=f"{kind}: is not a .*'other'"):
        read(path)


@pytest.mark.parametrize("kind", KINDS)
def test_an_unknown_setting_is_noted(tmp_path: Path, kind: str) -> None:
    path = change_document(written(tmp_path / kind), nested("attenuation", new_field=1, new_too="x"))
    want = ("settings unknown to this version ignored: 'new_field', 'new_too'",)
    assert read(path) == (ATTENUATION, CLASSIC, CALIBRATION, want)


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_setting_has_the_default_of_earlier_versions(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path / kind)
    change_document(path, lambda values: values.update(attenuation={"scene_distance": 2.5}))
    found = read(path)
    assert found.attenuation is not None
    assert (found.attenuation.tau, found.attenuation.cut, found.attenuation.max_sv) == (1 / 255, "hard", 5)
    assert found.attenuation.reference_distance == 2.5
    (note,) = found.notes
    assert "earlier versions: tau, cut, eps, normalizer, quantile, max_sv" in note
    change_document(path, lambda values: values.pop("attenuation"))
    assert read(path).attenuation == AttenuationConfig(**EARLIER, reference_distance=1.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda values: values["calibration"]["rows"][0].update(virtual_scale="one"), "unusable and ignored"),
        (lambda values: values["calibration"]["rows"][0].update(virtual_scale=3.0), "unusable and ignored.*ascend"),
        (nested("calibration", total=0), "unusable and ignored.*not positive"),
        (nested("calibration", against="paintings"), "unusable and ignored.*against 'paintings'"),
    ],
)
def test_a_damaged_calibration_is_ignored(
    tmp_path: Path, kind: str, change: Callable[[dict[str, Any]], object], said: str
) -> None:
    found = read(change_document(written(tmp_path / kind), change))
    assert found.calibration is None and found.attenuation == ATTENUATION
    assert len(found.notes) == 1 and re.search(said, found.notes[0])


@pytest.mark.parametrize("kind", KINDS[:-1])
def test_a_calibration_of_other_gaussians_is_ignored(tmp_path: Path, kind: str) -> None:
    found = read(change_document(written(tmp_path / kind), nested("calibration", total=41)))
    assert found.calibration is None
    assert found.notes == ("the calibration is of 41 Gaussians and ignored, these are 40",)


# As an earlier version wrote them.
HEADER = """version 0.1.0
tau 0.02
cut soft
eps 1e-08
normalizer scene
quantile 0.95
scene_distance 9.894437842071056
max_sv 5.0"""


def test_a_header_of_an_earlier_version_is_read_as_before(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "a.ply"
    rows = np.zeros(50, inria_dtype(0, dial=True))
    for name in rows.dtype.names or ():
        rows[name] = rng.normal(size=50)
    lines = [f"clod_adapter {comment}" for comment in HEADER.splitlines()]
    PlyData([PlyElement.describe(rows, "vertex", comments=lines)], byte_order="<").write(str(path))
    checkpoint = load(path)
    want = AttenuationConfig(scene_distance=9.894437842071056, reference_distance=9.894437842071056)
    assert checkpoint.gaussians.attenuation == want and checkpoint.notes == ()
    assert checkpoint.gaussians.sigma_d is not None
    assert checkpoint.gaussians.sigma_d.numpy().tobytes() == rows["sigma_d"].tobytes()
    save(tmp_path / "b.ply", checkpoint.gaussians, checkpoint)  # and written as this version does
    again = load(tmp_path / "b.ply").gaussians
    assert again.attenuation == AttenuationConfig(reference_distance=9.894437842071056) and again.sigma_d is not None
    positive = rows["sigma_d"] > 0
    want_sigma = 9.894437842071056 * rows["sigma_d"][positive]
    np.testing.assert_allclose(again.sigma_d.numpy()[positive], want_sigma, rtol=1e-5)


def test_a_document_of_an_earlier_version_is_read_as_before(tmp_path: Path) -> None:
    found = read_metadata(tmp_path, {"attenuation": EARLIER | {"scene_distance": 3.5}}, dial=True)
    assert found.attenuation == AttenuationConfig(**EARLIER | {"scene_distance": 3.5, "reference_distance": 3.5})
    assert found.notes == () and found.screen_filter is None


@pytest.mark.parametrize("tau", [0.02, 0.19, 0.2, 0.5, 0.98])
def test_an_unknown_range_fits_the_tau(tmp_path: Path, tau: float) -> None:
    found = read_metadata(tmp_path, {"attenuation": {"tau": tau}}, dial=True, described=False).attenuation
    assert found is not None and found.tau == tau and found.max_sv >= 1 and (found.max_sv == 5) == (tau < 0.2)


def test_without_a_dial_there_are_no_settings_of_one(tmp_path: Path) -> None:
    assert read_metadata(tmp_path, {"attenuation": asdict(ATTENUATION)}, dial=False).attenuation is None
