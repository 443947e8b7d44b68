"""``clod-adapt export``: formats, baked files, levels, streaming sets, orders and pages."""

from __future__ import annotations

import base64
import json
import re
import shlex
import shutil
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

import clod_adapter
from clod_adapter.calibration import Calibration, CalibrationRow, Viewpoint
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.formats.splat_transform import INSTALL, SplatTransform
from clod_adapter.io.ply_settings import write_comments
from scenes import gaussians as random_gaussians

FLIP = torch.tensor([1.0, -1, -1, 1])  # the axes of OpenGL's cameras
KEEP_DIAL = (".ply", ".glb", ".spz", ".safetensors", ".pt")
PACKED = (".sog", ".compressed.ply")  # by splat-transform
TOOL = """
import json, pathlib, sys
words = sys.argv[1:]
if words == ["--version"]:
    print("node:v22.1.0;splat-transform v3.7.0")
elif words != ["--list-gpus"]:
    out, inputs = pathlib.Path(words[-1]), [pathlib.Path(word) for word in words if word.endswith("ply")]
    sizes = [path.stat().st_size for path in inputs if path.exists()]
    out.write_text(json.dumps({"words": words, "sizes": sizes}))
    BEHAVE
"""


@pytest.fixture
def tool(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """A stand-in for splat-transform that stores its arguments and runs ``behave``."""

    def make(behave: str = "pass") -> None:
        script = tmp_path_factory.mktemp("tool") / "tool.py"
        script.write_text(TOOL.replace("BEHAVE", behave))
        monkeypatch.setenv("CLOD_SPLAT_TRANSFORM", shlex.join([sys.executable, str(script)]))

    return make


@pytest.fixture
def real_tool() -> None:
    """Skips if splat-transform is not installed."""
    try:
        SplatTransform.find()
    except ClodError as error:
        pytest.skip(str(error))


def baked(path: Path | str, s: float) -> Any:
    """A dial value of a file, baked for the cameras that the file stores."""
    model = load(path)
    assert model.viewpoints
    return clod_adapter.bake(model.gaussians, s, cameras=model.viewpoints)


def files(folder: Path) -> list[str]:
    """All files and folders in a folder, also hidden ones."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def same(a: Any, b: Any) -> bool:
    """Whether Gaussians are the same bit for bit."""
    left, right = a.tensors(), b.tensors()
    return left.keys() == right.keys() and all(torch.equal(left[name], right[name]) for name in left)


def exported(clod: Any, *words: object) -> Any:
    """The report."""
    done = clod("export", *words, "--json")
    assert done.code == 0, done
    return json.loads(done.out)


def test_baking(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    done = clod("export", dialled, "--sv", 2, "-o", "plain.ply", "--json")
    (output,), want, plain = json.loads(done.out)["outputs"], baked(dialled, 2.0), load("plain.ply")
    assert done.code == 0 and "baked for 8 training cameras; lossy" in done.err and json.loads(done.out)["notes"] == []
    assert output == {
        "file": "plain.ply", "virtual_scale": 2, "count": len(want), "bytes": (tmp_path / "plain.ply").stat().st_size,
    }  # fmt: skip
    assert f"{len(want)} of 300 Gaussians, s = 2\n" in done.err and len(want) < 300
    names = list(plain.vertex.dtype.names or ())
    assert same(plain.gaussians, want) and names[:6] == ["x", "y", "z", "nx", "ny", "nz"] and "sigma_d" not in names
    assert "baked at s = 2 by clod-adapter for 8 training cameras" in plain.comments
    report = exported(clod, dialled, "--sv", 2, "--images", capture.scene, "-o", "x.ply")
    cameras = [view.camera for view in clod_adapter.load_scene(capture.scene).train]
    want = clod_adapter.bake(load(dialled).gaussians, 2.0, cameras=cameras)
    assert report["cameras"] == 8 and torch.equal(load("x.ply").gaussians.means, want.means)
    torch.testing.assert_close(load("x.ply").gaussians.opacity_logits, want.opacity_logits)


def test_baking_for_a_camera(clod: Any, capture: Any, dialled: Path) -> None:
    """The image at that camera is the dial's."""
    there = ("--camera", "003", "--images", capture.scene)
    camera = next(v.camera for v in clod_adapter.load_scene(capture.scene).train if v.camera.name == "003.png")
    gaussians = load(dialled).gaussians
    few, many = (int(clod_adapter.render(gaussians, camera, s).kept.sum()) for s in (4.0, 1.0))
    n = (few + many) // 2
    done = clod("export", dialled, "--keep", n, *there, "-o", "from_3.ply", "--json")
    report, plain = json.loads(done.out), load("from_3.ply")
    (output,) = report["outputs"]
    assert report["camera"] == "003.png" and output["count"] == n == len(plain.gaussians) and few < n < many
    want = clod_adapter.render(gaussians, camera, output["virtual_scale"])
    shown = clod_adapter.render(plain.gaussians, camera)
    torch.testing.assert_close(shown.image, want.image, atol=2e-5, rtol=0)
    assert "exact at the camera of 003.png only" in done.err
    assert any("for the camera at (" in comment for comment in plain.comments)
    fast = exported(clod, dialled, "--fps", 1, *there, "-o", "fast.ply")  # timed here, at that camera
    assert fast["outputs"][0]["virtual_scale"] == 1 and any("frames timed here" in note for note in fast["notes"])


def without_viewpoints(path: Path, out: Path) -> Path:
    head, end, body = path.read_bytes().partition(b"end_header\n")
    lines = [line for line in head.splitlines(keepends=True) if not line.startswith(b"comment clod_adapter viewpoint")]
    out.write_bytes(b"".join(lines) + end + body)
    return out


def test_baking_without_cameras_places_some(clod: Any, dialled: Path, tmp_path: Path) -> None:
    old = without_viewpoints(dialled, tmp_path / "old.ply")
    report = exported(clod, old, "--sv", 2, "-o", "x.ply")
    assert report["notes"] == [f"{old} stores no cameras: baked for 16 placed ones; --images gives a better result"]
    model = load(old)
    want = clod_adapter.bake(model.gaussians, 2.0, cameras=clod_adapter.place_cameras(model.gaussians, views=16))
    assert model.viewpoints == () and torch.equal(load("x.ply").gaussians.means, want.means)
    assert "baked at s = 2 by clod-adapter for 16 placed cameras" in load("x.ply").comments
    faint = model.gaussians.replace(opacity_logits=model.gaussians.opacity_logits - 20)
    clod_adapter.save("faint.ply", faint)
    done = clod("export", "faint.ply", "--sv", 2, "-o", "y.ply")
    assert done.code == 2 and not Path("y.ply").exists()
    assert re.search("error: faint.ply: no cameras stored to bake for, and no .*; give --images$", done.err), done


def test_names_of_cameras(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """With or without suffix and folder; two photographs of one name need the whole one."""
    train = clod_adapter.load_scene(capture.scene).train
    names = ["a.jpg", "a.png", "images/b.jpg", "b.jpg"]
    frames = [
        {"file_path": name, "transform_matrix": (torch.linalg.inv(view.camera.viewmat) * FLIP).tolist()}
        for name, view in zip(names, train, strict=False)
    ]
    (tmp_path / "scene").mkdir()
    content = {"fl_x": 60, "w": 64, "h": 48, "frames": frames}
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    codes = {"a": 2, "a.png": 0, "b.jpg": 0, "images/b": 0, "c": 2}
    for name, code in codes.items():
        done = clod("export", dialled, "--sv", 2, "--images", "scene", "-o", "x.ply", "--camera", name)
        assert done.code == code, done
        assert name != "a" or "--camera: 'a' matches a.jpg and a.png; give the full name" in done.err


def test_levels(clod: Any, dialled: Path, tmp_path: Path) -> None:
    report = json.loads(clod("export", dialled, "--levels", "1,2.5,4", "-o", "some.set.ply", "--json").out)
    names = ["some.set_s1.ply", "some.set_s2.5.ply", "some.set_s4.ply"]
    assert files(tmp_path) == names == [output["file"] for output in report["outputs"]]
    for name, s in zip(names, (1.0, 2.5, 4.0), strict=True):
        assert same(load(name).gaussians, baked(dialled, s))
    clod("export", dialled, "--levels", "2", "-o", "one.glb")
    assert "one_s2.glb" in files(tmp_path)


def test_3dtiles(clod: Any, dialled: Path, tmp_path: Path) -> None:
    """A folder with the index and one tile a level; errors are measured, none for the finest."""
    report = json.loads(clod("export", dialled, "--levels", "1,2,4", "--3dtiles", "-o", "tiles", "--json").out)
    counts = [len(baked(dialled, s)) for s in (1.0, 2.0, 4.0)]
    assert [level["count"] for level in report["outputs"][0]["levels"]] == counts
    root = json.loads((tmp_path / "tiles" / "tileset.json").read_text())["root"]
    middle = root["children"][0]
    finest = middle["children"][0]
    assert [tile["content"]["uri"] for tile in (root, middle, finest)] == ["root.glb", "0_1.glb", "0_0.glb"]
    assert root["geometricError"] > middle["geometricError"] > finest["geometricError"] == 0
    assert sorted(files(tmp_path / "tiles")) == ["0_0.glb", "0_1.glb", "root.glb", "tileset.json"]


def test_levels_appear_together_or_not_at_all(clod: Any, dialled: Path, tmp_path: Path) -> None:
    """Neither a file of an earlier run nor the others change where the last cannot be written."""
    earlier = b"of an earlier run of clod-adapter"
    (tmp_path / "x_s1.ply").write_bytes(earlier)
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(dialled.read_bytes()) // 2, hard))
    try:
        done = clod("export", dialled, "--levels", "1,4", "-o", "x.ply")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert done.code == 2 and "Traceback" not in done.err, done
    assert files(tmp_path) == ["x_s1.ply"] and (tmp_path / "x_s1.ply").read_bytes() == earlier


@pytest.mark.parametrize("suffix", [*KEEP_DIAL, ".splat"])
def test_formats_keep_the_dial_if_they_can(clod: Any, dialled: Path, suffix: str) -> None:
    model, kept = load(dialled), suffix in KEEP_DIAL
    done = clod("export", dialled, "-o", f"x{suffix}", *(() if kept else ("--sv", 1)), "--json")
    (output,) = json.loads(done.out)["outputs"]
    assert done.code == 0 and output["bytes"] == Path(f"x{suffix}").stat().st_size and ("lossy" in done.err) != kept
    assert output["virtual_scale"] == (None if kept else 1) and (output["count"] == 300 or not kept)
    again = load(f"x{suffix}").gaussians
    assert (again.sigma_d is not None) == (again.growth_d is not None) == kept
    if suffix in (".ply", ".safetensors", ".pt"):
        assert same(again, model.gaussians) and (suffix == ".pt" or again.attenuation == model.gaussians.attenuation)
    if suffix == ".ply":
        assert load("x.ply").calibration == model.calibration and load("x.ply").notes == ()
    plain = clod("export", dialled, "-o", f"y{suffix}", "--sv", 2, "--quiet", "--json")
    assert plain.code == 0 and plain.err == ""
    assert json.loads(plain.out)["outputs"][0]["count"] == len(baked(dialled, 2.0))


def test_plain_file(clod: Any, capture: Any) -> None:
    report = json.loads(clod("export", capture.ply, "-o", "x.splat", "--json").out)
    assert report["outputs"][0] == {"file": "x.splat", "virtual_scale": None, "count": 300, "bytes": 300 * 32}
    assert "view-dependent colour is dropped" in report["notes"]


def test_dropped_columns_are_noted(clod: Any, dialled: Path, tmp_path: Path) -> None:
    vertex = PlyData.read(str(dialled), mmap=False)["vertex"]
    labelled = np.empty(300, [("label", "i4"), *vertex.data.dtype.descr])
    for name in vertex.data.dtype.names:
        labelled[name] = vertex.data[name]
    labelled["label"] = 7
    PlyData([PlyElement.describe(labelled, "vertex", comments=vertex.comments)]).write(tmp_path / "labelled.ply")
    report = json.loads(clod("export", "labelled.ply", "-o", "x.ply", "--json").out)
    assert report["notes"] == ["columns dropped: label"]
    assert same(load("x.ply").gaussians, load(dialled).gaussians)
    model = load(dialled).gaussians  # columns of settings are not dropped
    save("hard.ply", model.replace(attenuation=replace(model.attenuation, tau=0.01, cut="hard")))  # type: ignore[type-var]
    report = json.loads(clod("export", "hard.ply", "-o", "y.ply", "--json").out)
    assert report["notes"] == [] and load("y.ply").vertex.dtype == load("hard.ply").vertex.dtype


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".glb", ".pt", ".safetensors"])
def test_file_metadata_is_kept(clod: Any, dialled: Path, tmp_path: Path, suffix: str) -> None:
    data = dialled.read_bytes().replace(b"\nproperty", b"\ncomment SplatRenderMode: default\nproperty", 1)
    (tmp_path / "said.ply").write_bytes(data)
    assert clod("export", "said.ply", "--sv", 2, "-o", f"baked{suffix}").code == 0
    assert clod("export", f"baked{suffix}", "-o", "again.ply").code == 0
    header = (tmp_path / "again.ply").read_bytes().partition(b"end_header")[0].decode()
    for line in ("baked at s = 2 by clod-adapter for 8 training cameras", "SplatRenderMode: default"):
        assert header.count(f"comment {line}\n") == 1


