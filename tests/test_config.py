"""Settings and the quality table: impossible values are refused, and exact round trips through
adapter and PLY.
"""

import math
import re
from dataclasses import replace

import pytest
import torch
from refusals import refused

from clod_adapter import extract, load, load_adapter, save, save_adapter, with_dial
from clod_adapter.config import AdaptConfig, AttenuationConfig, ScreenFilter, field_descriptions
from clod_adapter.equation.distances import viewpoint_of
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.quality_table import QualityRow, QualityTable, Viewpoint
from scenes import gaussians, ring

BOTH = {"form": ["theirs"], "max_sv": [0.99, math.inf, math.nan]}
RATES = ("sigma", "growth", "means", "quats", "scales", "opacities", "sh0", "shN")
TABLES = {
    AdaptConfig: BOTH
    | {
        "max_sv": [*BOTH["max_sv"], 1e7],
        "iters": [-1],
        "time_budget": [0.0, math.nan],
        "start_share": [0.5, 1.01],
        "exponent": [0.0, math.inf],
        "reg_weight": [-1.0, math.nan],
        "ssim_weight": [-0.1, 1.1],
        "growth": ["yes"],
        "batch": [0, 4097],
        "seed": [-1, 2**63],
        **{f"lr_{name}": [-1e-9, 1.1e6, math.nan] for name in RATES},
    },
    AttenuationConfig: BOTH
    | {"scene_distance": [0.0, 1e308, math.nan], "reference_distance": [-1.0, math.inf]},
    ScreenFilter: {"variance": [9e-4, 101.0, math.nan], "compensate": [1, "yes", None]},
}


@pytest.mark.parametrize("kind", TABLES)
def test_impossible_values_are_named(kind):
    for name, values in TABLES[kind].items():
        for value in values:
            with refused(re.escape(f"{name} is {value}, it must be ")):
                kind(**{name: value})


@pytest.mark.parametrize("kind", TABLES)
def test_values_of_other_types_are_named(kind):
    for name, default in vars(kind()).items():
        for value in ([1], 10**400, {}, b"5", *(["5"] if not isinstance(default, str) else [])):
            with refused(re.escape(f"{name} is {value}, it must be ")):
                kind(**{name: value})


def test_limits_are_accepted():
    edges = {"max_sv": 1.0, "iters": 0, "time_budget": 0.1, "start_share": 1.0, "exponent": 0.1}
    AdaptConfig(**edges, reg_weight=0.0, ssim_weight=1.0, lr_means=0.0)


@pytest.mark.parametrize("kind", TABLES)
def test_every_field_has_help_and_a_default(kind):
    texts = field_descriptions(kind)
    assert all(len(text) > 10 and text == text.strip().rstrip(".") for text in texts.values())
    assert list(texts) == list(vars(kind()))
    with pytest.raises(TypeError):  # by keyword alone, as fields may move
        kind(0.5)


def test_the_papers_form():
    paper = AdaptConfig.paper(max_sv=7, reg_weight=0.0)
    assert paper.form == "paper" and paper.max_sv == 7 and paper.iters == 1600
    assert paper.lr_sigma == 1e-2 and paper.reg_weight == 0


def test_round_trips(tmp_path):
    """Of numbers with all their digits, and a machine whose name is odd."""
    measured = [
        Row(1.0, 1 / 3, -0.0, 1e6, 0.5, 1.0, 2.5),
        Row(1 + 2**-52, -1e-300, 0.1 + 0.2, -1 / 7, 0.5, 1.0, 1e-9),
        Row(299.9, 1e6, 5e-324, 0.0, 0.5, 1.0, 1e6),
    ]
    quality_table = QualityTable.of(
        measured,
        total=4,
        views=13,
        size=(640, 480),
        machine="\u2122 a\tb \\n 'c' \x00",
        against="checkpoint",
        viewpoints=[Viewpoint(1 / 3, -1e6, 5e-324, 1e-9)],
    )
    base = gaussians(4, 0, 0)
    attenuated = with_dial(base, torch.ones(4))
    save(tmp_path / "a.ply", attenuated, quality_table=quality_table)
    assert load(tmp_path / "a.ply").quality_table == quality_table
    assert load(tmp_path / "a.ply").notes == ()
    adapter = replace(
        extract(base, attenuated, fingerprint="", config={}), quality_table=quality_table
    )
    save_adapter(tmp_path / "a.safetensors", adapter)
    assert load_adapter(tmp_path / "a.safetensors").quality_table == quality_table
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0]
    assert header.isascii() and max(map(len, header.splitlines())) < 200


