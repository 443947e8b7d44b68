"""Names of files that are not UTF-8: all outputs are text."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]
ODD = "gr\udcfcn"  # Latin-1 for an umlaut, which is not UTF-8
COMMANDS = """
ODD.ply --images ODD --iters 2 --max-sv 2 -o OUT.ply
eval ODD_dial.ply --images ODD --sv 1 --report OUT.html
render ODD_dial.ply --images ODD -o OUT
export ODD_dial.ply -o OUT.html
robustness ODD.ply --images ODD --iters 2 --max-sv 2 -o OUT
"""


@pytest.fixture(scope="module")
def odd(capture: Any, dialled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene, its checkpoint and a file with a dial; no name is UTF-8."""
    folder = tmp_path_factory.mktemp("odd") / ODD
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("the file system takes UTF-8 only")
    shutil.copytree(capture.scene, folder / ODD)
    shutil.copy(capture.ply, folder / f"{ODD}.ply")
    for suffix in (".ply", ".safetensors"):
        shutil.copy(dialled.with_suffix(suffix), folder / f"{ODD}_dial{suffix}")
    return folder


@pytest.mark.usefixtures("without_splat_transform", "blank_figure")
@pytest.mark.parametrize("line", COMMANDS.strip().splitlines())
def test_every_command(clod: Any, odd: Path, tmp_path: Path, line: str) -> None:
    words = [word.replace("ODD", str(odd / ODD)).replace("OUT", str(tmp_path / ODD)) for word in line.split()]
    done = clod(*words, "--quiet", "--json")
    assert done.code == 0 and "gr\\xfcn/gr\\xfcn" in json.dumps(json.loads(done.out)).replace("\\\\", "\\"), done
    for path in tmp_path.glob("*.[hj][ts][mo][ln]"):  # pages and reports
        assert "gr\\xfcn" in path.read_text("utf-8").replace("\\\\", "\\"), path


def test_names_in_a_transforms_file(clod: Any, dialled: Path, tmp_path: Path) -> None:
    """That of a photograph with an umlaut is the image's; one that is not UTF-8 is refused."""
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    for name in ("größe", "001", "002"):
        Image.new("RGB", (64, 48)).save(scene / "images" / f"{name}.png")
    for name, code in (("größe", 0), ("\ud800", 2)):
        frames = [{"file_path": f"images/{each}.png", "transform_matrix": POSE} for each in (name, "001", "002")]
        (scene / "transforms.json").write_text(json.dumps({"fl_x": 60, "w": 64, "h": 48, "frames": frames}))
        done = clod("render", dialled, "--images", scene, "--views", "all", "-o", "out")
        assert done.code == code and len(list((tmp_path / "out").rglob("größe.png"))) == 1, done
    assert done.err.rstrip().endswith("is not UTF-8; rename the photograph, there too"), done
