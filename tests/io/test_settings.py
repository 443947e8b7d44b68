"""Settings in files: one reader, which every format and the adapter use."""

from __future__ import annotations

import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from clod_adapter.adapter import Adapter, detach, extract
from clod_adapter.calibration import Calibration
from clod_adapter.config import CLASSIC, FILTERS, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.adapter_file import load_adapter, save_adapter
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import write
from clod_adapter.io.ply import inria_dtype
from clod_adapter.io.settings import EARLIER, parse_metadata, read_metadata
from formats import ATTENUATION, CALIBRATION, change_setting, model, write_rows

pytest.importorskip("pygltflib", reason="pygltflib is not installed")
KINDS = ["a.ply", "a.glb", "a.spz", "a.safetensors", "a.pt", "adapter.safetensors"]
OTHER_FORMAT = ("clod-model", "clod-other"), ("clod-adapter", "clod-strange")
OTHER = ScreenFilter(variance=0.123456789, compensate=True)
WHOLE: dict[str, Any] = {
    "format": "clod-model", "format_version": 1, "package_version": "0", "attenuation": asdict(ATTENUATION),
    "screen_filter": asdict(FILTERS["on"]), "calibration": CALIBRATION.as_dict(),
}  # fmt: skip


class Read(NamedTuple):
    attenuation: AttenuationConfig | None
    screen_filter: ScreenFilter
    calibration: Calibration | None
    notes: tuple[str, ...]


def written(path: Path, screen_filter: ScreenFilter = CLASSIC) -> Path:
    g = model(0).replace(screen_filter=screen_filter)
    if path.name.startswith("adapter"):
        adapter = extract(detach(g), g.replace(growth_d=None), fingerprint="0", config={})
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
def test_every_format_uses_the_reader(tmp_path: Path, kind: str) -> None:
    path, ply = tmp_path / kind, kind == "a.ply"
    for screen_filter in (CLASSIC, OTHER):
        assert read(written(path, screen_filter)) == (ATTENUATION, screen_filter, CALIBRATION, ())
    damage = f"{kind}: its settings are damaged .*MESSAGE.*; restore them, or export"
    with pytest.raises(ClodError, match=damage.replace("MESSAGE", "compensate is .*, it must be true or false")):
        read(change_setting(path, *(("0.123456789", "True", "Yess") if ply else ("compensate", "true", "7e+2"))))
    with pytest.raises(ClodError, match=damage.replace("MESSAGE", "tau is 7.02, it must be between 0 and 1")):
        read(change_setting(written(path), "tau", "0.02", "7.02"))
    found = read(change_setting(written(path), "", "max_sv", "max_sx"))
    assert found[:3] == (replace(ATTENUATION, max_sv=EARLIER["max_sv"]), CLASSIC, CALIBRATION)
    assert found.notes == (
        "settings that are missing have the defaults of earlier versions: max_sv",
        "settings unknown to this version ignored: 'max_sx'",
    )
    total = "calibrated_with" if ply else "total"
    found = read(change_setting(written(path), total, "40", "-4"))
    assert found.calibration is None and found.attenuation == ATTENUATION
    assert len(found.notes) == 1 and re.search("unusable and ignored.*not positive", found.notes[0])
    if kind != "adapter.safetensors":
        found = read(change_setting(written(path), total, "40", "41"))
        assert found.calibration is None
        assert found.notes == ("the calibration is of 41 Gaussians and ignored, these are 40",)
    if not ply:
        with pytest.raises(ClodError, match=f"{kind}: its format 9 is too new.*upgrade"):
            read(change_setting(written(path), "format_version", "1", "9"))
        with pytest.raises(ClodError, match=f"{kind}: is not a .*'clod-(other|strange)'"):
            read(change_setting(written(path), "", *OTHER_FORMAT[kind[:2] == "ad"]))


def parse(**changes: Any) -> Any:
    """The settings of a whole document with some values replaced, or removed where None."""
    values = {name: value for name, value in (WHOLE | changes).items() if value is not ...}
    return parse_metadata(Path("a.glb"), values, dial=True)


def nested(name: str, **changes: Any) -> dict[str, Any]:
    return {name: WHOLE[name] | changes}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (nested("attenuation", tau="banana"), "could not convert string to float: 'banana'"),
        (nested("attenuation", tau=None), "float"),
        (nested("attenuation", normalizer="mean"), "normalizer is mean, it must be one of"),
        (nested("attenuation", scene_distance="nan"), "scene_distance is nan"),
        ({"attenuation": 3}, "int"),
        (nested("screen_filter", compensate="yes"), "compensate is yes, it must be true or false"),
        (nested("screen_filter", variance=-1), "variance is -1.0, it must be between"),
        ({"screen_filter": "0.3"}, "zip"), ({"screen_filter": "0.3 True 1"}, "zip"),
        ({"screen_filter": None}, "NoneType"), ({"screen_filter": []}, "list"),
        ({"origin": [1, 2]}, "unpack"), ({"origin": "far"}, ""), ({"package_version": 1}, "package_version is 1"),
        ({"format": ...}, "format"), ({"about": ["long"] * 20_000}, "more than 65,536 characters"),
    ],
)  # fmt: skip
def test_damaged_setting_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ClodError, match=f"a.glb: its settings are damaged .*{message}.*; restore them, or export"):
        parse(**change)


def test_missing_setting_has_the_default_of_earlier_versions() -> None:
    found = parse(attenuation={"scene_distance": 3.5})
    assert found.attenuation == AttenuationConfig(**EARLIER | {"scene_distance": 3.5, "reference_distance": 3.5})
    assert "earlier versions: tau, cut, eps, normalizer, quantile, max_sv" in found.notes[0]
    assert parse(attenuation=...).attenuation == AttenuationConfig(**EARLIER, reference_distance=1.0)
    assert parse(screen_filter=...).screen_filter is None
    assert read_metadata(Path("a"), WHOLE, dial=False).attenuation is None


@pytest.mark.parametrize(
    ("change", "note"),
    [
        ({"rows": [CALIBRATION.as_dict()["rows"][0] | {"virtual_scale": "one"}]}, "unusable and ignored"),
        ({"rows": [CALIBRATION.as_dict()["rows"][0] | {"virtual_scale": 3.0}]}, "unusable and ignored.*ascend"),
        ({"against": "paintings"}, "unusable and ignored.*against 'paintings'"),
    ],
)
def test_damaged_calibration_is_ignored(change: dict[str, Any], note: str) -> None:
    found = parse(**nested("calibration", **change))
    assert found.calibration is None and found.attenuation == ATTENUATION
    assert len(found.notes) == 1 and re.search(note, found.notes[0])


# As an earlier version wrote them.
HEADER = "version 0.1.0, tau 0.02, cut soft, eps 1e-08, normalizer scene, quantile 0.95, "
HEADER += "scene_distance 9.894437842071056, max_sv 5.0"


def test_header_of_an_earlier_version(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "a.ply"
    rows = np.zeros(50, inria_dtype(0, dial=("sigma_d",)))
    for name in rows.dtype.names or ():
        rows[name] = rng.normal(size=50)
    lines = [f"clod_adapter {comment}" for comment in HEADER.split(", ")]
    write_rows(path, rows, comments=lines)
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


@pytest.mark.parametrize("tau", [0.19, 0.2, 0.98])
def test_unknown_range_fits_tau(tmp_path: Path, tau: float) -> None:
    found = read_metadata(tmp_path, {"attenuation": {"tau": tau}}, dial=True, described=False).attenuation
    assert found is not None and found.tau == tau and found.max_sv >= 1 and (found.max_sv == 5) == (tau < 0.2)