def test_float64_positions_are_noted(clod: Any, dialled: Path, tmp_path: Path) -> None:
    vertex = PlyData.read(str(dialled), mmap=False)["vertex"]
    far = vertex.data.astype([(n, "f8" if n in "xyz" else t) for n, t in vertex.data.dtype.descr])
    far["x"] += 437_000.0
    calibration, config = load(dialled).calibration, load(dialled).gaussians.attenuation
    assert calibration is not None
    there = replace(calibration, viewpoints=tuple(v.moved([437_000.0, 0, 0]) for v in calibration.viewpoints))
    comments = write_comments(config, (), calibration=there)
    PlyData([PlyElement.describe(far, "vertex", comments=comments)]).write(tmp_path / "far.ply")
    report = json.loads(clod("export", "far.ply", "--sv", 2, "-o", "x.ply", "--json").out)
    assert any("x, y and z are doubles" in note for note in report["notes"])
    want = baked("far.ply", 2.0)
    assert (
        len(load("x.ply").gaussians) == len(want) == len(baked(dialled, 2.0))
        and 436_000 < load("x.ply").vertex["x"].mean() < 438_000
    )


def test_order_by_extinction(clod: Any, dialled: Path) -> None:
    gaussians = load(dialled).gaussians
    rows = clod_adapter.order_by_extinction(gaussians, load(dialled).viewpoints)
    done = clod("export", dialled, "--order", "extinction", "-o", "ordered.ply", "--json")
    assert json.loads(done.out)["order"] == "extinction"
    ordered = load("ordered.ply")
    assert same(ordered.gaussians, gaussians.select(rows)) and ordered.calibration == load(dialled).calibration
    assert any("rows in the order" in comment for comment in ordered.comments)
    n = len(baked(dialled, 3.0))
    assert n < 300 and clod("export", dialled, "--order", "extinction", "--keep", n, "-o", "first.ply").code == 0
    assert torch.equal(load("first.ply").gaussians.means, gaussians.means[rows[:n]])


