"""Settings in files: one reader, which every format and the adapter use; in a PLY comments, and
columns for tools that drop comments; the screen-space filter as other programs state it.
"""

import gzip
import json
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from plyfile import PlyData
from refusals import refused
from safetensors.torch import load_file, save_file

from clod_adapter.adapter import detach, extract, with_dial
from clod_adapter.config import CLASSIC, FILTERS, AttenuationConfig, ScreenFilter
from clod_adapter.equation.units import estimated_distance, in_world_units
from clod_adapter.inspection.report import inspect
from clod_adapter.integrations.splats import to_gsplat
from clod_adapter.io.adapter_file import load_adapter, save_adapter
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import write
from clod_adapter.io.settings import Metadata
from clod_adapter.io.tensor_file import read_tensors
from clod_adapter.quality_table import Viewpoint
from formats import (
    ATTENUATION,
    QUALITY_TABLE,
    change_setting,
    model,
    needed,
    random_rows,
    resaved,
    without_comments,
    write_rows,
)
from scenes import gaussians


def written(path, screen_filter=CLASSIC):
    g = model(0).replace(screen_filter=screen_filter)
    if path.name.startswith("adapter"):
        adapter = extract(detach(g), g.replace(growth_d=None), fingerprint="0", config={})
        save_adapter(path, replace(adapter, quality_table=QUALITY_TABLE))
    else:
        write(path, g, Metadata(quality_table=QUALITY_TABLE))
    return path


def read(path):
    if path.name.startswith("adapter"):
        adapter = load_adapter(path)
        return (
            adapter.attenuation,
            adapter.screen_filter,
            adapter.quality_table,
            list(adapter.notes),
        )
    base = load(path)
    notes = [
        note for note in base.notes if "opacity = +inf" not in note and "quantised" not in note
    ]
    return base.gaussians.attenuation, base.gaussians.screen_filter, base.quality_table, notes


@pytest.mark.parametrize("kind", ["a.ply", "a.spz", "a.pt", "adapter.safetensors"])
def test_every_format_uses_the_reader(tmp_path, kind):
    path, ply, adapter = tmp_path / kind, kind == "a.ply", kind == "adapter.safetensors"

    def changed(name, old, new, **filters):
        return read(change_setting(written(path, **filters), name, old, new))

    other = ScreenFilter(variance=0.123456789, compensate=True)
    for screen_filter in (CLASSIC, other):
        assert read(written(path, screen_filter)) == (ATTENUATION, screen_filter, QUALITY_TABLE, [])
    damage = f"{kind}: its settings are damaged .*{{}}.*; restore them, or export"
    with refused(damage.format("compensate is .*, it must be true or false")):
        change = ("0.123456789", "True", "Yess") if ply else ("compensate", "true", "7e+2")
        changed(*change, screen_filter=other)
    with refused(damage.format("reference_distance is -3.21, it must be")):
        changed("reference_distance", "3.217", "-3.21")
    notes = ["settings unknown to this version ignored: 'max_sx'"]
    notes += ["settings that are missing have their defaults: max_sv"]
    wanted = replace(ATTENUATION, max_sv=5.0), CLASSIC, QUALITY_TABLE, notes
    assert changed("", "max_sv", "max_sx") == wanted
    total = "calibrated_with" if ply else "total"
    *settings, (note,) = changed(total, "40", "-4")
    assert settings == [ATTENUATION, CLASSIC, None]
    assert re.search("unusable and ignored.*out of range", note)
    if not adapter:
        *settings, (note,) = changed(total, "40", "41")
        assert settings[2] is None
        assert note == "the quality table is of 41 Gaussians and ignored, these are 40"
    if not ply:
        with refused(f"{kind}: its format 9 is too new.*upgrade"):
            changed("format_version", "3" if adapter else "1", "9")
        old, new = ("clod-adapter", "clod-strange") if adapter else ("clod-model", "clod-other")
        with refused(f"{kind}: is not an? .*'{new}'"):
            changed("", old, new)


def described(path, *comments):
    rows = random_rows(40, [*needed(), "sigma_d"])
    return write_rows(path, rows, comments=[f"clod_adapter {comment}" for comment in comments])


