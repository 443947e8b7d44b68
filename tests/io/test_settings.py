"""Settings in files: one reader, which every format and the adapter use; in a PLY comments, and columns for tools that
drop comments; the screen-space filter as other programs state it."""

from __future__ import annotations

import re
import zlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData

from clod_adapter.adapter import Adapter, detach, extract, with_dial
from clod_adapter.calibration import Calibration
from clod_adapter.config import CLASSIC, FILTERS, AttenuationConfig, ScreenFilter
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.equation.extinction import sigma_for_extinction
from clod_adapter.equation.units import estimated_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.inspection.report import inspect
from clod_adapter.io.adapter_file import load_adapter, save_adapter
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import write
from clod_adapter.io.ply import inria_dtype
from clod_adapter.io.ply_settings import simplest
from clod_adapter.io.settings import EARLIER, implied_filter, is_antialiased, parse_metadata, read_metadata, tagged
from formats import ATTENUATION, CALIBRATION, change_setting, model, splat_transform, without_comments, write_rows
from scenes import camera, gaussians

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


def test_spz_flag(tmp_path: Path) -> None:
    """Bit 0: written with every compensating filter; other programs store nothing else."""

    def flags(path: Path) -> bytearray:
        return bytearray(zlib.decompress(path.read_bytes(), wbits=31))

    plain = detach(model(1))
    for screen_filter, want in ((CLASSIC, 2), (FILTERS["on"], 3), (FILTERS["mip"], 3), (ScreenFilter(variance=1), 2)):
        write(tmp_path / "a.spz", plain.replace(screen_filter=screen_filter))
        assert flags(tmp_path / "a.spz")[14] == want
    write(tmp_path / "a.spz", plain)
    data = flags(tmp_path / "a.spz")
    data[14] |= 1
    gzip = zlib.compressobj(wbits=31)
    (tmp_path / "b.spz").write_bytes(gzip.compress(bytes(data)) + gzip.flush())
    found = load(tmp_path / "b.spz")
    assert found.gaussians.screen_filter == FILTERS["on"] and not found.filter_known
    assert is_antialiased(found.comments)


def test_filter_of_a_dial_is_that_of_its_settings(tmp_path: Path) -> None:
    """It takes precedence over a comment of another program."""
    write(tmp_path / "a.ply", model(1))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"end_header", b"comment antialiased 1\nend_header", 1))
    found = load(tmp_path / "a.ply")
    assert found.gaussians.screen_filter == CLASSIC and found.filter_known
    save(tmp_path / "b.ply", detach(found.gaussians), found)
    assert not is_antialiased(load(tmp_path / "b.ply").comments)


@pytest.mark.parametrize("screen_filter", [*FILTERS.values(), ScreenFilter(variance=0.123, compensate=True)], ids=str)
def test_columns_store_the_filter(tmp_path: Path, screen_filter: ScreenFilter) -> None:
    """In a file with a dial; a plain one has no columns but those of Inria's layout."""
    write(tmp_path / "a.ply", model(1).replace(screen_filter=screen_filter))
    found = load(without_comments(tmp_path / "a.ply"))
    assert found.gaussians.screen_filter == screen_filter and found.filter_known and found.comments == ()
    write(tmp_path / "b.ply", detach(found.gaussians))
    assert not any(name.startswith("clod_") for name in load(tmp_path / "b.ply").vertex.dtype.names or ())


def test_columns_of_other_programs_and_damaged_columns(tmp_path: Path) -> None:
    write(tmp_path / "a.ply", detach(model(1)))
    found = load(without_comments(tmp_path / "a.ply", filter_3D=0.01))  # of Mip-Splatting
    assert found.gaussians.screen_filter == FILTERS["mip"] and not found.filter_known
    save(tmp_path / "b.ply", found.gaussians, found)  # without the column, which is fused
    assert load(tmp_path / "b.ply").gaussians.screen_filter == FILTERS["mip"]
    write(tmp_path / "a.ply", model(1))
    with pytest.raises(ClodError, match=r"rewritten.ply: its settings are damaged \(variance is -1.0"):
        load(without_comments(tmp_path / "a.ply", clod_screen_variance=-1.0))


