from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

import scenes
from clod_adapter.adapter import detach, extract, with_dial
from clod_adapter.cli.inspect import lines_of
from clod_adapter.cli.shared.outputs import jsonable
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.inspection.report import Inspection, inspect
from clod_adapter.io.adapter_file import save_adapter
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import write as save_as
from clod_adapter.origin import NOWHERE
from clod_adapter.training.state import TrainingState, save_state
from formats import CALIBRATION, inria_rows, with_columns
from packing import write_packed

ATTENUATION = AttenuationConfig(tau=0.01, max_sv=6.0, cut="soft", reference_distance=3.5)


def table(n: int = 300, degree: int = 1, seed: int = 0) -> np.ndarray:
    """Rows in Inria's layout, with unit quaternions and nonzero values in every column."""
    g = scenes.gaussians(n, degree, seed)
    g = g.replace(quats=torch.nn.functional.normalize(g.quats))
    return inria_rows(g)


def write(path: Path, vertex: np.ndarray, *, comments: tuple[str, ...] = (), order: str = "<") -> Path:
    element = PlyElement.describe(vertex, "vertex", comments=list(comments))
    PlyData([element], text=order == "ascii", byte_order="=" if order == "ascii" else order).write(str(path))
    return path


def kinds(found: Inspection) -> dict[str, int]:
    return {anomaly.kind: anomaly.count for anomaly in found.anomalies}


def adapted(path: Path, growth: bool = False) -> Path:
    """A file with a dial and its calibration."""
    g = with_dial(scenes.gaussians(40, 1, 0), attenuation=ATTENUATION)
    g = g.replace(growth_d=torch.linspace(-1, 3, 40)) if growth else g
    save(path, g, calibration=CALIBRATION)
    return path


def adapter_of(path: Path, n: int = 40) -> Path:
    g = scenes.gaussians(n, 1, 0)
    more = with_dial(g.replace(means=g.means + 0.01), torch.linspace(0.1, 2, n), ATTENUATION)
    save_adapter(path, extract(g, more, fingerprint="ab" * 32, config={"max_sv": 6.0, "iters": 3}))
    return path


def state_of(path: Path) -> Path:
    tensors = {"parameter.means": torch.zeros(7, 3), "steps.kept": torch.zeros(7, dtype=torch.int32)}
    numbers = {"loss": math.nan, "averaged": 0, "steps": 9, "seconds": 1.5, "start_seconds": 0.5}
    state = TrainingState(tensors, ATTENUATION, np.random.default_rng(0).bit_generator.state, (1, 0), **numbers)
    save_state(path, state, {"base": "abc", "version": "0"})
    return path


def gsplat_checkpoint(path: Path) -> Path:
    values = scenes.gaussians(9, 1, 0).tensors()
    names = {"log_scales": "scales", "opacity_logits": "opacities"}
    torch.save({"step": 1, "splats": {names.get(name, name): value for name, value in values.items()}}, path)
    return path


def test_a_plain_file(tmp_path: Path) -> None:
    vertex = table()
    found = inspect(write(tmp_path / "a.ply", vertex))
    splat = found.splat
    assert splat is not None and splat.dial is None and found.about is None
    v = splat.values
    assert (v.total, v.count, v.dropped, splat.sh_degree, v.used_sh_degree) == (300, 300, {}, 1, 1)
    assert found.what == "a splat, PLY" and "Inria" in (found.writer or "") and splat.encoding == "binary little-endian"
    assert splat.columns[0] == ("x", "float32") and len(splat.columns) == len(vertex.dtype.names)
    assert (found.anomalies, found.left_out, found.notes, splat.extra, splat.origin) == ((), (), (), (), NOWHERE)
    for axis, spread in zip("xyz", v.position, strict=True):
        assert (spread.least, spread.greatest) == (vertex[axis].min(), vertex[axis].max())
        assert [spread.low, spread.median, spread.high] == pytest.approx(np.quantile(vertex[axis], (0.01, 0.5, 0.99)))
    scales = np.sort(np.exp(np.stack([vertex[f"scale_{k}"] for k in range(3)])), 0)
    opacities = 1 / (1 + np.exp(-vertex["opacity"].astype(float)))
    largest = v.largest_scale.greatest
    assert v.scale.median == pytest.approx(np.median(scales)) and largest == pytest.approx(scales.max())
    assert v.opacity_quartiles == pytest.approx(tuple(np.quantile(opacities, (0.25, 0.5, 0.75))))
    assert v.fainter_than_tau == (opacities < 0.02).mean() and splat.tau == 0.02
    assert v.fainter_than_visible == (opacities < 1 / 255).mean()
    assert v.needles == (scales[2] > 10 * scales[1]).mean() and v.not_unit == 0


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 3))
def test_empty_sh_degrees_are_those_that_adapting_skips(tmp_path: Path, degree: int, used: int, seed: int) -> None:
    vertex = table(20, degree, seed)
    bands = (degree + 1) ** 2 - 1
    for name in vertex.dtype.names or ():
        if name.startswith("f_rest_") and int(name[7:]) % bands >= (used + 1) ** 2 - 1:
            vertex[name] = 0
    found = inspect(write(tmp_path / "a.ply", vertex))
    lean = load(tmp_path / "a.ply").gaussians.without_empty_bands()
    assert found.splat is not None and found.splat.values.used_sh_degree == lean.sh_degree == min(used, degree)
    assert any("skipped in training" in line for line in found.left_out) == (used < degree)
    assert ("empty_harmonics" in kinds(found)) == (degree > 0 == lean.sh_degree)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 999))
