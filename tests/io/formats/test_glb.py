from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import write
from formats import ATTENUATION, ORIGIN, change_glb, covariances, model, splat_transform, turned
from scenes import gaussians

pygltflib = pytest.importorskip("pygltflib", reason="pygltflib is not installed")
KHR = "KHR_gaussian_splatting"


def test_written_file_in_pygltflib(tmp_path: Path) -> None:
    g = model(3)
    write(tmp_path / "a.glb", g, origin=ORIGIN)
    gltf = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    (mesh,), (node,) = gltf.meshes, gltf.nodes
    (primitive,) = mesh.primitives
    assert primitive.mode == pygltflib.POINTS and gltf.extensionsUsed == [KHR] and not gltf.extensionsRequired
    assert primitive.extensions[KHR] == {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }  # fmt: skip
    assert gltf.asset.extras["clod_adapter"]["attenuation"]["reference_distance"] == ATTENUATION.reference_distance
    found = {}
    for name, number in vars(primitive.attributes).items():
        if number is None:
            continue
        accessor, blob = gltf.accessors[number], gltf.binary_blob()
        view = gltf.bufferViews[accessor.bufferView]
        kind = {pygltflib.FLOAT: "<f4", pygltflib.UNSIGNED_BYTE: "u1"}[accessor.componentType]
        data = blob[view.byteOffset : view.byteOffset + view.byteLength]
        found[name] = np.frombuffer(data, kind).reshape(accessor.count, -1)
        assert view.byteOffset % 4 == 0 and accessor.normalized in (None, name == "COLOR_0")
        if name == "POSITION":
            assert accessor.min == g.means.amin(0).tolist() and accessor.max == g.means.amax(0).tolist()
    assert set(found) == {
        "POSITION", "COLOR_0", "_SIGMA_D", "_GROWTH_D", f"{KHR}:ROTATION", f"{KHR}:SCALE", f"{KHR}:OPACITY",
        *(f"{KHR}:SH_DEGREE_{d}_COEF_{k}" for d in range(4) for k in range(2 * d + 1)),
    }  # fmt: skip
    np.testing.assert_allclose(found[f"{KHR}:SCALE"], g.scales, rtol=1e-6)
    np.testing.assert_allclose(found[f"{KHR}:OPACITY"][:, 0], g.opacities, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found[f"{KHR}:ROTATION"], axis=1), 1, rtol=1e-6)
    assert turned(torch.from_numpy(found[f"{KHR}:ROTATION"][:, [3, 0, 1, 2]].copy()), g.quats) < 1e-6
    np.testing.assert_array_equal(found[f"{KHR}:SH_DEGREE_2_COEF_1"], g.shN[:, 4])
    np.testing.assert_array_equal(found["_SIGMA_D"][:, 0], g.sigma_d)
    np.testing.assert_array_equal(found["_GROWTH_D"][:, 0], g.growth_d)
    np.testing.assert_allclose(found["COLOR_0"][:, :3] / 255, (0.5 + SH_C0 * g.sh0[:, 0]).clamp(0, 1), atol=2.1e-3)
    # The node turns y down into glTF's y up: (x, y, z) becomes (-x, -y, z).
    assert node.rotation == [0, 0, 1, 0] and node.translation == [-ORIGIN[0], -ORIGIN[1], ORIGIN[2]]


def test_file_of_splat_transform(tmp_path: Path) -> None:
    """Its values are in glTF's axes and its node has no rotation; read back they equal the checkpoint's."""
    g = gaussians(40, 3, 2)
    save(tmp_path / "a.ply", g)
    splat_transform(tmp_path / "a.ply", tmp_path / "b.glb")
    found = load(tmp_path / "b.glb")
    again = found.gaussians
    assert torch.equal(again.means, g.means) and torch.equal(again.sh0, g.sh0)
    torch.testing.assert_close(covariances(again), covariances(g), atol=1e-7, rtol=1e-4)
    torch.testing.assert_close(again.opacities, g.opacities, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(again.shN, g.shN, atol=1e-6, rtol=1e-6)
    assert not any(found.origin)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: g["accessors"][0].update(count=1 << 60), "more than the file"),
        (lambda g: g["accessors"][0].update(count=3), "of different lengths"),
        (lambda g: g["accessors"][0].update(count=-1), "is no count"),
        (lambda g: g["accessors"][0].update(count=1.5), "is no count"),
        (lambda g: g["bufferViews"][0].update(byteStride=0), "more than the file"),
        (lambda g: g["bufferViews"][0].update(byteOffset=1 << 70), "more than the file"),
        (lambda g: g["buffers"][0].update(uri="../secret"), "in another file"),
        (lambda g: g["accessors"][0].update(sparse={}), "sparse"),
        (lambda g: g["meshes"][0]["primitives"][0].pop("extensions"), "so it is a mesh"),
        (lambda g: g["meshes"][0]["primitives"][0]["extensions"][KHR].update(extensions={"x": {}}), "compressed"),
        (lambda g: g["nodes"][0].update(rotation=[0, 1, 0, 0]), "scaled or turned"),
        (lambda g: g["nodes"][0].update(scale=[2, 2, 2]), "scaled or turned"),
        (lambda g: g["nodes"].append({"children": [0]}), "scaled or turned"),
        (lambda g: g["asset"]["extras"]["clod_adapter"].update(format_version=2), "too new"),
        (lambda g: g["asset"]["extras"]["clod_adapter"]["attenuation"].update(tau=7), "tau"),
        (lambda g: g.pop("accessors"), "damaged"),
    ],
)
def test_invalid_json_is_refused(tmp_path: Path, change: Any, message: str) -> None:
    write(tmp_path / "a.glb", model(0, 5))
    with pytest.raises(ClodError, match=message):
        load(change_glb(tmp_path / "a.glb", change))


