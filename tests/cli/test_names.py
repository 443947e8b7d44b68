"""Names of files that are not UTF-8, or not of the locale's encoding: all outputs are text."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clod_adapter._support.text import file_name

ODD = "gr\udcfcn"  # Latin-1 for an umlaut, which is not UTF-8
COMMANDS = """
ODD.ply --images ODD --iters 2 --max-sv 2 -o OUT.ply
eval ODD_dial.ply --images ODD --sv 1 --against ODD.ply --report OUT.html
render ODD_dial.ply --images ODD -o OUT
export ODD_dial.ply -o OUT.html
export ODD_dial.ply -o OUT.ply --levels 1,2
apply ODD.ply ODD_dial.safetensors -o OUT.ply
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
    scene = _transforms(tmp_path / "scene", ["\ud800.png", "b.png", "c.png"])
    done = clod("render", dialled, "--images", scene, "-o", "out")
    assert done.code == 2 and done.err.rstrip().endswith("is not UTF-8; rename the photograph, there too"), done


@pytest.mark.skipif(sys.platform == "win32", reason="locales are those of POSIX")
def test_ascii_locale(capture: Any, dialled: Path, tmp_path: Path) -> None:
    """The names of files and photographs have umlauts, which ASCII cannot decode."""
    scene = _transforms(tmp_path / file_name("Gärten"), ["größe.png", "b.png", "c.png"], capture)
    shutil.copy(dialled, tmp_path / file_name("für.ply"))
    code = (
        "import sys; from clod_adapter.cli.main import main\n"
        "assert sys.getfilesystemencoding() == 'ascii'\n"
        "model, scene = sys.argv[1:]\n"
        "for words in (['render', model, '--images', scene, '--views', 'all', '-o', 'bild'],\n"
        "              ['inspect', 'fehlt' + model], ['inspect', model]):\n"
        "    code = main(words)\n"
        "    assert code == (2 if words[1] != model else 0), words\n"
    )
    plain = {key: value for key, value in os.environ.items() if key != "LANG" and not key.startswith("LC_")}
    environment = plain | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, "-c", code, file_name("für.ply"), str(scene)], cwd=tmp_path, capture_output=True, check=False,
        env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done
    assert (tmp_path / "bild" / file_name("größe.png")).is_file()


def _transforms(folder: Path, names: list[str], capture: Any = None) -> Path:
    """A scene of frames with these names, with the photographs of a capture if there is one."""
    folder.mkdir()
    frames = []
    for k, name in enumerate(names):
        pose = np.eye(4)
        pose[:3, 3] = [0.3 * k, 0.0, 4.0]
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        if capture is not None:
            shutil.copy(capture.scene / "images" / f"{k:03}.png", folder / file_name(name))
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 60, "w": 64, "h": 48, "frames": frames}), "utf-8")
    return folder
