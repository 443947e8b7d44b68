from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from clod_adapter._support.text import file_name
from clod_adapter.io.scene.files import scene_files
from photographs import as_text, write_scene


def there(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in scene_files(folder) if path.is_file()}


@pytest.mark.parametrize("text", [False, True])
def test_files_of_a_colmap_scene(tmp_path: Path, text: bool) -> None:
    write_scene(tmp_path, 3)
    if text:
        as_text(tmp_path)
    (tmp_path / "images" / "another.png").write_bytes(b"not of the scene")
    (tmp_path / "images_2" / "sub").mkdir(parents=True)
    (tmp_path / "images_2" / "sub" / "001.png").write_bytes(b"a smaller one")
    (tmp_path / "dataparser_transforms.json").write_text("{}")
    model = {str(path.relative_to(tmp_path)) for path in (tmp_path / "sparse" / "0").iterdir()}
    photographs = {f"images/sub/{k:03}.png" for k in (1, 2, 3)} | {"images_2/sub/001.png"}
    assert len(model) >= 3 and there(tmp_path) == model | photographs | {"dataparser_transforms.json"}


def test_files_of_transforms_scenes(tmp_path: Path) -> None:
    train = {"frames": [{"file_path": "./train/r_0", "mask_path": "masks/0.png"}, {"file_path": "train\\ü.jpg"}, 7]}
    test = {"frames": [{"file_path": "test/r_0.png", "depth_file_path": "depth/0.tif"}, {"file_path": "a\0\ud800"}]}
    (tmp_path / "transforms_train.json").write_text(json.dumps(train))
    (tmp_path / "transforms_test.json").write_text(json.dumps(test))
    (tmp_path / "transforms.json").write_text("no JSON")
    names = ["train/r_0.png", "train/ü.jpg", "masks/0.png", "test/r_0.png", "depth/0.tif"]
    names = [file_name(name) for name in names]
    for name in [*names, "train/r_1.png"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    files = {"transforms.json", "transforms_train.json", "transforms_test.json"}
    assert there(tmp_path) == {*names, *files}


def test_truncated_model_gives_its_own_path(tmp_path: Path) -> None:
    write_scene(tmp_path, 3)
    images = tmp_path / "sparse" / "0" / "images.bin"
    data = images.read_bytes()
    for size in (0, 5, 8, 40, 80, len(data) - 9):
        images.write_bytes(data[:size])
        assert os.path.relpath(images, tmp_path) in there(tmp_path)