def test_file_of_another_program(tmp_path: Path) -> None:
    """Interleaved, in short integers, moved, without metadata: sigma_d then has the default settings."""
    write(tmp_path / "a.glb", model(0, 5), origin=ORIGIN)
    path = change_glb(tmp_path / "a.glb", lambda g: g["asset"].pop("extras"))
    found = load(path)
    again = found.gaussians
    assert found.origin == ORIGIN and again.sigma_d is not None
    assert again.attenuation == AttenuationConfig()
    rows = np.zeros(5, [("position", "<f4", 3), ("rotation", "<i2", 4), ("opacity", "u1"), ("pad", "u1", 3)])
    rows["position"], rows["rotation"], rows["opacity"] = np.arange(15).reshape(5, 3), [0, 0, 0, 32767], 255

    def interleave(g: dict[str, Any]) -> None:
        names, accessors = g["meshes"][0]["primitives"][0]["attributes"], g["accessors"]
        for name, offset, kind in (("POSITION", 0, 5126), (f"{KHR}:ROTATION", 12, 5122), (f"{KHR}:OPACITY", 20, 5121)):
            where = {"bufferView": len(g["bufferViews"]), "byteOffset": offset, "componentType": kind}
            accessors[names[name]].update(where, normalized=kind != 5126)
        view = {"buffer": 0, "byteOffset": g["buffers"][0]["byteLength"], "byteLength": rows.nbytes, "byteStride": 24}
        g["bufferViews"].append(view)
        g["nodes"][0].pop("rotation")

    data = change_glb(path, interleave).read_bytes()
    size, start = struct.unpack_from("<I", data, 12)[0], 20
    body = data[start + size + 8 :] + rows.tobytes()
    head = struct.pack("<4sII", b"glTF", 2, start + size + 8 + len(body)) + data[12 : start + size]
    path.write_bytes(head + struct.pack("<II", len(body), 0x004E4942) + body)
    g = load(path).gaussians
    np.testing.assert_array_equal(g.means, rows["position"] * [-1, -1, 1])
    assert g.quats.tolist() == [[1, 0, 0, 0]] * 5 and torch.isposinf(g.opacity_logits).all()


def test_moved_node_moves_the_model(tmp_path: Path) -> None:
    """The node takes precedence over the origin in the metadata."""
    write(tmp_path / "a.glb", model(0, 5), origin=ORIGIN)
    to = [-1e6, 0.0, 0.0]
    found = load(change_glb(tmp_path / "a.glb", lambda g: g["nodes"][0].update(translation=to)))
    again = found.gaussians
    assert found.origin == (1e6, 0.0, 0.0) and again.attenuation == model().attenuation
    near = {"translation": [1.0, -2.0, 4.0]}  # no origin: float32 has digits for it
    found = load(change_glb(tmp_path / "a.glb", lambda g: g["nodes"][0].update(near)))
    moved = found.gaussians
    assert not any(found.origin)
    torch.testing.assert_close(moved.means, again.means + torch.tensor([-1.0, 2.0, 4.0]))


def test_unused_content_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a.glb", model(0, 5))

    def change(g: dict[str, Any]) -> None:
        g["meshes"].append({"primitives": [*g["meshes"][0]["primitives"], {"attributes": {"POSITION": 0}}]})
        g["meshes"][0]["primitives"][0]["extensions"][KHR]["colorSpace"] = "lin_rec709_display"

    colours, others = load(change_glb(tmp_path / "a.glb", change)).notes[-2:]
    assert "'lin_rec709_display'" in colours and others.startswith("1 more primitives")
    (tmp_path / "a.glb").write_bytes(b"ply\n")
    with pytest.raises(ClodError, match="a PLY file; call it .ply"):
        load(tmp_path / "a.glb")
    monkeypatch.setitem(sys.modules, "pygltflib", None)
    with pytest.raises(ClodError, match="pip install pygltflib"):
        write(tmp_path / "b.glb", model())
    assert list(tmp_path.iterdir()) == [tmp_path / "a.glb"]