def test_comments_of_other_programs() -> None:
    """Brush, whose filter has 0.1 px^2, splat-transform and Postshot."""
    assert not is_antialiased(["SplatRenderMode: default", "antialiased 0", "not antialiased 1"])
    assert implied_filter((), ("x", "y")) == implied_filter(("antialiased 0",), ()) == CLASSIC
    assert implied_filter(("Exported from Brush", "SplatRenderMode: mip"), ()) == FILTERS["mip"]
    mixed = ["made by hand", "SplatRenderMode: default", "antialiased 0"]
    assert tagged(mixed, CLASSIC) == mixed
    assert tagged(mixed, FILTERS["on"]) == ["made by hand", "SplatRenderMode: mip"]
    for comment in ("SplatRenderMode: mip", "antialiased 1"):
        assert implied_filter(("x", comment), ()) == FILTERS["on"]
        assert tagged(["made by hand", comment], FILTERS["on"]) == ["made by hand", comment]
        assert tagged(["made by hand", comment], CLASSIC) == ["made by hand"]


USUAL = AttenuationConfig(reference_distance=3.0)
EACH = {
    "usual": USUAL, "tau": replace(USUAL, tau=0.013), "faint": replace(USUAL, tau=1.23457e-05),
    "large tau": replace(USUAL, tau=0.4, max_sv=2.0), "hard": replace(USUAL, cut="hard"),
    "paper": AttenuationConfig(tau=1 / 255, cut="hard", normalizer="max", reference_distance=0.123456789),
    "eps": replace(USUAL, eps=1e-6), "no eps": replace(USUAL, eps=0.0), "unit": replace(USUAL, scene_distance=7.0),
    "quantile": replace(USUAL, normalizer="quantile"), "unknown distance": replace(USUAL, reference_distance=0.0),
    "median": replace(USUAL, normalizer="quantile", quantile=0.5, reference_distance=0.0),
}  # fmt: skip


def dialled(config: AttenuationConfig, growth: bool = False) -> Gaussians:
    growth_d = torch.linspace(-1, 3, 400) if growth else None
    return with_dial(gaussians(400, 1, 2), torch.logspace(-1, 1.3, 400), config, growth_d)


def same_dial(found: Gaussians, g: Gaussians) -> None:
    """The same Gaussians are kept and drawn, bit for bit, at three dial values; they grow alike, to float32."""
    assert found.sigma_d is not None and g.sigma_d is not None and found.attenuation and g.attenuation
    for s in (1.0, 1.7, 3.1):
        want, got = (
            attenuate(x.opacity_logits, x.sigma_d, (x.means, camera()), s, x.attenuation, growth_d=x.growth_d)  # type: ignore[arg-type]
            for x in (g, found)
        )
        if g.attenuation.scene_distance == 1:  # else sigma_d was rounded once more
            assert torch.equal(want.keep, got.keep) and torch.equal(want.drawn, got.drawn)
        assert 0 < want.keep.sum() < len(g) or s > 1 / g.attenuation.tau
        assert (want.growth is None) == (got.growth is None)
        if want.growth is not None:
            torch.testing.assert_close(got.growth, want.growth, rtol=1e-5, atol=0)


@pytest.mark.parametrize("growth", [False, True])
@pytest.mark.parametrize("name", EACH)
def test_dial_survives_a_rewrite_without_comments(tmp_path: Path, name: str, growth: bool) -> None:
    config, g = EACH[name], dialled(EACH[name], growth)
    save(tmp_path / "a.ply", g)
    assert name == "unit" or load(tmp_path / "a.ply").gaussians.attenuation == config
    names = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data.dtype.names
    assert names[-2:] == ("sigma_d", "growth_d") if growth else names[-1] == "sigma_d"
    usual = name in ("usual", "unit", "unknown distance") and not growth
    assert usual == ("clod_" not in " ".join(names)) or (growth and name == "unknown distance")
    path = without_comments(tmp_path / "a.ply")
    again = load(path).gaussians
    same_dial(again, g)
    for field in ("tau", "cut", "eps", "normalizer", "quantile"):
        assert getattr(again.attenuation, field) == getattr(config, field)
    found = inspect(path)
    assert found.splat is not None and found.splat.dial is not None and found.splat.extra == ()
    assert found.splat.dial.attenuation == again.attenuation
    assert growth or name != "paper" or any("read from columns: tau, cut, normalizer" in note for note in found.notes)
    if name in ("usual", "paper"):
        splat_transform(tmp_path / "a.ply", tmp_path / "b.ply")
        other = load(tmp_path / "b.ply")
        assert not any("clod_adapter" in comment for comment in other.comments)
        same_dial(other.gaussians, g)