def test_order_by_extinction_for_cameras_of_the_scene(clod: Any, capture: Any, dialled: Path) -> None:
    gaussians, cameras = load(dialled).gaussians, [view.camera for view in clod_adapter.load_scene(capture.scene).train]
    words = ("export", dialled, "--order", "extinction", "--images", capture.scene)
    assert clod(*words, "-o", "all.ply").code == 0
    assert same(load("all.ply").gaussians, gaussians.select(clod_adapter.order_by_extinction(gaussians, cameras)))
    assert clod(*words, "--camera", "003", "--sv", 2, "-o", "one.ply").code == 0
    camera = next(each for each in cameras if each.name == "003.png")
    ordered = gaussians.select(clod_adapter.order_by_extinction(gaussians, [camera]))
    assert same(load("one.ply").gaussians, clod_adapter.bake(ordered, 2.0, camera))


def saved(path: Path, degree: int, *, growth: bool = True) -> Any:
    """A model of that SH degree with a dial at ``path``."""
    sigma = torch.linspace(0.9, 9, 50)
    model = clod_adapter.with_dial(
        random_gaussians(50, degree, 4), sigma, clod_adapter.AttenuationConfig(reference_distance=3.0)
    )
    model = model.replace(growth_d=torch.linspace(-1, 3, 50) if growth else None)
    places = (Viewpoint(0.0, 0.0, -4.0, 1.0), Viewpoint(1.0, 0.0, 4.0, 1.0))
    row = CalibrationRow(1.0, 40.0, 30.0, 0.9, 5.0)
    save(path, model, calibration=Calibration((row,), 50, 1, 8, 6, "a machine", viewpoints=places))
    return model


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_sibr_reads_baked_files(clod: Any, tmp_path: Path, degree: int) -> None:
    """SIBR's loadPly takes the count from the third line, skips to end_header, and then reads RichPoint<D>.

    Position, three normals, (D + 1)^2 x 3 harmonics (channel after channel behind the first three), opacity, three
    scales, four of the rotation: all float32, without gaps. D is that of cfg_args, so the SH degree must not change.
    """
    saved(tmp_path / "model.ply", degree)
    assert clod("export", "model.ply", "--sv", 2, "-o", "baked.ply").code == 0
    want = baked("model.ply", 2.0)
    data = (tmp_path / "baked.ply").read_bytes()
    lines = data[: data.index(b"end_header\n")].split(b"\n")
    assert lines[:2] == [b"ply", b"format binary_little_endian 1.0"]
    count, harmonics = int(lines[2].split()[2]), 3 * (degree + 1) ** 2
    body = data[data.index(b"end_header\n") + len(b"end_header\n") :]
    point = struct.Struct(f"<3f3f{harmonics}f1f3f4f")
    assert count == len(want) and len(body) == count * point.size
    for row, values in enumerate(point.iter_unpack(body)):
        sh = values[6 : 6 + harmonics]
        assert values[:6] == (*want.means[row].tolist(), 0, 0, 0)
        assert list(sh[:3]) == want.sh0[row, 0].tolist()
        assert list(sh[3:]) == want.shN[row].T.reshape(-1).tolist()
        rest = [want.opacity_logits[row : row + 1], want.log_scales[row], want.quats[row]]
        assert list(values[6 + harmonics :]) == torch.cat(rest).tolist()


