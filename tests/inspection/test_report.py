"""What ``inspect`` finds in a file: values, anomalies, the dial, states and the writer; and what it
refuses.
"""

import json
import math

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from clod_adapter import AttenuationConfig, load, save, with_dial
from clod_adapter.cli.inspect import lines_of
from clod_adapter.cli.shared.outputs import jsonable
from clod_adapter.inspection.report import inspect, looks_like
from clod_adapter.io.ply import read_head
from clod_adapter.io.ply_layout import inria_dtype
from clod_adapter.origin import NOWHERE
from clod_adapter.training.state import TrainingState, save_state
from formats import CALIBRATION, PACKED, inria_rows, with_columns, write_rows
from runs import rejects
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
    assert found.splat is not None
    assert found.about is None
    return found, found.splat


def kinds(found):
    return {anomaly.kind: anomaly.count for anomaly in found.anomalies}


def test_a_plain_file(tmp_path):
    vertex = table()
    found, splat = seen(write_rows(tmp_path / "a.ply", vertex))
    v = splat
    assert (v.total, v.count, v.dropped, splat.sh_degree, v.used_sh_degree) == (300, 300, {}, 1, 1)
    assert found.what == "a splat, PLY" and "Inria" in (found.writer or "") and splat.dial is None
    assert splat.columns[0] == ("x", "float32") and len(splat.columns) == len(vertex.dtype.names)
    assert (found.anomalies, found.left_out, found.notes, splat.extra, splat.origin) == (
        (),
        (),
        (),
        (),
        NOWHERE,
    )
    for axis, spread in zip("xyz", v.position, strict=True):
        assert (spread.least, spread.greatest) == (vertex[axis].min(), vertex[axis].max())
        assert [spread.low, spread.median, spread.high] == pytest.approx(
            np.quantile(vertex[axis], (0.01, 0.5, 0.99))
        )
    scales = np.sort(np.exp(np.stack([vertex[f"scale_{k}"] for k in range(3)])), 0)
    opacities = 1 / (1 + np.exp(-vertex["opacity"].astype(float)))
    assert v.scale.median == pytest.approx(np.median(scales))
    assert v.scale.greatest == pytest.approx(scales.max())
    assert v.opacity.median == pytest.approx(np.median(opacities))
    assert v.fainter_than_visible == (opacities < 1 / 255).mean()
    assert v.needles == (scales[2] > 10 * scales[1]).mean()


@pytest.mark.parametrize("degree, used", [(0, 0), (2, 1), (3, 0), (4, 4)])
def test_empty_sh_degrees_are_those_that_adapting_skips(tmp_path, degree, used):
    vertex = table(20, degree)
    bands = (degree + 1) ** 2 - 1
    for name in vertex.dtype.names or ():
        if name.startswith("f_rest_") and int(name[7:]) % bands >= (used + 1) ** 2 - 1:
            vertex[name] = 0
    found, splat = seen(write_rows(tmp_path / "a.ply", vertex))
    lean = load(tmp_path / "a.ply").gaussians.without_empty_bands()
    assert splat.used_sh_degree == lean.sh_degree == used
    assert any("skipped in training" in line for line in found.left_out) == (used < degree)


def test_dropped_rows_are_those_that_load_drops(tmp_path):
    rng = np.random.default_rng(0)
    vertex = table(40)
    for name in rng.choice(vertex.dtype.names, 6):
        vertex[name][rng.integers(40, size=2)] = rng.choice([np.nan, np.inf, -np.inf])
    vertex["opacity"][5] = np.inf
    for k in range(4):
        vertex[f"rot_{k}"][:2] = 0
    v = seen(write_rows(tmp_path / "a.ply", vertex))[1]
    base = load(tmp_path / "a.ply")
    assert v.count == len(base.gaussians) < 38 and v.total == 40
    notes = [note for note in base.notes if "dropped" in note]
    assert notes == [
        f"{gone} of 40 Gaussians dropped: {reason}" for reason, gone in v.dropped.items()
    ]
    assert v.infinite_opacity == int((base.gaussians.opacity_logits == torch.inf).sum()) > 0
    assert v.position[0].greatest == float(base.gaussians.means[:, 0].max())


