"""``clod-adapt export``: formats, baked files, levels, streaming sets and pages."""

import base64
import json
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData
from torch.testing import assert_close

from clod_adapter import (
    ClodError,
    bake,
    bake_levels,
    detach,
    evaluate,
    load,
    load_scene,
    place_cameras,
    render,
    save,
)
from clod_adapter.evaluation.agreement import agreement
from clod_adapter.harmonics import with_sh_degree
from clod_adapter.initialization.merging import merge
from clod_adapter.io.formats import splat_transform
from clod_adapter.io.ply_layout import write_comments
from clod_adapter.io.settings import Metadata
from formats import inria_rows, with_columns, write_rows
from runs import data_in
from scenes import gaussians

EXPORT = "export DIAL --json"
KHR = "KHR_gaussian_splatting"
TOOL = """
import json, os, pathlib, signal, sys, time
words = sys.argv[1:]
if words == ["--version"]:
    print("node:v22.1.0;splat-transform v3.7.0")
elif words != ["--list-gpus"]:
    out = pathlib.Path(words[-1])
    inputs = [pathlib.Path(word) for word in words if word.endswith("ply")]
    sizes = [path.stat().st_size for path in inputs if path.exists()]
    out.write_text(json.dumps({"words": words, "sizes": sizes}))
    BEHAVE
"""


@pytest.fixture
def tool(tmp_path_factory, monkeypatch):
    """A stand-in for splat-transform that stores its arguments and runs ``behave``."""

    def make(behave="pass"):
        script = tmp_path_factory.mktemp("tool") / "tool.py"
        script.write_text(TOOL.replace("BEHAVE", behave))
        monkeypatch.setenv("CLOD_SPLAT_TRANSFORM", shlex.join([sys.executable, str(script)]))

    return make


def baked(path, s):
    model = load(path)
    return bake(model.gaussians, s, cameras=model.viewpoints)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_baking(clod, capture, attenuated):
    done = clod(EXPORT, "--sv 2 -o x.ply")
    want = baked(attenuated, 2.0)
    data = Path("x.ply").read_bytes()
    size = len(data)
    assert done.output == {"file": "x.ply", "virtual_scale": 2, "count": len(want), "bytes": size}
    assert done.report["notes"] == [] and "baked for 8 training cameras; lossy" in done.err
    assert f"{len(want)} of 300 Gaussians, s = 2\n" in done.err
    assert len(want) < 300 and load("x.ply").gaussians == want
    # SIBR takes the count from the third line, and rows of float32 in Inria's order without gaps.
    head, _, rows = data.partition(b"end_header\n")
    lines = b"ply\nformat binary_little_endian 1.0\nelement vertex %d\n" % len(want)
    assert head.startswith(lines) and rows == inria_rows(want).tobytes()


def test_baking_for_other_cameras(clod, capture, attenuated):
    """Those of a scene, one of them, and placed ones for a file without cameras."""
    report = clod(EXPORT, "--sv 2 --images SCENE -o x.ply").report
    cameras = [view.camera for view in load_scene(capture.scene).train]
    model = load(attenuated).gaussians
    want = bake(model, 2.0, cameras=cameras)
    assert report["cameras"] == 8
    assert_close(load("x.ply").gaussians.opacity_logits, want.opacity_logits)

    there = f"{EXPORT} --camera 003 --images SCENE"
    camera = camera_003(cameras)
    n = sum(int(render(model, camera, s).kept.sum()) for s in (4.0, 1.0)) // 2
    done = clod(there, "-o one.ply --keep", n)
    plain = load("one.ply")
    assert done.report["camera"] == "003.png" and done.output["count"] == n == len(plain.gaussians)
    # there the image is the dial's
    want = render(model, camera, done.output["virtual_scale"])
    assert_close(render(plain.gaussians, camera).image, want.image, atol=2e-5, rtol=0)
    assert "baked for the camera of 003.png only; lossy" in done.err
    assert any("for the camera of 003.png only" in comment for comment in plain.comments)
    done = clod(there, "--fps 1 -o fast.ply")  # timed here, at that camera
    assert done.output["virtual_scale"] == 1 and done.note("frames timed here")

    save("old.ply", model)  # as before cameras were stored
    (note,) = clod("export old.ply --sv 2 -o x.ply --json").report["notes"]
    unknown = "old.ply stores no cameras: baked for 16 placed ones; --images gives a better result"
    assert note == unknown
    want = bake(model, 2.0, cameras=place_cameras(model, views=16))
    assert torch.equal(load("x.ply").gaussians.means, want.means)


