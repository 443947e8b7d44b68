"""File names and locales that are not UTF-8: every command works, and its outputs are text."""

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
from PIL import Image

from clod_adapter._support.text import file_name
from clod_adapter.cli import view
from clod_adapter.cli.main import build_parser

ODD = "gr\udcfcn"  # Latin-1 for an umlaut, which is not UTF-8
SUFFIXES = (".ply", ".safetensors")
TINY = ("--iters", 4, "--max-sv", 2, "--quiet", "--json")


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
    for suffix in SUFFIXES:
        shutil.copy(dialled.with_suffix(suffix), folder / f"{ODD}_dial{suffix}")
    return folder


def test_adapting(clod: Any, odd: Path, tmp_path: Path) -> None:
    out = tmp_path / f"{ODD}.ply"
    done = clod(odd / f"{ODD}.ply", "--images", odd / ODD, *TINY, "--report", "-o", out)
    assert done.code == 0, done
    assert json.loads(done.out)["model"].endswith("gr\\xfcn/gr\\xfcn.ply")
    assert json.loads(out.with_suffix(".json").read_text("utf-8"))["scene"].endswith("gr\\xfcn/gr\\xfcn")
    assert "gr\\xfcn" in out.with_suffix(".html").read_text("utf-8")


@pytest.mark.usefixtures("without_splat_transform")
@pytest.mark.parametrize(
    "words",
    [
        ["eval", "dial.ply", "--images", "", "--sv", 1, "--against", ".ply", "--report", "out.html", "--json"],
        ["render", "dial.ply", "--images", "", "--out", "pictures"],
        ["export", "dial.ply", "--out", "out.html"],
        ["export", "dial.ply", "--out", "out.glb"],
        ["export", "dial.ply", "--out", "out.ply", "--levels", "1,2"],
        ["apply", ".ply", "dial.safetensors", "--out", "out.ply"],
        ["export", "dial.ply", "--out", "out.spz"],
        ["robustness", ".ply", "dial.ply", "--images", "", *TINY, "--out", "out"],
    ],
    ids=lambda words: " ".join(map(str, words[:4])),
)  # fmt: skip
def test_other_commands(clod: Any, odd: Path, tmp_path: Path, words: list[object]) -> None:
    names = {".ply": f"{ODD}.ply", "": ODD} | {f"dial{suffix}": f"{ODD}_dial{suffix}" for suffix in SUFFIXES}
    given = [odd / names[word] if isinstance(word, str) and word in names else word for word in words]
    given = [tmp_path / f"{ODD}{word}" if str(word).startswith(("out", "pictures")) else word for word in given]
    done = clod(*given)
    assert done.code == 0, done
    if words[0] == "export" and words[3] in ("out.pt", "out.glb", "out.safetensors", "out.spz"):
        assert clod("inspect", given[3], "--json").code == 0


def test_viewer(odd: Path, tmp_path: Path) -> None:
    words = [str(odd / f"{ODD}_dial.ply"), "--images", str(odd / ODD), "--base", str(odd / f"{ODD}.ply"), "--quiet"]
    answers, _ = view.make_page(build_parser("view").parse_args(words), view.Console(True))
    assert b"gr\\\\xfcn_dial.ply" in b"".join(answers["/"].blocks())


@pytest.mark.parametrize("name", ["a\udcff.png", "\ud800.png"])
def test_names_in_a_transforms_file(clod: Any, dialled: Path, tmp_path: Path, name: str) -> None:
    scene = _transforms(tmp_path / "scene", [name, "b.png", "c.png"])
    for words in (["export", "-o", "page.html"], ["eval"], ["render", "-o", "out"]):
        done = clod(words[0], dialled, "--images", scene, *words[1:])
        error = done.err.splitlines()[-1]
        assert done.code == 2 and error.endswith("is not UTF-8; rename the photograph, there too"), done


@pytest.mark.usefixtures("without_splat_transform")
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
        "              ['export', model, '-o', 'seite.html', '--images', scene],\n"
        "              ['eval', model, '--images', scene, '--sv', '1', '--report', 'bericht.html'],\n"
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
    assert "größe.png" in (tmp_path / "seite.html").read_text("utf-8")
    assert "für.ply" in (tmp_path / "bericht.html").read_text("utf-8")


def _transforms(folder: Path, names: list[str], capture: Any = None) -> Path:
    """A scene of frames with these names, with the photographs of a capture if there is one."""
    folder.mkdir()
    frames = []
    for k, name in enumerate(names):
        pose = np.diag([1.0, 1.0, 1.0, 1.0])
        pose[:3, 3] = [0.3 * k, 0.0, 4.0]
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        if capture is not None:
            Image.open(capture.scene / "images" / f"{k:03}.png").save(folder / file_name(name))
    content = {"fl_x": 60, "w": 64, "h": 48, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return folder