def test_dropped_rows_are_those_that_load_drops(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertex = table(40, 1, seed)
    for name in rng.choice(vertex.dtype.names, 3):
        vertex[name][rng.integers(40, size=2)] = rng.choice([np.nan, np.inf, -np.inf])
    for k in range(4):
        vertex[f"rot_{k}"][:2] = 0
    found = inspect(write(tmp_path / "a.ply", vertex))
    base = load(tmp_path / "a.ply")
    assert found.splat is not None
    v = found.splat.values
    assert v.count == len(base.gaussians) and v.total == 40
    notes = [note for note in base.notes if "dropped" in note]
    assert notes == [f"{gone} of 40 Gaussians dropped: {reason}" for reason, gone in v.dropped.items()]
    assert v.infinite_opacity == int((base.gaussians.opacity_logits == torch.inf).sum())
    assert v.position[0].greatest == float(base.gaussians.means[:, 0].max())


def test_anomalies_are_counted(tmp_path: Path) -> None:
    vertex = table(600)
    vertex["opacity"][:3] = np.inf
    for name in "xyz":
        vertex[name][10:14] = vertex[name][9]  # four on top of one
        vertex[name][20] = 1e4
    vertex["scale_1"][30:32] = 9.0
    for k in range(4):
        vertex[f"rot_{k}"][40:45] *= 3
    wide = np.zeros(600, [(n, "f8" if n == "x" else "f4") for n in vertex.dtype.names or ()] + [("label", "i4")])
    for name in vertex.dtype.names or ():
        wide[name] = vertex[name]
    found = inspect(write(tmp_path / "a.ply", wide, comments=("SplatRenderMode: mip",)))
    assert found.splat is not None
    assert kinds(found) == {
        "infinite_opacity": 3, "doubles": 4, "far": 1, "giant": 2, "double_precision": 1, "antialiased": 0,
    }  # fmt: skip
    assert found.splat.extra == ("label",) and any("label" in line for line in found.left_out)
    assert found.splat.values.not_unit == 5 / 600
    for axis in "xyz":  # all in one place, and -0 is 0
        vertex[axis] = np.where(np.arange(600) % 2, -0.0, 0.0) if axis != "z" else 1.5
    found = inspect(write(tmp_path / "b.ply", vertex))
    assert found.splat is not None
    v = found.splat.values
    assert v.doubles == 599 and v.far == v.giant == 0


def test_values_that_look_activated_are_read_as_activated(tmp_path: Path) -> None:
    plain, vertex = table(), table()
    vertex["opacity"] = 1 / (1 + np.exp(-vertex["opacity"]))
    for k in range(3):
        vertex[f"scale_{k}"] = np.exp(vertex[f"scale_{k}"])
    found = inspect(write(tmp_path / "a.ply", vertex))
    want = inspect(write(tmp_path / "b.ply", plain))
    assert found.splat is not None and want.splat is not None
    assert [o.kind for o in found.anomalies] == ["activated", "activated"]
    assert all("--activated both" in o.says for o in found.anomalies)
    assert found.splat.values.scale.median == pytest.approx(want.splat.values.scale.median, rel=1e-5)
    assert found.splat.values.opacity.median == pytest.approx(want.splat.values.opacity.median, rel=1e-5)


def test_columns_of_other_trainers_and_coordinates_far_from_0(tmp_path: Path) -> None:
    vertex = table()
    masked = with_columns(vertex, masks_0=0, masks_1=np.arange(300) < 100)
    found = inspect(write(tmp_path / "m.ply", masked))
    assert found.splat is not None and found.splat.values.count == 200 and "MaskGaussian" in (found.writer or "")
    found = inspect(write(tmp_path / "f.ply", with_columns(vertex, filter_3D=0.5)))
    assert found.splat is not None and found.splat.values.scale.least >= 0.5 and "Mip-Splatting" in (found.writer or "")
    assert any("filter_3D" in line for line in found.left_out) and found.splat.extra == ()
    wide = vertex.astype([(name, "f8" if name in "xyz" else "f4") for name in vertex.dtype.names or ()])
    wide["y"] += 4_500_000.0
    found = inspect(write(tmp_path / "a.ply", wide, comments=("Generated by Nerstudio 1.1.5",)))
    assert "ns-export" in (found.writer or "") and "dataparser_transforms.json" in found.notes[0]
    assert found.splat is not None and "far_from_0" in kinds(found)
    assert found.splat.origin == load(tmp_path / "a.ply").origin and found.splat.values.doubles == 0
    assert found.splat.values.position[1].median == pytest.approx(np.median(wide["y"]), abs=1e-6)


@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_parts_that_outputs_drop(tmp_path: Path, order: str) -> None:
    elements = [PlyElement.describe(table(12), "vertex"), PlyElement.describe(np.zeros(1, [("fx", "f4")]), "camera")]
    data = PlyData(elements, text=order == "ascii", byte_order="=" if order == "ascii" else order, obj_info=["x"])
    data.write(str(tmp_path / "a.ply"))
    found = inspect(tmp_path / "a.ply")
    assert "element camera, obj_info" in found.left_out
    names = {"<": "binary little-endian", ">": "binary big-endian", "ascii": "ascii"}
    assert found.splat is not None and found.splat.encoding == names[order]


def test_a_dial_and_its_calibration(tmp_path: Path) -> None:
    found = inspect(adapted(tmp_path / "a.ply"))
    assert found.splat is not None and found.splat.dial is not None and found.splat.dial.calibration == CALIBRATION
    assert found.splat.dial.attenuation == ATTENUATION and found.splat.tau == 0.01
    assert found.what == "an adapted splat, with sigma_d, PLY" and "clod-adapter" in (found.writer or "")
    assert found.splat.values.sigma is not None and found.splat.values.sigma.least > 0 and found.splat.comments == ()
    assert found.splat.values.growth is None and not any("growth" in line for line in lines_of(found))
    assert any(line.startswith("dial         sigma_d, s = 1 to 6") for line in lines_of(found))


def test_growth(tmp_path: Path) -> None:
    found = inspect(adapted(tmp_path / "a.ply", growth=True))
    assert found.splat is not None and found.what == "an adapted splat, with sigma_d and growth_d, PLY"
    growth = found.as_dict()["splat"]["growth"]
    assert (growth["least"], growth["median"], growth["greatest"]) == (-1, 1, 3)
    lines = lines_of(found)
    (row,) = (line for line in lines if line.startswith("growth_d"))
    assert row.split() == ["growth_d", "-1", "-0.96", "1", "2.96", "3"] and found.splat.extra == ()
    assert any(line.startswith("dial         sigma_d and growth_d, s = 1 to 6") for line in lines)
    assert found.writer == inspect(adapted(tmp_path / "b.ply")).writer
    # Another tool's column of the same name, which is no growth without a sigma_d.
    found = inspect(write(tmp_path / "c.ply", with_columns(table(), growth_d=0.5)))
    assert found.splat is not None and found.splat.values.growth is None and found.splat.extra == ("growth_d",)


def test_adapters_and_states(tmp_path: Path) -> None:
    found = inspect(adapter_of(tmp_path / "a.safetensors"))
    assert found.about is not None and found.splat is None and "an adapter" in found.what
    assert (found.about["count"], found.about["base"]) == (40, "ab" * 32)
    assert found.about["updates"] == {"means": "float16 [40, 3]"} and found.about["attenuation"]["max_sv"] == 6
    assert found.about["growth"] is None and not any("growth" in line for line in lines_of(found))
    found = inspect(state_of(tmp_path / "a.resume.safetensors"))
    assert found.about is not None and "interrupted run" in found.what
    assert (found.about["count"], found.about["steps"], found.about["belongs"]["base"]) == (7, 9, "abc")


def test_other_formats(tmp_path: Path) -> None:
    found = inspect(gsplat_checkpoint(tmp_path / "a.pt"))
    assert found.splat is not None and found.what == "a splat, .pt" and found.splat.columns == ()
    found = inspect(write_packed(tmp_path / "a.compressed.ply", scenes.gaussians(30, 2, 0)))
    assert found.splat is not None and found.what == "a splat, compressed PLY" and found.writer == "SuperSplat 2.6.2"
    assert found.splat.values.count == 30 and "quantised" in found.notes[0] and found.splat.extra == ()
    kinds = [(f"packed_{name}", "uint32") for name in ("position", "rotation", "scale", "color")]
    assert sorted(found.splat.columns) == sorted(kinds)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", b"<html>", "web page"),
        ("a.safetensors", b"xxxxxxxxxxxxxxxx", "not a safetensors file, or damaged"),
        ("a.pt", b"PK\x03\x04", "damaged or truncated"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "mesh or a point"),
        ("a.ply", None, "no usable Gaussian in it, of 12 rows"),
    ],
)
def test_files_without_a_splat_are_refused(tmp_path: Path, name: str, content: bytes | None, message: str) -> None:
    vertex = table(12)
    vertex["x"] = np.nan
    write(tmp_path / name, vertex)
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ClodError, match=f"{name}: .*{message}"):
        inspect(tmp_path / name)