def camera_003(cameras):
    return next(camera for camera in cameras if camera.name == "003.png")


def test_levels(clod, attenuated, tmp_path):
    outputs = clod(EXPORT, "--levels 1,2.5,4 -o some.set.ply").report["outputs"]
    names = ["some.set_s1.ply", "some.set_s2.5.ply", "some.set_s4.ply"]
    assert files(tmp_path) == names == [output["file"] for output in outputs]
    assert [load(name).gaussians for name in names] == [
        baked(attenuated, s) for s in (1.0, 2.5, 4.0)
    ]


def test_sets_have_a_level_for_each_band_of_distances(clod, attenuated, tmp_path):
    """The finest is the checkpoint; in others are those that reach the middle of the band, as large
    as there.
    """
    done = clod(EXPORT, "--3dtiles --multiplier 2 -o tiles")
    model = load(attenuated).gaussians
    counts = [level["count"] for level in done.output["levels"]]
    begins = [level["begins"] for level in done.output["levels"]]
    near = model.attenuation.near_distance
    assert begins[:3] == [0.0, near, 2 * near] and f"level 1 begins at {near:.4g}" in done.err
    assert counts == sorted(counts, reverse=True)
    assert counts[0] == model.whole and counts[-1] >= 0.01 * model.whole
    levels = bake_levels(model, 2.0)
    assert levels[0].gaussians == detach(model)
    for k, level in enumerate(levels[1:], 1):
        reached = model.sigma_d > near * 2 ** (k - 0.5)
        assert torch.equal(level.gaussians.means, model.means[reached])
        assert len(level.gaussians) == counts[k]
    root = json.loads((tmp_path / "tiles" / "tileset.json").read_text())["root"]
    assert root["geometricError"] > root["children"][0]["geometricError"] >= 0


def test_levels_beyond_the_trained_distances_are_merged(attenuated):
    model = load(attenuated).gaussians
    short = replace(model.attenuation, max_sv=1.0, reference_distance=0.01)
    trained = bake_levels(model, 1.5)
    merged = bake_levels(model.replace(attenuation=short), 1.5)
    assert [level.begins for level in merged] == [level.begins for level in trained]
    for before, level, like in zip(merged[:-1], merged[1:], trained[1:], strict=True):
        assert len(level.gaussians) <= len(like.gaussians) + 1
        want = merge(before.gaussians, len(like.gaussians))
        assert torch.equal(level.gaussians.means, want.means)


def test_tuned_files_show_the_photographs_better(clod, capture, attenuated):
    scene = load_scene(capture.scene)
    errors = []
    for option in ("", "--tune"):
        clod(EXPORT, "--keep 60 --images SCENE -o x.ply", option)
        plain = load("x.ply")
        assert len(plain.gaussians) == 60
        rows = evaluate(plain.gaussians, scene.train, [1.0])
        errors.append(rows[0].psnr)
    assert errors[1] > errors[0] + 1
    assert any("tuned" in comment for comment in plain.comments)


def test_a_lower_sh_degree_is_fitted(clod, capture):
    """Nearer to the renders of all degrees than one that is cut; what needs no higher degree stays
    as it is.
    """
    cameras = [view.camera for view in load_scene(capture.scene).train]
    base = gaussians(300, 3, 0).replace(means=capture.gaussians.means)
    capture.write("rich.ply", base)
    done = clod("export rich.ply --sh-degree 1 --images SCENE -o x.ply --json")
    assert "against those with degree 3 (fitted to 8 training cameras)" in done.note("SH degree 1")
    fitted = load("x.ply").gaussians
    assert fitted.sh_degree == 1

    def error(model):
        total = 0.0
        for camera in cameras:
            change = render(model, camera).image - render(base, camera).image
            total += float(change.square().mean())
        return total

    assert error(fitted) < 0.7 * error(base.without_bands(1))
    plain = base.replace(shN=torch.cat([base.shN[:, :3], torch.zeros(300, 12, 3)], 1))
    assert torch.allclose(with_sh_degree(plain, 1, cameras).shN, plain.shN[:, :3])
    assert "has SH degree 1, and stays as it is" in clod("export x.ply --sh-degree 2 -o y.ply").err