def test_comments_take_precedence_over_columns(tmp_path: Path) -> None:
    exact = replace(USUAL, tau=0.0123456789012345)
    save(tmp_path / "a.ply", dialled(exact))
    base = load(tmp_path / "a.ply")
    assert base.gaussians.attenuation == exact and base.notes == ()
    save(tmp_path / "b.ply", base.gaussians.replace(attenuation=replace(USUAL, cut="hard")), base)
    names = PlyData.read(str(tmp_path / "b.ply"))["vertex"].data.dtype.names
    assert names[-2:] == ("clod_hard_cut", "sigma_d") and "clod_tau" not in names
    assert load(without_comments(tmp_path / "b.ply")).gaussians.attenuation == AttenuationConfig(cut="hard")
    save(tmp_path / "c.ply", base.gaussians.replace(sigma_d=None, attenuation=None), base)
    assert "clod_tau" not in PlyData.read(str(tmp_path / "c.ply"))["vertex"].data.dtype.names


@settings(max_examples=200)
@given(st.integers(1, 999_999), st.integers(-12, 4), st.floats(2**-90, 2**90, width=32))
def test_numbers_of_columns_are_read_as_written(digits: int, power: int, value: float) -> None:
    """Up to six digits exactly, others as the float32 that is stored."""
    assert simplest(np.float32(f"{digits}e{power}")) == float(f"{digits}e{power}")
    assert np.float32(simplest(np.float32(value))) == np.float32(value)


def test_invalid_column_values_are_refused(tmp_path: Path) -> None:
    save(tmp_path / "a.ply", dialled(EACH["tau"]))
    for rows, value, message in (
        (3, 0.5, "property clod_tau must be one value for all rows and has several"), (slice(None), np.nan, "clod_tau"),
    ):  # fmt: skip
        table = np.array(PlyData.read(str(tmp_path / "a.ply"))["vertex"].data)
        table["clod_tau"][rows] = value
        write_rows(tmp_path / "b.ply", table)
        for read in (load, inspect):
            with pytest.raises(ClodError, match=message):
                read(tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("factor", "begin", "parts"),
    [
        (1.0, "its dial is not", ["world units, tau 0.02, soft cut: keeps 60% at s = 1"]),
        (0.05, "warning: ", ["keeps 0% at s = 1", "likely not what was adapted"]),
    ],
)
def test_file_without_settings_has_a_note(tmp_path: Path, factor: float, begin: str, parts: list[str]) -> None:
    """The file keeps six tenths at s = 1 from its reference distance; sigma_d is multiplied by ``factor``."""
    config, path, some = AttenuationConfig(), tmp_path / "a.ply", gaussians(500, 0, 1)
    some = some.replace(means=10 * some.means, opacity_logits=some.opacity_logits.clamp(min=-2))
    d = torch.full((500,), estimated_distance(some.means))
    sigma = sigma_for_extinction(some.opacity_logits, d, torch.linspace(0.5, 1.75, 500), config)
    save(path, with_dial(some, factor * sigma, config))
    assert load(path).notes == () and inspect(path).notes == ()
    base = load(without_comments(path))
    assert base.gaussians.attenuation == config
    for notes in (base.notes, inspect(path.with_name("rewritten.ply")).notes):
        (note,) = notes
        assert note.startswith(begin) and all(part in note for part in parts)
