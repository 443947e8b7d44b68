"""``clod-adapt export``: formats, baked files, levels, streaming sets, orders and pages."""

from __future__ import annotations

import base64
import json
import re
import shlex
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from plyfile import PlyData, PlyElement

import clod_adapter
from clod_adapter.calibration import Calibration, CalibrationRow, Viewpoint
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.formats import splat_transform
from clod_adapter.io.ply_settings import write_comments
from formats import with_columns
from scenes import gaussians as random_gaussians

FLIP = torch.tensor([1.0, -1, -1, 1])  # the axes of OpenGL's cameras
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


def exported(clod: Any, *words: object) -> tuple[Any, str]:
    """The report, and what was printed."""
    done = clod("export", *words, "--json")
    assert done.code == 0, done
    return json.loads(done.out), done.err


def test_baking(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """For the cameras that the file stores, for those of a scene, for one of them, and for placed ones."""
    (report, err), want, plain = exported(clod, dialled, "--sv", 2, "-o", "x.ply"), baked(dialled, 2.0), load("x.ply")
    size = (tmp_path / "x.ply").stat().st_size
    assert report["outputs"] == [{"file": "x.ply", "virtual_scale": 2, "count": len(want), "bytes": size}]
    assert report["notes"] == [] and "baked for 8 training cameras; lossy" in err and "scales include growth" in err
    assert f"{len(want)} of 300 Gaussians, s = 2\n" in err and len(want) < 300 and same(plain.gaussians, want)
    assert "sigma_d" not in plain.vertex.dtype.names
    assert "baked at s = 2 by clod-adapter for 8 training cameras" in plain.comments
    report, _ = exported(clod, dialled, "--sv", 2, "--images", capture.scene, "-o", "x.ply")
    cameras = [view.camera for view in clod_adapter.load_scene(capture.scene).train]
    model, again = load(dialled).gaussians, load("x.ply").gaussians
    want = clod_adapter.bake(model, 2.0, cameras=cameras)
    assert report["cameras"] == 8 and torch.equal(again.means, want.means)
    torch.testing.assert_close(again.opacity_logits, want.opacity_logits)

    there = ("--camera", "003", "--images", capture.scene)
    camera = next(each for each in cameras if each.name == "003.png")
    few, many = (int(clod_adapter.render(model, camera, s).kept.sum()) for s in (4.0, 1.0))
    n = (few + many) // 2
    report, err = exported(clod, dialled, "--keep", n, *there, "-o", "one.ply")
    (output,), plain = report["outputs"], load("one.ply")
    assert report["camera"] == "003.png" and output["count"] == n == len(plain.gaussians) and few < n < many
    want = clod_adapter.render(model, camera, output["virtual_scale"])  # there the image is the dial's
    torch.testing.assert_close(clod_adapter.render(plain.gaussians, camera).image, want.image, atol=2e-5, rtol=0)
    assert "exact at the camera of 003.png only" in err
    assert any("for the camera at (" in comment for comment in plain.comments)
    fast, _ = exported(clod, dialled, "--fps", 1, *there, "-o", "fast.ply")  # timed here, at that camera
    assert fast["outputs"][0]["virtual_scale"] == 1 and any("frames timed here" in note for note in fast["notes"])

    save("old.ply", model)  # as before cameras were stored
    report, _ = exported(clod, "old.ply", "--sv", 2, "-o", "x.ply")
    assert report["notes"] == ["old.ply stores no cameras: baked for 16 placed ones; --images gives a better result"]
    want = clod_adapter.bake(model, 2.0, cameras=clod_adapter.place_cameras(model, views=16))
    assert torch.equal(load("x.ply").gaussians.means, want.means)
    assert "baked at s = 2 by clod-adapter for 16 placed cameras" in load("x.ply").comments
    save("faint.ply", model.replace(opacity_logits=model.opacity_logits - 20))
    done = clod("export", "faint.ply", "--sv", 2, "-o", "y.ply")
    assert done.code == 2 and not Path("y.ply").exists()
    assert re.search("error: faint.ply: no cameras stored to bake for, and no .*; give --images$", done.err), done


def test_names_of_cameras(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """With or without suffix and folder; two photographs of one name need the whole one."""
    train = clod_adapter.load_scene(capture.scene).train
    frames = [
        {"file_path": name, "transform_matrix": (torch.linalg.inv(view.camera.viewmat) * FLIP).tolist()}
        for name, view in zip(["a.jpg", "a.png", "images/b.jpg", "b.jpg"], train, strict=False)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 60, "w": 64, "h": 48, "frames": frames}))
    for name, code in {"a": 2, "a.png": 0, "b.jpg": 0, "images/b": 0, "c": 2}.items():
        done = clod("export", dialled, "--sv", 2, "--images", tmp_path, "-o", "x.ply", "--camera", name)
        assert done.code == code, done
        assert name != "a" or "--camera: 'a' matches a.jpg and a.png; give the full name" in done.err