def test_the_lowest_sh_degree_that_looks_alike(clod, capture):
    base = gaussians(300, 3, 0).replace(means=capture.gaussians.means)
    faint = base.shN.clone()
    faint[:, 3:] *= 1e-3  # degrees 2 and 3
    capture.write("rich.ply", base)
    capture.write("faint.ply", base.replace(shN=faint))
    done = clod("export rich.ply --sh-degree auto --images SCENE -o x.ply")
    assert "auto: the file has SH degree 3, and stays as it is" in done.err
    clod("export faint.ply --sh-degree auto --images SCENE -o y.ply")
    assert load("x.ply").gaussians.sh_degree == 3 and load("y.ply").gaussians.sh_degree == 1


@pytest.mark.parametrize("suffix", [".ply", ".pt"])
def test_formats(clod, attenuated, suffix):
    model = load(attenuated)
    done = clod(EXPORT, f"-o x{suffix}")
    output = done.output
    again = load(f"x{suffix}")
    assert output["bytes"] == Path(f"x{suffix}").stat().st_size and "lossy" not in done.err
    assert output["virtual_scale"] is None and output["count"] == 300
    assert again.gaussians.sigma_d is not None and again.gaussians.growth_d is not None
    if suffix == ".ply":
        assert again.gaussians == model.gaussians and again.notes == ()
        assert again.quality_table == model.quality_table
    assert "lossy" in clod(EXPORT, f"--sv 2 -o baked{suffix}").err
    clod(f"export baked{suffix} -o again.ply")
    header = Path("again.ply").read_bytes().partition(b"end_header")[0].decode()
    assert "comment baked at s = 2 by clod-adapter for 8 training cameras\n" in header


def test_losses_are_noted(clod, attenuated):
    """Harmonics and foreign columns; positions far from 0 become doubles. Columns of settings are
    not dropped.
    """
    done = clod("export BASE -o x.spz --json")
    wanted = {"file": "x.spz", "virtual_scale": None, "count": 300}
    assert wanted.items() <= done.output.items() and done.note("about 8 bits")
    model = load(attenuated)
    element = PlyData.read(str(attenuated), mmap=False)["vertex"]
    labelled = with_columns(element.data, label=7)
    write_rows(Path("labelled.ply"), labelled, comments=element.comments)
    assert clod("export labelled.ply -o x.ply --json").report["notes"] == ["columns dropped: label"]
    assert load("x.ply").gaussians == model.gaussians
    assert load("x.ply").vertex.dtype == model.vertex.dtype
    far = element.data.astype([(n, "f8" if n in "xyz" else t) for n, t in element.data.dtype.descr])
    far["x"] += 437_000.0
    there = tuple(
        viewpoint.moved([437_000.0, 0, 0]) for viewpoint in model.quality_table.viewpoints
    )
    quality_table = replace(model.quality_table, viewpoints=there)
    settings = Metadata(model.gaussians.attenuation, quality_table=quality_table)
    write_rows(Path("far.ply"), far, comments=write_comments(settings))
    assert clod("export far.ply --sv 2 -o x.ply --json").note("x, y and z are doubles")
    again = load("x.ply")
    assert len(again.gaussians) == len(baked("far.ply", 2.0)) == len(baked(attenuated, 2.0))
    assert 436_000 < again.vertex["x"].mean() < 438_000