@pytest.mark.parametrize("growth", [True, False])
def test_growth(clod: Any, tmp_path: Path, growth: bool) -> None:
    """It is kept in step with the rows, and a baked file is said to have the grown scales."""
    g = saved(tmp_path / "model.ply", 0, growth=growth)
    rows = clod_adapter.order_by_extinction(g, load("model.ply").viewpoints)
    for suffix in (".ply", ".glb", ".pt"):
        done = clod("export", "model.ply", "--order", "extinction", "-o", f"x{suffix}")
        ordered = load(f"x{suffix}").gaussians
        assert done.code == 0 and ordered.sigma_d is not None and torch.equal(ordered.sigma_d, g.sigma_d[rows])
        assert (ordered.growth_d is not None) == growth
        assert ordered.growth_d is None or torch.equal(ordered.growth_d, g.growth_d[rows])
    done = clod("export", "model.ply", "--sv", 2, "-o", "baked.splat")
    assert done.code == 0 and "lossy" in done.out and ("the scales include growth" in done.out) == growth


def test_packed_formats(clod: Any, dialled: Path, tmp_path: Path, tool: Any) -> None:
    tool()
    for suffix in PACKED:
        done = clod("export", dialled, "--levels", "1,4", "-o", f"x{suffix}", "--json")
        report = json.loads(done.out)
        assert done.code == 0 and " took " in done.err
        assert "splat-transform rounds values and sorts the Gaussians" in report["notes"]
        assert any("without a GPU" in note for note in report["notes"]) == (suffix == ".sog")
        for output in report["outputs"]:
            said = json.loads(Path(output["file"]).read_text())
            assert said["words"][:5] == ["-w", "-g", "cpu", "-i", "1"] and len(said["words"]) == 7
            assert said["words"][-1].endswith(f"packed{suffix}") and said["sizes"][0] > 92 * output["count"]
    assert files(tmp_path) == sorted(f"x_s{s}{suffix}" for s in (1, 4) for suffix in PACKED)


