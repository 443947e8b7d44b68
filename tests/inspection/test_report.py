"""What ``inspect`` finds in a file: values, anomalies, the dial and the writer; and what it
refuses.
"""

import json

import numpy as np
import pytest
import torch
from plyfile import PlyElement
from refusals import refused

from clod_adapter import AttenuationConfig, load, save, with_dial
from clod_adapter.cli.inspect import lines_of
from clod_adapter.cli.shared.outputs import jsonable
from clod_adapter.inspection.report import inspect, looks_like
from clod_adapter.io.ply import read_head
from clod_adapter.origin import NOWHERE
from formats import (
    PACKED,
    QUALITY_TABLE,
    inria_rows,
    splat_transform,
    with_columns,
    write_elements,
    write_rows,
)
from scenes import gaussians

ATTENUATION = AttenuationConfig(max_sv=6.0, reference_distance=3.5)


def table(n=300, degree=1, seed=0):
    """Rows in Inria's layout, with unit quaternions and nonzero values in every column."""
    g = gaussians(n, degree, seed)
    return inria_rows(g.replace(quats=torch.nn.functional.normalize(g.quats)))


def seen(path):
    """The result for a splat, which can be printed and be written as JSON."""
    found = inspect(path)
    json.dumps(jsonable(found.as_dict()), allow_nan=False)
    assert all(line.isprintable() for line in lines_of(found))
    return found, found.splat


@pytest.fixture
def seen_rows(tmp_path):
    """What ``seen`` gives for a file of these rows, a.ply."""
    return lambda rows, *comments: seen(write_rows(tmp_path / "a.ply", rows, comments=comments))


def kinds(found):
    return {anomaly.kind: anomaly.count for anomaly in found.anomalies}


def test_a_plain_file(seen_rows):
    vertex = table()
    found, splat = seen_rows(vertex)
    assert splat.total == splat.count == 300 and splat.sh_degree == splat.used_sh_degree == 1
    assert found.what == "a splat, PLY" and found.writer is None and splat.dial is None
    assert splat.columns[0] == ("x", "float32") and len(splat.columns) == len(vertex.dtype.names)
    assert found.anomalies == found.left_out == found.notes == splat.extra == ()
    assert splat.dropped == {} and splat.origin == NOWHERE
    for axis, spread in zip("xyz", splat.position, strict=True):
        values = vertex[axis]
        assert spread.least == values.min() and spread.greatest == values.max()
        quantiles = np.quantile(values, (0.01, 0.5, 0.99))
        assert [spread.low, spread.median, spread.high] == pytest.approx(quantiles)
    scales = np.sort(np.exp(np.stack([vertex[f"scale_{k}"] for k in range(3)])), 0)
    opacities = 1 / (1 + np.exp(-vertex["opacity"].astype(float)))
    assert splat.scale.median == pytest.approx(np.median(scales))
    assert splat.scale.greatest == pytest.approx(scales.max())
    assert splat.opacity.median == pytest.approx(np.median(opacities))
    assert splat.fainter_than_visible == (opacities < 1 / 255).mean()
    assert splat.needles == (scales[2] > 10 * scales[1]).mean()


@pytest.mark.parametrize("degree, used", [(0, 0), (2, 1), (3, 0), (3, 3)])
def test_empty_sh_degrees_are_those_that_adapting_skips(seen_rows, tmp_path, degree, used):
    vertex = table(20, degree)
    bands = (degree + 1) ** 2 - 1
    for k in range(3 * bands):
        if k % bands >= (used + 1) ** 2 - 1:
            vertex[f"f_rest_{k}"] = 0
    found, splat = seen_rows(vertex)
    trained = load(tmp_path / "a.ply").gaussians.without_empty_bands()
    assert splat.used_sh_degree == trained.sh_degree == used
    assert any("skipped in training" in line for line in found.left_out) == (used < degree)


def test_dropped_rows_are_those_that_load_drops(seen_rows, tmp_path):
    rng = np.random.default_rng(0)
    vertex = table(40)
    for name in rng.choice(vertex.dtype.names, 6):
        vertex[name][rng.integers(40, size=2)] = rng.choice([np.nan, np.inf, -np.inf])
    vertex["opacity"][5] = np.inf
    for k in range(4):
        vertex[f"rot_{k}"][:2] = 0
    _, splat = seen_rows(vertex)
    base = load(tmp_path / "a.ply")
    assert splat.count == len(base.gaussians) < 38 and splat.total == 40
    notes = [note for note in base.notes if "dropped" in note]
    dropped = splat.dropped.items()
    assert notes == [f"{count} of 40 Gaussians dropped: {reason}" for reason, count in dropped]
    assert splat.infinite_opacity == int((base.gaussians.opacity_logits == torch.inf).sum()) > 0
    assert splat.position[0].greatest == float(base.gaussians.means[:, 0].max())