def test_levels(clod: Any, dialled: Path, tmp_path: Path) -> None:
    """A file each, or one 3D Tiles set, whose errors are measured; all or none."""
    report, _ = exported(clod, dialled, "--levels", "1,2.5,4", "-o", "some.set.ply")
    names = ["some.set_s1.ply", "some.set_s2.5.ply", "some.set_s4.ply"]
    assert files(tmp_path) == names == [output["file"] for output in report["outputs"]]
    for name, s in zip(names, (1.0, 2.5, 4.0), strict=True):
        assert same(load(name).gaussians, baked(dialled, s))
    (output,) = exported(clod, dialled, "--levels", "1,2,4", "--3dtiles", "-o", "tiles")[0]["outputs"]
    assert [level["count"] for level in output["levels"]] == [len(baked(dialled, s)) for s in (1.0, 2.0, 4.0)]
    root = json.loads((tmp_path / "tiles" / "tileset.json").read_text())["root"]
    middle = root["children"][0]
    finest = middle["children"][0]
    assert [tile["content"]["uri"] for tile in (root, middle, finest)] == ["root.glb", "0_1.glb", "0_0.glb"]
    assert root["geometricError"] > middle["geometricError"] > finest["geometricError"] == 0
    assert files(tmp_path / "tiles") == ["0_0.glb", "0_1.glb", "root.glb", "tileset.json"]
    resource, before = pytest.importorskip("resource"), [(tmp_path / name).read_bytes() for name in names]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(dialled.read_bytes()) // 2, hard))
    try:  # the last file fits, and the first does not
        done = clod("export", dialled, "--levels", "1,4,9", "-o", "some.set.ply")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert done.code == 2 and "Traceback" not in done.err, done
    assert files(tmp_path)[:4] == [*names, "tiles"] and [(tmp_path / name).read_bytes() for name in names] == before


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".spz", ".safetensors", ".pt", ".splat"])
def test_formats(clod: Any, dialled: Path, tmp_path: Path, suffix: str) -> None:
    """The dial is kept where the format can; comments survive baking and another export."""
    model, kept = load(dialled), suffix != ".splat"
    report, err = exported(clod, dialled, "-o", f"x{suffix}", *(() if kept else ("--sv", 1)))
    (output,), again = report["outputs"], load(f"x{suffix}")
    assert output["bytes"] == Path(f"x{suffix}").stat().st_size and ("lossy" in err) != kept
    assert output["virtual_scale"] == (None if kept else 1) and (output["count"] == 300 or not kept)
    assert (again.gaussians.sigma_d is not None) == (again.gaussians.growth_d is not None) == kept
    if suffix in (".ply", ".safetensors", ".pt"):
        assert same(again.gaussians, model.gaussians)
        assert suffix == ".pt" or again.gaussians.attenuation == model.gaussians.attenuation
    assert suffix != ".ply" or (again.calibration == model.calibration and again.notes == ())
    data = dialled.read_bytes().replace(b"\nproperty", b"\ncomment SplatRenderMode: default\nproperty", 1)
    (tmp_path / "said.ply").write_bytes(data)
    plain = clod("export", "said.ply", "--sv", 2, "-o", f"baked{suffix}", "--quiet", "--json")
    assert plain.code == 0 and plain.err == ""
    assert json.loads(plain.out)["outputs"][0]["count"] == len(baked(dialled, 2.0))
    exported(clod, f"baked{suffix}", "-o", "again.ply")
    header = (tmp_path / "again.ply").read_bytes().partition(b"end_header")[0].decode()
    for line in ("baked at s = 2 by clod-adapter for 8 training cameras", "SplatRenderMode: default"):
        assert header.count(f"comment {line}\n") == kept