def test_rows_of_an_evaluation():
    rows = [Row(s, 30 - s, 0.9, 100 / s, 1 / s, 50 / s, 10 / s) for s in (2.0, 1.0)]
    machine = " AMD\tRyzen\u2122  9\n"
    table = QualityTable.of(rows, total=100, views=3, size=(64, 48), machine=machine)
    near = QualityRow(1.0, 100.0, 29.0, 0.9, 10.0)
    assert table.rows == (near, QualityRow(2.0, 50.0, 28.0, 0.9, 5.0))
    assert table.machine == "AMD Ryzen? 9" and table.width == 64 and table.height == 48


ROW = QualityRow(1.0, 10.0, 30.0, 0.9, 5.0)
GOOD = {"rows": (ROW,), "total": 4, "views": 1, "width": 8, "height": 8, "machine": "m"}
PLACE = Viewpoint(1.5, 2.5, 3.5, 4.5, look_z=1.0, up_y=-1.0, fov=0.8)


@pytest.mark.parametrize(
    "good, bad, said",
    [
        *(
            (QualityTable(**GOOD), {"rows": rows}, "ascend from 1")
            for rows in ((), (replace(ROW, virtual_scale=2.0),), (ROW, ROW))
        ),
        (QualityTable(**GOOD), {"rows": (replace(ROW, psnr=float("inf")),)}, "out of range"),
        (QualityTable(**GOOD), {"rows": (replace(ROW, frame_ms=0.0),)}, "out of range"),
        (QualityTable(**GOOD), {"total": 0}, "out of range"),
        (
            QualityTable(**GOOD),
            {"against": "thin air"},
            "'thin air', it must be one of photographs, checkpoint",
        ),
        (QualityTable(**GOOD), {"machine": "caf\u00e9"}, "machine"),
        (PLACE, {"x": float("nan")}, "the centre of a viewpoint is"),
        (PLACE, {"unit": 0.0}, "the unit of a viewpoint is"),
        *((PLACE, bad, "the direction of a viewpoint is") for bad in ({"up_x": 7.0}, {"fov": -1})),
    ],
)
def test_bad_values_are_refused(good, bad, said):
    with refused(said):
        replace(good, **bad)


def test_stored_viewpoints_are_cameras_again(tmp_path):
    path = tmp_path / "a.ply"
    cameras = ring(3, 40, 30)
    attenuated = with_dial(gaussians(4, 0, 0), torch.ones(4))
    points = torch.randn(50, 3)
    viewpoints = tuple(viewpoint_of(camera, points, AttenuationConfig()) for camera in cameras)
    # one without a direction is no camera
    for places, count in ((viewpoints, 3), ((Viewpoint(1.5, 2.5, 3.5, 4.5),), 0)):
        save(path, attenuated, quality_table=QualityTable(**GOOD, viewpoints=places))
        stored = load(path)
        assert stored.viewpoints == places and len(stored.cameras) == count
        for camera, again in zip(cameras, stored.cameras, strict=False):
            assert torch.allclose(again.viewmat, camera.viewmat, atol=1e-5)
            focal = float(camera.K[1, 1]) / 30
            assert float(again.K[1, 1]) / again.height == pytest.approx(focal, rel=1e-5)