def test_anomalies_are_counted(tmp_path):
    vertex = table(600)
    vertex["opacity"][:3] = np.inf
    for name in "xyz":
        vertex[name][10:14] = vertex[name][9]  # four on top of one
        vertex[name][20] = 1e4
    vertex["scale_1"][30:32] = 9.0
    labelled = with_columns(vertex, label=1)
    found, splat = seen(
        write_rows(tmp_path / "a.ply", labelled, comments=("SplatRenderMode: mip",))
    )
    assert kinds(found) == {
        "infinite_opacity": 3,
        "doubles": 4,
        "far": 1,
        "giant": 2,
        "antialiased": 0,
    }
    assert splat.extra == ("label",) and any("label" in line for line in found.left_out)
    # -0 is 0
    vertex["x"], vertex["y"], vertex["z"] = np.where(np.arange(600) % 2, -0.0, 0.0), 0, 1.5
    v = seen(write_rows(tmp_path / "b.ply", vertex))[1]
    assert v.doubles == 599 and v.far == v.giant == 0
    vertex["x"] = np.nan
    with rejects("c.ply: no usable Gaussian in it, of 600 rows"):
        inspect(write_rows(tmp_path / "c.ply", vertex))


def test_values_that_look_activated_are_read_as_activated(tmp_path):
    vertex = table()
    opacity = vertex["opacity"] = 1 / (1 + np.exp(-vertex["opacity"]))
    found, splat = seen(write_rows(tmp_path / "a.ply", vertex))
    assert [o.kind for o in found.anomalies] == ["activated"]
    assert "--activated opacity" in found.anomalies[0].says
    assert splat.opacity.median == pytest.approx(np.median(opacity), rel=1e-5)


def test_other_trainers_encodings_and_coordinates(tmp_path):
    vertex = table()
    masked = with_columns(vertex, masks_0=0, masks_1=np.arange(300) < 100)
    assert seen(write_rows(tmp_path / "m.ply", masked))[1].count == 200
    found, splat = seen(write_rows(tmp_path / "f.ply", with_columns(vertex, filter_3D=0.5)))
    assert splat.scale.least >= 0.5 and splat.extra == ()
    assert any("filter_3D" in line for line in found.left_out)
    wide = vertex.astype(
        [(name, "f8" if name in "xyz" else "f4") for name in vertex.dtype.names or ()]
    )
    wide["y"] += 4_500_000.0
    found, splat = seen(
        write_rows(tmp_path / "a.ply", wide, comments=("Generated by Nerstudio 1.1.5",))
    )
    assert "dataparser_transforms.json" in found.notes[0] and "far_from_0" in kinds(found)
    assert splat.origin == load(tmp_path / "a.ply").origin and splat.doubles == 0
    assert splat.position[1].median == pytest.approx(np.median(wide["y"]), abs=1e-6)
    for order, name in {
        "<": "binary little-endian",
        ">": "binary big-endian",
        "ascii": "ascii",
    }.items():
        parts = [
            PlyElement.describe(vertex[:12], "vertex"),
            PlyElement.describe(np.zeros(1, [("fx", "f4")]), "camera"),
        ]
        data = PlyData(
            parts,
            text=order == "ascii",
            byte_order="=" if order == "ascii" else order,
            obj_info=["x"],
        )
        data.write(str(tmp_path / "o.ply"))
        found, splat = seen(tmp_path / "o.ply")
        assert "element camera, obj_info" in found.left_out and splat.encoding == name
    found, splat = seen(PACKED)
    assert found.what == "a splat, compressed PLY" and splat.count == 300 and splat.extra == ()
    packed = [(f"packed_{name}", "uint32") for name in ("position", "rotation", "scale", "color")]
    assert sorted(splat.columns) == sorted(packed) and "quantised" in found.notes[0]


