from __future__ import annotations

from pathlib import Path

import pytest

from clod_adapter.cli.commands.checks import check_scene
from clod_adapter.cli.commands.render import check_folder
from clod_adapter.errors import ClodError
from photographs import model_of


@pytest.fixture
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, the current one, with a COLMAP scene and one of transforms."""
    model_of(tmp_path / "colmap", "PINHOLE", [33, 33, 20, 15])
    (tmp_path / "colmap" / "images").mkdir()
    (tmp_path / "nerf").mkdir()
    (tmp_path / "nerf" / "transforms.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("scene", ["colmap", "colmap/sparse/0", "colmap/images", "nerf"])
def test_scenes(scenes: Path, scene: str) -> None:
    check_scene(scene)
    check_folder(Path("out"), Path(scene))


def test_no_scene(scenes: Path) -> None:
    (scenes / "empty").mkdir()
    with pytest.raises(ClodError, match="empty: no COLMAP model .*, and no transforms.json; give"):
        check_scene("empty")
    with pytest.raises(ClodError, match="nerf/transforms.json: is not a folder"):
        check_scene("nerf/transforms.json")


@pytest.mark.parametrize(
    ("scene", "out"),
    [
        ("colmap", "colmap"),
        ("colmap", "colmap/images"),
        ("colmap", "colmap/images_4/out"),
        ("colmap", "colmap/input"),
        ("colmap/sparse/0", "colmap/images/sub"),
        ("colmap/images", "colmap/images/sub"),
        ("nerf", "nerf"),
        ("nerf", "nerf/train"),
        ("nerf", "colmap/../nerf/train"),
    ],
)
def test_where_photographs_may_be(scenes: Path, scene: str, out: str) -> None:
    with pytest.raises(ClodError, match="the scene's own photographs may be there"):
        check_folder(Path(out), Path(scene))


def test_beside_a_models_images_there_is_room(scenes: Path) -> None:
    check_folder(Path("colmap/renders"), Path("colmap"))