def test_streaming_set(clod: Any, dialled: Path, tmp_path: Path, tool: Any) -> None:
    tool("(out.parent / '0_0').mkdir(); (out.parent / '0_0' / 'a.webp').write_text('1234')")
    assert clod("export", dialled, "--levels", "1,4", "--lod-meta", "--out=-o").code == 0  # not an option of the tool
    shutil.rmtree(tmp_path / "-o")
    (tmp_path / "out").mkdir()  # empty
    done = clod("export", dialled, "--levels", "1,2,4", "--lod-meta", "-o", "out", "--json")
    (output,) = json.loads(done.out)["outputs"]
    counts = [len(baked(dialled, s)) for s in (1.0, 2.0, 4.0)]
    levels = [{"virtual_scale": s, "count": n} for s, n in zip((1, 2, 4), counts, strict=True)]
    assert output["levels"] == levels and output["count"] == sum(counts)
    assert files(tmp_path) == ["out", "out/0_0", "out/0_0/a.webp", "out/lod-meta.json"]
    text = Path(output["file"]).read_text()
    assert output["bytes"] == len(text) + 4
    words = json.loads(text)["words"][5:]
    assert words[:4] == ["--lod-chunk-extent", "0", "--lod-chunk-min", "8"]
    words = words[4:]
    assert words[1::3] == ["-l"] * 3 and words[2::3] == ["0", "1", "2"] and words[-1].endswith("/lod-meta.json")
    assert any("lod-meta.json: has no tree of leaves" in note for note in json.loads(done.out)["notes"])
    done = clod("export", dialled, "--levels", "1,2", "--lod-meta", "-o", "out")
    assert done.code == 2 and "out: is a folder that is not empty" in done.err