@pytest.mark.parametrize("against", ["photographs", "checkpoint"])
def test_without_photographs_merged_where_that_is_nearer(clod, attenuated, against):
    """Far Gaussians of another colour are worse than the checkpoint, merged by importance."""
    model = load(attenuated)
    wrong = (~model.gaussians.near).float()[:, None, None]
    table = replace(model.quality_table, against=against)
    harmed = model.gaussians.replace(sh0=model.gaussians.sh0 + 3 * wrong)
    save("harmed.ply", harmed, quality_table=table)
    done = clod("export harmed.ply --keep 100 -o x.ply --json")
    of_dial = baked("harmed.ply", done.output["virtual_scale"])
    written = load("x.ply").gaussians
    if against == "photographs":
        assert done.report["notes"][1:] == [] and written == of_dial
        return
    assert done.note("are the checkpoint's, merged") and len(written) == len(of_dial)
    exact = detach(harmed)
    all_alike = merge(exact, len(written))
    for other in (of_dial, all_alike):
        assert agreement(written, exact, model.cameras) > agreement(other, exact, model.cameras)
    for words in ("--sv 0", "--keep 100 --images SCENE", "--sv 2 --camera 003 --images SCENE"):
        done = clod(f"export harmed.ply {words} -o x.ply --json")
        assert not any("merged" in note for note in done.report["notes"])
    clod("export harmed.ply --sv 0 -o x.ply")
    assert load("x.ply").gaussians == exact


def test_splat_transform(clod, attenuated, tmp_path, tool):
    tool()
    done = clod(EXPORT, "--sv 4 -o x.sog")
    said = json.loads(Path("x.sog").read_text())
    assert " took " in done.err and done.note("without a GPU") and files(tmp_path) == ["x.sog"]
    assert done.note("splat-transform rounds values and sorts the Gaussians")
    assert said["words"][:5] == ["-w", "-g", "cpu", "-i", "1"]
    assert said["words"][-1].endswith("packed.sog")
    assert said["sizes"][0] > 92 * done.output["count"]
    done = clod("export BASE --antialiasing on --json -o x.sog")
    assert done.note("trained antialiased") in done.err
    tool("(out.parent / '0_0').mkdir(); (out.parent / '0_0' / 'a.webp').write_text('1234')")
    (tmp_path / "-o").mkdir()  # empty; not an option of the tool
    done = clod(EXPORT, "--lod-meta --out=-o")
    output = done.output
    assert "minPixelSize = 0" in done.err
    counts = [len(level.gaussians) for level in bake_levels(load(attenuated).gaussians)]
    assert [level["count"] for level in output["levels"]] == counts
    assert output["count"] == sum(counts)
    assert files(tmp_path / "-o") == ["0_0", "0_0/a.webp", "lod-meta.json"]
    text = Path(output["file"]).read_text()
    words = json.loads(text)["words"][5:]
    assert output["bytes"] == len(text) + 4
    assert words[:4] == ["--lod-chunk-extent", "0", "--lod-chunk-min", "8"]
    assert words[5::3] == ["-l"] * len(counts)
    assert words[6::3] == [str(k) for k in range(len(counts))]
    assert words[-1].endswith("/lod-meta.json")


@pytest.mark.parametrize(
    "words, behave, limit, code, said",
    [
        ("--sv 2 -o x.sog", "time.sleep(60)", 0.5, 2, "was ended, it took longer than 0 s\n"),
        (
            "--lod-meta -o out",
            "os.kill(os.getppid(), signal.SIGINT); time.sleep(60)",
            60.0,
            130,
            "interrupted\n",
        ),
    ],
)
def test_failure_of_the_tool_leaves_no_file(
    clod, tmp_path, tool, monkeypatch, words, behave, limit, code, said
):
    monkeypatch.setattr(splat_transform, "LIMIT_EACH", 0.0)
    monkeypatch.setattr(splat_transform, "LIMIT", limit)
    tool(behave)
    done = clod("export DIAL", words, code=code)
    assert done.err.endswith(said) and files(tmp_path) == [], done


@pytest.fixture
def real_tool():
    """Skips the test if splat-transform is missing."""
    try:
        splat_transform.SplatTransform.find()
    except ClodError as error:
        pytest.skip(str(error))