def test_anomalies_are_counted(seen_rows, tmp_path):
    vertex = table(600)
    vertex["opacity"][:3] = np.inf
    for name in "xyz":
        vertex[name][10:14] = vertex[name][9]  # four on top of one
        vertex[name][20] = 1e4
    vertex["scale_1"][30:32] = 9.0
    found, splat = seen_rows(with_columns(vertex, label=1), "SplatRenderMode: mip")
    counts = {"infinite_opacity": 3, "doubles": 4, "far": 1, "giant": 2, "antialiased": 0}
    assert kinds(found) == counts
    assert splat.extra == ("label",) and any("label" in line for line in found.left_out)
    vertex["x"] = np.where(np.arange(600) % 2, -0.0, 0.0)  # -0 is 0
    vertex["y"] = 0
    vertex["z"] = 1.5
    _, splat = seen_rows(vertex)
    assert splat.doubles == 599 and splat.far == splat.giant == 0
    vertex["x"] = np.nan
    with refused("c.ply: no usable Gaussian in it, of 600 rows"):
        inspect(write_rows(tmp_path / "c.ply", vertex))


def test_values_that_look_activated_are_read_as_activated(seen_rows):
    vertex = table()
    opacity = vertex["opacity"] = 1 / (1 + np.exp(-vertex["opacity"]))
    found, splat = seen_rows(vertex)
    (anomaly,) = found.anomalies
    assert anomaly.kind == "activated" and "--activated opacity" in anomaly.says
    assert splat.opacity.median == pytest.approx(np.median(opacity), rel=1e-5)


def test_other_trainers_and_coordinates(seen_rows, tmp_path):
    vertex = table()
    _, splat = seen_rows(with_columns(vertex, masks_0=0, masks_1=np.arange(300) < 100))
    assert splat.count == 200
    found, splat = seen_rows(with_columns(vertex, filter_3D=0.5))
    assert splat.scale.least >= 0.5 and splat.extra == ()
    assert any("filter_3D" in line for line in found.left_out)
    wide = vertex.astype([(name, "f8" if name in "xyz" else "f4") for name in vertex.dtype.names])
    wide["y"] += 4_500_000.0
    found, splat = seen_rows(wide, "Generated by Nerstudio 1.1.5")
    assert "dataparser_transforms.json" in found.notes[0] and "far_from_0" in kinds(found)
    assert splat.origin == load(tmp_path / "a.ply").origin and splat.doubles == 0
    assert splat.position[1].median == pytest.approx(np.median(wide["y"]), abs=1e-6)


@pytest.mark.parametrize(
    "order, name", [("<", "binary little-endian"), (">", "binary big-endian"), ("ascii", "ascii")]
)
def test_encodings(tmp_path, order, name):
    path = tmp_path / "o.ply"
    cameras = PlyElement.describe(np.zeros(1, [("fx", "f4")]), "camera")
    write_elements(path, [PlyElement.describe(table(12), "vertex"), cameras], order)
    path.write_bytes(path.read_bytes().replace(b"element", b"obj_info x\nelement", 1))
    found, splat = seen(path)
    assert "element camera, obj_info" in found.left_out and splat.encoding == name


def test_a_packed_file():
    splat_transform("--version")
    found, splat = seen(PACKED)
    assert found.what == "a splat, compressed .ply" and splat.count == 300 and splat.extra == ()
    assert splat.columns == () and "quantised" in found.notes[0]


def test_a_dial(seen_rows, tmp_path):
    g = with_dial(gaussians(40, 1, 0), attenuation=ATTENUATION, growth_d=torch.linspace(-1, 3, 40))
    save(tmp_path / "dial.ply", g, quality_table=QUALITY_TABLE)
    found, splat = seen(tmp_path / "dial.ply")
    assert splat.dial.calibration == QUALITY_TABLE and splat.dial.attenuation == ATTENUATION
    assert found.what == "an adapted splat, with sigma_d and growth_d, PLY"
    assert "clod-adapter" in found.writer
    assert splat.sigma.least > 0 and splat.comments == splat.extra == ()
    rows = [line.split() for line in lines_of(found) if line.startswith("growth_d")]
    assert rows == [["growth_d", "-1", "-0.96", "1", "2.96", "3"]]
    # Another tool's column of the same name, which is no growth without a sigma_d.
    _, splat = seen_rows(with_columns(table(), growth_d=0.5))
    assert splat.growth is None and splat.extra == ("growth_d",)


@pytest.mark.parametrize(
    "comments, says",
    [
        (("clod_adapter version 0.1.0",), "clod-adapter 0.1.0"),
        (("Generated by Nerstudio 1.1.5", "Vertical Axis: z"), "nerfstudio's exporter"),
        (("Vertical Axis: z",), "nerfstudio's exporter"),
        (("Exported from Brush", "Vertical axis: y", "SplatRenderMode: default"), "Brush"),
        (("Generated by SuperSplat 2.6.2",), "SuperSplat 2.6.2"),
        (("Generated by splat-transform 3.7.0",), "splat-transform 3.7.0"),
        (("antialiased 0",), "Postshot"),
        (("by hand", "Vertical axis: y"), "None"),
    ],
)
def test_writers(tmp_path, comments, says):
    path = write_rows(tmp_path / "a.ply", np.zeros(1, [("x", "f4")]), comments=comments)
    assert str(looks_like(read_head(path))).startswith(says)
