"""Sets of several levels: 3D Tiles with the tiles as the SPZ reader finds them, and options of
streaming sets.
"""

import json
import struct

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import scenes
from clod_adapter import load
from clod_adapter.io.formats import tileset
from clod_adapter.io.formats.tileset import TILESET, write_tileset
from clod_adapter.origin import NOWHERE

BEGINS = [0.0, 0.25, 1.0]


def levels(n=400):
    whole = scenes.gaussians(n, 2, 0)
    return [whole, whole[::4], whole[::16]]


def written(folder, given, begins=BEGINS, origin=NOWHERE):
    """The index of a set of these levels."""
    notes = write_tileset(folder, [*zip(begins, given, strict=True)], origin=origin)
    assert any("rounded" in note for note in notes)
    return json.loads((folder / TILESET).read_text())


def tiles_of(tile, depth=0):
    tiles = [(depth, tile)]
    for child in tile.get("children", ()):
        tiles += tiles_of(child, depth + 1)
    return tiles


def read_tile(path, folder):
    """The JSON of a tile, and its Gaussians by the reader of .spz."""
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data)) and len(data) % 4 == 0
    length, kind = struct.unpack_from("<I4s", data, 12)
    gltf = json.loads(data[20 : 20 + length])
    more, binary = struct.unpack_from("<I4s", data, 20 + length)
    assert (kind, binary, 28 + length + more) == (b"JSON", b"BIN\0", len(data))
    found = folder / "tile.spz"
    found.write_bytes(data[28 + length : 28 + length + gltf["buffers"][0]["byteLength"]])
    return gltf, load(found).gaussians


def test_index_and_tiles(tmp_path):
    """Properties and ranges of tileset.schema.json and tile.schema.json of 3D Tiles 1.1; one chain
    of levels, coarsest first; errors descend; what is packed is what was given.
    """
    given = levels()
    index = written(tmp_path, given)
    assert set(index) <= {"asset", "extensionsUsed", "extensions", "geometricError", "root"}
    assert index["asset"]["version"] == "1.1" and index["root"]["refine"] == "REPLACE"
    assert set(index["extensions"]) == set(index["extensionsUsed"])
    required = index["extensions"]["3DTILES_content_gltf"]["extensionsRequired"]
    assert required == ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    chain = [tile for _, tile in tiles_of(index["root"])]
    # on a screen of 1,080 lines, 60 degrees high
    begins = [tile["geometricError"] * 935 / 16 for tile in chain]
    assert begins == pytest.approx(BEGINS[::-1])
    assert index["geometricError"] >= chain[0]["geometricError"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "0_0.glb",
        "0_1.glb",
        "root.glb",
        TILESET,
    ]
    for tile, want in zip(chain, given[::-1], strict=True):
        assert set(tile) - {"content", "children", "refine"} == {"boundingVolume", "geometricError"}
        (box,) = tile["boundingVolume"].values()
        assert len(box) == 12
        assert all(isinstance(number, float) for number in box)
        assert tile.get("children", True)
        gltf, found = read_tile(tmp_path / tile["content"]["uri"], tmp_path)
        assert_close(found.means, want.means, rtol=0, atol=1e-4)
        assert_close(found.log_scales, want.log_scales, rtol=0, atol=0.04)
        primitive = gltf["meshes"][0]["primitives"][0]
        assert primitive["extensions"]["KHR_gaussian_splatting"]["extensions"] == {
            tileset.SPZ: {"bufferView": 0}
        }
        assert {accessor["count"] for accessor in gltf["accessors"]} == {len(want)}
        # of degree 1 and 2, as readers count
        assert sum("SH_DEGREE" in name for name in primitive["attributes"]) == 8
        assert (
            gltf["accessors"][primitive["attributes"]["POSITION"]]["min"]
            == want.means.amin(0).tolist()
        )


def test_a_set_is_drawn_until_it_is_a_pixel(tmp_path):
    """Viewers draw nothing where the index's error covers at most 16 pixels, whatever the levels'
    errors.
    """
    for size in (0.02, 500.0):
        given = [level.replace(means=level.means * size) for level in levels()]
        index = written(tmp_path, given, (0.0, 1e-6, 2e-6))
        halves = np.diag(np.reshape(index["root"]["boundingVolume"]["box"], (4, 3))[1:])
        # of the box, where that error is 16
        pixels = 2 * float(np.linalg.norm(halves)) * 16 / index["geometricError"]
        assert 0.9 < pixels < 1.1


def test_boxes_are_where_viewers_place_the_gaussians(tmp_path):
    """The node's matrix, then glTF's y-up axes into z-up ones, with a large origin; floaters are
    left out.
    """
    size, place = torch.tensor([3.0, 1.0, 0.5]), torch.tensor([20.0, 10.0, 0.0])
    given = [level.replace(means=level.means * size + place) for level in levels()]
    given[0].means[0] = 1e4
    root = written(tmp_path, given, origin=(1000.0, -2000.0, 50.0))["root"]
    gltf, _ = read_tile(tmp_path / "0_0.glb", tmp_path)
    matrix = np.array(gltf["nodes"][0]["matrix"], float).reshape(4, 4).T
    placed = given[0].means.double().numpy() @ matrix[:3, :3].T + matrix[:3, 3]
    upright = np.stack([placed[:, 0], -placed[:, 2], placed[:, 1]], 1)
    box = np.array(root["boundingVolume"]["box"]).reshape(4, 3)
    inside = (np.abs(upright - box[0]) <= np.diag(box[1:])).all(1)
    assert 0.9 < inside.mean() < 1 and not inside[0]
    assert (np.diag(box[1:]) < 20).all() and (box[1:] == np.diag(np.diag(box[1:]))).all()


def test_cells_hold_every_gaussian_once(tmp_path, monkeypatch):
    monkeypatch.setattr(tileset, "LARGEST", 60)
    given = levels()
    given[0].means[:100] = given[0].means[0]  # more in one place than a cell holds
    root = written(tmp_path, given)["root"]
    assert len(root["children"]) >= 6
    for level, want in enumerate(given[:2]):
        of_level = [
            tile for depth, tile in tiles_of(root) if depth == 2 - level and "content" in tile
        ]
        parts = [
            read_tile(tmp_path / tile["content"]["uri"], tmp_path)[1].means for tile in of_level
        ]
        assert all(len(part) <= 100 for part in parts) and sum(map(len, parts)) == len(want)
        assert_close(
            torch.cat(parts).double().sum(0), want.means.double().sum(0), rtol=0, atol=0.02
        )