@pytest.mark.usefixtures("real_tool")
def test_gltf_of_the_real_tool(clod, attenuated):
    """Has the baked Gaussians, their rows in order, in glTF's axes: y is up and its x goes left."""
    pygltflib = pytest.importorskip("pygltflib", reason="pygltflib is not installed")
    done = clod(EXPORT, "--sv 2 -o x.glb")
    want = baked(attenuated, 2.0)
    assert done.output["count"] == len(want) and done.report["notes"] == []
    gltf = pygltflib.GLTF2().load("x.glb")
    (mesh,), (node,) = gltf.meshes, gltf.nodes
    (primitive,) = mesh.primitives
    assert primitive.mode == pygltflib.POINTS and gltf.extensionsUsed == [KHR]
    assert node.rotation is None and node.translation is None and node.matrix is None

    def column(name):
        accessor = gltf.accessors[getattr(primitive.attributes, name)]
        view = gltf.bufferViews[accessor.bufferView]
        data = gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        assert accessor.componentType == pygltflib.FLOAT and accessor.count == len(want)
        return np.frombuffer(data, "<f4").reshape(len(want), -1)

    assert_array_equal(column("POSITION"), want.means * torch.tensor([-1, -1, 1]))
    assert_allclose(column(f"{KHR}:SCALE"), want.scales, rtol=1e-6)
    assert_allclose(column(f"{KHR}:OPACITY")[:, 0], want.opacities, rtol=1e-6)
    assert_allclose(column(f"{KHR}:SH_DEGREE_0_COEF_0"), want.sh0[:, 0], rtol=1e-6)
    refused = clod("inspect x.glb", code=2).err
    assert refused.endswith("x.glb: is a glTF model; adapt the PLY that it was made from\n")


@pytest.mark.usefixtures("real_tool")
def test_a_set_of_the_real_tool(clod, attenuated, tmp_path):
    clod("export DIAL --lod-meta --multiplier 4 -o out")
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    levels = bake_levels(load(attenuated).gaussians, 4.0)
    assert meta["counts"] == [len(level.gaussians) for level in levels]
    assert meta["lodLevels"] == len(levels) > 2
    assert all((tmp_path / "out" / name).is_file() for name in meta["filenames"])
    assert not [name for name in files(tmp_path) if "tmp" in name]


@pytest.mark.usefixtures("without_splat_transform")
def test_page_holds_the_splat_and_its_dial(clod, attenuated, tmp_path):
    def page(*words, name):
        """What was printed, the settings of the page, and the splat in it."""
        done = clod(EXPORT, "-o page.html", *words)
        text = Path("page.html").read_text("utf-8")
        config, data = data_in(text, "clod-(?:model|config)")
        Path(name).write_bytes(base64.b64decode(data))
        return done, json.loads(config), load(name)

    done, config, held = page("--sv 9 --images SCENE", name="held.spz")
    assert config["model"]["name"] == attenuated.name and config["virtual_scale"] == 4
    assert done.note("dial ends at s = 4")
    assert "300 Gaussians, s = 4" in done.err
    assert " of " not in done.err.splitlines()[-1]
    assert [camera["name"] for camera in config["cameras"]] == [f"{k:03}.png" for k in range(10)]
    assert held.gaussians.whole == done.output["count"] == 300
    assert done.output["bytes"] == Path("page.html").stat().st_size
    assert held.gaussians.sigma_d is not None and held.quality_table is not None
    said = re.search(r"PSNR of (\S+) dB against the exact file \(s = 1\)", done.err)
    assert said and float(said[1]) > 40 and [*tmp_path.glob(".tmp-*")] == []
    done, _, held = page("--exact", name="held.ply")
    assert "PSNR" not in done.err and held.gaussians == load(attenuated).gaussians


def test_a_page_of_several_models(clod, attenuated, tmp_path):
    """Of the same name in two folders; each has its own data."""
    other = tmp_path / "other" / attenuated.name
    other.parent.mkdir()
    save(other, load(attenuated).gaussians[:100])
    done = clod("export DIAL", other, "--exact --json -o page.html")
    assert done.report["files"] == [str(attenuated), str(other)] and done.output["count"] == 400
    text = (tmp_path / "page.html").read_text("utf-8")
    (config,) = re.findall(r'id="clod-config">(.*?)</script>', text)
    entries = [json.loads(config)["model"], *json.loads(config)["others"]]
    names = [f"{path.parent.name}/{path.name}" for path in (attenuated, other)]
    assert [entry["name"] for entry in entries] == names
    for entry, path in zip(entries, (attenuated, other), strict=True):
        (data,) = re.findall(f'id="{entry["element"]}">(.*?)</script>', text)
        Path("held.ply").write_bytes(base64.b64decode(data))
        assert load("held.ply").gaussians == load(path).gaussians