@pytest.mark.parametrize("name", ["plush_half/pretrained_mask.ply", "splats/playbot_lod4_from_sog.ply"])
def test_real_files(shared_data: Callable[[str], Path], name: str) -> None:
    path = shared_data(name)
    found, base = inspect(path), load(path)
    assert found.splat is not None and found.splat.values.count == len(base.gaussians)
    assert found.splat.values.opacity.greatest == pytest.approx(float(base.gaussians.opacities.max()), abs=1e-6)


def mutants(folder: Path) -> list[bytes]:
    """The bytes of a file of every kind, each preceded by its suffix."""
    paths = [
        write(folder / "a.ply", table(6, 1)), write(folder / "b.ply", table(4, 0), order="ascii"),
        write_packed(folder / "c.ply", scenes.gaussians(6, 1, 0)), adapted(folder / "d.ply", growth=True),
        adapter_of(folder / "e.safetensors", 5), state_of(folder / "f.safetensors"), gsplat_checkpoint(folder / "g.pt"),
    ]  # fmt: skip
    for suffix in (".glb", ".spz", ".safetensors", ".splat"):
        g = with_dial(scenes.gaussians(5, 1, 0), attenuation=ATTENUATION)
        paths.append(folder / f"model{suffix}")
        save_as(paths[-1], detach(g) if suffix == ".splat" else g, ("made here",))
    return [path.suffix.encode() + b"\0" + path.read_bytes() for path in paths]