def test_losses_are_noted(clod: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    """Harmonics and foreign columns; positions far from 0 become doubles. Columns of settings are not dropped."""
    report, _ = exported(clod, capture.ply, "-o", "x.splat")
    assert report["outputs"] == [{"file": "x.splat", "virtual_scale": None, "count": 300, "bytes": 300 * 32}]
    assert "view-dependent colour is dropped" in report["notes"]
    model, element = load(dialled), PlyData.read(str(dialled), mmap=False)["vertex"]
    labelled = PlyElement.describe(with_columns(element.data, label=7), "vertex", comments=element.comments)
    PlyData([labelled]).write(tmp_path / "labelled.ply")
    report, _ = exported(clod, "labelled.ply", "-o", "x.ply")
    assert report["notes"] == ["columns dropped: label"] and same(load("x.ply").gaussians, model.gaussians)
    assert model.gaussians.attenuation is not None and model.calibration is not None
    settings = replace(model.gaussians.attenuation, tau=0.01, cut="hard")
    save("hard.ply", model.gaussians.replace(attenuation=settings))
    report, _ = exported(clod, "hard.ply", "-o", "y.ply")
    assert report["notes"] == [] and load("y.ply").vertex.dtype == load("hard.ply").vertex.dtype
    far = element.data.astype([(n, "f8" if n in "xyz" else t) for n, t in element.data.dtype.descr])
    far["x"] += 437_000.0
    there = replace(
        model.calibration, viewpoints=tuple(v.moved([437_000.0, 0, 0]) for v in model.calibration.viewpoints)
    )
    comments = write_comments(model.gaussians.attenuation, (), calibration=there)
    PlyData([PlyElement.describe(far, "vertex", comments=comments)]).write(tmp_path / "far.ply")
    report, _ = exported(clod, "far.ply", "--sv", 2, "-o", "x.ply")
    assert any("x, y and z are doubles" in note for note in report["notes"])
    again = load("x.ply")
    assert len(again.gaussians) == len(baked("far.ply", 2.0)) == len(baked(dialled, 2.0))
    assert 436_000 < again.vertex["x"].mean() < 438_000


def test_order_by_extinction(clod: Any, capture: Any, dialled: Path) -> None:
    """For the stored cameras, of which a count is a prefix, for those of a scene, and for one."""
    model, cameras = load(dialled), [view.camera for view in clod_adapter.load_scene(capture.scene).train]
    words = (dialled, "--order", "extinction")
    rows = clod_adapter.order_by_extinction(model.gaussians, model.viewpoints)
    report, _ = exported(clod, *words, "-o", "ordered.ply")
    ordered = load("ordered.ply")
    assert report["order"] == "extinction" and same(ordered.gaussians, model.gaussians.select(rows))
    assert ordered.calibration == model.calibration
    assert any("rows in the order" in comment for comment in ordered.comments)
    n = len(baked(dialled, 3.0))
    exported(clod, *words, "--keep", n, "-o", "first.ply")
    assert n < 300 and torch.equal(load("first.ply").gaussians.means, model.gaussians.means[rows[:n]])
    exported(clod, *words, "--images", capture.scene, "-o", "all.ply")
    rows = clod_adapter.order_by_extinction(model.gaussians, cameras)
    assert same(load("all.ply").gaussians, model.gaussians.select(rows))
    exported(clod, *words, "--images", capture.scene, "--camera", "003", "--sv", 2, "-o", "one.ply")
    camera = next(each for each in cameras if each.name == "003.png")
    ordered = model.gaussians.select(clod_adapter.order_by_extinction(model.gaussians, [camera]))
    assert same(load("one.ply").gaussians, clod_adapter.bake(ordered, 2.0, camera))


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_sibr_reads_baked_files(clod: Any, tmp_path: Path, degree: int) -> None:
    """SIBR's loadPly takes the count from the third line, skips to end_header, and then reads RichPoint<D>.

    Position, three normals, (D + 1)^2 x 3 harmonics (channel after channel behind the first three), opacity, three
    scales, four of the rotation: all float32, without gaps. D is that of cfg_args, so the SH degree must not change.
    """
    dial = clod_adapter.AttenuationConfig(reference_distance=3.0)
    model = clod_adapter.with_dial(random_gaussians(50, degree, 4), torch.linspace(0.9, 9, 50), dial)
    places = (Viewpoint(0.0, 0.0, -4.0, 1.0), Viewpoint(1.0, 0.0, 4.0, 1.0))
    row = CalibrationRow(1.0, 40.0, 30.0, 0.9, 5.0)
    save("model.ply", model, calibration=Calibration((row,), 50, 1, 8, 6, "a machine", viewpoints=places))
    assert "growth" not in exported(clod, "model.ply", "--sv", 2, "-o", "baked.ply")[1]
    want = baked("model.ply", 2.0)
    head, _, body = (tmp_path / "baked.ply").read_bytes().partition(b"end_header\n")
    lines = head.split(b"\n")
    assert lines[:2] == [b"ply", b"format binary_little_endian 1.0"]
    count, harmonics = int(lines[2].split()[2]), 3 * (degree + 1) ** 2
    point = struct.Struct(f"<3f3f{harmonics}f1f3f4f")
    assert count == len(want) and len(body) == count * point.size
    for row, values in enumerate(point.iter_unpack(body)):
        rest = [want.opacity_logits[row : row + 1], want.log_scales[row], want.quats[row]]
        parts = [want.means[row], torch.zeros(3), want.sh0[row, 0], want.shN[row].T.reshape(-1), *rest]
        assert list(values) == torch.cat(parts).tolist()


def test_packed_formats(clod: Any, dialled: Path, tmp_path: Path, tool: Any) -> None:
    tool()
    for suffix in PACKED:
        report, err = exported(clod, dialled, "--levels", "1,4", "-o", f"x{suffix}")
        assert " took " in err and "splat-transform rounds values and sorts the Gaussians" in report["notes"]
        assert any("without a GPU" in note for note in report["notes"]) == (suffix == ".sog")
        for output in report["outputs"]:
            said = json.loads(Path(output["file"]).read_text())
            assert said["words"][:5] == ["-w", "-g", "cpu", "-i", "1"] and len(said["words"]) == 7
            assert said["words"][-1].endswith(f"packed{suffix}") and said["sizes"][0] > 92 * output["count"]
    assert files(tmp_path) == sorted(f"x_s{s}{suffix}" for s in (1, 4) for suffix in PACKED)


def test_streaming_set(clod: Any, dialled: Path, tmp_path: Path, tool: Any) -> None:
    tool("(out.parent / '0_0').mkdir(); (out.parent / '0_0' / 'a.webp').write_text('1234')")
    (tmp_path / "-o").mkdir()  # empty; not an option of the tool
    report, _ = exported(clod, dialled, "--levels", "1,2,4", "--lod-meta", "--out=-o")
    (output,) = report["outputs"]
    counts = [len(baked(dialled, s)) for s in (1.0, 2.0, 4.0)]
    levels = [{"virtual_scale": s, "count": n} for s, n in zip((1, 2, 4), counts, strict=True)]
    assert output["levels"] == levels and output["count"] == sum(counts)
    assert files(tmp_path) == ["-o", "-o/0_0", "-o/0_0/a.webp", "-o/lod-meta.json"]
    text = Path(output["file"]).read_text()
    words = json.loads(text)["words"][5:]
    assert output["bytes"] == len(text) + 4 and words[:4] == ["--lod-chunk-extent", "0", "--lod-chunk-min", "8"]
    words = words[4:]
    assert words[1::3] == ["-l"] * 3 and words[2::3] == ["0", "1", "2"] and words[-1].endswith("/lod-meta.json")
    done = clod("export", dialled, "--levels", "1,2", "--lod-meta", "--out=-o")
    assert done.code == 2 and "-o: is a folder that is not empty" in done.err


@pytest.mark.parametrize("words", [("--sv", 2, "-o", "x.sog"), ("--levels", "1,2", "--lod-meta", "-o", "out")])
@pytest.mark.parametrize(
    ("behave", "code", "said"),
    [
        (None, 2, f"splat-transform is not installed.*{re.escape(splat_transform.INSTALL)}"),
        ("print('\\u2717 Error: no memory'); sys.exit(1)", 2, "failed: Error: no memory$"),
        ("import time; time.sleep(60)", 2, "was ended, it took longer than 1 s$"),
        ("import os, signal, time; os.kill(os.getppid(), signal.SIGINT); time.sleep(60)", 130, "interrupted"),
    ],
)
def test_failure_of_the_tool_leaves_no_file(
    clod: Any, dialled: Path, tmp_path: Path, tool: Any, monkeypatch: Any, behave: Any, code: int, said: str, words: Any
) -> None:
    monkeypatch.setattr(splat_transform, "LIMIT", 1.0 if behave and "signal" not in behave else 60.0)
    monkeypatch.setattr(splat_transform, "LIMIT_EACH", 0.0)
    monkeypatch.setenv("PYTHONIOENCODING", "utf-8")
    if behave:
        tool(behave)
    else:
        monkeypatch.delenv("CLOD_SPLAT_TRANSFORM", raising=False)
        monkeypatch.setenv("PATH", str(tmp_path))
    done = clod("export", dialled, *words)
    assert done.code == code and re.search(said, done.err.splitlines()[-1]) and files(tmp_path) == [], done


def test_the_real_tool(clod: Any, dialled: Path, tmp_path: Path) -> None:
    try:
        splat_transform.SplatTransform.find()
    except ClodError as error:
        pytest.skip(str(error))
    counts = [len(baked(dialled, s)) for s in (1.0, 4.0)]
    exported(clod, dialled, "--levels", "1,4", "--lod-meta", "-o", "out")
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    assert meta["counts"] == counts and meta["lodLevels"] == 2
    assert all((tmp_path / "out" / name).is_file() for name in meta["filenames"])
    for suffix in PACKED:
        exported(clod, dialled, "--sv", 4, "-o", f"x{suffix}")
    data = (tmp_path / "x.compressed.ply").read_bytes()
    assert b"packed_position" in data and f"element vertex {counts[1]}\n".encode() in data
    assert (tmp_path / "x.sog").read_bytes().startswith(b"PK")
    assert not [name for name in files(tmp_path) if "tmp" in name]


@pytest.mark.parametrize("sv", [None, 2, 9])
def test_page_holds_the_splat_and_its_dial(
    clod: Any, dialled: Path, tmp_path: Path, capture: Any, monkeypatch: Any, sv: int | None
) -> None:
    monkeypatch.setenv("CLOD_SPLAT_TRANSFORM", "there-is-none")  # it is not needed
    scene = ["--images", capture.scene] if sv == 2 else []
    report, err = exported(clod, dialled, "-o", "page.html", *(["--sv", sv] if sv else []), *scene)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    (output,), config = report["outputs"], json.loads(re.findall('id="clod-config">(.*?)</script>', text)[0])
    assert config["model"]["name"] == dialled.name and config["virtual_scale"] == (min(sv, 4) if sv else None)
    assert any("dial ends at s = 4" in note for note in report["notes"]) == (sv == 9)
    assert ("Gaussians, initial dial value s = " in err) == bool(sv) and " of " not in err.splitlines()[-1]
    names = [camera["name"] for camera in config["cameras"]]
    assert (names == sorted(path.name for path in (capture.scene / "images").iterdir())) == (sv == 2)
    held = load(held_in(text, tmp_path / "held.spz"))
    assert len(held.gaussians) == output["count"] == 300 and output["bytes"] == (tmp_path / "page.html").stat().st_size
    assert held.gaussians.sigma_d is not None and held.calibration is not None
    said = re.search(r"PSNR of (\S+) dB against the exact file \(4 views, s = 1\)", err)
    assert said and float(said[1]) > 40 and [path.name for path in tmp_path.glob(".tmp-*")] == []
    _, err = exported(clod, dialled, "-o", "page.html", "--exact")
    held = load(held_in((tmp_path / "page.html").read_text(encoding="utf-8"), tmp_path / "held.ply"))
    assert "PSNR" not in err and same(held.gaussians, load(dialled).gaussians)


def held_in(page: str, path: Path) -> Path:
    """Writes the file that a page holds."""
    path.write_bytes(base64.b64decode(re.findall('id="clod-model">(.*?)</script>', page)[0]))
    return path