def test_a_dial(tmp_path):
    g = with_dial(gaussians(40, 1, 0), attenuation=ATTENUATION, growth_d=torch.linspace(-1, 3, 40))
    save(tmp_path / "a.ply", g, calibration=CALIBRATION)
    (found, splat), names = seen(tmp_path / "a.ply"), "sigma_d and growth_d"
    assert splat.dial is not None
    assert splat.dial.calibration == CALIBRATION
    assert splat.dial.attenuation == ATTENUATION
    assert found.what == f"an adapted splat, with {names}, PLY"
    assert "clod-adapter" in (found.writer or "")
    assert splat.sigma is not None and splat.sigma.least > 0 and splat.comments == splat.extra == ()
    rows = [line.split() for line in lines_of(found) if line.startswith("growth_d")]
    assert rows == [["growth_d", "-1", "-0.96", "1", "2.96", "3"]]
    # Another tool's column of the same name, which is no growth without a sigma_d.
    _, splat = seen(write_rows(tmp_path / "c.ply", with_columns(table(), growth_d=0.5)))
    assert splat.growth is None and splat.extra == ("growth_d",)


def test_a_state(tmp_path):
    tensors = {
        "parameter.means": torch.zeros(7, 3),
        "steps.kept": torch.zeros(7, dtype=torch.int32),
    }
    numbers = {"loss": math.nan, "averaged": 0, "steps": 9, "seconds": 1.5, "start_seconds": 0.5}
    state = TrainingState(
        tensors, ATTENUATION, np.random.default_rng(0).bit_generator.state, (1, 0), **numbers
    )
    save_state(tmp_path / "s.safetensors", state, {"base": "abc", "version": "0"})
    found = inspect(tmp_path / "s.safetensors")
    assert found.about is not None and "interrupted run" in found.what
    assert (found.about["count"], found.about["steps"], found.about["belongs"]["base"]) == (
        7,
        9,
        "abc",
    )
    json.dumps(jsonable(found.as_dict()), allow_nan=False)


INRIA = list(inria_dtype(3).names or ())
PLAIN = [name for name in INRIA if not name.startswith("n")]
UNKNOWN = ("by hand", "Vertical axis: y")


@pytest.mark.parametrize(
    "names, comments, says",
    [
        (INRIA, (), "Inria's trainer"),
        ([*INRIA, "clod_paper", "sigma_d", "growth_d"], (), "Inria's trainer"),
        ([*INRIA, "sigma_d"], ("clod_adapter version 0.1.0",), "clod-adapter 0.1.0"),
        (PLAIN, (), "gsplat's exporter"),
        (INRIA, ("Generated by Nerstudio 1.1.5", "Vertical Axis: z"), "nerfstudio's exporter"),
        (INRIA, ("Vertical Axis: z",), "nerfstudio's exporter"),
        (PLAIN, ("Exported from Brush", "Vertical axis: y", "SplatRenderMode: default"), "Brush"),
        (PLAIN, ("Generated by SuperSplat 2.6.2",), "SuperSplat 2.6.2"),
        (PLAIN, ("Generated by splat-transform 3.7.0",), "splat-transform 3.7.0"),
        (PLAIN, ("antialiased 0",), "Postshot"),
        ([*INRIA, "masks_0", "masks_1"], (), "MaskGaussian"),
        ([*INRIA, "filter_3D"], (), "Mip-Splatting"),
        ([*PLAIN[:3], *PLAIN[-4:], *PLAIN[-7:-4], "opacity", *PLAIN[3:-8]], (), "splat-transform"),
        *((names, UNKNOWN, "None") for names in (PLAIN[::-1], [*INRIA, "label"], ["x"])),
    ],
)
def test_writers(tmp_path, names, comments, says):
    path = write_rows(
        tmp_path / "a.ply", np.zeros(1, [(name, "f4") for name in names]), comments=comments
    )
    assert str(looks_like(read_head(path))).startswith(says)


def test_writers_of_packed_files(tmp_path):
    path = tmp_path / "a.ply"
    comment = b"comment Generated by splat-transform 3.7.0\n"
    for instead, says in (
        (b"comment Generated by SuperSplat 2.6.2\n", "SuperSplat 2.6.2"),
        (b"", "gsplat's exporter, or a tool of PlayCanvas"),
    ):
        path.write_bytes(PACKED.read_bytes().replace(comment, instead))
        assert looks_like(read_head(path)) == says