def mutate(data: bytes, chance: random.Random) -> bytes:
    """Changes a few bytes or digits, mostly near the beginning, or removes some bytes."""
    changed = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        near = int(chance.expovariate(1 / 600)) if chance.random() < 0.5 else chance.randrange(len(changed))
        at = min(near, len(changed) - 1)
        if chance.random() < 0.1:
            del changed[at : at + chance.randint(1, 40)]
        elif digits := [m.start() for m in re.finditer(rb"\d", bytes(changed[:2000]))] if chance.random() < 0.3 else []:
            changed[chance.choice(digits)] = ord(chance.choice("0123456789-.e"))
        elif changed:
            changed[min(at, len(changed) - 1)] = chance.randrange(256)
        if len(changed) < 2:
            break
    return bytes(changed if chance.random() < 0.9 else changed[: chance.randrange(len(changed) + 1)])


@pytest.mark.filterwarnings("error")
def test_damage_is_read_or_refused_in_one_line(tmp_path: Path) -> None:
    originals, outcomes = mutants(tmp_path), {"read": 0, "refused": 0}
    for number in range(880):
        suffix, data = originals[number % len(originals)].split(b"\0", 1)
        path = tmp_path / f"mutant{suffix.decode()}"
        path.write_bytes(mutate(data, random.Random(number)))
        try:
            found = inspect(path)
            json.dumps(jsonable(found.as_dict()), allow_nan=False)
            assert all("\n" not in line and line.isprintable() for line in lines_of(found))
            outcomes["read"] += 1
        except ClodError as error:
            assert "\n" not in str(error) and str(path) in str(error), number
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 70, outcomes