def test_damaged_settings_are_refused(tmp_path):
    for comment, message in (
        ("max_sv banana", "could not convert string to float: 'banana'"),
        ("form theirs", "form is theirs, it must be"),
        ("max_sv 0.4", "max_sv is 0.4, it must be"),
        ("scene_distance nan", "scene_distance is nan"),
        ("screen_filter 0.3", "no 'compensate'"),
        ("screen_filter -1 True", "variance is -1.0, it must be between"),
    ):
        with refused(f"a.ply: its settings are damaged .*{message}.*; restore them, or export"):
            load(described(tmp_path / "a.ply", "max_sv 5", comment))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("40 3 64 48", "40 3 100000 100000"),
        ("40 3 64 48", f"40 3 {'9' * 310} 48"),
        ("40 3 64 48", f"40 {'9' * 310} 64 48"),
        ("viewpoint 1 ", "viewpoint 1e308 "),
        (" 0.7", " 1e-308"),
        ("calibrated 1 ", f"calibrated {'9' * 310} "),
    ],
)
def test_a_quality_table_of_absurd_numbers_is_ignored(tmp_path, old, new):
    """A note says so; nothing is rendered in its size."""
    places = (Viewpoint(1, 0, -5, 1, 0, 0, 1, 0, -1, 0, 0.7),)
    write(
        tmp_path / "a.ply",
        model(0),
        Metadata(quality_table=replace(QUALITY_TABLE, viewpoints=places)),
    )
    data = (tmp_path / "a.ply").read_bytes()
    assert data.count(old.encode()) == 1
    (tmp_path / "a.ply").write_bytes(data.replace(old.encode(), new.encode()))
    found = load(tmp_path / "a.ply")
    assert found.quality_table is None
    assert any("quality table is unusable and ignored" in note for note in found.notes)


def with_a_cut(path):
    """A safetensors file whose JSON has a setting of the earlier form."""
    about = json.loads(read_tensors(written(path))[1]["clod_adapter"])
    about["attenuation"]["cut"] = "soft"
    save_file(load_file(path), path, {"clod_adapter": json.dumps(about)})
    return path


def test_a_dial_of_the_earlier_form_is_refused(tmp_path):
    """The form shows in a comment, in a column where comments were dropped, and in JSON."""
    made = [partial(described, tmp_path / "a.ply", "tau 0.02", "max_sv 5")]
    made.append(partial(with_a_cut, tmp_path / "adapter.safetensors"))
    for name, value in {"tau": 0.01, "eps": 1e-7, "hard_cut": 1, "max": 1}.items():
        made.append(
            partial(without_comments, written(tmp_path / "b.ply"), **{f"clod_{name}": value})
        )
    for make in made:
        path = make()
        with refused(f"^{path}: its dial is of an earlier form.*; adapt its checkpoint again"):
            read(path)


@pytest.mark.parametrize(
    "screen_filter", [*FILTERS.values(), ScreenFilter(variance=0.123, compensate=True)], ids=str
)
def test_columns_and_the_flag_of_an_spz_store_the_filter(tmp_path, screen_filter):
    """A PLY with a dial has columns of settings; a plain one has no columns but those of Inria's
    layout.
    """
    write(tmp_path / "a.ply", model(1).replace(screen_filter=screen_filter))
    found = load(without_comments(tmp_path / "a.ply"))
    assert found.gaussians.screen_filter == screen_filter
    assert found.filter_known
    assert found.comments == ()
    plain = detach(found.gaussians)
    write(tmp_path / "b.ply", plain)
    assert not any(
        name.startswith("clod_") for name in load(tmp_path / "b.ply").vertex.dtype.names or ()
    )
    write(tmp_path / "a.spz", plain)
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    assert data[14] & 1 == screen_filter.compensate
    data[14] = 1  # without our record, as another program's
    (tmp_path / "b.spz").write_bytes(gzip.compress(data[: 16 + 40 * 29]))
    other = load(tmp_path / "b.spz")
    assert other.gaussians.screen_filter == FILTERS["on"] and not other.filter_known


def test_columns_of_other_programs_and_damaged_columns(tmp_path):
    write(tmp_path / "a.ply", detach(model(1)))
    found = load(without_comments(tmp_path / "a.ply", filter_3D=0.01))  # of Mip-Splatting
    assert found.gaussians.screen_filter == FILTERS["mip"] and not found.filter_known
    write(tmp_path / "a.ply", model(1))
    for columns, message in (
        (
            {"clod_screen_variance": -1.0},
            r"rewritten.ply: its settings are damaged \(variance is -1.0",
        ),
        ({"clod_reference_distance": np.nan}, "clod_reference_distance"),
        (
            {"clod_paper": np.arange(40) % 2},
            "property clod_paper must be one value for all rows and has several",
        ),
    ):
        with refused(message):
            load(without_comments(tmp_path / "a.ply", **columns))