def test_packing_needs_the_tool(clod: Any, dialled: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for words in (("--sv", 2, "-o", "x.sog"), ("--levels", "1,2", "--lod-meta", "-o", "out")):
        done = clod("export", dialled, *words)
        assert done.code == 2 and len(done.err.splitlines()) == 1, done
        assert "splat-transform is not installed" in done.err and INSTALL in done.err
    assert files(tmp_path) == []


@pytest.mark.parametrize(
    ("behave", "said", "words"),
    [
        ("print('\\u2717 Error: no memory'); sys.exit(1)", "failed: Error: no memory", ("-o", "x.sog")),
        ("import time; time.sleep(60)", "was ended, it took longer than 1 s", ("--lod-meta", "-o", "out")),
    ],
)
def test_failure_of_the_tool_leaves_no_file(
    clod: Any, dialled: Path, tmp_path: Path, tool: Any, monkeypatch: Any, behave: str, said: str, words: Any
) -> None:
    monkeypatch.setattr("clod_adapter.io.formats.splat_transform.LIMIT", 1.0)
    monkeypatch.setattr("clod_adapter.io.formats.splat_transform.LIMIT_EACH", 0.0)
    monkeypatch.setenv("PYTHONIOENCODING", "utf-8")
    tool(behave)
    done = clod("export", dialled, "--levels", "1,2", *words)
    assert done.code == 2 and done.err.splitlines()[-1].endswith(said) and files(tmp_path) == [], done


def test_ctrl_c_ends_the_tool_too(clod: Any, dialled: Path, tmp_path: Path, tool: Any) -> None:
    tool("import os, signal, time; os.kill(os.getppid(), signal.SIGINT); time.sleep(60)")
    done = clod("export", dialled, "--levels", "1,2", "--lod-meta", "-o", "out")
    assert done.code == 130 and files(tmp_path) == []


@pytest.mark.usefixtures("real_tool")
def test_the_real_tool(clod: Any, dialled: Path, tmp_path: Path) -> None:
    counts = [len(baked(dialled, s)) for s in (1.0, 4.0)]
    assert clod("export", dialled, "--levels", "1,4", "--lod-meta", "-o", "out").code == 0
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    assert meta["counts"] == counts and meta["lodLevels"] == 2
    assert meta["lodErrors"] and meta["tree"]["errors"][0] == 0 < meta["tree"]["errors"][1]  # of a single leaf
    assert all((tmp_path / "out" / name).is_file() for name in meta["filenames"])
    for suffix in PACKED:
        assert clod("export", dialled, "--sv", 4, "-o", f"x{suffix}").code == 0
    data = (tmp_path / "x.compressed.ply").read_bytes()
    assert b"packed_position" in data and f"element vertex {counts[1]}\n".encode() in data
    assert (tmp_path / "x.sog").read_bytes().startswith(b"PK")
    assert files(tmp_path / "out") != [] and not [name for name in files(tmp_path) if "tmp" in name]


@pytest.mark.parametrize("sv", [None, 2, 9])
def test_page_holds_the_splat_and_its_dial(
    clod: Any, dialled: Path, tmp_path: Path, capture: Any, monkeypatch: Any, sv: int | None
) -> None:
    monkeypatch.setenv("CLOD_SPLAT_TRANSFORM", "there-is-none")  # it is not needed
    scene = ["--images", capture.scene] if sv == 2 else []
    done = clod("export", dialled, "-o", "page.html", *(["--sv", sv] if sv else []), *scene, "--json")
    assert done.code == 0, done
    report, text = json.loads(done.out), (tmp_path / "page.html").read_text(encoding="utf-8")
    (output,), config = report["outputs"], json.loads(re.findall('id="clod-config">(.*?)</script>', text)[0])
    assert config["model"]["name"] == dialled.name and config["virtual_scale"] == (min(sv, 4) if sv else None)
    assert any("dial ends at s = 4" in note for note in report["notes"]) == (sv == 9)
    assert ("Gaussians, initial dial value s = " in done.err) == bool(sv) and " of " not in done.err.splitlines()[-1]
    names = [camera["name"] for camera in config["cameras"]]
    assert (names == sorted(path.name for path in (capture.scene / "images").iterdir())) == (sv == 2)
    (tmp_path / "held.spz").write_bytes(base64.b64decode(re.findall('id="clod-model">(.*?)</script>', text)[0]))
    held = clod_adapter.load(tmp_path / "held.spz")
    assert len(held.gaussians) == output["count"] == 300 and output["bytes"] == (tmp_path / "page.html").stat().st_size
    assert held.gaussians.sigma_d is not None and held.calibration is not None
    said = re.search(r"PSNR of (\S+) dB against the exact file \(4 views, s = 1\)", done.err)
    assert said and float(said[1]) > 40 and [path.name for path in tmp_path.glob(".tmp-*")] == []


def test_exact_page_holds_every_digit(clod: Any, dialled: Path, tmp_path: Path) -> None:
    done = clod("export", dialled, "-o", "page.html", "--exact")
    assert done.code == 0 and "PSNR" not in done.err
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    (tmp_path / "held.ply").write_bytes(base64.b64decode(re.findall('id="clod-model">(.*?)</script>', text)[0]))
    held, model = clod_adapter.load(tmp_path / "held.ply").gaussians, clod_adapter.load(dialled).gaussians
    for name, value in model.tensors().items():
        assert torch.equal(held.tensors()[name], value), name