def test_comments_of_other_programs(tmp_path):
    """Brush, whose filter has 0.1 px^2, splat-transform and Postshot; outputs contradict none."""
    for comments, name in (
        (("SplatRenderMode: default", "antialiased 0", "not antialiased 1"), "off"),
        (("Exported from Brush", "SplatRenderMode: mip"), "mip"),
        (("x", "SplatRenderMode: mip"), "on"),
        (("x", "antialiased 1"), "on"),
    ):
        found = load(
            write_rows(tmp_path / "a.ply", random_rows(40, needed()), comments=comments),
            activated="none",
        )
        assert found.gaussians.screen_filter == FILTERS[name] and not found.filter_known
        for other in FILTERS.values():
            again = resaved(found, found.gaussians.replace(screen_filter=other))
            assert again.gaussians.screen_filter == other
            stated = {"SplatRenderMode: mip", "antialiased 1"} & set(again.comments)
            assert bool(stated) == other.compensate


USUAL = AttenuationConfig(reference_distance=3.0)
EACH = {
    "usual": USUAL,
    "unit": replace(USUAL, scene_distance=7.0),
    "no reference": AttenuationConfig(max_sv=2.0),
    "paper": AttenuationConfig(form="paper", reference_distance=0.123456789),
}


@pytest.mark.parametrize("growth", [False, True])
@pytest.mark.parametrize("name", EACH)
def test_dial_survives_a_rewrite_without_comments(tmp_path, name, growth):
    config, growth_d = EACH[name], torch.linspace(-1, 3, 400) if growth else None
    g = with_dial(gaussians(400, 1, 2), torch.logspace(-1, 1.3, 400), config, growth_d)
    save(tmp_path / "a.ply", g)
    assert name == "unit" or load(tmp_path / "a.ply").gaussians.attenuation == config
    names = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data.dtype.names
    assert names[-2:] == ("sigma_d", "growth_d") if growth else names[-1] == "sigma_d"
    assert (name == "paper" or (growth and name != "no reference")) == ("clod_" in " ".join(names))
    path = without_comments(tmp_path / "a.ply")
    again, wanted = load(path).gaussians, in_world_units(g)
    assert again == wanted.replace(attenuation=again.attenuation)
    assert again.attenuation.form == config.form
    reference = wanted.attenuation.reference_distance if growth else 0
    assert again.attenuation.reference_distance == pytest.approx(reference, rel=1e-6)
    found = inspect(path)
    assert found.splat.extra == ()
    assert (
        growth or name != "paper" or any("read from columns: form" in note for note in found.notes)
    )


def test_file_without_settings_has_a_note(tmp_path):
    """The file keeps six tenths at s = 1 from its reference distance; sigma_d is multiplied by
    ``factor``.
    """
    for factor, begin, parts in (
        (1.0, "its dial is not", ["world units: keeps 60% at s = 1"]),
        (0.05, "warning: ", ["keeps 0% at s = 1", "likely not what was adapted"]),
    ):
        path, some = tmp_path / "a.ply", gaussians(500, 0, 1)
        some = some.replace(means=10 * some.means)
        sigma_d = estimated_distance(some.means) * torch.linspace(0.5, 1.75, 500)
        save(path, with_dial(some, factor * sigma_d))
        assert load(path).notes == () and inspect(path).notes == ()
        base = load(without_comments(path))
        assert base.gaussians.attenuation == AttenuationConfig()
        for notes in (base.notes, inspect(path.with_name("rewritten.ply")).notes):
            (note,) = notes
            assert note.startswith(begin) and all(part in note for part in parts)


@pytest.mark.parametrize(
    ("names", "method"),
    [
        (["trbf_center", "trbf_scale", "motion_0", "motion_8", "omega_3"], "SpacetimeGaussians"),
        (["t", "scale_t_0", "rot_r_3"], "a 4D method"),
        (["times", "t_scale"], "a 4D method"),
        (["sg_axis_0", "sg_sharpness_0"], "spherical Gaussians"),
        (["beta", "sb_params_5"], "Beta Splatting"),
        (["roughness", "base_color_1"], "materials"),
        (["label", "confidence", "obj_dc_0", "nx"], ""),
    ],
)
def test_columns_that_change_the_picture(tmp_path, names, method):
    """A warning names the method, of a PLY and of gsplat's checkpoint; other columns have none."""
    rows = random_rows(5, [*needed(), *names])
    splats = to_gsplat(gaussians(5, 0, 0)) | {name: torch.zeros(5) for name in names}
    torch.save({"step": 1, "splats": splats}, tmp_path / "a.pt")
    for path in (write_rows(tmp_path / "a.ply", rows), tmp_path / "a.pt"):
        found = [
            note for note in load(path, activated="none").notes if note.startswith("warning: ")
        ]
        assert len(found) == bool(method)
        assert all(method in note and names[0] in note for note in found)
